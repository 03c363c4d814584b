"""Files that were cut: everything before the cut is read, then an error names the place."""

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Bag1

from tests.transports.recording.samples import SIZE, sample_edges, sample_events, write
from transports.recording import rosbag
from transports.recording.files import OpenRecording, iter_events, read_events
from transports.recording.part import IMU, RecordingError

EVENTS = sample_events(30_000)


def cut(path, size):
    path.write_bytes(path.read_bytes()[:size])


def read_up_to_damage(path):
    """Return the events before the damage, and the text of the error."""
    pieces, text = [EVENTS[:0]], ""
    try:
        pieces.extend(iter_events(path))
    except RecordingError as error:
        text = str(error)
    return np.concatenate(pieces), text


@pytest.fixture(scope="module", params=[None, *Bag1.CompressionFormat])
def bag(request, tmp_path_factory):
    """Return the bytes of a bag of several chunks, compressed or not, and the place of its index."""
    path = tmp_path_factory.mktemp("bag") / "a.bag"

    class Small(Bag1):
        def __init__(self, path):
            super().__init__(path)
            self.chunk_threshold = 30_000
            if request.param is not None:
                self.set_compression(request.param)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rosbag, "Bag1", Small)
        write(path, "ros1", EVENTS, sample_edges(EVENTS))
    content = path.read_bytes()
    return content, int.from_bytes(content[content.index(b"index_pos=") + 10 :][:8], "little")


@pytest.mark.parametrize("share", [0.3, 0.77])
def test_messages_of_a_bag_before_a_cut_are_read(bag, share, tmp_path):
    content, index_at = bag
    path = tmp_path / "a.bag"
    path.write_bytes(content[: int(share * index_at)])
    events, text = read_up_to_damage(path)
    np.testing.assert_array_equal(events, EVENTS[: len(events)])
    assert (share - 0.2) * len(EVENTS) < len(events) < len(EVENTS)
    assert "it is cut or damaged in its record at octet " in text


@pytest.mark.parametrize("change", ["in the index", "before the index", "not closed"])
def test_all_messages_of_a_bag_without_an_index_are_read(bag, change, tmp_path):
    content, index_at = bag
    at = content.index(b"index_pos=") + 10
    changed = {
        "in the index": content[: index_at + 100],
        "before the index": content[:index_at],
        "not closed": content[:at] + bytes(8) + content[at + 8 : index_at],
    }
    path = tmp_path / "a.bag"
    path.write_bytes(changed[change])
    events, text = read_up_to_damage(path)
    np.testing.assert_array_equal(events, EVENTS)
    assert "it is cut or" in text


def test_a_bag_without_a_message_before_its_cut_names_the_cut(bag, tmp_path):
    path = tmp_path / "a.bag"
    path.write_bytes(bag[0][:4400])
    with pytest.raises(RecordingError, match=r"it is cut .* at octet \d+ .*; before that it has no topic of"):
        read_events(path)


@pytest.fixture(scope="module", params=["stored", "compressed", "written", "sequence"])
def archive(request, tmp_path_factory):
    """Return the bytes of an .npz with EVENTS, by numpy, by a run, or as of a data set."""
    path = tmp_path_factory.mktemp("archive") / "a.npz"
    sequence = {f"events/{name}": EVENTS[name] for name in "txy"} | {"events/p": EVENTS["on"].view(np.uint8)}
    match request.param:
        case "stored":
            np.savez(path, events=EVENTS, resets=np.zeros(1, np.int64), size=SIZE)
        case "compressed":
            np.savez_compressed(path, events=EVENTS, resets=np.zeros(1, np.int64), size=SIZE)
        case "written":
            write(path, "npz", EVENTS, sample_edges(EVENTS))
        case "sequence":
            np.savez(path, **sequence)
    return request.param, path.read_bytes()


@pytest.mark.parametrize("share", [0.001, 0.5, 0.97])
def test_events_of_an_archive_before_a_cut_are_read(archive, share, tmp_path):
    name, content = archive
    path = tmp_path / "a.npz"
    path.write_bytes(content[: int(share * len(content))])
    events, text = read_up_to_damage(path)
    np.testing.assert_array_equal(events, EVENTS[: len(events)])
    assert f"it is cut at octet {path.stat().st_size}, in events" in text
    least = (0.3 if share > 0.9 else 0) if name == "sequence" else share - 0.1  # p is the last of its four arrays
    assert least * len(EVENTS) <= len(events) < len(EVENTS)


@pytest.mark.parametrize("left_out", [1, 60, 200])
def test_an_archive_without_its_directory_is_read_to_its_end(archive, left_out, tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(archive[1][:-left_out])
    events, text = read_up_to_damage(path)
    np.testing.assert_array_equal(events, EVENTS)
    assert f"it is cut at octet {path.stat().st_size}, in " in text


def test_streams_beside_the_cut_are_whole(tmp_path):
    """Samples are cut, events and edges before them are there, the size is behind the cut."""
    path = tmp_path / "a.npz"
    edges, samples = sample_edges(EVENTS), np.zeros(1000, IMU)
    samples["t"] = np.arange(1000)
    with path.open("wb") as file:
        np.savez(file, events=EVENTS, edges=edges, imu=samples, size=SIZE)
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"imu.npy") + 4000])
    with OpenRecording(path) as recording:
        assert recording.facts.size is None
        parts = []
        with pytest.raises(RecordingError, match="in imu; where its clock was restarted is behind the cut"):
            parts.extend(recording.parts())
    np.testing.assert_array_equal(np.concatenate([part.events for part in parts]), EVENTS)
    assert sum(len(part.edges) for part in parts) == len(edges)
    assert 50 < sum(len(part.imu) for part in parts) < 100

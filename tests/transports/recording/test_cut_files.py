"""Files that were cut: everything before the cut is read, then an error names the place."""

import h5py
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Bag1

from emulator.cli.app import _main
from firmware_protocol.recordings.part import IMU
from tests.transports.recording.samples import SIZE, sample_edges, sample_events, write
from transports.recording import dsec, rosbag
from transports.recording.files import iter_events, read_events
from transports.recording.format import format_to_read
from transports.recording.part import RecordingError

EVENTS = sample_events(30_000)


def read_up_to_damage(path):
    """Return the events before the damage, and the text of the error; read here where the reader closes its files."""
    pieces, text = [EVENTS[:0]], ""
    try:
        if path.suffix == ".h5":
            pieces.extend(iter_events(path))
        else:
            pieces.extend(part.events for part in format_to_read(path).open_reader(path).parts())
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
    reader, parts = format_to_read(path).open_reader(path), []
    assert reader.facts.size is None
    with pytest.raises(RecordingError, match="in imu; where its clock was restarted is behind the cut"):
        parts.extend(reader.parts())
    np.testing.assert_array_equal(np.concatenate([part.events for part in parts]), EVENTS)
    assert sum(len(part.edges) for part in parts) == len(edges)
    assert 50 < sum(len(part.imu) for part in parts) < 100


@pytest.fixture(scope="module", params=["chunks", "raw chunks", "contiguous", "new lists"])
def hdf5(request, tmp_path_factory):
    """Return the layout of an HDF5 file with EVENTS, and its bytes."""
    path = tmp_path_factory.mktemp("hdf5") / "a.h5"
    events = EVENTS
    if request.param == "chunks":
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(dsec, "_CHUNK", 1 << 10)
            write(path, "dsec", events)
    else:
        options = {"raw chunks": {"chunks": (1000,)}, "new lists": {"chunks": (100,), "compression": "lzf"}}
        version = "latest" if request.param == "new lists" else "earliest"
        with h5py.File(path, "w", libver=version) as file:
            for name, of in zip("pxyt", ("on", "x", "y", "t"), strict=True):
                values = events[of].astype({"p": "u1", "t": "u4"}.get(name, "u2"))
                file.create_dataset(f"events/{name}", data=values, **options.get(request.param, {}))
    return request.param, path.read_bytes()


@pytest.mark.parametrize("share", [0.02, 0.5, 0.85])
def test_events_of_hdf5_before_a_cut_are_read(hdf5, share, tmp_path):
    layout, content = hdf5
    path = tmp_path / "a.h5"
    path.write_bytes(content[: int(share * len(content))])
    events, text = read_up_to_damage(path)
    np.testing.assert_array_equal(events, EVENTS[: len(events)])
    assert f"it is cut at octet {path.stat().st_size} of {len(content)}" in text
    assert len(events) < len(EVENTS)
    if share == 0.85:  # without chunks t comes last
        assert len(events) > 0.5 * len(EVENTS)
    if layout == "chunks" and share == 0.5:
        assert len(events) > 0.3 * len(EVENTS)


def test_commands_name_damage_of_a_file_by_their_exit_code(hdf5, tmp_path, capsys):
    """Without a list of arrays nothing can be read: the file is damaged all the same, and no other option helps."""
    path = tmp_path / "a.h5"
    for size, words in ((200, "no array is known by what is before that; copy the file again"), (-1000, "")):
        path.write_bytes(hdf5[1][:size])
        assert _main(["info", str(path)]) == 1
        assert words in "".join(capsys.readouterr()).replace("\n", " ")

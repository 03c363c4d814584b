"""Recordings written and read back in every format, and what is refused."""

import dataclasses

import numpy as np
import pytest

from firmware_protocol.events import EDGE, EVENT, make_edges
from firmware_protocol.recordings.part import Facts, Part
from tests.made_events import events_at
from tests.transports.recording.samples import SIZE, UNIX_US, sample_edges, sample_events, write
from transports.recording.files import OpenRecording, RecordingFile
from transports.recording.format import FORMATS, format_to_write, with_addition
from transports.recording.part import RecordingError

pytestmark = pytest.mark.system

EVENTS = sample_events()
EDGES = sample_edges(EVENTS)
DATED = {"aedat4", "aedat2", "dsec", "ros1", "ros2"}


def read_all(path, size=None):
    with OpenRecording(path, size) as recording:
        parts = list(recording.parts())
    events = np.concatenate([np.zeros(0, EVENT), *(part.events for part in parts)])
    return recording, events, np.concatenate([np.zeros(0, EDGE), *(part.edges for part in parts)])


def read_until_damage(path):
    got, trouble = [np.zeros(0, EVENT)], ""
    try:
        with OpenRecording(path, SIZE) as recording:
            for part in recording.parts():
                got.append(part.events)
    except RecordingError as error:
        trouble = str(error)
    return np.concatenate(got), trouble


@pytest.mark.parametrize("name", FORMATS)
def test_what_was_written_is_read_back(name, tmp_path):
    form = FORMATS[name]
    path = tmp_path / f"a{form.suffixes[0]}"
    assert format_to_write(path) is form
    file = write(path, name, EVENTS, EDGES)
    assert (file.written["events"], +file.late) == (len(EVENTS), {})
    recording, events, edges = read_all(path, SIZE)
    start = EVENTS["t"][0] if name.endswith("-dvs") else 0  # these know Unix time alone
    events["t"] += start
    np.testing.assert_array_equal(events, EVENTS)
    assert recording.facts.size == SIZE
    if name in DATED:
        assert recording.facts.unix_us == UNIX_US
    if "edges" in form.holds:
        np.testing.assert_array_equal(edges["t"], EDGES["t"])
        np.testing.assert_array_equal(edges["kind"], EDGES["kind"])
    else:
        assert len(edges) == 0


@pytest.mark.usefixtures("forked_readers")
@pytest.mark.long
@pytest.mark.parametrize("name", FORMATS)
def test_a_recording_of_nothing_is_a_recording(name, tmp_path):
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    RecordingFile(path, FORMATS[name], Facts(SIZE)).close()
    assert len(read_all(path, SIZE)[1]) == 0


@pytest.mark.parametrize("name", FORMATS)
def test_a_sensor_beyond_the_format_or_unknown_is_refused(name, tmp_path):
    form = FORMATS[name]
    width, height = form.size_px
    for facts, words in ((Facts((width + 1, height)), "numbers"), (Facts(None), "not known")):
        with pytest.raises(RecordingError, match=words):
            form.open_writer(tmp_path / "a", facts)
    assert list(tmp_path.iterdir()) == []


def test_what_a_file_cannot_hold_is_told(tmp_path):
    cases = [("dat", [5, 1 << 32], "no time beyond 4294 s"), ("aedat4", [5, 4], "goes back in time, from 5 to 4")]
    for name, times, words in cases:
        file = RecordingFile(tmp_path / name, FORMATS[name], Facts(SIZE))
        with pytest.raises(RecordingError, match=words):
            file.write(Part(events_at(times)))
        file.close()
    file = RecordingFile(tmp_path / "c.csv", FORMATS["csv"], Facts(SIZE))
    outside = events_at([1])
    outside["x"] = SIZE[0]
    with pytest.raises(RecordingError, match="outside a sensor of 346 x 260"):
        file.write(Part(outside))
    file.close()


@pytest.mark.long
def test_each_clock_has_a_file_of_its_own(tmp_path):
    file = RecordingFile(tmp_path / "a.dvs.ros2", FORMATS["ros2-dvs"], Facts(SIZE))
    file.restart(10**15)  # nothing was written: the same file
    file.write(Part(events_at([100, 200])))
    file.restart(2 * 10**15)
    file.write(Part(events_at([50])))
    file.close()
    assert [path.name for path in file.paths] == ["a.dvs.ros2", "a-clock2.dvs.ros2"]
    assert [read_all(path)[1]["t"].tolist() for path in file.paths] == [[0, 100], [0]]
    assert [read_all(path)[0].facts.unix_us for path in file.paths] == [10**15 + 100, 2 * 10**15 + 50]


def edge_at(t_us):
    return make_edges(t_us, 2)


@pytest.mark.usefixtures("forked_readers")
@pytest.mark.sampled
@pytest.mark.parametrize(
    ("hold", "behind_us", "is_late"), [(False, 90_000, 0), (False, 110_000, 1), (True, 110_000, 0)]
)
def test_an_edge_that_comes_after_later_events_is_put_in_order_or_counted(hold, behind_us, is_late, tmp_path):
    """A tenth of a second behind the newest event, whatever the pieces; of a file, four packets behind."""
    for pieces in (1, 400):
        file = RecordingFile(tmp_path / "a.raw", FORMATS["evt3"], Facts(SIZE), hold=hold)
        for events in np.array_split(events_at(range(0, 200_001, 10)), pieces):
            file.write(Part(events))
        file.write(Part(edges=edge_at(200_000 - behind_us)))
        for t in range(500_000, 1_000_000, 100_000):
            file.write(Part(events_at([t])))
        file.close()
        if hold and pieces > 4:
            continue
        _, events, read = read_all(tmp_path / "a.raw")
        assert len(events) == 20_006
        assert (read["t"].tolist(), file.late["edges"]) == ([] if is_late else [200_000 - behind_us], is_late)


@pytest.mark.usefixtures("forked_readers")
def test_an_edge_ahead_of_its_events_waits_for_them_however_long(tmp_path):
    """A step of a run may be long: its edges come first."""
    file = RecordingFile(tmp_path / "a.raw", FORMATS["evt3"], Facts(SIZE))
    file.write(Part(edges=np.concatenate([edge_at(t) for t in range(50_000, 1_000_001, 50_000)])))
    for start in range(0, 1_000_000, 1000):
        file.write(Part(events_at(range(start, start + 1000, 100))))
    file.close()
    _, events, read = read_all(tmp_path / "a.raw")
    assert read["t"].tolist() == list(range(50_000, 1_000_001, 50_000))
    assert len(events) == 10_000
    assert +file.late == {}


def test_what_no_event_follows_is_written_when_its_time_is_reached(tmp_path):
    for reach in (True, False):
        file = RecordingFile(tmp_path / "a.raw", FORMATS["evt3"], Facts(SIZE))
        file.write(Part(events_at([5]), edges=edge_at(10)))
        if reach:
            file.reach(120_000)
        assert (file.written["events"], file.written["edges"]) == ((1, 1) if reach else (0, 0))
        file.write(Part(edges=edge_at(15_000_000)))  # nothing waits for more than ten seconds
        assert (file.written["events"], file.written["edges"]) == (1, 1)
        file.close()
        assert file.written["edges"] == 2


@pytest.mark.usefixtures("forked_readers")
@pytest.mark.sampled
@pytest.mark.parametrize("name", [name for name, form in FORMATS.items() if not form.is_folder])
def test_a_file_cut_anywhere_gives_what_came_before_or_a_reason(name, tmp_path):
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    write(path, name, EVENTS[:3000])
    whole = path.read_bytes()
    for share in (0.001, 0.4, 0.999):
        path.write_bytes(whole[: max(1, int(len(whole) * share))])
        events, trouble = read_until_damage(path)
        assert trouble or share == 0.999 or name not in {"aedat4", "npz", "dsec", "ros1", "ros1-dvs"}
        events["t"] += EVENTS["t"][0] if name == "ros1-dvs" and len(events) else 0
        np.testing.assert_array_equal(events[:-1], EVENTS[: max(0, len(events) - 1)])  # CSV may cut a number


@pytest.mark.usefixtures("forked_readers")
@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.aedat4", b"", "is empty"),
        ("a.raw", b"\x89PNG\r\n\x1a\n" * 9, "none of the recordings"),
        ("a.aedat", b"#!AER-DAT3.0\r\n", "it is AEDAT 3.0"),
        ("a.aedat", b"#!AER-DAT2.0\r\n#no size\r\n12345678", "give --size"),
        ("a.aedat4", b"#!AER-DAT4.0\r\n" + b"\xff" * 100, "header is cut"),
        ("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(100), "open file"),
        ("a.bag", b"#ROSBAG V2.0\n" + bytes(100), "field 'op'"),
        ("a.npz", b"PK\x03\x04" + bytes(100), "no sound .npz"),
        ("a.es", b"Event Stream" + bytes(3), "header is cut"),
        ("a.csv", b"t,x,y,on\n1,2,nonsense,1\n", "nonsense"),
    ],
)
def test_foreign_and_damaged_files_are_refused_in_words(name, content, words, tmp_path):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=words) as refused:
        read_all(path)
    assert "Traceback" not in str(refused.value)
    assert 3 < len(str(refused.value)) < 500


def test_folders_and_devices_are_no_recordings(tmp_path):
    with pytest.raises(RecordingError, match="no ROS 2 bag"):
        OpenRecording(tmp_path)
    with pytest.raises(RecordingError, match="no regular file"):
        OpenRecording(tmp_path.joinpath("/dev/null"))


@pytest.mark.parametrize("name", ["dvs", "a", "a.txt", "a.AEDAT4", ".raw"])
def test_a_suffix_that_is_not_written_is_answered_with_those_that_are(name, tmp_path):
    with pytest.raises(RecordingError, match=r"\.aedat4, \.aedat2.*\.npz"):
        format_to_write(tmp_path / name)
    with pytest.raises(RecordingError, match="format 'aedat5' is not known here; did you mean 'aedat4'"):
        format_to_write(tmp_path / name, "aedat5")


def test_a_missing_library_is_told_with_the_command_that_adds_it(tmp_path):
    form = dataclasses.replace(FORMATS["dsec"], writer="not_there_at_all:Writer")
    with pytest.raises(RecordingError, match=r"needs h5py: pip install '\.\[files\]'"):
        form.open_writer(tmp_path / "a.h5", Facts(SIZE))


def test_a_name_with_an_addition_keeps_its_format(tmp_path):
    for form in FORMATS.values():
        for suffix in form.suffixes:
            path = with_addition(tmp_path / f"a.b{suffix}", "usb")
            assert path.name == f"a.b-usb{suffix}"
            assert format_to_write(path) is form
    assert with_addition(tmp_path / "truth.txt", "usb").name == "truth-usb.txt"
    assert with_addition(tmp_path / "truth", "usb").name == "truth-usb"

"""Files of other programs as users have them: times as stored, columns by their names, all before the damage."""

import warnings

import numpy as np
import pytest

from tests.made_events import events_at
from tests.transports.recording.samples import SIZE, sample_events, write
from transports.recording.files import OpenRecording, iter_events, read_events
from transports.recording.format import FORMATS
from transports.recording.part import RecordingError

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("forked_readers")]

DAT = b"% Version 2\n% Height 48\n% Width 64\n\x0c\x08"
BACK = b"t,x@64,y@48,on\n100,1,1,1\n300,2,2,1\n200,3,3,0\n400,4,4,1\n"


def dat(*times):
    return DAT + b"".join(np.array([t, 1 << 28 | 1 << 14 | 1], "<u4").tobytes() for t in times)


def read_until_damage(path, size=None):
    got = []
    try:
        for events in iter_events(path, size=size):
            got += events.tolist()
    except RecordingError as error:
        return got, str(error)
    return got, ""


def aedat4(path, times):
    """Write a file whose second packet goes back in time, which faery's encoder refuses: two files, joined."""
    from firmware_protocol.recordings.aedat4 import Aedat4Head

    packets = b""
    for t in times:
        events = events_at([t])
        write(path, "aedat4", events, unix_us=0)
        content = path.read_bytes()
        head = Aedat4Head(content)
        packets += content[head.packets_at : head.table_at]
    path.write_bytes(head.unfinished() + packets)


@pytest.mark.parametrize("name", ["a.csv", "a.dat", "a.aedat4"])
def test_times_that_go_back_are_refused_at_their_event_and_returned_as_stored(name, tmp_path):
    path, times = tmp_path / name, [100, 300, 200, 400]
    if name == "a.aedat4":
        aedat4(path, times)
    else:
        path.write_bytes(BACK if name == "a.csv" else dat(*times))
    with pytest.raises(RecordingError, match="event 2 goes back in time, from 300 to 200 us"):
        read_events(path)
    assert read_events(path, strict=False)["t"].tolist() == times
    assert [event[0] for event in read_until_damage(path)[0]] == [100, 300]


def test_a_bad_line_loses_no_line_before_it_and_a_column_has_its_name(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"t,x@64,y@48,on\n100,1,1,1\n200,2,2,1\nbad,3,3,0\n400,4,4,1\n")
    got, trouble = read_until_damage(path)
    assert got == [(100, 1, 1, True), (200, 2, 2, True)]
    assert "line 4: 'bad,3,3,0'" in trouble
    path.write_bytes(b"t,y,x,p\n100,10,50,1\n200,11,51,0\n")
    with pytest.warns(UserWarning, match="times are taken as us"):
        events = read_events(path)
    assert events.tolist() == [(100, 50, 10, True), (200, 51, 11, False)]
    with warnings.catch_warnings(action="error"):
        assert read_events(path, columns="t,x,y,p", time_unit="ms")["t"].tolist() == [100_000, 200_000]
    (tmp_path / "a.dat").write_bytes(dat(1))
    with pytest.raises(RecordingError, match="DAT is no table of text: leave --columns"):
        read_events(tmp_path / "a.dat", columns="t,x,y,p")


def test_a_large_table_is_read_in_pieces(tmp_path):
    events = sample_events(200_000)
    write(tmp_path / "a.csv", "csv", events)
    np.testing.assert_array_equal(read_events(tmp_path / "a.csv"), events)
    assert max(map(len, iter_events(tmp_path / "a.csv"))) < 60_000


@pytest.mark.parametrize("name", ["dat", "es", "csv", "aedat4"])
def test_a_cut_record_at_the_end_is_reported_after_all_before_it(name, tmp_path):
    events = sample_events()[:3000]
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    write(path, name, events)
    whole = path.read_bytes()
    cut = len(whole) * 9 // 10 if name == "aedat4" else len(whole) - 3
    path.write_bytes(whole[:cut])
    got, trouble = read_until_damage(path)
    assert got == events[: len(got)].tolist()
    assert len(got) == 2999 if name != "aedat4" else 0 < len(got) < 3000
    assert "octets of a cut record at the end" in trouble or "line 3001" in trouble


def test_a_sequence_of_a_data_set_is_a_recording_and_other_arrays_are_refused(tmp_path):
    path, events = tmp_path / "000000.npz", sample_events(200_000)
    arrays = {f"events/{name}": events["on" if name == "p" else name] for name in "txyp"}
    arrays["events/p"] = arrays["events/p"].astype("u1")
    np.savez_compressed(path, **arrays, **{"pictures/depth": np.zeros((2, *SIZE[::-1]), np.float32)})
    np.testing.assert_array_equal(read_events(path), events)
    with OpenRecording(path) as recording:
        assert recording.facts.size == SIZE
    np.savez(path, **{**arrays, "events/x": events["x"][:5]})
    with pytest.raises(RecordingError, match="not of the same length"):
        read_events(path)
    np.savez(path, **{"a": np.arange(5), "events/t": np.arange(5)})
    with pytest.raises(RecordingError, match=r"only a, events/t: .* lacks events/x, events/y, events/p"):
        read_events(path)

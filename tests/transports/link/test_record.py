"""Records of what was delivered."""

import numpy as np

from firmware_protocol.events import EVENT, empty_events
from transports.recording.part import Part
from transports.recording.record import Recorder, load_record


def test_a_record_holds_device_time_and_where_it_starts_anew(tmp_path):
    path = tmp_path / "run.npz"
    events = np.zeros(6, EVENT)
    events["t"] = [5, 15, 25, 40, 50, 60]
    events["x"] = range(6)
    recorder = Recorder(path)
    recorder.append(Part(events[:2]))
    recorder.append(Part(events[2:3]))
    recorder.append(Part(events[3:]), restarted=True)
    recorder.close()
    read, resets = load_record(path)
    assert read.dtype == EVENT
    assert list(read["t"]) == [5, 15, 25, 40, 50, 60]
    assert list(read["x"]) == [0, 1, 2, 3, 4, 5]
    assert resets == [0, 3]
    assert [p.name for p in tmp_path.iterdir()] == ["run.npz"]


def test_an_empty_record_is_a_record(tmp_path):
    recorder = Recorder(tmp_path / "none.npz")
    recorder.close()
    read, resets = load_record(tmp_path / "none.npz")
    assert np.array_equal(read, empty_events())
    assert resets == []

"""Records of what was delivered."""

import numpy as np

from firmware_protocol.events import EVENT, empty_edges, empty_events
from firmware_protocol.recordings.part import Frame, Part
from tests.made_events import events_at
from tests.npz_records import load_edges
from transports.recording.record import Recorder, load_record


def test_a_record_holds_device_time_and_where_it_starts_anew(tmp_path):
    path = tmp_path / "run.npz"
    events = events_at([5, 15, 25, 40, 50, 60], x=range(6))
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


def test_edges_that_were_heard_late_are_in_the_order_of_time_between_two_restarts(tmp_path):
    recorder = Recorder(tmp_path / "run.npz")
    for k, times in enumerate(([5, 9], [7], [3, 8], [1])):
        edges = empty_edges(len(times))
        edges["t"], edges["seq"] = times, k
        recorder.append(Part(edges=edges), restarted=k in (0, 2))
    recorder.close()
    read, resets = load_edges(tmp_path / "run.npz")
    assert [part["t"].tolist() for part in np.split(read, resets)] == [[], [5, 7, 9], [1, 3, 8]]
    assert read["seq"].tolist() == [0, 1, 0, 3, 2, 2]
    assert recorder.summary.written == {"edges": 6}


def test_frames_of_a_sensor_of_unknown_size_are_counted_as_left_out(tmp_path):
    recorder = Recorder(tmp_path / "run.npz")
    recorder.append(Part(frames=(Frame(1, 1, 2, np.zeros((2, 2), np.uint16)),)))
    assert not recorder.summary.closed
    recorder.close()
    assert (recorder.summary.written, recorder.summary.left_out) == ({}, {"frames": 1})

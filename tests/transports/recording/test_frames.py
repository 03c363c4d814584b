"""Frames in recordings: written to AEDAT4 and read back by faery, and to `.npz`."""

import numpy as np
import pytest

from firmware_protocol.events import empty_events
from firmware_protocol.recordings.part import Facts, Frame, Part
from tests.made_events import events_at
from tests.npz_records import load_frames
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS
from transports.recording.record import Recorder, frame_record

SIZE = (346, 260)
FACTS = Facts(SIZE, "DAVIS346_1", 1_700_000_000_000_000, frozenset({"edges", "frames"}))


def frame(t_us, origin=(0, 0), shape=(260, 346)):
    pixels = np.random.default_rng(t_us).integers(0, 1024, shape, np.uint16)
    return Frame(t_us, t_us, t_us + 4000, pixels, origin)


def events(n=10):
    return events_at(np.arange(n) * 1000)


def test_frames_written_to_aedat4_are_read_by_faery(tmp_path):
    aedat = pytest.importorskip("faery.extension").aedat
    frames = [frame(1000), frame(51_000), frame(90_000, (10, 20), (5, 7))]
    file = RecordingFile(tmp_path / "a.aedat4", FORMATS["aedat4"], FACTS)
    for one in frames:
        file.write(Part(events()[:0], frames=(one,)))
    file.write(Part(events()))
    file.close()
    with aedat.Decoder(tmp_path / "a.aedat4") as packets:
        read = [packet for track, packet in packets if track.data_type == "frame"]
    assert len(read) == 3
    for one, other in zip(read, frames, strict=True):
        times = one.t, one.start_t, one.end_t, one.exposure_start_t, one.exposure_end_t
        begin, end = (FACTS.unix_us + t for t in (other.exposure_begin_us, other.exposure_end_us))
        assert times == (begin, begin, end, begin, end)
        assert (one.offset_x, one.offset_y) == other.origin
        assert (one.pixels == other.pixels >> 2).all()


def test_frames_in_npz_keep_all_bits_and_their_place(tmp_path):
    recorder = Recorder(tmp_path / "a.npz", SIZE)
    frames = (frame(1000), frame(2000, (10, 20), (5, 7)))
    recorder.append(Part(empty_events(), frames=frames[:1]), restarted=True)
    recorder.append(Part(events(), frames=frames[1:]))
    recorder.close()
    read, resets = load_frames(tmp_path / "a.npz")
    assert resets == [0]
    assert read.dtype == frame_record(SIZE)
    assert read["t"].tolist() == [1000, 2000]
    assert (read["pixels"][0] == frames[0].pixels).all()
    assert (read["pixels"][1, 20:25, 10:17] == frames[1].pixels).all()
    assert np.count_nonzero(read["pixels"][1]) <= 35
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_frames_in_npz_are_told_apart_where_time_began_anew(tmp_path):
    recorder = Recorder(tmp_path / "a.npz", SIZE)
    recorder.append(Part(events()), restarted=True)
    recorder.append(Part(events(), frames=(frame(1000), frame(2000))), restarted=True)
    recorder.append(Part(empty_events(), frames=(frame(500),)), restarted=True)
    recorder.close()
    read, resets = load_frames(tmp_path / "a.npz")
    assert [part["t"].tolist() for part in np.split(read, resets)] == [[], [], [1000, 2000], [500]]

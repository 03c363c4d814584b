"""Recordings in the sensor's place: every event once, at its time, whatever the step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.light import LightFrame, SceneError
from emulator.playback.recording import RecordingParameters, load_recording
from emulator.playback.replay import Replay
from emulator.rig.loading import RigError, parse_rig
from emulator.run.assembly import build_sensor
from emulator.sensor.presets import PRESETS
from tests.made_events import scattered
from tests.npz_records import save_record

SENSOR = PRESETS["davis346"]
FILE = "played.npz"  # named, not read
DARK = np.zeros((260, 346), np.float32)


def played(replay, ends_ns):
    replay.reset(LightFrame(0, DARK))
    return np.concatenate([replay.expose(LightFrame(t, DARK)) for t in ends_ns] + [replay.finish()])


@given(st.lists(st.integers(0, 5000), min_size=1, max_size=60), st.lists(st.integers(1, 900), min_size=1, max_size=40))
def test_every_event_comes_once_and_at_its_time(times, steps_us):
    events = scattered(sorted(times))
    events["t"] -= events["t"][0]
    ends = [*np.cumsum(steps_us) * 1000, 6_000_000]
    replay = Replay(SENSOR, events, RecordingParameters(FILE, loop=False))
    np.testing.assert_array_equal(played(replay, sorted(ends)), events)
    assert replay.raised == replay.read_out == len(events)


@given(st.lists(st.integers(100, 3000), min_size=1, max_size=20))
def test_a_loop_does_not_depend_on_the_step(steps_us):
    events = scattered([0, 10, 10, 400, 1000])
    ends = [int(t) for t in np.cumsum([*steps_us, 10]) * 1000]
    by_steps = played(Replay(SENSOR, events, RecordingParameters(FILE)), ends)
    at_once = played(Replay(SENSOR, events, RecordingParameters(FILE)), ends[-1:])
    np.testing.assert_array_equal(by_steps, at_once)
    rounds = ends[-1] // 1_250_000  # one mean gap after the last event
    assert len(at_once) >= 5 * rounds
    assert (np.diff(at_once["t"].astype(np.int64)) >= 0).all()


def test_an_event_at_the_end_of_a_step_belongs_to_it():
    replay = Replay(SENSOR, scattered([0, 7]), RecordingParameters(FILE, loop=False))
    replay.reset(LightFrame(0, DARK))
    assert [len(replay.expose(LightFrame(t, DARK))) for t in (0, 6_999, 7_000)] == [1, 0, 1]


def test_a_time_scale_plays_faster():
    events = scattered([0, 1000, 3001])
    replay = Replay(SENSOR, events, RecordingParameters(FILE, time_scale=2.0, loop=False))
    assert list(played(replay, [10**7])["t"]) == [0, 500, 1500]


def test_the_arbiter_takes_part_where_asked():
    events = scattered([5] * 2000, seed=3)
    events["t"] = 0
    replay = Replay(SENSOR, events, RecordingParameters(FILE, loop=False, through_readout=True))
    out = played(replay, [10**6])
    assert len(out) + replay.lost_at_readout == replay.raised == 2000
    assert int(out["t"][-1]) > 100  # 80 ns an event
    assert replay.read_out == len(out)


def test_recordings_of_evstim_and_of_others(tmp_path):
    faery = pytest.importorskip("faery", reason="the `files` extra is not installed")
    events = scattered(np.arange(100, 1100))
    save_record(tmp_path / "a.npz", np.concatenate([events[:7], events]), [0, 7])
    theirs = events.astype(faery.EVENTS_DTYPE)
    faery.events_stream_from_array(theirs, (346, 260)).to_file(tmp_path / "a.aedat4")
    expected = events.copy()
    expected["t"] -= 100
    for name in ("a.npz", "a.aedat4"):
        np.testing.assert_array_equal(load_recording(tmp_path / name, (346, 260)), expected)


def test_what_cannot_be_played_is_told(tmp_path):
    events = scattered([5, 4, 6])
    save_record(tmp_path / "back.npz", events, [0])
    save_record(tmp_path / "none.npz", events[:0], [0])
    save_record(tmp_path / "wide.npz", scattered([1, 2]), [0])
    (tmp_path / "junk.npz").write_bytes(b"junk")
    (tmp_path / "junk.aedat4").write_bytes(b"junk" * 100)
    for name, size, message in (
        ("back.npz", (346, 260), "event 1 goes back in time, from 5 to 4 us"),
        ("none.npz", (346, 260), "holds no events"),
        ("wide.npz", (2, 2), "outside a sensor of 2 x 2"),
        ("junk.npz", (346, 260), "it is none of the recordings that are read"),
        ("junk.aedat4", (346, 260), "it is none of the recordings that are read"),
        ("gone.aedat4", (346, 260), "No such file"),
    ):
        with pytest.raises(SceneError, match=message):
            load_recording(tmp_path / name, size)


def test_a_rig_plays_a_recording(tmp_path):
    save_record(tmp_path / "a.npz", scattered([7, 8, 9]), [0])
    text = '[scene]\nkind = "recording"\npath = "a.npz"\nloop = false\n'
    rig = parse_rig(text, str(tmp_path / "r.toml"), "r")
    assert list(played(build_sensor(rig, rig.camera.sensor), [10**6])["t"]) == [0, 1, 2]


def test_a_rig_without_a_file_is_refused():
    with pytest.raises(RigError, match="path is missing"):
        parse_rig('[scene]\nkind = "recording"\n', "r.toml", "r")
    with pytest.raises(ValueError, match="time_scale must be"):
        RecordingParameters("a.npz", time_scale=0.0)

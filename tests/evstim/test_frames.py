"""Frames in, events out: against closed forms, and with arguments that are not frames."""

import dataclasses

import numpy as np
import pytest

import evstim
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import PRESETS

PLAIN = {
    "sensor": "ideal", "threshold_on": 0.25, "threshold_off": 0.25, "random_start": True, "dark_current_relative": 1e-6,
}  # fmt: skip


def ramp(n=5, height=4, width=6, step=0.7):
    """Return frames whose log light grows by `step` a frame, the same in all pixels."""
    return np.exp(-3 + step * np.arange(n))[:, None, None] * np.ones((1, height, width))


def test_a_straight_line_in_log_has_its_crossings():
    events = evstim.events_from_frames(ramp(), t_us=10_000 * np.arange(5), **PLAIN)
    one = events[(events["x"] == 3) & (events["y"] == 2)]
    # 2.8 in ln over 40 ms, a threshold each 0.25: 0.25 / 0.07 ms apart; where the first lies is drawn for each pixel.
    assert len(one) in (11, 12)
    assert 11 * 24 <= len(events) <= 12 * 24
    np.testing.assert_allclose(np.diff(one["t"].astype(float)), 250 / 0.07, atol=8)
    assert one["t"][0] <= 250 / 0.07 + 8


@pytest.mark.parametrize("step_us", [200, 40_000])
def test_steps_do_not_change_a_straight_line(step_us):
    coarse = evstim.events_from_frames(ramp(), 10_000 * np.arange(5), step_us=step_us, **PLAIN)
    fine = evstim.events_from_frames(ramp(), 10_000 * np.arange(5), step_us=50, **PLAIN)
    assert len(coarse) == len(fine)
    assert np.abs(coarse["t"].astype(float) - fine["t"]).max() <= 2


def test_levels_of_8_bits_are_decoded():
    levels = np.array([20, 200], np.uint8)[:, None, None] * np.ones((1, 4, 6), np.uint8)
    share = levels / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    times = [0, 30_000]
    sensor = dataclasses.replace(PRESETS["davis346"], noise=NoiseParameters())  # noise follows the last bit of a time
    by_levels = evstim.events_from_frames(levels, times, sensor=sensor, levels="srgb", light_at_white=0.5)
    by_light = evstim.events_from_frames(light.astype(np.float32) * np.float32(0.5), times, sensor=sensor)
    assert len(by_levels)
    assert np.array_equal(by_levels[["x", "y", "on"]], by_light[["x", "y", "on"]])
    linear = evstim.events_from_frames(levels, times, sensor=sensor, levels="linear")
    assert len(linear) < len(by_levels), "linear levels have less contrast"


def test_any_iterable_of_frames_and_the_sensor_s_own_size():
    frames, times = ramp(), 10_000 * np.arange(5)
    whole = evstim.events_from_frames(frames, times, seed=2)
    assert np.array_equal(whole, evstim.events_from_frames(iter(list(frames)), times, seed=2))
    assert whole["x"].max() == 5
    assert whole["y"].max() == 3


def test_black_frames_are_allowed():
    frames = np.zeros((3, 4, 6))
    frames[1] = 1.0
    events = evstim.events_from_frames(frames, [0, 1000, 2000], sensor="ideal")
    assert events["on"].any()
    assert (~events["on"]).any()


@pytest.mark.parametrize(
    ("frames", "times", "options", "message"),
    [
        (ramp(3), [0, 10], {}, "more frames than t_us"),
        (ramp(3), [0, 10, 20, 30], {}, "3 frames and 4 t_us"),
        (ramp(3), [0, 20, 20], {}, r"t_us\[2\] is 20, the one before it 20"),
        (ramp(3), [0, 20, 10], {}, "times must grow"),
        (ramp(3), [-1, 0, 1], {}, "negative"),
        (ramp(3), [[0, 1, 2]], {}, "t_us has the shape"),
        (ramp(0), [], {}, "frames is empty"),
        (np.ones((2, 4, 6, 3)), [0, 10], {}, r"frame 0 has the shape \(4, 6, 3\)"),
        (-ramp(2), [0, 10], {}, "must be 0 or more"),
        (np.full((2, 4, 6), np.nan), [0, 10], {}, "must be finite"),
        ([np.ones((4, 6)), np.ones((6, 4))], [0, 10], {}, r"frame 1 .*\(6, 4\), those before it \(4, 6\).*crop"),
        ([np.ones((4, 6)), np.ones((4, 1))], [0, 10_000], {}, "frame 1 has the shape"),
        ([np.ones((4, 6)), [[1.0], [1.0, 2.0]]], [0, 10], {}, "frame 1 is no array"),
        (ramp(2), [0, 10], {"step_us": 0}, "step_us is 0"),
        (ramp(2), [0, 10], {"levels": "gamma"}, "levels is 'gamma'"),
        (ramp(2), [0, 10], {"light_at_white": 0.0}, "light_at_white is 0"),
        (ramp(2), [0, 10], {"width": 7}, r"frames .*\(4, 6\), the sensor \(4, 7\): leave width and height out"),
    ],
)
def test_arguments_that_do_not_fit_are_named(frames, times, options, message):
    with pytest.raises(ValueError, match=message):
        evstim.events_from_frames(frames, times, **options)


@pytest.mark.parametrize("frames", [ramp(2).astype(complex), np.ones((2, 4, 6), np.int32), np.ones((2, 4, 6), bool)])
def test_frames_of_another_type(frames):
    with pytest.raises(TypeError, match="frame 0 is"):
        evstim.events_from_frames(frames, [0, 10])


def test_floats_are_never_srgb():
    with pytest.raises(TypeError, match='levels = "srgb" is for uint8'):
        evstim.events_from_frames(ramp(2), [0, 10], levels="srgb")


def test_a_video_file_is_its_frames(tmp_path):
    levels = np.array([20, 200, 90], np.uint8)[:, None, None] * np.ones((1, 4, 6), np.uint8)
    np.save(tmp_path / "frames.npy", levels)
    of_file = evstim.events_from_video(tmp_path / "frames.npy", frames_per_s=100.0, seed=5)
    of_frames = evstim.events_from_frames(levels, 10_000 * np.arange(3), levels="srgb", seed=5)
    assert len(of_file)
    assert np.array_equal(of_file, of_frames)
    smaller = evstim.events_from_video(tmp_path / "frames.npy", frames_per_s=100.0, width=3, height=2)
    assert smaller["x"].max() == 2
    with pytest.raises(evstim.SceneError, match="no such file"):
        evstim.events_from_video(tmp_path / "other.npy")
    with pytest.raises(ValueError, match="frames_per_s is 0"):
        evstim.events_from_video(tmp_path / "frames.npy", frames_per_s=0)


def test_the_light_of_white_scales_floats_too():
    frames, times = ramp(), 10_000 * np.arange(5)
    scaled = evstim.events_from_frames(frames, times, light_at_white=0.25)
    assert np.array_equal(scaled, evstim.events_from_frames(0.25 * frames, times))
    assert not np.array_equal(scaled, evstim.events_from_frames(frames, times))


@pytest.mark.parametrize("seed", ["a", 1.5, None])
def test_a_seed_that_is_no_number_is_named(seed):
    with pytest.raises(TypeError, match=rf"seed is {seed!r}: a whole number is needed, 0 to"):
        evstim.events_from_frames(ramp(2), [0, 10], seed=seed)


@pytest.mark.filterwarnings("ignore:t_us holds floats")
@pytest.mark.parametrize("times_s", [np.arange(5) / 30, np.arange(5) / 1e4, np.array([0.0, 0.5])])
def test_times_in_seconds_are_refused_with_what_to_write(times_s):
    """They would be frames within a nanosecond or few, and no event."""
    frames = ramp(len(times_s))
    with pytest.raises(ValueError, match=r"t_us: the frames are .* us apart.*write t_us = np.rint\(1e6 \* times_s"):
        evstim.events_from_frames(frames, times_s)
    assert len(evstim.events_from_frames(frames, np.rint(1e6 * times_s).astype(np.int64), **PLAIN))


@pytest.mark.filterwarnings("ignore:t_us holds floats")
@pytest.mark.parametrize(
    ("times", "message"), [([0, np.nan, 1], "not finite"), ([0, 20, 20.0001], r"t_us\[2\] is 20.0001.*must grow")]
)
def test_floats_that_do_not_fit_are_named(times, message):
    with pytest.raises(ValueError, match=message):
        evstim.events_from_frames(ramp(3), times)


def test_floats_work_for_one_version_with_a_warning():
    with pytest.warns(DeprecationWarning, match="t_us holds floats: give whole microseconds") as warned:
        events = evstim.events_from_frames(ramp(), 1e4 * np.arange(5), **PLAIN)
    assert warned[0].filename == __file__
    assert np.array_equal(events, evstim.events_from_frames(ramp(), 10_000 * np.arange(5), **PLAIN))


@pytest.mark.parametrize("times", [["0", "1"], [0j, 1j], np.array([0, 1], "M8[us]")])
def test_times_of_another_type(times):
    with pytest.raises(TypeError, match=r"t_us is an array of .*: whole microseconds are needed"):
        evstim.events_from_frames(ramp(2), times)


def test_times_that_may_be_seconds_are_warned_of():
    with pytest.warns(UserWarning, match="the frames are 1 us apart, 1e.06 frames a second") as warned:
        evstim.events_from_frames(ramp(), np.arange(5))
    assert warned[0].filename == __file__


def test_integer_frames_need_levels():
    levels = np.full((2, 4, 6), 100, np.uint8)
    with pytest.raises(ValueError, match=r'levels is missing, and frame 0 is uint8: write levels="srgb".*"linear"'):
        evstim.events_from_frames(levels, [0, 10])


def test_floats_as_bright_as_levels_are_warned_of_once():
    frames, times = 255 * ramp() / ramp().max(), 10_000 * np.arange(5)
    with pytest.warns(UserWarning, match=r'frame 1 reaches 31.*uint8 frames and levels="srgb"') as warned:
        by_warning = evstim.events_from_frames(frames, times)
    assert len(warned) == 1
    assert np.array_equal(by_warning, evstim.events_from_frames(frames, times, light_at_white=1.0))
    evstim.events_from_frames(frames, times, light_at_white=1 / 255)

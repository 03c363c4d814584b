"""Frames: brightness, noise and blur against closed forms, the same for any steps, saturation, regions, shutters."""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.frames import FrameSource, frame_times
from emulator.sensor.parameters import FrameParameters
from firmware_protocol.frames import FrameSettings, LineKind

SIZE = (346, 260)
QUIET = FrameParameters(
    electrons_per_dn=0, read_noise_dn=0, column_noise_dn=0, row_noise_dn=0, column_pattern_dn=0, column_fixed_dn=0,
    gain_spread=0,
)  # fmt: skip
ASKED = FrameSettings(True, True, False, 120_000, 4_000_000, 40_000_000, 0, 0, 345, 259)


def numbers(settings):
    return tuple(int(n) for n in dataclasses.astuple(settings))


def frames(parameters, light, settings=ASKED, until_ns=60_000_000, step_ns=1_000_000, seed=1):
    """All lines of a run, and the frames of them as (reset, signal), in the user's picture."""
    source = FrameSource(parameters, seed, SIZE)
    source.reset(LightFrame(0, light(0).astype(np.float32)))
    times = range(step_ns, until_ns + 1, step_ns)
    told = np.concatenate([source.read(LightFrame(t, light(t).astype(np.float32)), numbers(settings)) for t in times])
    return told, [picture(told, a, b, settings) for a, b in ends(told)]


def ends(told):
    return zip(
        np.flatnonzero(told["kind"] == LineKind.START), np.flatnonzero(told["kind"] == LineKind.END), strict=False
    )


def picture(told, start, end, settings):
    part = told[start : end + 1]
    reads = []
    for kind in (LineKind.RESET, LineKind.SIGNAL):
        lines = part[part["kind"] == kind]
        read = lines["samples"][:, : lines["length"][0]].astype(int)
        reads.append(read.T if settings.by_column else read)
    return reads


def flat(value):
    return lambda _: np.full(SIZE[::-1], value)


def brightness(reads):
    return reads[0] - reads[1]


def test_brightness_is_light_times_exposure():
    _, (frame, *_) = frames(QUIET, flat(0.5))
    assert np.unique(brightness(frame)).tolist() == [200]


def test_half_the_exposure_is_half_as_bright():
    _, (frame, *_) = frames(QUIET, flat(0.5), dataclasses.replace(ASKED, exposure_ns=2_000_000))
    assert np.unique(brightness(frame)).tolist() == [100]


def test_too_much_light_saturates_the_signal_read_at_zero():
    _, (frame, *_) = frames(QUIET, flat(5.0))
    assert not frame[1].any()


@pytest.mark.parametrize("by_column", [False, True])
def test_a_picture_keeps_its_place_in_both_layouts(by_column):
    y, x = np.mgrid[:260, :346]
    gradient = (x + 400 * (y % 2)) / 1000
    _, (frame, *_) = frames(QUIET, lambda _: gradient, dataclasses.replace(ASKED, by_column=by_column))
    assert np.abs(brightness(frame) - 400 * gradient).max() <= 0.51


def test_a_region_is_cut_out_of_the_picture_and_read_faster():
    y, x = np.mgrid[:260, :346]
    asked = dataclasses.replace(ASKED, first_column=10, first_row=20, last_column=29, last_row=24)
    _, (frame, *_) = frames(QUIET, lambda _: x / 1000 + y / 700, asked)
    assert brightness(frame).shape == (5, 20)
    assert np.abs(brightness(frame) - 400 * (x / 1000 + y / 700)[20:25, 10:30]).max() <= 0.51
    assert frame_times(0, asked, 35.25).line_ns == round(35_250 * 20 / 346)


def test_global_shutter_exposes_all_lines_at_once_between_the_reads():
    times = frame_times(0, ASKED, 35.25)
    assert set(times.open_ns) == {260 * 35_250}
    assert set(times.shut_ns - times.open_ns) == {4_000_000}
    assert times.end_ns == 2 * 260 * 35_250 + 4_000_000  # 22.33 ms


def test_rolling_shutter_takes_turns_and_no_two_reads_overlap():
    times = frame_times(0, dataclasses.replace(ASKED, global_shutter=False), 35.25)
    assert (np.diff(np.sort(np.concatenate([times.reset_ns, times.signal_ns]))) >= times.line_ns).all()
    assert set(times.shut_ns - times.open_ns) == {57 * 2 * 35_250}  # 4.02 ms


def test_rolling_shutter_sees_a_flash_in_the_lines_exposed_then():
    asked = dataclasses.replace(ASKED, global_shutter=False)
    times = frame_times(0, asked, 35.25)
    _, (frame, *_) = frames(
        QUIET, lambda t: np.full(SIZE[::-1], 1.0 * (10_000_000 <= t <= 10_100_000)), asked, step_ns=100_000
    )
    lit = brightness(frame).max(axis=1) > 0
    expected = (times.open_ns < 10_100_000) & (times.shut_ns > 10_000_000)
    assert abs(lit.astype(int) - expected).sum() <= 4  # light rises and falls in a step of 100 us


def test_frames_follow_each_other_by_the_interval_or_at_once():
    told, _ = frames(QUIET, flat(0.1), until_ns=130_000_000)
    assert told["t"][told["kind"] == LineKind.START].tolist() == [0, 40_000, 80_000, 120_000]
    told, _ = frames(QUIET, flat(0.1), dataclasses.replace(ASKED, interval_ns=0), until_ns=70_000_000)
    assert told["t"][told["kind"] == LineKind.START].tolist() == [0, 22_330, 44_660, 66_990]


@pytest.mark.parametrize("shutter", [True, False])
def test_frames_do_not_depend_on_the_step(shutter):
    asked = dataclasses.replace(ASKED, global_shutter=shutter, interval_ns=0)
    y, x = np.mgrid[:260, :346]

    def light(t):
        return (x + y) / 700 + 0.3e-6 * t / 60

    runs = [frames(FrameParameters(), light, asked, step_ns=step)[0] for step in (100_000, 1_000_000, 6_000_000)]
    # sums of float32 in another order: one sample in tens of thousands is rounded otherwise
    assert (runs[0]["samples"] == runs[1]["samples"]).mean() > 0.9999
    assert np.abs(runs[0]["samples"].astype(int) - runs[2]["samples"]).max() <= 1
    for name in ("t", "kind", "line", "length"):
        assert (runs[0][name] == runs[2][name]).all()


def test_noise_has_the_figures_of_the_parameters():
    p = FrameParameters()
    _, made = frames(p, flat(1.0), dataclasses.replace(ASKED, interval_ns=0), until_ns=900_000_000)
    level = np.array([brightness(one) for one in made])
    assert len(level) == 40
    temporal = level.std(axis=0, ddof=1)
    columns = level.mean(axis=1).std(axis=0, ddof=1).mean()
    expected = np.sqrt(2.0**2 + 400 / 9.5 + 1.7**2 + 0.4**2 + 2 / 12)
    assert np.sqrt((temporal**2).mean()) == pytest.approx(expected, rel=0.02)
    assert columns == pytest.approx(1.7, rel=0.15)
    fixed = level.mean(axis=(0, 1))
    assert (fixed[::2].mean() - fixed[1::2].mean()) / 2 == pytest.approx(8.0, abs=0.6)
    assert level.mean() == pytest.approx(400, abs=1.5)


def test_shot_noise_grows_as_the_square_root_of_the_light():
    p = dataclasses.replace(QUIET, electrons_per_dn=9.5)
    for light in (0.02, 0.2, 2.0):
        _, (frame, *_) = frames(p, flat(light))
        dn = 400 * light
        assert brightness(frame).mean() == pytest.approx(dn, rel=0.01)
        assert brightness(frame).var() == pytest.approx(dn / 9.5 + 1 / 12, rel=0.03)


@pytest.mark.parametrize(("step_ns", "within"), [(100_000, 1), (1_000_000, 3)])
def test_blur_of_an_edge_is_its_closed_form(step_ns, within):
    """An edge that moves at 2 px/ms: straight lines between pictures, 0.7 % of its height with steps of 1 ms."""
    x = np.arange(346)[None, :] + np.zeros((260, 1))

    def light(t):
        return 1 / (1 + np.exp((x - 100 - 2e-6 * t) / 1.5))

    def integral(t):
        return np.log1p(np.exp(-(x[:2] - 100 - 2e-6 * t) / 1.5)) * 1.5 / 2

    asked = dataclasses.replace(ASKED, first_row=100, last_row=101)
    frame = frames(QUIET, light, asked, 8_000_000, step_ns)[1][0]
    opened = frame_times(0, asked, 35.25).open_ns[0]
    expected = 100 * (integral(opened + 4_000_000) - integral(opened))
    assert np.abs(brightness(frame) - expected).max() <= within


def test_switching_frames_off_ends_one_and_on_begins_another():
    source = FrameSource(QUIET, 1, SIZE)
    light = np.full(SIZE[::-1], 0.5, np.float32)
    source.reset(LightFrame(0, light))
    assert len(source.read(LightFrame(3_000_000, light), ())) == 0
    assert source.read(LightFrame(9_000_000, light), numbers(ASKED))["t"].tolist() == [9_000]
    assert len(source.read(LightFrame(10_000_000, light), numbers(dataclasses.replace(ASKED, run=False)))) == 0
    assert source.read(LightFrame(20_000_000, light), numbers(ASKED))["t"].tolist() == [20_000]
    later = source.read(LightFrame(50_000_000, light), numbers(ASKED))
    assert set(np.unique(later[later["kind"] == LineKind.SIGNAL]["samples"])) == {700}

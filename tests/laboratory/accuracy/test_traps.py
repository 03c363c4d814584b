"""The traps of event simulators: for each, a rule that falls into it, shown falling, and our kernel beside it, not.

Rules that are nobody's method any more, or only a part of one, are written here; the others are those of
`laboratory.methods.other_simulators`.
"""

import math

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import Field, draw
from laboratory.accuracy.harness import Case, Method, events, methods, score, truth
from laboratory.accuracy.scenes import BlurredCheckerboard, Dark, Flash, SineGrating, SlowRamp
from laboratory.accuracy.scores import Stream, compare
from laboratory.accuracy.stability import SWEEPS, cells
from laboratory.methods.other_simulators import (
    OTHER_SIMULATORS,
    Esim,
    Fired,
    FrameDifference,
    Sikorski,
    V2e,
    V2eExactFilter,
)
from tests.laboratory.accuracy.rows import row

OURS = methods()[0]
MS = 1_000_000


def of(rule):
    return Method(rule.__name__, rule)


def without_filter(pixels, **changes):
    """A corner so high that the filter does not show, and equal pixels without leak."""
    plain = {"mismatch": 0.0, "leak_hz": 0.0, "corner_hz_at_reference": 2e3, "corner_min_hz": 2e3}
    return row(pixels, **(plain | {"corner_max_hz": 2e3} | changes))


def counts(method, case, step_s):
    return events(method, case, step_s)[0].counts


# --- comparisons


class StrictWithLeak(Esim):
    """OpenEB's comparison: a level must lie strictly beyond the line's start, and leak moves the level behind it."""

    def _fire(self, frame):
        self._r = self._r - self._drawn.leak * frame.h_s
        return super()._fire(frame)


def test_leak_under_a_strict_comparison_never_fires_and_deafens():
    p = without_filter(20, leak_hz=2.0)
    case = Case("still", SlowRamp(pixels=20, slowest=0.0, fastest=0.0, level=1.0), p, 3.0, fine_s=1e-4)
    assert counts(of(StrictWithLeak), case, 1e-3).sum() == 0
    assert counts(OURS, case, 1e-3).sum() == len(truth(case)) > 100

    strict, ours = StrictWithLeak(p, 3), PixelArray(p, 3)
    heard = []
    for array in (strict, ours):
        light = np.ones((1, 20), np.float32)
        array.reset(LightFrame(0, light))
        for k in range(1, 1001):
            array.step(LightFrame(k * MS, light))
        heard.append(len(array.step(LightFrame(1001 * MS, light * np.float32(1.8)))))
    assert heard[0] == 0, "a level passed by leak is behind every line's start from then on"
    assert heard[1] > 20


def test_creeping_light_under_a_tolerance_is_never_seen():
    """ESIM leaves out changes below 1e-6 but remembers the new value: slow enough light never fires."""
    p = without_filter(1, threshold_on=4e-4, threshold_off=4e-4)
    creep = np.float64(8e-7)
    found = {}
    for rule in (Esim, Sikorski, PixelArray):
        array = rule(p, 3)
        array.reset(LightFrame(0, np.array([[1.0]], np.float32)))
        found[rule] = sum(
            len(array.step(LightFrame(k * MS, np.array([[math.exp(creep * k)]], np.float32)))) for k in range(1, 4001)
        )
    assert found[Esim] <= 1
    assert found[Sikorski] == found[PixelArray] == 8


def test_a_signal_that_comes_back_fires_as_often_down_as_up_and_rests_in_between():
    """Levels are those stored, never recomputed from counts: what went up by n events comes down by n."""
    p = without_filter(20)
    ours, on, off = PixelArray(p, 3), 0, 0
    ours.reset(LightFrame(0, np.ones((1, 20), np.float32)))
    t_ns = 0
    for k in range(60):
        light = np.full((1, 20), 1.0 if k % 2 else 1.9, np.float32)
        for t_ms in (1, 5):
            moved = ours.step(LightFrame(t_ns + t_ms * MS, light))
            on, off = on + int(moved.on.sum()), off + int((~moved.on).sum())
        rest = ours.step(LightFrame(t_ns + 6 * MS, light))
        assert len(rest) == 0
        t_ns += 6 * MS
    # Each pixel comes down to within a threshold of where it started.
    assert 0 <= on - off <= 20
    assert off >= 20 * 30 * 2


def test_thresholds_drawn_anew_kill_pixels():
    """Fifty thresholds of a ramp: a crossing missed by a high draw can never be met again, the worse the finer."""
    p = without_filter(40, mismatch=0.05)
    case = Case("ramp", SlowRamp(pixels=40, slowest=25.0, fastest=25.0, level=1e-2), p, 0.4)

    def redrawn(parameters, seed):
        return Esim(parameters, seed, redraw=True)

    expected = truth(case).counts
    assert expected.min() >= 40
    coarse, fine = (np.median(counts(Method("redrawn", redrawn), case, step_s)) for step_s in (2e-3, 2e-4))
    assert fine < coarse
    assert fine < 12
    for method in (of(Esim), of(Sikorski), OURS):
        assert np.abs(counts(method, case, 1e-3) - expected).max() <= 1


# --- leak


class InStep(V2e):
    """Leak without a phase of each pixel's own."""

    def reset(self, frame):
        super().reset(frame)
        self._r = self._u.copy()


def test_leak_without_phases_fires_all_pixels_at_once():
    p = row(60, leak_hz=2.0, leak_spread=0.0, mismatch=0.0)
    case = Case("dark", Dark(pixels=60), p, 2.0, fine_s=1e-4)
    in_step, _ = events(of(InStep), case, 1e-3)
    ours, _ = events(OURS, case, 1e-3)
    assert np.unique(in_step.t_us).size <= 4
    assert compare(in_step, truth(case)).same_time == 1
    assert compare(ours, truth(case)).same_time < 0.1


class FloatReference(V2e):
    """Leak taken off a float32 reference in every step."""

    def _fire(self, frame):
        self._r = self._r.astype(np.float32).astype(np.float64)
        return super()._fire(frame)


def test_leak_off_a_float32_reference_in_every_step_gets_the_rate_wrong():
    """A step's leak, 2e-6, is rounded to the spacing of float32 there, 5e-7; ours writes references at events only."""
    p, steps, h_ns = row(20), 3000, 100_000
    light = np.full((1, 20), 1e-3, np.float32)
    rule, ours = FloatReference(p, 3), PixelArray(p, 3)
    for array in (rule, ours):
        array.reset(LightFrame(0, light))
    began, stored, silent = rule._r.copy(), ours.field(Field.REFERENCE)[0], np.ones(20, np.bool_)
    for k in range(1, steps + 1):
        rule.step(LightFrame(k * h_ns, light))
        silent[ours.step(LightFrame(k * h_ns, light)).pixel] = False
    leaked = (began - rule._r)[silent] / (draw(p, 3).leak[silent] * steps * h_ns * 1e-9)
    assert silent.sum() > 10
    assert np.abs(leaked - 1).max() > 0.05
    np.testing.assert_array_equal(ours.field(Field.REFERENCE)[0][silent], stored[silent])


# --- filters


class Euler(V2e):
    """The mixing factor without its clamp."""

    def _mixing(self, rate, h_s):
        return rate * h_s


class Bilinear(V2e):
    """The bilinear transform: rings beyond two time constants a step."""

    def _fire(self, frame):
        x = self._rate(frame.u1) * frame.h_s
        self._v = ((2 - x) * self._v + x * (frame.u0 + frame.u1)) / (2 + x)
        return super()._fire(frame)

    def _mixing(self, rate, h_s):
        return 0 * rate


def fixed_corner(dt_over_tau, step_s, pixels=30):
    hz = dt_over_tau / (2 * math.pi * step_s)
    return row(pixels, corner_hz_at_reference=hz, corner_min_hz=hz, corner_max_hz=hz)


def test_euler_beyond_two_time_constants_invents_events():
    case = Case("flash", Flash(pixels=30, dark=0.3), fixed_corner(2.05, 1e-3), 0.1)
    invented = score(of(Euler), case, 1e-3)
    assert invented.count > 10
    assert score(OURS, case, 1e-3).right >= 0.97


def test_the_bilinear_transform_beyond_two_time_constants_rings():
    case = Case("flash", Flash(pixels=30, dark=0.3), fixed_corner(20.0, 1e-3), 0.1)
    ringing = score(of(Bilinear), case, 1e-3)
    assert ringing.count > 1.05
    assert ringing.right < 0.6
    assert score(of(V2e), case, 1e-3).right == 1, "it is the filter that rings, not the slots"
    assert score(OURS, case, 1e-3).right >= 0.97


def test_a_clamped_filter_turns_itself_off():
    """Behind a ramp in log light the filter lags by tau; with a step of two tau the clamped one does not lag at all."""
    p, slope, tau_s = fixed_corner(2.0, 1e-3, 4), 20.0, 5e-4
    lag_s = {}
    for rule in (V2e, V2eExactFilter, PixelArray):
        array = rule(p, 3)
        for k in range(40):
            light = np.full((1, 4), np.exp(slope * k * 1e-3) - p.dark_current_relative, np.float32)
            array.reset(LightFrame(0, light)) if k == 0 else array.step(LightFrame(k * MS, light))
        filtered = array.field(Field.FILTERED)[0] if rule is PixelArray else array._v
        lag_s[rule] = (slope * 0.039 - filtered[0]) / slope
    assert lag_s[V2e] == pytest.approx(0, abs=1e-6)
    assert lag_s[V2eExactFilter] < 0.5 * tau_s
    assert lag_s[PixelArray] == pytest.approx(tau_s, rel=0.01)


# --- time


def test_time_in_float32_seconds_has_no_room_for_events():
    case = Case("sine", SineGrating(pixels=20), row(20), 0.1)
    stream, _ = events(OURS, case, 5e-4)
    hour_s = 3600.0
    rounded = (np.float32(hour_s + stream.t_us * 1e-6).astype(np.float64) - hour_s) * 1e6
    coarse = Stream.of(rounded, stream.pixel, stream.on, stream.pixels)
    assert compare(coarse, truth(case)).t95_us > 100
    later = Case("sine", case.scene, case.parameters, 0.1, start_ns=round(hour_s * 24 * 1e9))
    assert compare(events(OURS, later, 5e-4)[0], truth(case)).t95_us < 20


class AtTheEnd(V2eExactFilter):
    """All events of a step get its end as their time."""

    def _fire(self, frame):
        fired = super()._fire(frame)
        return Fired(fired.pixel, np.ones_like(fired.share), fired.on)


def test_timestamps_at_the_end_of_the_step_are_batched():
    case = Case("sine", SineGrating(pixels=60), row(60), 0.1)
    batched, ours = score(of(AtTheEnd), case, 2e-3), score(OURS, case, 2e-3)
    assert batched.same_time > 0.99
    assert ours.same_time < 0.01
    assert batched.t50_us > 5 * ours.t50_us


# --- counting


class OneAtMost(V2eExactFilter):
    """At most one event of a pixel in a step, the rest forgotten."""

    def _fire(self, frame):
        fired = super()._fire(frame)
        last = np.append(np.diff(fired.pixel) != 0, True) if fired.pixel.size else np.empty(0, np.bool_)
        return Fired(fired.pixel[last], fired.share[last], fired.on[last])


def test_one_event_of_a_pixel_in_a_step_at_most_loses_counts():
    case = Case("board", BlurredCheckerboard(pixels=40), row(40), 0.2)
    assert score(of(OneAtMost), case, 5e-3).count < 0.6
    assert score(OURS, case, 5e-3).count == pytest.approx(1, abs=0.01)


def test_a_memoryless_difference_of_pictures_never_sees_slow_light():
    case = Case("ramp", SlowRamp(pixels=20, slowest=0.1, fastest=0.4), without_filter(20), 3.0, fine_s=1e-4)
    assert counts(of(FrameDifference), case, 1e-3).sum() == 0
    assert (counts(OURS, case, 1e-3) == truth(case).counts).all()
    assert truth(case).counts.min() >= 1


def test_deferred_events_multiply():
    """Deferring instead of reading the level anew is the largest single error in common use, at any step."""
    board = BlurredCheckerboard(pixels=30)
    case = Case("board", board, row(30, refractory_us=5000.0), 0.3)
    for step_s in (5e-4, 2e-3):
        assert score(of(V2e), case, step_s).count > 2
        assert score(OURS, case, step_s).count == pytest.approx(1, abs=0.01)


# --- light


@pytest.mark.parametrize("dark_current", [1e-2, 1e-4, 1e-7])
def test_the_dark_current_and_nothing_else_sets_the_count_from_black_to_white(dark_current):
    p = without_filter(4, dark_current_relative=dark_current)
    expected = math.log((1 + dark_current) / dark_current) / 0.2
    assert expected < 1000
    for method in methods():
        if method.name == "frame_difference":
            continue
        array = method.make(p, 3)
        array.reset(LightFrame(0, np.zeros((1, 4), np.float32)))
        crossings = array.step(LightFrame(MS, np.ones((1, 4), np.float32)))
        total = len(crossings) + crossings.lost_in_pixel
        total += len(array.step(LightFrame(2 * MS, np.ones((1, 4), np.float32))))
        assert total / 4 == pytest.approx(expected, abs=1)


@pytest.mark.parametrize("name", ["ours", *OTHER_SIMULATORS])
def test_an_all_black_picture_is_no_trouble(name):
    array = (PixelArray if name == "ours" else OTHER_SIMULATORS[name])(row(9, leak_hz=0.0), 3)
    black = np.zeros((1, 9), np.float32)
    array.reset(LightFrame(0, black))
    assert sum(len(array.step(LightFrame(k * MS, black))) for k in range(1, 20)) == 0
    assert array.quiet_nan == 0


@pytest.mark.system
def test_eight_bits_undo_what_exact_times_gain():
    sweep = next(s for s in SWEEPS if s.axis == "bit_depth")
    one = next(cells([sweep], [OURS]))
    eight = next(c for c in cells([type(sweep)(**{**vars(sweep), "values": (8.0,)})], [OURS]))
    assert one.value == 0
    assert eight.t95_steps > 50 * one.t95_steps

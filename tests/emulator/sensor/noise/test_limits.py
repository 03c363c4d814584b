"""Noise where it is tiny, huge, or meets light that jumps, is no number or goes past all: bounded, counted, silent.

Without noise the crossings are known (`pixels/test_accuracy.py`), and small noise moves them by little.
"""

import dataclasses
import math
import time

import numpy as np
import pytest

from emulator.sensor.parameters import ComparatorParameters, NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.passages.rounds import MOST_PASSAGES
from emulator.sensor.pixels.state import Field
from emulator.sensor.presets import PRESETS
from tests.emulator.sensor.noise.noisy_arrays import (
    MS,
    begun,
    ends,
    events_of,
    frame,
    one_pole,
    ramp,
    run,
    sine,
    still,
    two_poles,
    without,
)

SMALL = {"width": 16, "height": 12}
SENSORS = {name: dataclasses.replace(PRESETS[name], **SMALL, leak_spread=0.0) for name in ("imx636", "davis346")}
LOUD = two_poles(2.0, 52.6e-6, 84e-6)


def with_rms(p, rms):
    return dataclasses.replace(p, noise=NoiseParameters(rms=rms, corner_hz=1000.0))


def by_pixel(found):
    return found.rows()[np.lexsort((found.t_ns, found.pixel))]


@pytest.mark.parametrize("rms", [1e-5, 1e-7, 1e-12])
@pytest.mark.parametrize("name", SENSORS)
def test_tiny_noise_moves_the_events_by_little(name, rms):
    """By some rms over the signal's speed, which is 5 ln units a second and more here, and by the kernels' float32."""
    light = sine(1.3, 5.0, 1.0)
    steps = ends(2, 60)
    free, noisy = (by_pixel(events_of(with_rms(SENSORS[name], one), light, steps)) for one in (0.0, rms))
    assert len(free) == len(noisy) > 500
    assert np.array_equal(free["f1"], noisy["f1"])
    assert np.array_equal(free["f2"], noisy["f2"])
    assert np.abs(free["f0"] - noisy["f0"]).max() < 6 * rms / 5 * 1e9 + 6000


@pytest.mark.parametrize("p", [one_pole(1e4, 1e-3, refractory_us=100.0), two_poles(1e4, 1e-3, 1e-4)])
def test_small_noise_scatters_events_by_its_rms_over_the_speed(p):
    speed = 3.0
    found, free = (by_pixel(events_of(one, ramp(speed), ends(20, 200))) for one in (p, without(p)))
    late_s = (found["f0"] - free["f0"]) * 1e-9 * speed * 1e4 / 0.223
    assert late_s.std() < 6
    assert abs(np.median(late_s)) < 6
    assert late_s.std() > 0.3


@pytest.mark.parametrize("factor", [math.exp(1.05), math.exp(-1.05)])
@pytest.mark.parametrize("name", SENSORS)
def test_a_jump_of_light_has_its_events(name, factor):
    counts = []
    for rms in (0.0, 1e-3):
        p = with_rms(SENSORS[name], rms)
        array = begun(p, still(0.5))
        run(array, still(0.5), [MS])
        array.step(frame(p, still(0.5 * factor), MS))
        found = run(array, still(0.5 * factor), ends(2, 41, 1))
        assert np.all(found.on == (factor > 1))
        counts.append(len(found.t_ns))
    assert counts[1] == pytest.approx(counts[0], rel=0.03)
    assert counts[0] > 300


def test_a_jump_without_low_pass_fires_each_pixel_at_once():
    """With a dead time: the reference is read at its end, on the new light. Steps do not matter."""
    found = []
    for step_ms in (0.01, 1, 40):
        p = one_pole(20.0, 1e-3, random_start=False)
        array = begun(p, still())
        array.step(frame(p, still(), MS))
        array.step(frame(p, still(4.0), MS))
        found.append(run(array, still(4.0), ends(step_ms, 41, 1)).rows())
        assert np.array_equal(np.sort(found[-1]["f1"]), np.arange(192))
        assert found[-1]["f0"].max() < MS + 2000
        assert found[-1]["f2"].all()
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])


def test_a_jump_without_low_pass_and_dead_time_passes_all_thresholds():
    p = one_pole(100.0, 1e-3, random_start=False, refractory_us=0.0)
    counts = []
    for one in (p, without(p)):
        array = begun(one, still())
        array.step(frame(one, still(math.exp(5.3 * 0.223)), 0))
        found = run(array, still(math.exp(5.3 * 0.223)), [MS])
        counts.append(len(found.t_ns) + array.lost_in_pixel)
    assert counts == [5 * 192, 5 * 192]


@pytest.mark.parametrize("level", [np.nan, np.inf, -1.0, 0.0])
def test_light_that_is_no_number_is_silent_and_light_below_zero_dark(level):
    p = dataclasses.replace(SENSORS["imx636"], noise=NoiseParameters(rms=0.1, corner_hz=1900.0))
    lights = np.full((12, 16), 1.0)
    lights[:6] = level
    array = begun(p, still(lights))
    found = run(array, still(lights), ends(10, 500))
    dark = found.pixel < 96
    if math.isfinite(level):
        lit = still(np.where(lights > 0, lights, 0.0))
        zero = run(begun(p, lit), lit, ends(10, 500))
        assert np.array_equal(found.rows(), zero.rows())
        assert dark.any()
    else:
        assert array.quiet_nan == 50 * 96
        assert not dark.any()
    assert np.count_nonzero(~dark) > 1000


def test_a_pixel_whose_light_comes_back_goes_on():
    array, parts = begun(LOUD, still()), []
    for k in range(1, 151):
        parts.append(run(array, still(np.nan if k % 3 == 0 else 1.0), [k * MS]))
    t_ns = np.concatenate([part.t_ns for part in parts])
    assert np.all(t_ns[t_ns >= MS] // MS % 3 == 1)  # steps whose light is a number at both ends
    assert len(t_ns) > 2000


def test_dead_pixels_are_silent_and_cost_next_to_nothing():
    array = PixelArray(LOUD, 1)
    array.kill(np.arange(96))
    array.reset(frame(LOUD, still(), 0))
    found = run(array, still(), [50 * MS])
    assert found.pixel.min() >= 96
    array.kill(np.arange(192))
    run(array, still(), ends(10, 100, 50))
    before = array.candidates
    assert len(run(array, still(), ends(10, 200, 100)).t_ns) == 0
    assert array.candidates - before < 0.02 * 10 * 192


@pytest.mark.parametrize("light", [1e8, 1e10, 1e12])
def test_parasitic_leak_of_very_bright_light_is_listed_or_counted(light):
    """As without noise: 64 events a pixel and step are listed there, the others counted."""
    p = dataclasses.replace(SENSORS["davis346"], width=4, height=1, leak_hz=0.0)
    sums = []
    for one in (p, without(p)):
        array = begun(one, still(light))
        found = run(array, still(light), ends(10, 30))
        assert len(found.t_ns) <= 3 * 4 * MOST_PASSAGES
        sums.append(len(found.t_ns) + array.lost_in_pixel)
    assert sums[0] == pytest.approx(sums[1], rel=0.05)


def test_a_leak_of_the_highest_rate_is_counted():
    p = dataclasses.replace(SENSORS["imx636"], leak_hz=1e4, mismatch=0.0)
    array = begun(p, still())
    found = run(array, still(), [400 * MS])
    assert len(found.t_ns) == 192 * MOST_PASSAGES
    interval_s = 1e-4 + p.refractory_us * 1e-6
    assert len(found.t_ns) + array.lost_in_pixel == pytest.approx(192 * 0.4 / interval_s, rel=0.05)


def test_events_beyond_the_most_of_a_step_are_counted_about():
    finer = events_of(LOUD, still(), ends(100, 2000))
    array = begun(LOUD, still())
    found = run(array, still(), [2000 * MS])
    assert len(found.t_ns) == 192 * MOST_PASSAGES
    assert len(found.t_ns) + array.lost_in_pixel == pytest.approx(len(finer.t_ns), rel=0.1)


@pytest.mark.parametrize("speed", [1e4, 1e7, 1e9])
@pytest.mark.parametrize("name", ["imx636", "davis346"])
def test_light_that_passes_any_number_of_thresholds_ends_in_bounded_time(name, speed):
    """In a second, where it would take minutes to follow it nanosecond by nanosecond."""
    p = dataclasses.replace(SENSORS[name], width=4, height=2, parasitic_hz_at_reference=0.0)
    span_ns = max(round(60 / speed / 10 * 1e9), 1)
    light = ramp(speed, 1e-12)
    begun_s = time.process_time()
    found = events_of(p, light, [k * span_ns for k in range(1, 11)])
    assert time.process_time() - begun_s < 60
    assert found.on.all()
    assert len(found.t_ns) <= 8 * 10 * MOST_PASSAGES


@pytest.mark.parametrize(("changes", "rms", "corner_hz"), [
    ({"corner_max_hz": 1e6, "corner_hz_at_reference": 1e6, "refractory_us": 0.0}, 1.0, 1e6),
    ({"threshold_on": 1e-4, "threshold_off": 1e-4, "refractory_us": 0.0}, 0.045, 1900.0),
    ({"threshold_on": 100.0, "threshold_off": 100.0}, 1.0, 1.0),
    ({"corner_hz_at_reference": 1e-3, "corner_min_hz": 1e-6}, 0.2, 1e6),
    ({"comparator": ComparatorParameters(on_us=50.0, off_us=400.0)}, 0.1, 1900.0),
])  # fmt: skip
def test_any_noise_that_a_rig_may_ask_for_ends(changes, rms, corner_hz):
    noise = NoiseParameters(rms=rms, corner_hz=corner_hz, spread=1.0)
    p = dataclasses.replace(SENSORS["imx636"], **changes, noise=noise)
    found = events_of(p, sine(0.5, 20.0), ends(5, 20))
    assert np.all((found.t_ns >= 0) & (found.t_ns < 20 * MS))
    assert np.all(np.diff(found.t_ns) >= 0)
    assert len(found.t_ns) <= 4 * 192 * MOST_PASSAGES


def test_a_dead_time_follows_each_event():
    for dead_us in (20.0, 700.0):
        p = dataclasses.replace(LOUD, refractory_us=dead_us)
        rows = by_pixel(events_of(p, still(), ends(10, 100)))
        waits_ns = np.diff(rows["f0"])[np.diff(rows["f1"]) == 0]
        assert waits_ns.min() >= dead_us * 1000
        assert waits_ns.size > 3000


def test_a_slow_comparator_is_late_by_its_law_and_changes_no_order_of_a_pixel():
    p = dataclasses.replace(LOUD, comparator=ComparatorParameters(on_us=30.0, off_us=300.0))
    rows = by_pixel(events_of(p, still(), ends(10, 200)))
    plain = by_pixel(events_of(LOUD, still(), ends(10, 200)))
    assert len(rows) < 0.8 * len(plain)
    first = [np.unique(one["f1"], return_index=True)[1] for one in (rows, plain)]
    assert np.array_equal(rows["f2"][first[0]], plain["f2"][first[1]])
    late_us = (rows["f0"][first[0]] - plain["f0"][first[1]]) * 1e-3
    on = rows["f2"][first[0]]
    assert np.all(late_us > 0)
    assert np.median(late_us[~on]) > 3 * np.median(late_us[on])


def test_light_that_falls_fast_beside_a_slow_receptor_takes_few_substeps():
    """A star leaves a pixel of a chip with a time constant of a second: a step costs less than forty short ones."""
    p = dataclasses.replace(SENSORS["imx636"], width=64, height=64, dark_current_relative=2e-5, corner_min_hz=0.04)

    def leaving(t_s):
        """Log photocurrent falls by 1.6 within 80 ms along a cubic, as any step has it."""
        x = t_s / 0.08
        current = 1.2e-4 * math.exp(-1.6 * x * x * (3 - 2 * x))
        return current - 2e-5, current * -1.6 * 6 * x * (1 - x) / 0.08

    fine, coarse = begun(p, leaving), begun(p, leaving)
    spent_s = []
    for array, step_ms in ((fine, 1), (coarse, 40)):
        run(array, leaving, ends(step_ms, 40))
        begun_s = time.process_time()
        run(array, leaving, ends(step_ms, 80, 40))
        spent_s.append(time.process_time() - begun_s)
    assert spent_s[1] < spent_s[0]
    assert np.abs(fine.field(Field.FILTERED) - coarse.field(Field.FILTERED)).max() < 0.004 * 0.223


@pytest.mark.parametrize("level", [0.0, 1.0])
@pytest.mark.parametrize("name", SENSORS)
def test_few_pixels_in_still_light_have_no_certificate(name, level):
    """In the dark the poles act as one, in light they do not; most of the block lies beyond the end of the array."""
    array = begun(SENSORS[name], still(level))
    found = run(array, still(level), ends(10, 500))
    assert array.candidates < 0.1 * 50 * 512 + 3 * len(found.t_ns)


def test_few_pixels_in_still_light_are_solved():
    """In the dark noise forgets a reset within half a second; settled pixels rest until close to their event."""
    array = begun(dataclasses.replace(PRESETS["imx636"], width=160, height=100), still(0.0))
    found = run(array, still(0.0), ends(1, 500))
    assert len(found.t_ns) > 300
    assert array.candidates < 0.02 * 500 * 16_000


def test_parasitic_leak_does_not_move_a_pixel_at_rest():
    """In the dark it is too slow to matter: certificates are as long as without it."""
    cold = dataclasses.replace(PRESETS["davis346"], width=64, height=64, dark_current_relative=2e-5)
    few, none = (
        run(begun(p, still(0.0)), still(0.0), ends(20, 10_000)).array.candidates  # longer than a certificate
        for p in (cold, dataclasses.replace(cold, parasitic_hz_at_reference=0.0))
    )
    assert cold.parasitic_hz_at_reference > 0
    assert 4096 < few < 1.1 * none

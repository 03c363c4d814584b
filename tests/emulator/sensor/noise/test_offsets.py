"""Noise of grade "offsets" beside the Monte Carlo of the full law, see `test_still_light` and `test_motion`.

It leaves out bursts, so the bounds are wider: they are what docs/physics.md states.
"""

import copy
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from tests.emulator.sensor.noise.noisy_arrays import (
    MS,
    THRESHOLD,
    begun,
    ends,
    events_of,
    frame,
    one_pole,
    ramp,
    run,
    set_thresholds,
    sine,
    statistics_of,
    still,
    two_poles,
)
from tests.emulator.sensor.noise.test_motion import PHASES, PIXELS, RAMPS, SINES
from tests.emulator.sensor.noise.test_still_light import ONE_POLE, TWO_POLES

Z = 3.9


def offsets(p, **changes):
    return dataclasses.replace(p, noise=dataclasses.replace(p.noise, grade="offsets"), **changes)


IMX = offsets(PRESETS["imx636"], width=24, height=16)
LOUD = dataclasses.replace(IMX, noise=dataclasses.replace(IMX.noise, rms=0.09))
SENSORS = {
    "two poles": LOUD,
    "one pole": offsets(one_pole(3.0, 1e-3, leak_hz=20.0, random_start=True)),
    "leak by light": dataclasses.replace(LOUD, parasitic_hz_at_reference=5.0),
    "no dead time": dataclasses.replace(LOUD, refractory_us=0.0),
    "long dead time": dataclasses.replace(LOUD, refractory_us=30_000.0),
    "high-pass": dataclasses.replace(LOUD, highpass_hz=20.0),
}


@pytest.mark.parametrize("case", SINES)
def test_events_of_a_sine(case):
    tau1_us, tau2_us, a, amplitude, hz, rate_hz, error, opposite = case
    p = offsets(one_pole(a, tau2_us * 1e-6) if not tau1_us else two_poles(a, tau1_us * 1e-6, tau2_us * 1e-6))
    light, seconds = sine(amplitude, hz, PHASES), 2.0 if rate_hz > 100 else 8.0
    array, random = begun(p, light), np.random.default_rng(1)
    on, off = (THRESHOLD * (1 + 0.12 * random.standard_normal(PIXELS)) for _ in range(2))
    set_thresholds(array, on, off, np.exp(0.15 * random.standard_normal(PIXELS)))
    array.reset(frame(p, light, 0))
    found = statistics_of(run(array, light, ends(40 / hz / max(1, 2 * amplitude), seconds * 1e3)), seconds)
    ours = 1 / math.sqrt(rate_hz * PIXELS * seconds)
    assert abs(found.rate_hz / rate_hz - 1) < 0.13 + Z * math.hypot(ours, error)
    assert abs(found.opposite - opposite) < 0.05 + Z * ours


@pytest.mark.parametrize("case", RAMPS)
def test_intervals_on_a_ramp(case):
    tau_us, a, speed, mean, low, high = case
    p, light, until_s = offsets(one_pole(a, tau_us * 1e-6)), ramp(speed * THRESHOLD, 1e-3), 40 / speed
    waits = statistics_of(events_of(p, light, ends(until_s * 25, until_s * 1e3)), until_s).waits_s * speed
    fast = speed * tau_us * 1e-6 > 1 and a >= 3  # more than a threshold in a time constant of the noise
    assert waits.mean() == pytest.approx(mean, rel=0.02 if fast else 0.18)
    assert np.subtract(*np.quantile(waits, [0.95, 0.05])) == pytest.approx(high - low, rel=0.1)


@pytest.mark.parametrize("case", ONE_POLE)
def test_still_light_of_one_pole(case):
    dead, a, rate, opposite, _ = case
    p = offsets(one_pole(a, 1e-3, 0.04, refractory_us=dead * 1e3))
    found = statistics_of(events_of(p, still(), ends(5, 2000)), 2.0)
    assert found.rate_hz * 1e-3 == pytest.approx(rate, rel=0.12)
    assert found.opposite == pytest.approx(opposite, abs=0.065)


@pytest.mark.parametrize("case", TWO_POLES)
def test_still_light_of_two_poles(case):
    tau1_us, tau2_us, dead_us, a, rate_hz, _, opposite, _ = case
    p = offsets(two_poles(a, tau1_us * 1e-6, tau2_us * 1e-6, 0.04, refractory_us=dead_us))
    seconds = 0.4 if rate_hz > 200 else 3.0
    found = statistics_of(events_of(p, still(), ends(4, seconds * 1e3)), seconds)
    assert found.rate_hz == pytest.approx(rate_hz, rel=0.1)
    assert found.opposite == pytest.approx(opposite, abs=0.065)


def light_of(name):
    return {"still": still(), "sine": sine(0.5, 2.0, 1.0), "ramp": ramp(0.5)}[name]


@pytest.mark.parametrize("light", ["still", "sine", "ramp"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_short_and_long_steps_have_the_events_of_the_full_law(sensor, light):
    """Within 15 %, in steps much shorter and much longer than pixels wait."""
    p = SENSORS[sensor]
    full = dataclasses.replace(p, noise=dataclasses.replace(p.noise, grade="passages"))
    expected = len(events_of(full, light_of(light), ends(10, 960)).t_ns)
    for step_ms in (2, 80):
        count = len(events_of(p, light_of(light), ends(step_ms, 960)).t_ns)
        assert count == pytest.approx(expected, rel=0.15), step_ms


@given(steps=st.lists(st.integers(1, 50 * MS), min_size=1, max_size=12), begin_ns=st.integers(-(2**60), 2**60))
def test_any_division_of_time_has_its_events(steps, begin_ns):
    until = begin_ns + np.cumsum(steps)
    parts = events_of(LOUD, sine(0.5, 5.0), until.tolist(), begin_ns)
    assert np.all((parts.t_ns >= begin_ns) & (parts.t_ns <= until[-1]))
    assert np.all(np.diff(parts.t_ns) >= 0)
    order = np.lexsort((parts.t_ns, parts.pixel))
    waits_ns = np.diff(parts.t_ns[order])[np.diff(parts.pixel[order]) == 0]
    assert waits_ns.min(initial=10**9) >= LOUD.refractory_us * 1000


def test_threads_and_restarts_do_not_matter():
    p, light, until = dataclasses.replace(LOUD, width=160, height=100), sine(0.5, 5.0), ends(10, 100)
    first, second = (run(begun(p, light, threads=threads), light, until) for threads in (1, 2))
    assert len(first.t_ns) > 1000
    assert np.array_equal(first.rows(), second.rows())
    array = begun(p, light)
    head = run(array, light, until[:5])
    other = PixelArray(p, 1)
    other.state = copy.deepcopy(array.state)
    tail = run(other, light, until[5:])
    assert np.array_equal(np.concatenate([head.rows(), tail.rows()]), first.rows())


@pytest.mark.parametrize("light", ["still", "ramp"])
def test_times_have_no_pattern(light):
    """Neither in a step, by more than a hundredth of the events, nor across an epoch of the leak."""
    p, step_ms = dataclasses.replace(LOUD, width=96, height=64), 20
    begin_ns = (1 << 33) - 400 * MS if light == "still" else 0
    found = events_of(
        p, light_of(light), range(begin_ns + step_ms * MS, begin_ns + 800 * MS + 1, step_ms * MS), begin_ns
    )
    late = found.t_ns[found.t_ns > begin_ns + 200 * MS] - begin_ns
    of_step = kstest(late % (step_ms * MS) / (step_ms * MS), "uniform")
    assert of_step.statistic < 0.01 + Z / math.sqrt(late.size)  # a hundredth of the events, beside chance
    if light == "still":
        before = (late < 500 * MS).sum()
        assert abs(before - late.size / 2) < Z * math.sqrt(late.size)


def test_the_pixels_of_still_light_rest_until_their_clocks():
    p = dataclasses.replace(IMX, width=64, height=64)
    array = begun(p, still())
    found = run(array, still(), ends(1, 300))
    assert array.candidates < 4 * len(found.t_ns) + 64 * 64


def test_changes_reach_the_levels():
    """A dead pixel is silent, and higher thresholds have fewer events at once."""
    array = begun(LOUD, still())
    before = run(array, still(), ends(10, 200))
    array.kill(np.arange(0, 24 * 16, 2))
    array.adjust("threshold_on", 1.5 * LOUD.threshold_on)
    array.adjust("threshold_off", 1.5 * LOUD.threshold_off)
    after = run(array, still(), ends(10, 400, 200))
    assert np.all(after.pixel % 2)
    assert 0 < len(after.t_ns) < 0.1 * len(before.t_ns)


def test_events_of_noise_are_known():
    sensor = Sensor(dataclasses.replace(LOUD, leak_hz=0.0), 1)
    sensor.reset(frame(LOUD, still(), 0))
    events = sensor.expose(frame(LOUD, still(), 200 * MS))
    assert len(events) > 100
    assert len(sensor.pixels.of_noise) > 0.95 * len(events)

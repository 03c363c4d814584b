"""The high-pass in front of the comparators against closed forms, LSODA and a Monte Carlo of its noise."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from emulator.light import LightFrame
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import SensorParameters

ON, OFF = 0.223, 0.25
DARK = 1e-3
S = 1_000_000_000
P = SensorParameters(
    width=16, height=4, threshold_on=ON, threshold_off=OFF, mismatch=0.0, leak_hz=0.0, random_start=False,
    dark_current_relative=DARK, corner_min_hz=1.0, corner_max_hz=30_000.0, corner_hz_at_reference=2180.0,
)  # fmt: skip
NO_LOW_PASS = dataclasses.replace(P, corner_hz_at_reference=math.inf, dark_current_relative=1e-6)
IMX636 = {"photoreceptor": "large_signal", "source_follower_hz": 4050.0, "refractory_us": 105.0}
STEPS_S = [2e-4, 1e-3, 1e-2, 8e-2]


def frame(p, t_s, light, log_rate=None):
    values = np.full((p.height, p.width), light, np.float32)
    return LightFrame(round(t_s * S), values, None if log_rate is None else values * np.float32(log_rate))


def events(p, frames):
    """Return (time in s, on) of pixel 0, and the array."""
    array = PixelArray(p, 1)
    array.reset(frames[0])
    found = []
    for one in frames[1:]:
        c = array.step(one)
        found += [(t * 1e-9, bool(on)) for t, on in zip(c.t_ns[c.pixel == 0], c.on[c.pixel == 0], strict=True)]
    return found, array


def lsoda(light, p, end_s, longest_s):
    """Return (time, on) of a pixel: photoreceptor, source follower and the low-pass h that the high-pass subtracts."""
    first, second, high = (2 * math.pi * hz for hz in (p.corner_hz_at_reference, p.source_follower_hz, p.highpass_hz))

    def slopes(t, y):
        current = light(t) + DARK
        behind = y[0] - math.log(current)
        rise = first * current * (-math.expm1(behind) if p.photoreceptor == "large_signal" else -behind)
        return [rise, second * (y[0] - y[1]) if second else rise, high * (y[1] - y[2])]

    def on(t, y):
        return y[1] - y[2] - reference - ON

    def off(t, y):
        return y[1] - y[2] - reference + OFF

    on.terminal = off.terminal = True
    on.direction, off.direction = 1, -1
    options = {"method": "LSODA", "rtol": 1e-10, "atol": 1e-12, "max_step": longest_s}
    y, t, reference, found = [math.log(light(0) + DARK)] * 3, 0.0, 0.0, []
    while t < end_s:
        solved = solve_ivp(slopes, (t, end_s), y, events=(on, off), **options)
        t, y = solved.t[-1], solved.y[:, -1]
        if solved.status != 1:
            break
        rises = solved.t_events[0].size > 0
        found.append((t, rises))
        reference += ON if rises else -OFF
        if p.refractory_us:
            solved = solve_ivp(slopes, (t, t + p.refractory_us * 1e-6), y, **options)
            t, y = solved.t[-1], solved.y[:, -1]
            reference = y[1] - y[2]
    return found


@pytest.mark.system
@pytest.mark.parametrize("sensor", [{}, IMX636], ids=["one pole", "imx636"])
@pytest.mark.parametrize(
    ("hz", "high_hz", "step_s", "least", "within_us"),
    [
        (0.5, 0.1, 1e-3, 25, 2.0), (0.5, 1.0, 1e-2, 12, 8.0), (5.0, 1.0, 1e-3, 40, 1.0), (5.0, 1.0, 1e-2, 40, 10.0),
        (5.0, 30.0, 1e-3, 0, 0.0), (50.0, 0.1, 2e-4, 60, 1.0), (50.0, 30.0, 2e-4, 50, 2.0),
        (50.0, 30.0, 1e-3, 50, 10.0),
    ],
)  # fmt: skip
def test_events_of_a_sine_are_those_of_lsoda(sensor, hz, high_hz, step_s, least, within_us):
    p = dataclasses.replace(P, highpass_hz=high_hz, **sensor)
    w, end_s = 2 * math.pi * hz, {0.5: 4.0, 5.0: 0.6, 50.0: 0.1}[hz]

    def light(t):
        return math.exp(math.sin(w * t + 0.3))

    true = lsoda(light, p, end_s, min(2e-3, 0.02 / hz))
    times = step_s * np.arange(round(end_s / step_s) + 1)
    ours, _ = events(p, [frame(p, t, light(t), w * math.cos(w * t + 0.3)) for t in times])
    assert [on for _, on in ours] == [on for _, on in true]
    assert len(true) >= least
    late_us = 1e6 * np.abs(np.subtract([t for t, _ in ours], [t for t, _ in true]))
    assert late_us.max(initial=0.0) <= within_us


@pytest.mark.parametrize("step_s", STEPS_S)
@pytest.mark.parametrize("high_hz", [1.0, 30.0])
def test_a_ramp_fires_where_its_slope_exceeds_the_threshold_times_the_rate(high_hz, step_s):
    """The output is slope / a (1 - e^-at), a = 2 pi f."""
    p, a = dataclasses.replace(NO_LOW_PASS, highpass_hz=high_hz), 2 * math.pi * high_hz
    for share in (0.98, 1.02, 3.5):
        slope = share * ON * a
        steps = round(1.2 / a / step_s) + 1 if share > 2 else round(8 / a / step_s) + 1
        ours, _ = events(p, [frame(p, k * step_s, math.exp(slope * k * step_s)) for k in range(steps + 1)])
        levels = ON * np.arange(1, 1 + int(share * (1 - math.exp(-a * steps * step_s))))
        assert [on for _, on in ours] == [True] * len(levels)
        closed = -np.log(1 - levels * a / slope) / a
        assert np.abs(np.subtract([t for t, _ in ours], closed)).max(initial=0.0) < 5e-6


@pytest.mark.parametrize("step_s", STEPS_S)
@pytest.mark.parametrize("high_hz", [0.3, 30.0])
def test_after_a_jump_the_output_decays_through_the_off_levels(high_hz, step_s):
    p, a, jump = dataclasses.replace(NO_LOW_PASS, highpass_hz=high_hz), 2 * math.pi * high_hz, 1.0
    up = int(jump / ON)
    before = [frame(p, 0, 1.0), frame(p, 0.08, 1.0), frame(p, 0.08, math.exp(jump))]
    steps = max(round(5 / a / step_s), 1)
    ours, array = events(p, before + [frame(p, 0.08 + k * step_s, math.exp(jump)) for k in range(1, steps + 1)])
    levels = up * ON - OFF * np.arange(1, 1 + int(up * ON / OFF))
    assert [on for _, on in ours] == [True] * up + [False] * len(levels)
    closed = 0.08 - np.log(levels / jump) / a
    assert np.abs(np.subtract([t for t, on in ours if not on], closed)).max() < 2e-4 / a
    for k in range(1, 400):  # the output comes to rest at 0, and costs nothing more
        array.step(frame(p, 0.08 + (steps + k) * step_s + 9 / high_hz, math.exp(jump)))
    assert array.levels().of(np.array([0])) == pytest.approx(-(levels[-1]), abs=1e-5)


def test_levels_stay_where_the_filter_begins_and_ends():
    array, everywhere = PixelArray(P, 1), np.arange(P.width * P.height)
    array.reset(frame(P, 0, 1.0))
    array.step(frame(P, 0.1, 1.15))
    before = array.levels().of(everywhere)
    assert np.all(np.abs(before) > 0.1)
    for high_hz in (5.0, 50.0, 0.0):
        array.adjust("highpass_hz", high_hz)
        assert array.levels().of(everywhere) == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("high_hz", [-1.0, 0.005, math.inf, math.nan, 2e5])
def test_filters_that_cannot_be_are_refused(high_hz):
    with pytest.raises(ValueError, match="highpass_hz"):
        dataclasses.replace(P, highpass_hz=high_hz)


def monte_carlo(p, signal, dt_s, steps, pixels):
    """Return the counts of ON and OFF events of pixels whose poles do not move: filters by Euler's exponential rule."""
    first, second, high = (
        -math.expm1(-2 * math.pi * hz * dt_s) for hz in (p.corner_max_hz, p.noise.corner_hz, p.highpass_hz)
    )
    rng, counts, dead = np.random.default_rng(7), [0, 0], round(p.refractory_us * 1e-6 / dt_s)
    shot = p.noise.rms * math.sqrt(first * (2 - first))
    v, n, w, h, waits = np.zeros(pixels), np.zeros(pixels), np.zeros(pixels), np.zeros(pixels), np.zeros(pixels)
    reference = np.zeros(pixels)
    for k in range(steps):
        v += first * (signal(k * dt_s) - v)
        n += -first * n + shot * rng.standard_normal(pixels)
        w += second * (n - w)
        h += high * (v + w - h)
        level = v + w - h - reference
        waits -= 1
        ends = waits == 0
        reference[ends] += level[ends]
        for polarity, fires in enumerate((level >= p.threshold_on, level <= -p.threshold_off)):
            fires &= waits < 0
            waits[fires] = dead
            counts[polarity] += np.count_nonzero(fires) * (2 * k > steps)
    return np.array(counts) / pixels


@pytest.mark.long
@pytest.mark.sampled
@pytest.mark.parametrize("step_s", [1e-3, 1e-2])
def test_noise_and_motion_together_are_those_of_a_monte_carlo(step_s):
    """Light that moves by a third of a threshold, with noise of 0.4 thresholds: neither fires much alone."""
    p = dataclasses.replace(
        P, width=32, height=16, threshold_off=ON, corner_min_hz=300.0, corner_max_hz=300.0, refractory_us=300.0,
        highpass_hz=30.0, noise=NoiseParameters(rms=0.09, corner_hz=1000.0),
    )  # fmt: skip
    w, end_s = 2 * math.pi * 10, 1.0

    def signal(t):
        return 0.075 * math.sin(w * t)

    true = monte_carlo(p, signal, 1e-5, round(end_s / 1e-5), 512)
    array, ours = PixelArray(p, 1), np.zeros(2)
    array.reset(frame(p, 0, 1.0, 0.075 * w))
    for t in step_s * np.arange(1, round(end_s / step_s) + 1):
        c = array.step(frame(p, t, math.exp(signal(t)), 0.075 * w * math.cos(w * t)))
        ours += [np.count_nonzero(c.on) * (t > end_s / 2), np.count_nonzero(~c.on) * (t > end_s / 2)]
    assert true.min() > 3
    assert ours / 512 == pytest.approx(true, rel=0.15)

"""The large-signal photoreceptor of the pixel array against LSODA, its closed forms, and itself in other steps."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from emulator.light import LightFrame, Region
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import SensorParameters
from laboratory.methods.grid import NoisyPixels

K = 2 * math.pi * 3000
DARK = 1e-3
THETA = 0.223
P = SensorParameters(
    width=16, height=4, threshold_on=THETA, threshold_off=THETA, mismatch=0.0, leak_hz=0.0, random_start=False,
    dark_current_relative=DARK, corner_min_hz=1.0, corner_max_hz=30_000.0, photoreceptor="large_signal",
)  # fmt: skip
S = 1_000_000_000


def sine(hz, amplitude):
    w = 2 * math.pi * hz
    return lambda t: math.exp(amplitude * math.sin(w * t)), lambda t: w * amplitude * math.cos(w * t)


def edge(sigma_s):
    """Return a blurred edge from dark to light 1 and back, and the derivative of its logarithm."""

    def light(t):
        return 0.5 * (math.tanh((t - 0.05) / sigma_s) - math.tanh((t - 0.15) / sigma_s)) + 1e-12

    return light, lambda t: (light(t + 1e-8) - light(t - 1e-8)) / 2e-8 / light(t)


def true_events(light, p, end_s):
    """Return (time, on) of a pixel without refractory period, by LSODA on the output itself."""

    def slopes(t, y):
        current = light(t) + DARK
        hz = min(max(p.corner_hz_at_reference * current, p.corner_min_hz), p.corner_max_hz)
        first = 2 * math.pi * hz * (1 - math.exp(y[0] - math.log(current)))
        return [first, 2 * math.pi * p.source_follower_hz * (y[0] - y[1]) if p.source_follower_hz else first]

    def on(t, y):
        return y[1] - reference - THETA

    def off(t, y):
        return y[1] - reference + THETA

    on.terminal = off.terminal = True
    on.direction, off.direction = 1, -1
    reference, t, found = math.log(light(0) + DARK), 0.0, []
    y = [reference, reference]
    while t < end_s:
        solved = solve_ivp(
            slopes, (t, end_s), y, method="LSODA", rtol=1e-10, atol=1e-12, max_step=2e-4, events=(on, off)
        )
        t, y = solved.t[-1], list(solved.y[:, -1])
        if solved.status != 1:
            break
        rises = solved.t_events[0].size > 0
        found.append((t, rises))
        reference += THETA if rises else -THETA
    return found


def frame(p, t_s, light, log_rate=None):
    values = np.full((p.height, p.width), light, np.float32)
    rate = None if log_rate is None else np.full((p.height, p.width), light * log_rate, np.float32)
    return LightFrame(round(t_s * S), values, rate)


def events(p, frames, pixel=0, threads=0):
    pixels = PixelArray(p, 1, threads)
    pixels.reset(frames[0])
    found = []
    for one in frames[1:]:
        c = pixels.step(one)
        found += [(t * 1e-9, bool(on)) for t, on in zip(c.t_ns[c.pixel == pixel], c.on[c.pixel == pixel], strict=True)]
    return found


@pytest.mark.system
@pytest.mark.parametrize(
    ("scene", "corner_hz", "second_hz", "step_s", "within_us"),
    [
        (sine(5, 1.5), 3000, 0, 1e-3, 0.1), (sine(20, 0.86), 200, 0, 1e-3, 0.5), (sine(5, 3), 100, 0, 1e-3, 0.5),
        (sine(5, 1.5), 3000, 286, 1e-3, 0.1), (sine(20, 0.86), 200, 286, 1e-3, 0.5), (edge(2e-3), 3000, 0, 1e-4, 1.0),
        (edge(5e-4), 3000, 0, 1e-4, 1.0), (edge(5e-4), 3000, 4350, 1e-4, 1.0),
    ],
)  # fmt: skip
def test_events_are_those_of_lsoda(scene, corner_hz, second_hz, step_s, within_us):
    p = dataclasses.replace(P, corner_hz_at_reference=corner_hz, source_follower_hz=second_hz)
    light, log_rate = scene
    end_s = 0.2
    true = true_events(light, p, end_s)
    ours = events(p, [frame(p, t, light(t), log_rate(t)) for t in np.arange(0, end_s + step_s / 2, step_s)])
    assert [on for _, on in ours] == [on for _, on in true]
    assert len(true) > 20
    assert np.max(np.abs(np.subtract([t for t, _ in ours], [t for t, _ in true]))) * 1e6 < within_us


def jumped(p, before, after, steps):
    """Return the events after a jump of the light at the time 0.1 s, seen for 0.2 s in that many steps."""
    still = [frame(p, 0, before), frame(p, 0.1, before), frame(p, 0.1, after)]
    return events(p, still + [frame(p, 0.1 + 0.2 * k / steps, after) for k in range(1, steps + 1)])


@pytest.mark.parametrize("steps", [1, 7, 400])
@pytest.mark.parametrize("light", [0.03, 0.3, 3.0])
def test_events_from_the_dark_come_one_after_another_at_theta_over_k_i(light, steps):
    current, got = light + DARK, jumped(P, 0.0, light, steps)
    end = math.log(current / DARK)
    levels = THETA * np.arange(1, int(end / THETA) + 1)
    # w = e^-V falls from 1 / dark to 1 / current as one exponential
    w = np.exp(-(math.log(DARK) + levels))
    closed = 0.1 - np.log((w - 1 / current) / (1 / DARK - 1 / current)) / (K * current)
    assert all(on for _, on in got)
    assert len(got) == len(levels)
    assert np.abs(np.array([t for t, _ in got]) - closed)[: len(levels) // 2].max() < 2e-7 / light
    simple = THETA / (K * current)  # where the light is far above the dark current
    assert got[0][0] - 0.1 == pytest.approx(simple, rel=0.005 + 1.2 * DARK / current)


@pytest.mark.parametrize("steps", [1, 7, 400])
@pytest.mark.parametrize("light", [0.3, 3.0, 30.0])
def test_events_into_the_dark_follow_a_logarithm(light, steps):
    p = dataclasses.replace(P, corner_max_hz=math.inf)
    current, got = light + DARK, jumped(p, light, 0.0, steps)
    n = np.arange(1, 11)
    w = np.exp(THETA * n) / current
    closed = 0.1 - np.log((1 / DARK - w) / (1 / DARK - 1 / current)) / (K * DARK)
    assert not any(on for _, on in got[:10])
    late_s = np.array([t for t, _ in got[:10]]) - 0.1
    assert late_s == pytest.approx(closed - 0.1, rel=0.005, abs=2e-9)
    assert late_s[0] == pytest.approx(math.expm1(THETA) / (K * current), rel=0.01)


def test_small_signals_are_those_of_one_pole():
    small = dataclasses.replace(P, threshold_on=0.002, threshold_off=0.002, corner_hz_at_reference=100.0)
    light, log_rate = sine(20, 0.02)
    frames = [frame(small, t, light(t), log_rate(t)) for t in np.arange(0, 0.1, 1e-3)]
    large, one_pole = events(small, frames), events(dataclasses.replace(small, photoreceptor="one_pole"), frames)
    assert [on for _, on in large] == [on for _, on in one_pole]
    assert len(large) > 20
    assert np.abs(np.subtract([t for t, _ in large], [t for t, _ in one_pole])).max() < 3e-4


def test_the_bounds_of_the_corner_hold():
    bounded = dataclasses.replace(P, corner_max_hz=300.0)
    got = jumped(bounded, 0.0, 3.0, 10)
    assert got[0][0] - 0.1 == pytest.approx(THETA / (2 * math.pi * 300), rel=0.01)


def scenes(rng, p, steps):
    """Return frames in which a part of the light rests, moves, jumps or goes dark, with their changed regions."""
    light = rng.lognormal(0, 1.5, (p.height, p.width)).astype(np.float32)
    t_ns, frames = 0, [LightFrame(0, light.copy())]
    for _ in range(steps):
        t_ns += int(rng.choice([100_000, 1_000_000, 5_000_000]))
        rows = np.sort(rng.integers(0, p.height + 1, 2)) if rng.random() < 0.5 else (0, 0)
        there = slice(*(int(row) for row in rows))
        kind = rng.integers(4)
        if kind == 0:
            light[there] = 0
        elif kind == 1:
            light[there] *= rng.lognormal(0, 0.1, light[there].shape).astype(np.float32)
        elif kind == 2:
            light[there] *= np.float32(rng.choice([0.01, 100.0]))
        light = np.clip(light, 0, 1e3).astype(np.float32)
        frames.append(LightFrame(t_ns, light.copy(), changed=Region(there.start, there.stop, 0, p.width)))
    return frames


@pytest.mark.system
@pytest.mark.parametrize("changes", [{}, {"source_follower_hz": 300.0}, {"parasitic_hz_at_reference": 0.5}])
def test_skipping_and_threads_change_no_bit(changes):
    p = dataclasses.replace(
        P, width=128, height=96, mismatch=0.1, leak_hz=1.0, random_start=True, refractory_us=50.0, **changes
    )
    frames = scenes(np.random.default_rng(3), p, 120)
    arrays = {"skips": PixelArray(p, 1, 1), "full": PixelArray(p, 1, 1), "threads": PixelArray(p, 1, 3)}
    for pixels in arrays.values():
        pixels.reset(frames[0])
    fired = 0
    for one in frames[1:]:
        arrays["full"].wake()
        found = {name: pixels.step(one) for name, pixels in arrays.items()}
        fired += len(found["full"])
        for name in ("skips", "threads"):
            for field in ("t_ns", "pixel", "on"):
                np.testing.assert_array_equal(getattr(found[name], field), getattr(found["full"], field))
    assert fired > 10_000
    for name in ("skips", "threads"):
        np.testing.assert_array_equal(arrays[name].state.fields, arrays["full"].state.fields)


def test_times_do_not_depend_on_the_step():
    light, log_rate = sine(5, 2)
    runs = [
        events(P, [frame(P, t, light(t), log_rate(t)) for t in np.linspace(0, 0.2, n + 1)]) for n in (100, 400, 2000)
    ]
    assert len(runs[0]) > 20
    for run in runs[1:]:
        assert [on for _, on in run] == [on for _, on in runs[0]]
        assert np.abs(np.subtract([t for t, _ in run], [t for t, _ in runs[0]])).max() < 1e-6


def test_grid_noise_has_the_same_photoreceptor():
    quiet = dataclasses.replace(P, noise=NoiseParameters(rms=1e-6, corner_hz=10_000.0, grade="grid"))
    frames = [frame(P, 0, 0.0), frame(P, 0.01, 0.0), frame(P, 0.01001, 0.1), frame(P, 0.02, 0.1)]
    pixels = NoisyPixels(quiet, 1)
    pixels.reset(frames[0])
    noisy = [t * 1e-9 for one in frames[1:] for c in [pixels.step(one)] for t in c.t_ns[c.pixel == 0].tolist()]
    whole = [t for t, _ in events(P, frames)]
    assert len(noisy) >= 10
    assert np.abs(np.array(noisy[:10]) - np.array(whole[:10])).max() < 3e-6

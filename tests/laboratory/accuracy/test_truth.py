"""The truth against scipy's adaptive integrator, closed answers, and the thresholds of the array under test."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import Field, draw
from laboratory.accuracy.scenes import Dark, Flash, SineGrating
from laboratory.accuracy.scores import compare
from laboratory.accuracy.truth import true_events
from tests.laboratory.accuracy.rows import row

SEED = 3


def adaptive(scene, p, pixel, duration_s):
    """One pixel's (t us, on), solved by DOP853 piece by piece from event to event; refractory periods included."""
    d = draw(p, SEED)
    on, off, leak = d.on[pixel], d.off[pixel], d.leak[pixel]

    def slopes(t, y):
        current = scene.value(t)[0, pixel] + p.dark_current_relative
        rate = 2 * math.pi * min(max(p.corner_hz_at_reference * current, p.corner_min_hz), p.corner_max_hz)
        behind = math.log(current) - y[0]
        first = rate * (-math.expm1(-behind) if p.photoreceptor == "large_signal" else behind)
        second = 2 * math.pi * p.source_follower_hz * (y[0] - y[1]) if p.source_follower_hz else first
        return [first, second, current]

    start = math.log(scene.value(0.0)[0, pixel] + p.dark_current_relative)
    solution = solve_ivp(
        slopes, (0, duration_s), [start, start, 0], "DOP853", dense_output=True, rtol=1e-12, atol=1e-12, max_step=2e-4
    ).sol

    def g(t):
        y = solution(t)
        return y[1] + leak * t + p.parasitic_hz_at_reference * on * y[2]

    grid = np.linspace(0, duration_s, 20001)
    y = solution(grid)
    dense = y[1] + leak * grid + p.parasitic_hz_at_reference * on * y[2]
    t, r, events = 0.0, start - on * d.phase[pixel], []
    while True:
        after = int(np.searchsorted(grid, t, side="right"))
        beyond = np.flatnonzero((dense[after:] - r >= on) | (dense[after:] - r <= -off))
        if beyond.size == 0:
            return events
        k = after + beyond[0]
        rising = bool(dense[k] > r)
        level = r + on if rising else r - off
        t = brentq(lambda x, level=level: g(x) - level, max(t, grid[k - 1]), grid[k], xtol=1e-14, rtol=1e-14)
        events.append((t * 1e6, rising))
        refractory = p.refractory_us * 1e-6
        t, r = (t, level) if refractory == 0 else (t + refractory, g(min(t + refractory, duration_s)))


@pytest.mark.system
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"refractory_us": 700.0},
        {"leak_hz": 5.0, "source_follower_hz": 150.0, "parasitic_hz_at_reference": 20.0},
        {"photoreceptor": "large_signal"},
        {"photoreceptor": "large_signal", "source_follower_hz": 150.0, "refractory_us": 700.0},
    ],
    ids=["plain", "refractory", "two poles and both leaks", "large signals", "large signals and a second pole"],
)
def test_crossings_agree_with_an_adaptive_solver(changes):
    scene, p = SineGrating(pixels=3), row(3, **changes)
    truth = true_events(scene, p, SEED, 0.1)
    for pixel in range(3):
        known = adaptive(scene, p, pixel, 0.1)
        ours = slice(truth.first[pixel], truth.first[pixel + 1])
        assert len(known) > 10
        assert truth.on[ours].tolist() == [on for _, on in known]
        np.testing.assert_allclose(truth.t_us[ours], [t for t, _ in known], rtol=0, atol=1e-6)


def test_the_fine_step_is_of_fourth_order():
    scene, p = SineGrating(pixels=6), row(6)
    finest, fine, coarse = (true_events(scene, p, SEED, 0.1, fine_s=h) for h in (5e-6, 4e-5, 8e-5))
    assert compare(coarse, finest).t50_us / compare(fine, finest).t50_us > 12


def test_a_flash_is_met_at_its_own_instant():
    """The answer to a step in log light is u1 + (u0 - u1) e^(-lambda t), whichever part of a fine step it begins in."""
    scene, p = Flash(pixels=7), row(7, leak_hz=0.0)
    truth, d = true_events(scene, p, SEED, 0.1), draw(p, SEED)
    u0, u1 = (math.log(x + p.dark_current_relative) for x in (scene.dark, scene.bright))
    rate = 2 * math.pi * p.corner_hz_at_reference * (scene.bright + p.dark_current_relative)
    for k in range(7):
        level = u0 - d.on[k] * d.phase[k] + d.on[k] * np.arange(1, 100)
        level = level[level < u1]
        known = scene.jumps_s()[k, 0] - np.log((u1 - level) / (u1 - u0)) / rate
        known = known[known < 0.1]
        np.testing.assert_allclose(truth.t_us[truth.first[k] : truth.first[k + 1]], known * 1e6, atol=2e-6)


def test_the_circuit_has_no_truth():
    with pytest.raises(ValueError, match='photoreceptor = "circuit"'):
        true_events(Dark(pixels=1), row(1, photoreceptor="circuit"), SEED, 0.1)


def test_leak_in_the_dark_has_its_rate_and_phase():
    p = row(4, leak_hz=2.0)
    truth, d = true_events(Dark(pixels=4), p, SEED, 3.0, fine_s=1e-4), draw(p, SEED)
    for k in range(4):
        rate_hz = d.leak[k] / d.on[k]
        known = (np.arange(100) + 1 - d.phase[k]) / rate_hz
        np.testing.assert_allclose(truth.t_us[truth.first[k] : truth.first[k + 1]], known[known < 3] * 1e6, rtol=1e-9)
    assert truth.on.all()


def test_thresholds_leak_and_phase_are_those_of_the_array():
    p = row(50, mismatch=0.2)
    d, array = draw(p, SEED), PixelArray(p, SEED)
    np.testing.assert_allclose(array.field(Field.ON)[0], d.on, rtol=1e-6)
    np.testing.assert_allclose(array.field(Field.OFF)[0], d.off, rtol=1e-6)
    np.testing.assert_allclose(array.field(Field.LEAK)[0], d.leak, rtol=1e-6)
    array.reset(LightFrame(0, np.ones((1, 50), np.float32)))
    u = math.log(1 + p.dark_current_relative)
    np.testing.assert_allclose(u - array.field(Field.REFERENCE)[0], d.on * d.phase, atol=1e-6)


def test_the_truth_refuses_what_it_cannot_solve():
    with pytest.raises(ValueError, match="3 pixels"):
        true_events(SineGrating(pixels=3), row(4), SEED, 0.1)
    with pytest.raises(ValueError, match="too long"):
        true_events(SineGrating(pixels=4), row(4, corner_hz_at_reference=3000.0), SEED, 0.1, fine_s=1e-4)
    with pytest.raises(ValueError, match="low-pass"):
        true_events(SineGrating(pixels=4), row(4, corner_hz_at_reference=math.inf), SEED, 0.1)

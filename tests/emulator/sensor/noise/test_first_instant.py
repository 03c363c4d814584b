"""Point noise from the level that the last event left, against a process followed in fine steps.

The reference follows the noise voltage in steps of a hundredth of its time constant and shares nothing with the
emulator. Counts are compared within 5 %, the target, and 3.9 standard errors of both, found from the spread
between pixels: a law within 5 % fails with a probability of 1e-4. The seeds are fixed.
`laboratory/benchmarks/noise.py` has more thresholds and longer times.
"""

import dataclasses
import math

import numba
import numpy as np
import pytest
from emulator.sensor.noise.passages import passage_rates, passage_table, rates_between
from scipy import stats

from emulator.light import LightFrame
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor

Z, TARGET = stats.norm.isf(1e-4 / 2), 0.05
F_N = 150.0
TAU_S = 1 / (2 * math.pi * F_N)
EDGES_S = np.array([0.1, 1.0])
STEP = 0.01
P = SensorParameters(
    width=40, height=30, threshold_on=0.283, threshold_off=0.262, mismatch=0.035, corner_hz_at_reference=300.0,
    leak_hz=0.0, refractory_us=3.4,
)  # fmt: skip
MEAN = (P.threshold_on + P.threshold_off) / 2
LIT = np.float32(1 - P.dark_current_relative)


def noisy(a, grade="points", **changes):
    """A sensor of which the mean threshold is `a` deviations of the noise at light 1."""
    return dataclasses.replace(P, noise=NoiseParameters(MEAN / a * 2**0.5, 300.0, grade), **changes)


@numba.njit
def followed(level, on, off, refractory, edges, random):
    """Counts of each pixel before each edge, (pixels, edges); lengths in deviations, times in time constants."""
    counts = np.zeros((level.size, edges.size))
    decay, kick = np.exp(-STEP), np.sqrt(-np.expm1(-2 * STEP))
    again = np.exp(-refractory)
    blind = np.sqrt(1 - again * again)
    for pixel in range(level.size):
        x, reference, t = random.normal(), -level[pixel], 0.0
        while t < edges[-1]:
            y = x * decay + kick * random.normal()
            t += STEP
            up, down, event = reference + on[pixel], reference - off[pixel], -1
            if y >= up or (y > down and random.random() < math.exp(-max(0.0, (up - x) * (up - y)) / STEP)):
                event = 1
            elif y <= down or random.random() < math.exp(-max(0.0, (x - down) * (y - down)) / STEP):
                event = 0
            if event >= 0:
                counts[pixel, min(np.searchsorted(edges, t), edges.size - 1)] += 1
                y = (up if event else down) * again + blind * random.normal()
                reference, t = y, t + refractory
            x = y
    return counts


def truth(a, level, edges_s=EDGES_S, copies=1):
    drawn, sigma = draw(P, 1), MEAN / a
    level, on, off = (np.tile(one, copies) / sigma for one in (level, drawn.on, drawn.off))
    return followed(level, on, off, P.refractory_us * 1e-6 / TAU_S, edges_s / TAU_S, np.random.default_rng(3))


def counted(t_us, pixel, pixels, edges_us):
    table = np.zeros((pixels, len(edges_us)))
    k = np.searchsorted(edges_us, t_us)
    inside = k < len(edges_us)
    np.add.at(table, (pixel[inside], k[inside]), 1)
    return table


def events_of(p, seed, frames, begin_s, edges_s=EDGES_S):
    sensor = Sensor(p, seed)
    sensor.reset(frames[0])
    parts = [sensor.expose(frame) for frame in frames[1:]]
    e = np.concatenate([*parts, sensor.finish()])
    e = e[e["t"] >= begin_s * 1e6]
    return counted(e["t"] - begin_s * 1e6, e["y"] * np.int64(p.width) + e["x"], p.width * p.height, edges_s * 1e6)


def light(level, t_s):
    return LightFrame(round(t_s * 1e9), np.full((P.height, P.width), level, np.float32))


def assert_alike(found, expected):
    for k in range(found.shape[1]):
        means = found[:, k].mean(), expected[:, k].mean()
        error = math.hypot(*(one[:, k].std() / math.sqrt(len(one)) for one in (found, expected)))
        assert abs(means[0] - means[1]) < TARGET * means[1] + Z * error, (k, means)


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("a", [1.6, 4.83, 7.15])
def test_after_a_reset_at_random_phases(a):
    drawn = draw(P, 1)
    expected = truth(a, drawn.phase * drawn.on)
    frames = [light(LIT, t) for t in (0.0, 0.02, 0.1, 1.0)]
    found = events_of(noisy(a), 1, frames, 0.0)
    assert expected[:, 0].sum() > 200
    assert_alike(found, expected)


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("a", [2.5, 4.0])
def test_against_the_grid_after_a_reset_at_random_phases(a):
    frames, edges_s = [light(LIT, t) for t in (0.0, 0.02, 0.1, 0.5)], np.array([0.1, 0.5])
    found = events_of(noisy(a), 1, frames, 0.0, edges_s)
    assert_alike(found, events_of(noisy(a, "grid"), 1, frames, 0.0, edges_s))


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize(("a", "over"), [(4.83, 0.35), (2.5, 0.75)])
def test_after_events_of_a_signal_that_stops_between_two_thresholds(a, over):
    """Light rises by some thresholds in 20 ms, and stops: the last event left the reference below the light."""
    p = noisy(a, corner_hz_at_reference=300.0, mismatch=0.0, random_start=False)
    rise = P.threshold_on * (3 + over)
    t_s = np.linspace(0, 0.02, 21)[1:]
    levels = np.exp(-rise + rise * t_s / 0.02)
    frames = [
        light(np.exp(-rise) - 0.001, 0.0),
        *(light(level - 0.001, t) for level, t in zip(levels, t_s, strict=True)),
    ]
    begin_s = 0.04  # the filter has come to rest
    frames += [light(LIT, t) for t in (0.025, 0.03, 0.04, 0.06, 0.14, 1.04)]
    edges_s = np.array([0.1, 1.0])
    found = events_of(p, 1, frames, begin_s, edges_s)
    expected = events_of(dataclasses.replace(p, noise=dataclasses.replace(p.noise, grade="grid")), 1, frames, begin_s,
                         edges_s)  # fmt: skip
    assert_alike(found, expected)


def test_a_crossing_that_noise_has_made_before_does_not_come_again():
    """On a slow ramp noise fires each event early; their number is that of the thresholds passed."""
    p = noisy(8.0, mismatch=0.0, width=10, height=10)
    end_s, rate = 4.0, 0.5
    t_s = np.linspace(0, end_s, 201)
    sensor = Sensor(p, 1)
    make = [LightFrame(round(t * 1e9), np.full((10, 10), math.exp(rate * (t - end_s)), np.float32)) for t in t_s]
    sensor.reset(make[0])
    events = np.concatenate([*(sensor.expose(frame) for frame in make[1:]), sensor.finish()])
    counts = np.bincount(events["y"] * 10 + events["x"], np.where(events["on"], 1, -1), 100)
    assert counts.mean() == pytest.approx(rate * end_s / p.threshold_on, abs=0.35)
    assert sensor.pixels.lost_in_pixel == 0


@pytest.mark.parametrize("step_ms", [0.4, 5.0, 50.0])
def test_steps_do_not_matter_with_leak_and_signal_levels(step_ms):
    p = noisy(4.0, leak_hz=0.5, parasitic_hz_at_reference=0.3)

    def found(step_s):
        sensor, parts = Sensor(p, 5), []
        sensor.reset(light(LIT, 0.0))
        for k in range(1, round(1 / step_s) + 1):
            parts.append(sensor.expose(light(LIT, k * step_s)))
        return np.concatenate([*parts, sensor.finish()])

    one, other = found(1e-3), found(step_ms * 1e-3)
    assert len(one) > 1000
    assert abs(len(one) - len(other)) <= 0.002 * len(one)
    assert np.isin(one["t"] * 2000 + one["x"], other["t"] * 2000 + other["x"]).mean() > 0.99


def test_the_table_between_its_nodes_is_the_law():
    random = np.random.default_rng(1)
    above, below = random.uniform(-1, 7, (2, 1000))
    above, below = (one[above + below > 2] for one in (above, below))
    found = np.array([rates_between(x, y, passage_table()) for x, y in zip(above, below, strict=True)])
    for k, law in enumerate(passage_rates(above, below)):
        assert found[:, k] == pytest.approx(law, rel=0.012)


def test_a_start_after_noise_has_acted_has_no_burst():
    fresh, settled = (
        events_of(dataclasses.replace(noisy(4.83), noise=dataclasses.replace(noisy(4.83).noise, history_s=seconds)), 1,
                  [light(LIT, t) for t in (0.0, 0.1)], 0.0, np.array([0.1])).sum() for seconds in (0.0, 100.0)
    )  # fmt: skip
    assert fresh > 20 * max(settled, 1)


@pytest.mark.parametrize("a", [3.0, 4.0])
def test_a_start_after_noise_has_acted_has_the_rate_of_later_times(a):
    """Levels have settled, though each pixel's noise ran only as long as its own level takes for that."""
    p = dataclasses.replace(noisy(a), noise=dataclasses.replace(noisy(a).noise, spread=0.1, history_s=1000.0))
    frames, edges_s = [light(LIT, t) for t in (0.0, 0.2, 10.0, 10.2)], np.array([0.2, 10.0, 10.2])
    found = events_of(p, 1, frames, 0.0, edges_s)
    assert found[:, 2].sum() > 300
    assert_alike(found[:, :1], found[:, 2:])


def test_noise_before_the_start_acts_in_the_light_of_the_reset():
    """The first step ends in light that is no number, in which no noise acts."""
    noise = dataclasses.replace(noisy(4.83).noise, history_s=100.0)
    frames = [light(LIT, 0.0), light(np.nan, 1e-8), light(LIT, 2e-8), light(LIT, 0.1)]
    p = dataclasses.replace(noisy(4.83), noise=noise)
    fresh = events_of(noisy(4.83), 1, frames, 0.0, np.array([0.1])).sum()
    assert fresh > 20 * max(events_of(p, 1, frames, 0.0, np.array([0.1])).sum(), 1)


def test_pixels_with_more_noise_fire_more_often():
    p = dataclasses.replace(noisy(4.0), noise=dataclasses.replace(noisy(4.0).noise, spread=0.2, history_s=5.0))
    frames, until_s = [light(LIT, t) for t in (0.0, 3.0)], np.array([3.0])
    counts = events_of(p, 1, frames, 0.0, until_s).sum(1)
    even = events_of(noisy(4.0), 1, frames, 0.0, until_s).sum(1)
    assert counts.max() > 3 * even.max()

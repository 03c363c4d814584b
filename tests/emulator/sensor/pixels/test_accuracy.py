"""The float32 kernels against the continuous-time pixel in float64, integrated finely, sharing no code with them."""

from functools import lru_cache, partial

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import brentq
from scipy.special import erf

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import Field
from emulator.sensor.presets import ReadoutParameters
from tests.laboratory.accuracy.rows import row

PIXELS = 60
FINE_S = 2e-5


def sensor(**changes):
    return row(PIXELS, readout=ReadoutParameters(event_ns=80.0, row_ns=80), **changes)


def sine(t, hz=20.0, swing=1.73):
    """Light of each pixel at times t, phases spread: (pixels, times)."""
    phase = np.linspace(0, 2 * np.pi, PIXELS, endpoint=False)[:, None]
    return 0.5 * np.exp(swing / 2 * np.sin(2 * np.pi * hz * t + phase))


def edge(t, sigma=1.0, speed=100.0):
    """A blurred 10:1 edge passing the pixels one after the other."""
    x = np.linspace(-12, 12, PIXELS)[:, None]
    rise = 0.5 * (1 + erf((speed * (t - 0.2) - x) / sigma / np.sqrt(2)))
    return 0.1 + 0.9 * rise


sharper, sharpest = partial(edge, sigma=0.5), partial(edge, sigma=0.3)


def ramp(t):
    """Light that rises by a constant factor a second, another for each pixel."""
    return 0.05 * np.exp(np.linspace(2, 8, PIXELS)[:, None] * t)


def flash(t):
    """Light that goes from 0.01 to 1 at an instant of its own for each pixel."""
    return np.where(t < 0.02 + np.linspace(0, 0.02, PIXELS)[:, None], 0.01, 1.0)


def filtered(light, p, t_end):
    """The continuous-time filter by RK4 at 20 us: times, values and slopes of each pixel, (times, pixels)."""
    n = round(t_end / FINE_S)
    current = light(np.arange(2 * n + 3) * (FINE_S / 2)).T + p.dark_current_relative
    u = np.log(current)
    rate = 2 * np.pi * np.clip(p.corner_hz_at_reference * current, p.corner_min_hz, p.corner_max_hz)
    v = u[0]
    values, slopes = np.empty((n + 1, PIXELS)), np.empty((n + 1, PIXELS))
    for k in range(n + 1):
        j = 2 * k
        k1 = rate[j] * (u[j] - v)
        values[k], slopes[k] = v, k1
        k2 = rate[j + 1] * (u[j + 1] - v - FINE_S / 2 * k1)
        k3 = rate[j + 1] * (u[j + 1] - v - FINE_S / 2 * k2)
        k4 = rate[j + 2] * (u[j + 2] - v - FINE_S * k3)
        v = v + FINE_S / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.arange(n + 1) * FINE_S, values, slopes


@lru_cache
def reference_events(light, p, t_end):
    """Events of each pixel, [(t, on)...]: the fine filter, and root finding on its dense output."""
    array = started(p, light)
    on, off, leak, r = (
        array.field(f).reshape(-1).astype(float) for f in (Field.ON, Field.OFF, Field.LEAK, Field.REFERENCE)
    )
    grid, values, slopes = filtered(light, p, t_end)
    return [
        walk(CubicHermiteSpline(grid, values[:, j] + leak[j] * grid, slopes[:, j] + leak[j]), grid, r[j], on[j], off[j],
             p.refractory_us * 1e-6)
        for j in range(PIXELS)
    ]  # fmt: skip


def walk(g, grid, r, on, off, refractory):
    dense, t, events = g(grid), 0.0, []
    while True:
        after = np.searchsorted(grid, t, side="right")
        beyond = np.flatnonzero((dense[after:] - r >= on) | (dense[after:] - r <= -off))
        if beyond.size == 0:
            return events
        k = after + beyond[0]
        rising = dense[k] > r
        level = r + on if rising else r - off
        start = max(t, grid[k - 1])
        t = (
            brentq(lambda x, level=level: g(x) - level, start, grid[k], xtol=1e-12)
            if (g(start) < level) == rising
            else start
        )
        events.append((t, rising))
        t, r = (t, level) if refractory == 0 else (t + refractory, float(g(min(t + refractory, grid[-1]))))


def kernel_events(light, array, t_end, dt):
    """Events of each pixel, [(t, on)...], from the array stepped over the same light."""
    events = [[] for _ in range(PIXELS)]
    for k in range(1, round(t_end / dt) + 1):
        now = light(np.array([k * dt])).reshape(1, -1).astype(np.float32)
        c = array.step(LightFrame(round(k * dt * 1e9), now))
        for t, pixel, on in zip(c.t_ns, c.pixel, c.on, strict=True):
            events[pixel].append((t * 1e-9, bool(on)))
    return events


def started(parameters, light, seed=3):
    array = PixelArray(parameters, seed)
    array.reset(LightFrame(0, light(np.array([0.0])).reshape(1, -1).astype(np.float32)))
    return array


def score(light, parameters, t_end, dt):
    """Share of pixels with the right sequence; |error| in us at 50 % and 95 % over those; ratio of counts."""
    truth = reference_events(light, parameters, t_end)
    ours = kernel_events(light, started(parameters, light), t_end, dt)
    right, errors = 0, []
    for a, b in zip(truth, ours, strict=True):
        if [on for _, on in a] == [on for _, on in b]:
            right += 1
            errors += [abs(x - y) * 1e6 for (x, _), (y, _) in zip(a, b, strict=True)]
    count = sum(map(len, ours)) / sum(map(len, truth))
    return right / PIXELS, float(np.quantile(errors, 0.5)), float(np.quantile(errors, 0.95)), count


# Median and 95th percentile of the timestamp error in us that a straight line in log light left in a prototype, for
# such scenes and steps (0.4 s, contrast 10:1, 60-150 pixels).
LINE = [
    (sine, 1e-4, 0.068, 0.19),
    (sine, 5e-4, 1.7, 4.8),
    (sine, 1e-3, 6.7, 19),
    (sharper, 2e-3, 41, 119),
    (sharpest, 5e-4, 3.7, 12),
    (sharpest, 2e-3, 60, 194),
    (edge, 5e-3, 131, 401),
]


@pytest.mark.system
@pytest.mark.parametrize(("light", "dt", "t50", "t95"), LINE)
def test_timestamps_are_within_twice_what_a_straight_line_leaves(light, dt, t50, t95):
    right, median, high, count = score(light, sensor(), 0.4, dt)
    assert right >= 0.9
    assert median <= 2 * t50
    assert high <= 2 * t95
    assert count == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("light", [sine, edge], ids=["sine", "edge"])
def test_the_step_is_of_second_order(light):
    _, coarse, _, _ = score(light, sensor(), 0.4, 1e-3)
    _, fine, _, _ = score(light, sensor(), 0.4, 2.5e-4)
    assert coarse / fine > 3.5**2


def test_a_ramp_in_log_light_leaves_only_the_change_of_the_time_constant_within_a_step():
    right, median, high, _ = score(ramp, sensor(), 0.4, 1e-3)
    assert right == 1
    assert median < 1
    assert high < 1.5


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("refractory_us", [10.0, 100.0, 1000.0, 5000.0])
def test_the_reference_is_read_anew_when_the_refractory_period_ends(refractory_us):
    """V2eExactFilter against the truth; deferring events instead gives up to 3.6 times as many."""
    for light in (sine, edge):
        right, _, high, count = score(light, sensor(refractory_us=refractory_us), 0.4, 1e-3)
        assert right >= 0.85
        assert count == pytest.approx(1, abs=0.01)
        assert high < 100


@pytest.mark.parametrize(
    ("dt", "corner_hz"), [(1e-4, 300.0), (1e-3, 300.0), (1e-2, 300.0), (1e-2, 30.0), (5e-3, 100.0)]
)
def test_a_flash_keeps_its_sequence_of_events(dt, corner_hz):
    """100:1 at an instant that the pictures do not tell: the best possible is half a step, a line leaves more.

    With slow corners the exponential goes on for steps after the flash, and a cubic alone gets the sequence wrong.
    """
    slow = sensor(corner_hz_at_reference=corner_hz, corner_max_hz=corner_hz)
    right, median, _, count = score(flash, slow, 0.1, dt)
    assert right >= 0.99
    assert median < 0.6 * dt * 1e6
    assert count == 1


@pytest.mark.parametrize("steps", [1, 3, 6, 40])
def test_a_filter_that_settles_fires_at_the_times_of_its_exponential(steps):
    """Closed form: after a jump at time 0 the filter lacks e^(-rate t) of it. One step of 12 time constants or many."""
    parameters = sensor(corner_hz_at_reference=100.0, corner_min_hz=100.0, corner_max_hz=100.0, leak_hz=0.0)
    dark, bright = (np.full((1, PIXELS), x, np.float32) for x in (0.01, 1.0))
    array = PixelArray(parameters, 3)
    array.reset(LightFrame(-1, dark))
    level, on = (array.field(f)[0].astype(float) for f in (Field.REFERENCE, Field.ON))
    u0, u1 = np.log(dark[0, 0] + 1e-4), np.log(bright[0, 0] + 1e-4)
    array.step(LightFrame(0, bright))
    ours = [[] for _ in range(PIXELS)]
    for k in range(1, steps + 1):
        c = array.step(LightFrame(k * 20_000_000 // steps, bright))
        for t, pixel in zip(c.t_ns, c.pixel, strict=True):
            ours[pixel].append(t)
    for pixel in range(PIXELS):
        levels = np.arange(level[pixel] + on[pixel], u1, on[pixel])
        times = -np.log((u1 - levels) / (u1 - u0)) / (2 * np.pi * 100.0) * 1e9
        times = times[times < 19.9e6]
        assert np.max(np.abs(np.array(ours[pixel][: times.size]) - times) * (u1 - levels[: times.size])) < 2_000

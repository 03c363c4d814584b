"""Windows of the search for passages: no hazard within a window is above the bound below which points are drawn."""

import numpy as np
import pytest

from emulator.sensor.noise.hazard import hazard_tables
from emulator.sensor.numerics.keyed import CERTAIN_HZ
from emulator.sensor.pixels import passage
from emulator.sensor.pixels.passage import Piece

THRESHOLD = 0.25
INSIDE = np.linspace(0.02, 0.98, 13)
LONG_AGO_NS = -1e12
NEVER_HZ = 1e-9  # beyond 8 deviations, where the tables end, a hazard is this small


def curve(rng, pole):
    """Return a random curve of one piece.

    Half of them change by up to four thresholds in 0.2 to 80 ms and may turn, half are edges that come to a stop.
    """
    span_ns = 10 ** rng.uniform(5.3, 7.9)
    bends = rng.uniform(-1, 1, 3) * THRESHOLD * 10 ** rng.uniform(-2, 0.6)
    if rng.random() < 0.5:
        span_ns *= 0.01
        bends = np.array([3, -3, 1]) * rng.uniform(-1, 1) * THRESHOLD
    rate = 10 ** rng.uniform(3, 4.3)
    piece = Piece(0.0, span_ns, 0.0, *bends, rate, rate * np.exp(bends.sum()))
    return passage.Curve(piece, 1 / span_ns, 0, 0.0, rng.uniform(0, 1e-3), rng.uniform(0.01, 0.06), pole, 0.0)


def state(reference, reset_ns, n_r=0.0, v_r=0.0):
    return passage.State(THRESHOLD, THRESHOLD, np.uint64(7), reference, n_r, v_r, reset_ns)


def stretches(along):
    """Return the times between which a curve does not turn."""
    turns = sorted(set(passage._turns(along)))
    return list(zip([0.0, *turns[:-1]], turns, strict=True))


def hazard_at(t_ns, along, pixel, tables):
    _, h = passage._hazard_at(t_ns, along, pixel, tables)
    return min(h.on + h.off, CERTAIN_HZ)


@pytest.mark.parametrize("pole", [0.0, 2 * np.pi * 4050, 2 * np.pi * 40500])
def test_no_hazard_in_a_window_is_above_its_bound(pole):
    rng, tables, windows = np.random.default_rng(5), hazard_tables(), 0
    for _ in range(150):
        along = curve(rng, pole)
        age_s = rng.uniform(0, 12) / min(along.piece.rate0, pole or np.inf)
        pixel = state(rng.uniform(-0.2, 0.2), rng.choice([LONG_AGO_NS, -1e9 * age_s]), along.rms * rng.normal())
        for begin, limit in stretches(along):
            t = begin
            now, h = passage._hazard_at(t, along, pixel, tables)
            while t < limit and min(h.c_on, h.c_off) > -3:
                to = passage._window_end(t, limit, now, h, along, pixel)
                assert t < to <= limit
                after, at_end = passage._hazard_at(to, along, pixel, tables)
                bound_hz = passage._bound_hz(h.on + h.off, to - t, now, after, at_end)
                assert max(hazard_at(t + x * (to - t), along, pixel, tables) for x in INSIDE) <= bound_hz + NEVER_HZ
                t, now, h, windows = to, after, at_end, windows + 1
    assert windows > 400


@pytest.mark.parametrize("pole", [0.0, 2 * np.pi * 4050, 2 * np.pi * 40500])
@pytest.mark.parametrize("ages", [(0.0, 0.0), (0.1, 12.0), (1e6, 1e7)])
def test_no_hazard_in_a_calm_time_is_above_its_bound(pole, ages):
    rng, tables, calm = np.random.default_rng(6), hazard_tables(), 0
    for _ in range(300):
        along = curve(rng, pole)
        now = passage._signal(0.0, along)
        n_r, v_r = now.noise.sigma * rng.normal(), now.noise.sigma * now.noise.rate * rng.normal() * (pole > 0)
        age_s = rng.uniform(*ages) / min(now.noise.a1, now.noise.a2)
        reference = now.value + (n_r if age_s == 0 else rng.choice([0.0, rng.uniform(-0.2, 0.2)]))
        pixel, limit = state(reference, -1e9 * age_s, n_r, v_r), stretches(along)[0][1]
        to, bound_hz, *_ = passage._calm_window(0.0, limit, now, along, pixel)
        assert 0 <= to <= limit
        if to > 0:
            highest = max(hazard_at(x * to, along, pixel, tables) for x in INSIDE)
            assert highest <= bound_hz + NEVER_HZ
            calm += 1
    assert calm > 100


def highest_over_bound(along, pixel, tables):
    """Return the highest hazard in a calm window from the start of a curve over its bound; 0 without such a window."""
    limit = stretches(along)[0][1]
    to, bound_hz, *_ = passage._calm_window(0.0, limit, passage._signal(0.0, along), along, pixel)
    return max(hazard_at(x * to, along, pixel, tables) - NEVER_HZ for x in INSIDE) / bound_hz if to > 0 else 0.0


@pytest.mark.parametrize("pole", [2 * np.pi * 4050, 2 * np.pi * 13000])
def test_noise_that_runs_towards_a_threshold_is_below_the_bound(pole):
    """Slopes of 4.5 deviations, shortly after a reset: the mean of the noise overshoots its value there."""
    rng, tables, ratios = np.random.default_rng(11), hazard_tables(), []
    for _ in range(300):
        along = curve(rng, pole)
        now = passage._signal(0.0, along)
        sigma, slope = now.noise.sigma, 4.5 * now.noise.sigma * now.noise.rate * rng.choice([-1, 1])
        age_s = rng.uniform(0, 3) / min(now.noise.a1, now.noise.a2)
        pixel = state(now.value + rng.uniform(-0.2, 0.2), -1e9 * age_s, 0.2 * sigma * rng.normal(), slope)
        ratios.append(highest_over_bound(along, pixel, tables))
    assert np.count_nonzero(ratios) > 50
    assert max(ratios) <= 1


def test_noise_that_slows_down_remembers_the_reset():
    """The receptor's rate falls by 200 in 0.2 ms: what was forgotten at its old rate is not, and the signal follows."""
    rng, tables, ratios = np.random.default_rng(12), hazard_tables(), []
    for _ in range(300):
        rate, span_ns = 10 ** rng.uniform(3.6, 4.3), 2e5
        piece = Piece(0.0, span_ns, 0.0, 0.1, 0.0, 0.0, rate, rate / 200)
        along = passage.Curve(piece, 1 / span_ns, 0, 0.0, 0.0, 0.033, 0.0, 0.0)
        pixel = state(rng.uniform(-0.08, 0.0), -1e9 * rng.uniform(2, 10) / rate, 0.075)
        ratios.append(highest_over_bound(along, pixel, tables))
    assert np.count_nonzero(ratios) > 50
    assert max(ratios) <= 1


def test_a_search_for_a_time_stops_just_before_the_signal_is_there():
    rng, near = np.random.default_rng(7), 0
    for _ in range(200):
        along = curve(rng, 0.0)
        _, limit = stretches(along)[0]
        now, end = passage._signal(0.0, along), passage._signal(limit, along)
        travel = 0.5 * abs(end.value - now.value)
        t = passage._time_at(0.0, limit, travel, now, along)
        gone = abs(passage._signal(t, along).value - now.value)
        assert 0 <= t <= limit
        assert gone <= travel
        near += gone > 0.8 * travel
    assert near > 150

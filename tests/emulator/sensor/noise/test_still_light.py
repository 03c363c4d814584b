"""Noise events in still light beside rates and waits of an independent Monte Carlo.

The noise was followed on a grid of exact transitions, of a fiftieth of its time constant for one pole, with a bridge
between two grid points; of a twentieth of the geometric mean of both time constants for two, with the cubic between
them. Comparator, dead time, reference = signal + noise at its end: a pixel of the textbook, which shares nothing with
the solver. One pole: 64 pixels, 2000 to 16 000 time constants, error of the rates .3 to .5 %. Two: 96 pixels, .3 to 3
s, errors below. ON thresholds are 4 % above OFF, of one pole too; references begin at random phases, as here.

Rates are compared within 3 %, or 3.9 standard errors of both where that is more: a solver that is right fails in one
of 10 000 cases. The share of waits below a quantile is compared within .015, beside the rounding of the quantile.
"""

import math

import numpy as np
import pytest

from tests.emulator.sensor.noise.noisy_arrays import (
    MS,
    QUANTILES,
    events_of,
    one_pole,
    statistics_of,
    still,
    two_poles,
)

Z = 3.9

# Dead time over tau; threshold over sigma; rate tau; share of opposite successors; quantiles of the wait, tau.
ONE_POLE = [
    (0.02, 1.6, 0.624, 0.733, (0.29, 0.63, 1.15, 2.10, 4.50)),
    (0.02, 2.0, 0.356, 0.816, (0.45, 0.98, 1.87, 3.58, 8.48)),
    (0.02, 3.0, 0.0870, 0.932, (0.89, 1.99, 4.29, 11.7, 48.7)),
    (0.147, 1.6, 0.572, 0.715, (0.42, 0.76, 1.29, 2.26, 4.67)),
    (0.147, 2.5, 0.173, 0.871, (0.81, 1.69, 3.27, 6.97, 19.5)),
    (0.5, 2.0, 0.284, 0.731, (0.94, 1.53, 2.51, 4.43, 9.54)),
    (0.5, 3.0, 0.0666, 0.861, (1.54, 3.10, 6.61, 16.7, 57.0)),
]
# tau 1, tau 2, dead time, us; threshold over sigma; rate, Hz; its error; opposite; quantiles of the wait, ms.
TWO_POLES = [
    (52.6, 84, 20, 1.6, 2026, 0.003, 0.812, (0.10, 0.19, 0.33, 0.62, 1.44)),
    (52.6, 84, 20, 2.0, 1262, 0.005, 0.889, (0.13, 0.25, 0.47, 0.95, 2.56)),
    (52.6, 84, 20, 3.0, 285, 0.014, 0.965, (0.19, 0.40, 0.93, 2.87, 15.9)),
    (52.6, 84, 2, 2.0, 1177, 0.005, 0.850, (0.13, 0.26, 0.49, 1.03, 2.76)),
    (52.6, 84, 100, 3.0, 220, 0.010, 0.923, (0.26, 0.54, 1.32, 4.16, 20.1)),
    (84, 84, 20, 2.0, 997, 0.006, 0.881, (0.16, 0.31, 0.58, 1.20, 3.29)),
    (487, 84, 20, 1.6, 575, 0.004, 0.765, (0.31, 0.64, 1.17, 2.22, 5.06)),
    (487, 84, 20, 3.0, 69.6, 0.012, 0.942, (0.69, 1.56, 3.72, 12.4, 64.2)),
    (1900, 84, 20, 2.0, 122, 0.006, 0.836, (1.19, 2.64, 5.07, 10.2, 25.9)),
    (5000, 84, 20, 2.0, 54.5, 0.007, 0.832, (2.71, 6.10, 11.6, 22.8, 56.6)),
]


def assert_alike(found, rate, error, opposite, quantiles):
    assert abs(found.rate_hz / rate - 1) < max(0.03, Z * math.hypot(found.error, error)), found.rate_hz / rate
    assert found.opposite == pytest.approx(opposite, abs=max(0.01, Z / math.sqrt(found.waits_s.size)))
    for share, quantile in zip(QUANTILES, quantiles, strict=True):
        rounding = 0.5 * 10 ** (math.floor(math.log10(quantile)) - (1 if quantile < 1 else 2)) + 1e-12
        below = [(found.waits_s < quantile + sign * rounding).mean() for sign in (-1, 1)]
        assert below[0] - 0.015 < share < below[1] + 0.015, (quantile, below)


@pytest.mark.parametrize(("dead", "a", "rate", "opposite", "quantiles"), ONE_POLE)
def test_events_of_one_pole(dead, a, rate, opposite, quantiles):
    tau_s = 1e-3
    p = one_pole(a, tau_s, 0.04, refractory_us=dead * tau_s * 1e6)
    seconds = 1.0 if rate > 0.2 else 4.0  # a pixel has at most 1024 events in a step
    found = statistics_of(events_of(p, still(), [round(seconds * 1e9)]), seconds)
    waits = found._replace(waits_s=found.waits_s / tau_s)
    assert_alike(waits, rate / tau_s, 0.004, opposite, quantiles)


@pytest.mark.parametrize(
    ("tau1_us", "tau2_us", "dead_us", "a", "rate_hz", "error", "opposite", "quantiles_ms"), TWO_POLES
)
def test_events_of_two_poles(tau1_us, tau2_us, dead_us, a, rate_hz, error, opposite, quantiles_ms):
    p = two_poles(a, tau1_us * 1e-6, tau2_us * 1e-6, 0.04, refractory_us=dead_us)
    seconds = {1.6: 0.3, 2.0: 0.4, 3.0: 1.0}[a] * (1 if tau1_us < 100 else 3)
    step_ns = 100 * MS
    found = statistics_of(events_of(p, still(), range(step_ns, round(seconds * 1e9) + 1, step_ns)), seconds)
    waits = found._replace(waits_s=found.waits_s * 1e3)
    assert_alike(waits, rate_hz, error, opposite, quantiles_ms)


def test_noise_of_other_seeds_is_other_noise_of_the_same_rate():
    p = two_poles(2.0, 52.6e-6, 84e-6)
    first, second, again = (events_of(p, still(), [200 * MS], seed=seed) for seed in (1, 2, 1))
    assert np.array_equal(first.rows(), again.rows())
    assert np.isin(first.t_ns, second.t_ns).mean() < 0.01
    assert len(first.t_ns) == pytest.approx(len(second.t_ns), rel=0.03)

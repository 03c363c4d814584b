"""The law of a sensor's noise: rms and poles by light, and the rates in still light that plans and bounds use."""

import dataclasses
import math

import numpy as np
import pytest

from emulator.sensor.noise.hazard import integral_tables
from emulator.sensor.noise.law import SHARES, Before, corner_hz, fixed_corner_hz, rms, solve_start, still_hz
from emulator.sensor.noise.moments import noise_in
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import PRESETS, SensorParameters
from tests.emulator.sensor.noise.noisy_arrays import ends, events_of, one_pole, statistics_of, still, two_poles
from tests.emulator.sensor.noise.test_still_light import ONE_POLE, TWO_POLES

P = SensorParameters(
    width=4, height=4, threshold_on=0.2, threshold_off=0.2, mismatch=0.0, corner_hz_at_reference=3000.0,
    noise=NoiseParameters(rms=0.08, corner_hz=300.0),
)  # fmt: skip
WITHIN = 1.3


def test_noise_gets_weaker_as_the_fixed_pole_takes_over():
    f = corner_hz(P, [0.001, 0.1, 1.0])
    assert f == pytest.approx([6, 303, 3000])
    assert rms(P, f) == pytest.approx(0.08 * np.sqrt([300 / 306, 300 / 603, 300 / 3300]))
    assert rms(P, f) == pytest.approx([noise_in(*map(np.float32, (x, 300.0, 0.08, 0.0))).sigma for x in f])


def test_without_one_of_the_poles_the_noise_has_the_other():
    ideal = dataclasses.replace(P, corner_hz_at_reference=math.inf)
    assert rms(ideal, corner_hz(ideal, 1.0)) == 0.08
    receptor = dataclasses.replace(P, noise=NoiseParameters(rms=0.05))
    assert math.isinf(fixed_corner_hz(receptor))
    assert rms(receptor, corner_hz(receptor, 1.0)) == 0.05
    assert fixed_corner_hz(dataclasses.replace(receptor, source_follower_hz=250.0)) == 250.0  # the signal's
    assert fixed_corner_hz(dataclasses.replace(P, source_follower_hz=250.0)) == 300.0  # its own


@pytest.mark.parametrize(("dead", "a", "rate"), [row[:3] for row in ONE_POLE])
def test_rates_of_one_pole_in_still_light(dead, a, rate):
    p = one_pole(a, 1e-3, 0.04, refractory_us=dead * 1e3)
    assert sum(still_hz(p, math.inf)) * 1e-3 == pytest.approx(rate, rel=WITHIN - 1)


@pytest.mark.parametrize(("tau1_us", "tau2_us", "dead_us", "a", "rate_hz"), [row[:5] for row in TWO_POLES])
def test_rates_of_two_poles_in_still_light(tau1_us, tau2_us, dead_us, a, rate_hz):
    p = two_poles(a, tau1_us * 1e-6, tau2_us * 1e-6, 0.04, refractory_us=dead_us)
    assert sum(still_hz(p, p.corner_hz_at_reference)) == pytest.approx(rate_hz, rel=WITHIN - 1)


def test_rates_are_means_over_pixels_with_thresholds_of_their_own():
    """Low thresholds fire so often that they make the mean; ON and OFF share the pixels' events."""
    even = dataclasses.replace(
        P, threshold_on=0.22, threshold_off=0.18, leak_hz=0.0, noise=NoiseParameters(rms=0.15, corner_hz=300.0)
    )
    spread = dataclasses.replace(even, mismatch=0.12, width=60, height=40)
    rates = still_hz(spread, 3000.0)
    assert sum(rates) > 1.2 * sum(still_hz(even, 3000.0))
    p = dataclasses.replace(spread, noise=dataclasses.replace(spread.noise, history_s=20.0))
    found = events_of(p, still(), ends(500, 4000))
    assert 1 / WITHIN < statistics_of(found, 4.0).rate_hz / sum(rates) < WITHIN
    assert found.on.mean() == pytest.approx(rates.on / sum(rates), abs=0.02)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("noise_rms", [0.0, 1e-12, 2e-3])
def test_noise_far_below_the_thresholds_is_silent(noise_rms):
    p = dataclasses.replace(P, leak_hz=0.0, random_start=False, noise=NoiseParameters(rms=noise_rms, corner_hz=300.0))
    assert sum(still_hz(p, 1000.0)) < 1e-20
    assert len(events_of(p, still(), [10**9]).t_ns) == 0
    leaking = dataclasses.replace(p, leak_hz=0.3)
    assert still_hz(leaking, 1000.0) == pytest.approx((0.3, 0.0), rel=0.01)


@pytest.mark.parametrize("deviations", [5.0, 6.0])
def test_leak_carries_references_to_where_noise_is_frequent(deviations):
    """The sum of leak and of the rate of noise without it is much too low.

    The law's 1.2 is more than five standard errors of the rate that the array has, which is asserted.
    """
    p = two_poles(deviations, 1e-3, 1e-4, leak_hz=0.1, leak_spread=0.0)
    p = dataclasses.replace(p, noise=dataclasses.replace(p.noise, history_s=100.0))
    found = events_of(p, still(), ends(500, 20_000))
    true, rates = statistics_of(found, 20.0), still_hz(p, p.corner_hz_at_reference)
    assert true.error < 0.04
    assert 1 / 1.2 < sum(rates) / true.rate_hz < 1.2
    assert found.on.mean() == pytest.approx(rates.on / sum(rates), abs=0.03)
    apart = sum(still_hz(dataclasses.replace(p, leak_hz=0.0), p.corner_hz_at_reference)) + p.leak_hz
    assert apart < true.rate_hz / 2


@pytest.mark.parametrize("on", [94.0, 99.0, 300.0])
@pytest.mark.parametrize("turns", [0.3, 3.0, 30.0])
def test_references_that_leak_moves_are_uniform_at_the_start(on, turns):
    """Between two events the reference of a quiet pixel falls by a threshold at one speed, in cells of any size."""
    quantiles = np.empty(SHARES.size, np.float32)
    solve_start(on, 0.9 * on, 12_600.0, turns, Before(100.0, 1.0, 3.4e-6, 1800.0, 0.0), integral_tables(), quantiles)
    to_threshold = np.array([3.0, 5.0, 10.0, 0.2 * on, 0.5 * on, 0.8 * on])
    shares = np.interp(to_threshold - on, quantiles, SHARES)
    assert np.diff(shares) * on == pytest.approx(np.diff(to_threshold), rel=0.02)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_have_rates_at_any_light(name):
    p = PRESETS[name]
    hz = [sum(still_hz(p, float(f))) for f in np.unique(corner_hz(p, np.geomspace(1e-6, 1e6, 7)))]
    assert np.all(np.isfinite(hz))
    assert max(hz) < 100

"""Hazards of first passages: closed limits, and the law of noise between a reset and its end."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from numba import njit
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_lyapunov

from emulator.sensor.noise.hazard import (
    FARTHEST,
    LEAST_RATIO,
    ONE_POLE,
    exit_speed,
    integral_tables,
    pair_factors,
    rate_of,
    slice_of,
)
from emulator.sensor.noise.moments import Signal, Start, moments_over, nearness, noise_in

TABLES = integral_tables()
LONG_S = 1e3
FAR = 1e3
F0, F1 = np.float32(0), np.float32(1)


class Hazard(NamedTuple):
    on: float
    off: float


@njit
def settled_or_aged(s, signal, start, noise, tables):
    """The hazards at a time s after a reset, as a slice of a burst has them."""
    near = nearness(s, signal, start, noise)
    k, rise = slice_of(near.z), np.float32(0.5) * (near.nu_on - near.nu_off)
    share = near.deviation**4 / (F1 + rise * rise)
    on_factor, off_factor = pair_factors(tables, near.c_on, near.c_off, near.z, share, True)
    on = near.slope * rate_of(tables, k, noise.apart, near.c_on, near.nu_on, True) * on_factor
    return on, near.slope * rate_of(tables, k, noise.apart, near.c_off, near.nu_off, True) * off_factor


def hazard(s, signal, noise, n_r=0.0, v_r=0.0):
    signal, start = Signal(*map(np.float32, signal)), Start(np.float32(n_r), np.float32(v_r))
    return Hazard(*settled_or_aged(np.float32(s), signal, start, noise, TABLES))


def noise_of(a1, a2, rms, high=0.0):
    return type(noise_in(F1, F1, F1, F0))(*map(np.float32, noise_in(*map(np.float32, (a1, a2, rms, high)))))


def poles_of(b, slower=1000.0):
    """Rates of two poles of the ratio sqrt(a1 a2) / (a1 + a2) = 1 / b, the slower one first, 1/s."""
    return slower, slower * (b * b / 2 - 1 + b * math.sqrt(b * b / 4 - 1))


def of_unit_rms(a1, a2):
    """Noise of unit deviation behind both poles."""
    return noise_of(a1, a2, math.sqrt((a1 + a2) / a2)) if a2 else noise_of(a1, 0.0, 1.0)


def rice(noise, c, speed):
    slope = math.sqrt(noise.a1 * noise.a2)
    nu = speed / slope
    return slope * stats.norm.pdf(c) * (stats.norm.pdf(nu) + nu * stats.norm.cdf(nu))


@pytest.mark.parametrize("b", [2.0, 2.3, 3.0, 5.0, 7.9])
@pytest.mark.parametrize(("c", "nu"), [(3.0, 4.0), (5.0, 2.0), (7.0, 1.0), (1.0, 8.0), (7.4, 0.0)])
def test_a_fast_or_far_threshold_is_passed_as_often_as_rice_says(b, c, nu):
    """Times 1 / Phi(c): paths that were beyond the threshold when it came are not first ones."""
    noise = of_unit_rms(*poles_of(b))
    found = hazard(LONG_S, (c, FAR, nu * noise.rate, 0.0), noise)
    still = nu * c < 20  # the slower, the more often a path comes back
    assert found.on == pytest.approx(rice(noise, c, nu * noise.rate) / stats.norm.cdf(c), rel=0.3 if still else 0.02)
    assert found.on <= 1.01 * rice(noise, c, nu * noise.rate) / stats.norm.cdf(c)
    assert found.off == 0


@pytest.mark.parametrize("a", [(1000.0, 0.0), poles_of(2.0), poles_of(4.0), poles_of(20.0)])
@pytest.mark.parametrize("c", [0.5, 2.0, 4.0])
def test_a_very_fast_threshold_cuts_frozen_noise(a, c):
    noise = of_unit_rms(*a)
    speed = 1e4 * max(noise.rate, math.sqrt(noise.a1 * noise.a2))
    found = hazard(LONG_S, (FAR, c, -speed, 0.0), noise).off
    assert found == pytest.approx(speed * stats.norm.pdf(c) / stats.norm.cdf(c), rel=0.01)


@pytest.mark.parametrize("nu", [0.0, 0.5, 2.0, -0.3])
@pytest.mark.parametrize("c", [0.5, 1.5, 3.0, 4.5])
def test_poles_so_far_apart_that_they_act_as_one_have_the_hazard_of_two(c, nu):
    """A ratio a little below and above the limit: there the law changes from one to the other."""
    values = []
    for b in (1 / LEAST_RATIO + 1e-4, 1 / LEAST_RATIO - 1e-4):
        noise = of_unit_rms(*poles_of(b))
        assert (noise.z > ONE_POLE) == (b > 1 / LEAST_RATIO)
        speed = nu * math.sqrt(noise.a1 * noise.a2)
        values.append(hazard(LONG_S, (c, FAR, speed, 0.0), noise).on)
    assert values[0] == pytest.approx(values[1], rel=0.04)


@pytest.mark.parametrize("b", [2.0, 2.5, 4.0, 10.0])
def test_the_order_of_the_poles_does_not_matter(b):
    first, second = poles_of(b)
    one, other = of_unit_rms(first, second), of_unit_rms(second, first)
    assert one.sigma == pytest.approx(other.sigma)
    found = [hazard(3e-4, (1.5, 2.0, 100.0, 0.0), noise, 0.3, 50.0) for noise in (one, other)]
    assert found[0].on == pytest.approx(found[1].on, rel=1e-6)
    assert found[0].off == pytest.approx(found[1].off, rel=1e-6)


def test_the_noise_of_a_light():
    """Of rms behind the receptor; the fixed pole passes a2 / (a1 + a2) of its power."""
    assert noise_of(300.0, 100.0, 0.2).sigma == pytest.approx(0.1)
    assert noise_of(300.0, 0.0, 0.2)[:2] == pytest.approx((0.2, 300.0))  # no fixed pole
    assert noise_of(1e12, 100.0, 0.2)[:2] == pytest.approx((0.2, 100.0))  # no receptor
    assert noise_of(300.0, 100.0, 0.2).rate == pytest.approx(math.sqrt(3e4))
    assert noise_of(1e5, 100.0, 0.2).rate == pytest.approx(1 / (1e-5 + 1e-2))


@pytest.mark.parametrize(
    ("a1", "a2", "high"), [(2e3, 25e3, 200.0), (2e2, 25e3, 200.0), (14e3, 25e3, 3e3), (1e3, 0, 80)]
)
def test_the_noise_behind_a_high_pass_has_the_variances_of_three_poles(a1, a2, high):
    """Of the value and of its slope, by Lyapunov's equation of white noise behind the filters."""
    noise, two = noise_of(a1, a2, 0.2, high), a2 > 0
    poles = np.array([[-a1, 0, 0], [a2, -a2, 0], [0, high, -high]]) if two else np.array([[-a1, 0], [high, -high]])
    white = np.zeros_like(poles)
    white[0, 0] = 2 * a1 * 0.2**2
    covariance = solve_continuous_lyapunov(poles, -white)
    output = np.array([0, 1, -1]) if two else np.array([1, -1])
    assert noise.sigma == pytest.approx(math.sqrt(output @ covariance @ output))
    if two:  # the slope of one pole is infinite
        slope = output @ poles
        assert noise.sigma**2 * noise.a1 * noise.a2 == pytest.approx(slope @ covariance @ slope)
    if two and not math.isclose(noise.a1, noise.a2, rel_tol=1e-3):  # else both would be complex: three near poles
        assert 2 * noise.sigma**2 * noise.a1 * noise.a2 * (noise.a1 + noise.a2) == pytest.approx(white[0, 0] * a2**2)


def matrices(s, noise):
    m, k, total = moments_over(np.float32(s), noise), noise.a1 * noise.a2, noise.a1 + noise.a2
    c = k * total * m.p12**2
    return np.array([[m.p11, m.p12], [-k * m.p12, m.p22]]), np.array([[m.v, c], [c, m.w * k]])


@pytest.mark.parametrize("a", [poles_of(2.0), poles_of(2.00001), poles_of(2.8), poles_of(7.5), (9000.0, 9001.0)])
def test_noise_is_carried_over_times_as_its_equation_says(a):
    noise = of_unit_rms(*a)
    k, both = a[0] * a[1], a[0] + a[1]
    step = np.array([[0, 1], [-k, -both]])

    def moments(_, y):
        mean, spread = y[:4].reshape(2, 2), y[4:].reshape(2, 2)
        noise_in = np.array([[0, 0], [0, 2 * k * both]])
        return np.concatenate([(step @ mean).ravel(), (step @ spread + spread @ step.T + noise_in).ravel()])

    for s in np.array([1e-4, 1e-2, 0.3, 3.0]) / both:
        start = np.concatenate([np.eye(2).ravel(), np.zeros(4)])
        y = solve_ivp(moments, (0, s), start, rtol=1e-11, atol=1e-14).y[:, -1]
        mean, spread = matrices(s, noise)
        scale = np.array([[1, 1 / math.sqrt(k)], [math.sqrt(k), 1]])
        assert np.abs(mean - y[:4].reshape(2, 2)).max(where=np.eye(2, dtype=bool), initial=0) < 1e-3
        assert (mean / scale) == pytest.approx(y[:4].reshape(2, 2) / scale, rel=2e-3, abs=1e-6)
        assert spread == pytest.approx(y[4:].reshape(2, 2), rel=3e-3)
    _, spread = matrices(LONG_S, noise)
    assert spread == pytest.approx(np.diag([1, k]), rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("a", [(1000.0, 0.0), poles_of(2.1), poles_of(5.0), poles_of(30.0)])
def test_hazards_fall_with_the_distance_and_end(a):
    noise = of_unit_rms(*a)
    c = np.arange(-1.0, FARTHEST + 2, 0.25)
    for speed in np.array([0.0, 0.1, 1.0, 10.0]) * noise.rate:
        found = [hazard(LONG_S, (x, FAR, speed, 0.0), noise).on for x in c]
        assert np.all(np.diff(found) <= 0)
        assert found[-1] == 0 < found[-12]


@pytest.mark.parametrize("nu", [0.0, 1.0, 6.0, 20.0])
def test_the_noise_leaves_with_the_speed_of_a_crossing(nu):
    """Mean of Rice's density u phi(u - nu): an integral in closed form; first passages are faster by 15 % at most."""
    shares = (np.arange(4000) + 0.5) / 4000
    mean = np.mean([exit_speed(TABLES, *map(np.float32, (nu, 6.0, share, 5.2))) for share in shares])
    pdf, cdf = stats.norm.pdf(nu), stats.norm.cdf(nu)
    assert mean == pytest.approx((nu * pdf + (1 + nu * nu) * cdf) / (pdf + nu * cdf), rel=0.03)
    nearer = np.mean([exit_speed(TABLES, *map(np.float32, (nu, 1.0, share, 5.2))) for share in shares])
    assert mean <= nearer * 1.01 <= 1.2 * mean

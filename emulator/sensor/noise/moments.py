"""Noise of a column: its poles along a piece of light, and its mean and variance since a reset, in float32.

The formulas are those of `hazard`, without a branch, so that loops over columns become vectors; rates are 1/s, or in
units of a piece. lo <= hi are the rates of the poles; over a time s, with e = e^(-lo s),

    p12 = e s (1 - e^-y) / y, y = (hi - lo) s        p11 = e + lo p12        p22 = e - hi p12        p21 = -lo hi p12

which holds for equal poles too. Differences of nearly equal numbers are replaced by their series below X = (lo + hi) s
of .15 (variance of the value) and .01 (of the slope).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.sensor.noise.hazard import LEAST_RATIO, ONE_POLE
from emulator.sensor.numerics.compiled import Real, lane
from emulator.sensor.numerics.elementary import decay, exponential

_ZERO, _HALF, _ONE, _TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
_LEAST_RATIO, _A_RATIO = np.float32(LEAST_RATIO), np.float32(16)
_LAST_TWO, _OF_ONE = np.float32(5.999), np.float32(7)
_NO_POLE = np.float32(1e11)  # rad/s: a pole that fast is none
_TINY, _SMALL_GAP = np.float32(1e-20), np.float32(1e-3)
_SMALLEST_GAP = np.float32(1e-6)
_SHORT, _SHORTEST = np.float32(0.15), np.float32(0.01)
_TWO_THIRDS, _V1, _V2, _V3 = (np.float32(x) for x in (2 / 3, 0.75, 0.35, 0.2))
_LEAST_SLOPE = np.float32(1e-12)


class Noise(NamedTuple):
    """The noise in a light."""

    sigma: Real  # rms at the comparator, ln units
    rate: Real  # geometric mean of the poles' rates, or the one rate
    z: Real  # place along 1/b, (1/b - 1/8) 16; beyond ONE_POLE: one pole
    apart: Real  # 1/b of two poles that act as one, else 0
    a1: Real  # rates of the poles
    a2: Real


@lane
def noise_in(a1: Real, a2: Real, rms: Real, high: Real) -> Noise:
    """Return the noise of a receptor of rate a1, in front of a fixed pole of rate a2; 0: no such pole.

    Behind a high-pass of rate `high` it is that of two poles with the same variance, the same variance of its slope and
    the same density at high frequencies, which is exact on short times.
    """
    no_receptor = a1 > _NO_POLE
    a1, a2 = (a2 if no_receptor else a1), (_ZERO if no_receptor else a2)
    alone = a2 == _ZERO
    total, product = a1 + a2, a1 * a2
    sigma = rms * (_ONE if alone else np.sqrt(a2 / total))
    passed = np.sqrt(a1 / (a1 + high)) * (_ONE if alone else np.sqrt(a2 / (a2 + high)))
    sigma *= passed
    raised = product + high * total
    half = max(_HALF * (total + high - product * high / max(raised, _ONE)), np.sqrt(raised))
    faster = half + np.sqrt(max(half * half - raised, _ZERO))
    filtered = high > _ZERO
    a2 = faster if filtered else a2
    a1 = raised / faster if filtered else a1
    total, product = a1 + a2, a1 * a2
    rate = np.sqrt(product)
    ratio = rate / total
    single = alone | (ratio < _LEAST_RATIO)
    rate_of_one = a1 + a2 if alone else product / total
    z = min((ratio - _LEAST_RATIO) * _A_RATIO, _LAST_TWO)
    apart = ratio if single & ~alone else _ZERO
    return Noise(sigma, rate_of_one if single else rate, _OF_ONE if single else z, apart, a1, a2)


@lane
def slower_rate(noise: Noise) -> Real:
    """Return the rate at which the noise forgets a reset."""
    return noise.rate if noise.z > ONE_POLE else min(noise.a1, noise.a2)


class Moments(NamedTuple):
    """Transition of value and slope over a time, and their covariance over sigma^2 and rate."""

    p11: Real
    p12: Real
    p22: Real
    e: Real  # of one pole
    v: Real  # variance of the value
    w: Real  # of the slope, over a1 a2
    b12: Real  # p12 sqrt(a1 a2)


@lane
def moments_over(s: Real, noise: Noise) -> Moments:
    """Return the moments over a time s."""
    lo, hi = min(noise.a1, noise.a2), max(noise.a1, noise.a2)
    e, y = exponential(-lo * s), (hi - lo) * s
    p12 = e * s * (decay(y) / max(y, _SMALLEST_GAP) if y > _SMALL_GAP else _ONE - _HALF * y)
    p11, p22 = e + lo * p12, e - hi * p12
    product, total = lo * hi, lo + hi
    x, b12 = total * s, np.sqrt(product) * p12
    r2 = product / (total * total)
    early = _TWO_THIRDS * r2 * x * x * x * (_ONE - _V1 * x + (_V2 - _V3 * r2) * x * x)
    v = early if x < _SHORT else _ONE - p11 * p11 - b12 * b12
    w = _TWO * x * (_ONE - x) if x < _SHORTEST else _ONE - b12 * b12 - p22 * p22
    return Moments(p11, p12, p22, exponential(-noise.rate * s), v, w, b12)


class Start(NamedTuple):
    """Value and slope of the noise at a reset."""

    n: Real
    v: Real


class Signal(NamedTuple):
    """Distances of the signal from both thresholds, its speed, and the rate at which sigma shrinks."""

    on: Real
    off: Real
    speed: Real
    narrowing: Real


class Nearness(NamedTuple):
    """Distances and speeds of both thresholds by the noise since a reset, and what an event needs."""

    c_on: Real  # deviations
    c_off: Real
    nu_on: Real  # speeds of approach, in units of `slope`
    nu_off: Real
    slope: Real  # s
    deviation: Real  # over sigma
    pull: Real
    mean_slope: Real
    z: Real


@lane
def nearness(s: Real, signal: Signal, start: Start, noise: Noise) -> Nearness:
    """Return distances and speeds at a time s > 0 after a reset, by the formulas of `hazard`."""
    single = noise.z > ONE_POLE
    m = moments_over(s, noise)
    product, total = noise.a1 * noise.a2, noise.a1 + noise.a2
    mean = start.n * m.e if single else m.p11 * start.n + m.p12 * start.v
    mean_slope = -noise.rate * mean if single else m.p22 * start.v - product * m.p12 * start.n
    variance = max(decay(_TWO * noise.rate * s) if single else m.v, _TINY)
    deviation = np.sqrt(variance)
    inverse = _ONE / deviation
    per_variance = inverse * inverse
    pull = noise.rate * m.e * m.e * per_variance if single else product * total * m.p12 * m.p12 * per_variance
    shared = total * m.p12 * m.b12
    of_two = noise.rate * np.sqrt(max(m.w - shared * shared * per_variance, _LEAST_SLOPE)) * inverse
    slope = noise.rate * per_variance if single else of_two
    ratio = variance * of_two * of_two * of_two / (product * total)
    z = _OF_ONE if single else min(max((ratio - _LEAST_RATIO) * _A_RATIO, _ZERO), _LAST_TWO)
    per_sigma, per_slope = inverse / noise.sigma, _ONE / slope
    c_on, c_off = (signal.on - mean) * per_sigma, (signal.off + mean) * per_sigma
    rise, nearer = (signal.speed + mean_slope) * per_sigma, pull - signal.narrowing
    nu_on, nu_off = (rise + c_on * nearer) * per_slope, (c_off * nearer - rise) * per_slope
    return Nearness(c_on, c_off, nu_on, nu_off, slope, deviation, pull, mean_slope, z)

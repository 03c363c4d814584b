"""The photoreceptor's low-pass over an interval of time, solved in warped time; float32, for loops that become vectors.

Log light u goes from u0 to u1 with given slopes at both ends; the filter follows it at the rate lambda, which depends
on the light. In warped time s, the integral of lambda dt, the filter's time constant is one at any light:

    dv/ds = u - v,    u(s) = the cubic through u0, u1 with the slopes w0, w1 (per whole interval S) at the ends
    v(s)  = u - u' + u'' - u''' + B e^-s                    (primes: d/ds), B such that v(0) = v0

All formulas below are of fourth order in the length of the interval.

A second pole of fixed rate follows v: dw/dt = lambda2 (v - w). Up to S = 1, v is the cubic in time through its values
and slopes. On longer intervals no cubic holds B e^-s, and the first slope alone may put it off by many times B; there
the cubic is used for the steady part of v only, and B e^-s has a closed form, which is accurate where both rates meet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.sensor.numerics.compiled import Real, lane
from emulator.sensor.numerics.elementary import decay, exponential
from emulator.sensor.pixels.state import StepConstants

__all__ = [
    "Course",
    "Filtered",
    "Transient",
    "missed_by_cubic",
    "passed_by_second_pole",
    "photocurrent",
    "rise_behind_second_pole",
    "rise_of_filter",
    "transient",
    "warped_time",
]

_ZERO, _ONE, _TWO, _THREE, _FOUR, _SIX, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 4, 6, 0.5))
_THIRD, _TWELFTH, _A_384TH = np.float32(1 / 3), np.float32(1 / 12), np.float32(1 / 384)
# k = 1/6 - s/24 + s^2/120 ... for s in [0, 0.5]: Chebyshev's polynomial of third degree, within 9e-8.
_K0, _K1, _K2, _K3 = (np.float32(x) for x in (0.16666658, -0.04166122, 0.00827807, -0.00120679))
_SERIES_UP_TO = np.float32(0.5)  # beyond, the closed forms lose less than the series
_SHORTEST = np.float32(0.01)  # below, the error of a cubic for an exponential is below the resolution of float32
_FAST = np.float32(100)  # above, an exponential below _FAINT is rounding noise, which its slope would amplify
_FAINT = np.float32(1e-5)
_LEAST_GAP = np.float32(1e-6)
_LINEAR, _OFFSET = np.float32(0.16), np.float32(0.2)


class Course(NamedTuple):
    """Log light over an interval: its warped length s, its change d, and its slopes at both ends per interval."""

    s: Real
    d: Real
    w0: Real
    w1: Real


class Transient(NamedTuple):
    """The exponential part of the filter's answer: the weight b of e^-s; and the steady lags at both ends."""

    b: Real
    lag0: Real
    lag1: Real
    faint: Real  # whether b is rounding noise, and is to be ignored


class Filtered(NamedTuple):
    """The filter over an interval: its distance from the light at both ends, its rise, and rates times the length."""

    behind0: Real
    behind1: Real
    rise: Real
    r0: Real
    r1: Real


@lane
def photocurrent(u: Real) -> Real:
    """Return the photocurrent of a log light; 0 where it is not known."""
    return exponential(u) if u == u else _ZERO


@lane
def warped_time(h: Real, rates: tuple[Real, Real], a0: Real, a1: Real, c: StepConstants) -> Real:
    """Return the integral of the rate over h seconds, while the log light changes with slopes a0, a1 (per h).

    This is the trapezium rule with end correction, for a rate proportional to the light except at its bounds; the mean
    rate is at least the lower one of both ends.
    """
    l0, l1 = rates
    bend0 = l0 * a0 if (l0 > c.rate_min) & (l0 < c.rate_max) else _ZERO
    bend1 = l1 * a1 if (l1 > c.rate_min) & (l1 < c.rate_max) else _ZERO
    return h * max(_HALF * (l0 + l1) + _TWELFTH * (bend0 - bend1), min(l0, l1))


@lane
def rise_of_filter(q: Real, behind: Real, u: Course) -> Real:
    """Return v1 - v0, with behind = u0 - v0 and q = 1 - e^-s. The rounding error shrinks with s.

    With the integrals I0 = q / s, I1 = (1 - I0) / s, I2 = (1 - 2 I1) / s, k is (1/2 - I1) / s.
    """
    s, d, w0, w1 = u
    inverse, short = _ONE / s, s < _SERIES_UP_TO
    series = ((_K3 * s + _K2) * s + _K1) * s + _K0
    less_i0 = s * (_HALF - s * series) if short else _ONE - q * inverse
    less_i1 = s * series if short else _HALF - less_i0 * inverse
    k = series if short else less_i1 * inverse
    bent = (_SIX * d - _FOUR * w0 - _TWO * w1) * less_i1 + (_THREE * (w0 + w1) - _SIX * d) * (_THIRD - _TWO * k)
    return q * behind + (w0 * less_i0 + bent)


@lane
def transient(behind: Real, u: Course) -> Transient:
    """Return the exponential part of the answer of a filter that starts at `behind` = u0 - v0."""
    inverse = _ONE / max(u.s, _SHORTEST)
    third = _SIX * (u.w0 + u.w1 - _TWO * u.d)  # derivatives of u by s / S
    second = _TWO * (_THREE * u.d - _TWO * u.w0 - u.w1)
    lag0 = inverse * (u.w0 - inverse * (second - inverse * third))
    lag1 = inverse * (u.w1 - inverse * (second + third - inverse * third))
    b = lag0 - behind
    return Transient(b, lag0, lag1, (u.s > _FAST) & (abs(b) < _FAINT))


@lane
def missed_by_cubic(b: Real, s: Real) -> Real:
    """Return the largest error of a cubic through values and slopes at both ends of an interval for b e^-s."""
    s2 = s * s
    return abs(b) * min(s2 * s2 * _A_384TH, _LINEAR * s + _OFFSET)


@lane
def passed_by_second_pole(s: Real, r0: Real, second: Real) -> Real:
    """Return the output of a pole of rate `second` for the input e^-s, at the interval's end; rates times its length.

    s is the warped length, r0 the first filter's rate at the start. Its rate is taken as one constant that has the
    effect of the changing one to first order in the change: the mean, s, weighted towards the start the faster e^-s
    decays. The answer is then second (e^-r - e^-second) / (second - r).
    """
    lead = s - second
    r = r0 + (s - r0) * (_TWO + max(-lead, _ZERO)) / (_THREE + abs(lead))
    gap = max(abs(second - r), _LEAST_GAP)
    return second * exponential(-min(r, second)) * (decay(gap) / gap)


@lane
def rise_behind_second_pole(q: Real, behind: Real, second: Real, u: Course, v: Filtered) -> Real:
    """Return w1 - w0, with behind = v0 - w0, and q = 1 - e^-second.

    `second` is the pole's rate times the length of the interval.
    """
    t = transient(v.behind0, u)
    slow = u.s < _ONE
    b = _ZERO if slow else t.b
    rise = v.rise if slow else u.d - (t.lag1 - t.lag0)
    m0, m1 = v.r0 * (v.behind0 if slow else t.lag0), v.r1 * (v.behind1 if slow else t.lag1)
    followed = rise_of_filter(q, behind - b, Course(second, rise, m0, m1))
    return followed + b * passed_by_second_pole(u.s, v.r0, second)

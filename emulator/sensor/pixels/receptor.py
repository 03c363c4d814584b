"""The large-signal law of the photoreceptor, solved over an interval of time by the fourth-order rules of `curve`.

The feedback transistor of a logarithmic photoreceptor carries e^V where the photodiode carries the photocurrent i; the
output moves as the difference charges the node:

    V' = K (i - e^V),    K = 2 pi corner_hz_at_reference

For small signals this is the low-pass of `curve` with the rate lambda = K i. With bounds on that rate the law is

    V' = lambda(i) (1 - e^(V - u)),    u = ln i

For large signals both directions differ: from the dark the output rises by lambda a second and no faster, whatever the
step; into the dark it falls like a logarithm, -ln(1 + K i1 t). So a first event comes theta / (K i) after a step from
the dark to the light i, and (e^theta - 1) / (K i1) after one from the light i1 into the dark. Measured latencies of an
IMX636 have this law (NIST, doi 10.1109/tim.2025.3623767).

The law is solved by w = e^-V, for which it is linear. In warped time s, the integral of lambda dt,

    dw/ds = e^-u - w

so w follows e^-u as the filter of `curve` follows u, and the same closed forms hold: constant light is exact, and e^-u
is the cubic through its values and slopes at both ends otherwise. All values are relative to w at the interval's start,
which keeps float32 exact for any light: with P = e^(V0 - u), w runs from 1 to 1 + rise, and V falls by ln(1 + rise).

The comparator's curve is again the cubic in time through V and its slopes at both ends. It misses a part of the
exponential in w, as in `curve`, and a part of the logarithm, at most x^4 / 64 where the slopes and the change of V per
interval are below x (the fourth derivative of ln(1 + x z) is at most 6 x^4, and a cubic misses 1/384 of it).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.sensor.numerics.compiled import Real, lane
from emulator.sensor.numerics.elementary import decay, exponential_less_one, log_of_one_more
from emulator.sensor.pixels import curve

_ZERO, _ONE, _TWO, _SIX = (np.float32(x) for x in (0, 1, 2, 6))
_THIRD, _A_64TH = np.float32(1 / 3), np.float32(1 / 64)
_LEAST_W = np.float32(-0.9999999)  # of w's rise: w stays positive

MOST_BEHIND = np.float32(3)
"""Farthest that V may lie below ln i where a step is solved in one piece: w then falls to e^-3 of its value at most,
and loses 1e-6 by rounding. A pixel that is farther behind is solved in substeps, in each of which w changes little."""

_WIDER, _BULGE = np.float32(1.08), np.float32(1.2)  # as in the quiet test of the small-signal law
_CHORD = np.float32(1.57)  # e^x <= 1 + 1.57 x for x up to 0.84, the farthest that smooth light goes
_SMALL = np.float32(0.02)  # an exponential of V that is the same in w, within 2e-4
_MISSED = np.float32(1e-3)  # ln units
_FAINT = np.float32(1e-5)


@lane
def excess_of(behind: Real) -> Real:
    """Return P - 1 = e^(V - u) - 1, by which the output falls per warped time, with behind = u - V."""
    return exponential_less_one(-behind)


@lane
def _reciprocal(excess: Real, u: curve.Course) -> curve.Course:
    """Return the course of P = e^(V0 - u), with excess = P - 1 at the start."""
    p0 = _ONE + excess
    rise = p0 * exponential_less_one(-u.d)
    return curve.Course(u.s, rise, -p0 * u.w0, -(p0 + rise) * u.w1)


@lane
def rise_of_receptor(q: Real, excess: Real, u: curve.Course) -> Real:
    """Return V1 - V0 over an interval, with the excess at its start and q = 1 - e^-s."""
    return -log_of_one_more(max(curve.rise_of_filter(q, excess, _reciprocal(excess, u)), _LEAST_W))


@lane
def bounds_of_receptor(q: Real, behind: Real, excess: Real, d: Real, a0: Real, a1: Real) -> tuple[Real, Real]:
    """Return bounds of the output's rise and fall (<= 0), from the light's Bernstein coefficients.

    With U the highest log light and y = U - V0 the rise is -ln(1 - q (1 - e^-y)) at most, which is below q y. The fall
    is below q (P - 1) for the highest P, and below the distance to the lowest light.
    """
    first = _THIRD * a0  # the inner Bernstein coefficients of the light's change; the outer ones are 0 and d
    last = d - _THIRD * a1
    end = max(d, _ZERO)
    top, bottom = max(end, max(first, last)), min(min(d, _ZERO), min(first, last))
    share = min(q * (_WIDER + _BULGE * (top - end)), _ONE)
    highest = (_ONE + excess) * (_ONE - _CHORD * bottom) - _ONE
    return share * max(behind + top, _ZERO), -min(max(-(behind + bottom), _ZERO), share * max(highest, _ZERO))


@lane
def fourth_derivative(excess: Real, u: curve.Course, allowed: Real) -> Real:
    """Return a bound of the fourth derivative of V by warped time over an interval; 0 if its exponential is faint.

    V falls as -ln(1 + x s) with x = P - 1 where light is lowest: that derivative is 6 y^2 + y at most, y = x (1 + x).
    To w the weight b of its exponential adds as much as light does: no light needs shorter intervals by its own slope.
    """
    p = _reciprocal(excess, u)
    t = curve.transient(excess, p, allowed)
    above = max(max(excess, excess + p.d), _ZERO)
    x = (_ONE + above) * above
    return _ZERO if t.faint else max(abs(t.b), x * (_SIX * x + _ONE))


class Response(NamedTuple):
    """The output over an interval: its slopes at both ends, the weight of the exponential in w, and the cubic's miss.

    The slopes are per interval. `lag0` and `lag1` are the slopes, by warped time, without that exponential.
    """

    m0: Real
    m1: Real
    b: Real
    lag0: Real
    lag1: Real
    missed: Real


@lane
def response(v: curve.Filtered, u: curve.Course, allowed: Real) -> Response:
    """Return the response over an interval from the output's distances below the light at both ends, and its rise.

    A faint exponential is ignored, see `transient`.
    """
    excess0, excess1 = excess_of(v.behind0), excess_of(v.behind1)
    p = _reciprocal(excess0, u)
    t = curve.transient(excess0, p, allowed)
    to_end = (_ONE + excess1) / (_ONE + excess0 + p.d)  # w at the start over that at the end
    b = _ZERO if t.faint else t.b
    lag0, lag1 = -t.lag0, -t.lag1 * to_end
    m0 = v.r0 * (lag0 if t.faint else -excess0)
    m1 = v.r1 * (lag1 if t.faint else -excess1)
    steepest = max(max(abs(m0), abs(m1)), abs(v.rise))
    square = steepest * steepest
    return Response(m0, m1, b, lag0, lag1, curve.missed_by_cubic(b, u.s) + _A_64TH * square * square)


@lane
def rise_behind_second_pole_of_receptor(
    behind: Real, second: Real, u: curve.Course, v: curve.Filtered
) -> tuple[Real, Real]:
    """Return the rise of a second pole behind the receptor, with behind = V0 - w0, and 1 where it is not accurate.

    `second` is the pole's rate times the length of the interval. A faint exponential is the same in V and in w; a
    strong one on a long interval has no closed form, and its pixel must be solved in substeps.
    """
    r = response(v, u, _FAINT)
    cubic = r.missed <= _MISSED
    b = _ZERO if cubic else -r.b
    m0, m1 = (r.m0 if cubic else v.r0 * r.lag0), (r.m1 if cubic else v.r1 * r.lag1)
    q = decay(second)
    followed = curve.rise_of_filter(q, behind - b, curve.Course(second, v.rise + b * decay(u.s), m0, m1))
    inaccurate = _ONE if (not cubic) & (abs(b) > _SMALL) else _ZERO
    return followed + b * curve.passed_by_second_pole(u.s, v.r0, second), inaccurate

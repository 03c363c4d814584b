"""Interpolation of log light within a step with its quality checks, and the low-pass that follows it.

The cubic goes through the values and time derivatives of two frames. d is the change over the step, a0 and a1 are the
slopes per step at its ends. d - (a0 + a1) / 2, the error of the trapezium rule, is zero for a parabola, and as large as
the contrast itself when an edge passed between the frames.

    smooth         the cubic is used as it is, in one piece
    undersampled   that error is more than a share of a threshold, or the light turns by more: the frames are too far
                   apart here. The share is a half; a twentieth or tenth where `refinement` has the light in between
    jump           undersampled, with small slopes at both ends: the change happened in between, and is put at mid-step
    limited        monotone with slopes that no monotone cubic has (Fritsch and Carlson): these are scaled down. Slopes
                   stay where the light turns: a turning point inside a step is real, and its slopes decide its events
    bent           light is almost straight at one end and steep at the other, as where an edge enters or leaves within
                   the step, and the cubic would swing to both sides. A straight line joined to a cubic is used instead:
                   it keeps both values and both slopes, and is convex (concave), so it stays between its tangents

The bend. With delta = d - (a0 + a1) / 2 and g = |a1 - a0| the cubic is convex or concave if |delta| <= g / 6, and such
a curve through these ends exists if |delta| < g / 2. In between the bend has the width w = 3 (1/2 - |delta| / g):

    late    u = a0 z + (a1 - a0) (w / 3) t^3,             t = max(0, z - (1 - w)) / w     |d - a0| < |d - a1|
    early   u = d - a1 (1 - z) + (a1 - a0) (w / 3) t^3,   t = max(0, w - z) / w           else

No rule helps where a whole plateau lies between two frames: the frames do not show it. There the straight line may have
more right sequences than any curve that follows the slopes.

The second half of the module solves the photoreceptor's low-pass over an interval of time; float32, for loops that
become vectors. Log light u goes from u0 to u1 with given slopes at both ends; the filter follows it at the rate lambda,
which depends on the light. In warped time s, the integral of lambda dt, the filter's time constant is one at any light:

    dv/ds = u - v,    u(s) = the cubic through u0, u1 with the slopes w0, w1 (per whole interval S) at the ends
    v(s)  = u - u' + u'' - u''' + B e^-s                    (primes: d/ds), B such that v(0) = v0

All formulas below are of fourth order in the length of the interval.

A second pole of fixed rate follows v: dw/dt = lambda2 (v - w). Up to S = 1, v is the cubic in time through its values
and slopes. On longer intervals no cubic fits B e^-s, and the first slope alone may shift it by many times B; there the
cubic is used for the steady part of v only, and B e^-s has a closed form, which is accurate where both rates are equal.

A high-pass behind them, y = w - h with dh/dt = a (w - h), is h as a pole behind the cubic of w. The state is y: in
still light it decays to 0, and h would stop where a step's change is lost in rounding.

Fast because the answer over an interval is a closed form: no steps of time, few divisions, and choices of values in the
place of branches, so that callers compute 16 pixels at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.sensor.numerics.compiled import Real, lane
from emulator.sensor.numerics.elementary import decay, exponential
from emulator.sensor.pixels.state import StepConstants

_ZERO, _ONE, _TWO, _THREE, _FOUR, _SIX = (np.float32(x) for x in (0, 1, 2, 3, 4, 6))
_HALF, _QUARTER, _EIGHTH, _THIRD = (np.float32(x) for x in (0.5, 0.25, 0.125, 1 / 3))
_BEHIND, _ENDLESS = np.float32(4), np.float32(np.inf)  # log light
_OVERSHOOT = np.float32(4 / 27)  # of a cubic beyond its ends, over its slopes there
LARGEST_CHANGE = np.float32(0.5)
"""Largest change of log light in one piece: the fourth-order rules of the low-pass allow no more."""

UNSEEN_SHARE = np.float32(0.5)
"""Share of a threshold that may stay unseen between two frames; a step with more is undersampled."""

REFINED_UNSEEN_SHARE = np.float32(0.05)
"""The same share where undersampled steps can be refined."""

MOVED_UNSEEN_SHARE = np.float32(0.1)
"""The same share where they are refined with light moved between drawings, whose own errors are larger."""

WORTH_BENDING = np.float32(0.05)
"""Share of a threshold that the trapezium rule may miss before the cubic is replaced by a bend."""

_SLOPES = np.float32(3)  # largest slopes of a monotone cubic, together, in changes ...
_IMMATERIAL = np.float32(0.02)  # ... and a harmless excess: it swings the cubic by less than 0.003
_ONE_SLOPE, _ONE_IMMATERIAL = _SLOPES * np.float32(0.7071), _IMMATERIAL * np.float32(0.7071)
_ABSURD = np.float32(1e9)  # a step
_STEEPEST = np.float32(64)  # bounds the work where slopes and light contradict each other
_ONE_SIDED = np.float32(0.1)  # slopes of different signs bend if one is below this share of the other: no true peak
_SHARPEST = np.float32(1e-4)  # width of a bend, of a step


@lane
def is_smooth(d: Real, a0: Real, a1: Real, threshold: Real, unseen_share: Real) -> Real:
    """Return whether the step can be solved in one piece with the cubic as it is; False with unknown slopes.

    `unseen_share` is the share of the threshold, ln units, that may stay unseen. The test is slightly stricter than
    "neither undersampled, limited nor bent", and takes fewer operations.
    """
    steepest, gap = max(abs(a0), abs(a1)), abs(a0 - a1)
    missed = abs(_TWO * d - (a0 + a1))  # twice the error of the trapezium rule
    # Small enough for the low-pass rules; nothing unseen between the frames, nor a turn higher than gap / 8; neither a
    # bend nor slopes to be limited, as each is one more division. All comparisons are false for NaN.
    one_piece = max(_TWO * abs(d), steepest) <= _TWO * LARGEST_CHANGE
    seen = max(missed, _QUARTER * gap) <= _TWO * (unseen_share * threshold)
    unbent = missed <= max(_TWO * WORTH_BENDING * threshold, _THIRD * gap)
    fits = unbent if a0 * a1 < _ZERO else steepest <= _ONE_SLOPE * abs(d) + _ONE_IMMATERIAL
    return one_piece & seen & fits


@lane
def completed(d: Real, a0: Real, a1: Real) -> tuple[Real, Real]:
    """Return both slopes; an unknown one is that of the parabola, two unknown ones are that of the straight line.

    NaN and values that no light has mean unknown.
    """
    # A parabola's mean slope is its change: the other slope is 2 d less the known one.
    known0, known1 = abs(a0) <= _ABSURD, abs(a1) <= _ABSURD
    first = a0 if known0 else (_TWO * d - a1 if known1 else d)
    last = a1 if known1 else (_TWO * d - a0 if known0 else d)
    return first, last


@lane
def is_undersampled(d: Real, a0: Real, a1: Real, unseen: Real) -> Real:
    """Return whether the light may have changed by more than `unseen`, ln units, unseen by the frames."""
    # A parabola with slopes of two signs rises above its ends by |a0 - a1| / 8 at most.
    turns = (a0 * a1 < _ZERO) & (_EIGHTH * abs(a0 - a1) > unseen)
    return turns | (abs(d - _HALF * (a0 + a1)) > unseen)


@lane
def capped(a0: Real, a1: Real) -> Real:
    """Return the factor that bounds the work for both slopes."""
    return _STEEPEST / max(max(abs(a0), abs(a1)), _STEEPEST)


@lane
def bend_width(d: Real, a0: Real, a1: Real, threshold: Real) -> Real:
    """Return the width of the bend, as a share of the step; 1 where the step has none. The slopes must be capped."""
    away, gap = abs(d - _HALF * (a0 + a1)), abs(a1 - a0)
    opposed = a0 * a1 < _ZERO
    # The cubic swings where a slope is against the change, or the slopes are too steep to be monotone. A turn with two
    # steep sides is a true peak, which the cubic has.
    swings = (min(a0 * d, a1 * d) < _ZERO) | opposed | (a0 * a0 + a1 * a1 > _SLOPES * _SLOPES * d * d)
    no_peak = (min(abs(a0), abs(a1)) <= _ONE_SIDED * max(abs(a0), abs(a1))) | (not opposed)
    possible = (_SIX * away > gap) & (_TWO * away < gap)
    bends = (away > WORTH_BENDING * threshold) & possible & swings & no_peak
    return max(_THREE * (_HALF - away / gap), _SHARPEST) if bends else _ONE


@lane
def limit(d: Real, a0: Real, a1: Real) -> Real:
    """Return the factor that limits both slopes."""
    # Within the circle of radius 3 d a cubic is monotone (Fritsch and Carlson).
    together = np.sqrt(a0 * a0 + a1 * a1)
    turns = min(min(a0 * d, a1 * d), a0 * a1) < _ZERO
    fits = turns | (together <= _SLOPES * abs(d) + _IMMATERIAL)
    not_too_steep = capped(a0, a1)
    return not_too_steep if fits else min(_SLOPES * abs(d) / together, not_too_steep)


_TWELFTH, _A_384TH = np.float32(1 / 12), np.float32(1 / 384)
# k = 1/6 - s/24 + s^2/120 ... for s in [0, 0.5]: Chebyshev's polynomial of third degree, within 9e-8.
_K0, _K1, _K2, _K3 = (np.float32(x) for x in (0.16666658, -0.04166122, 0.00827807, -0.00120679))
_SERIES_UP_TO = np.float32(0.5)  # beyond, the closed forms lose less than the series
_SHORTEST = np.float32(0.01)  # below, the error of a cubic for an exponential is below the resolution of float32
_FAST = np.float32(10)  # above, a cubic with the exponential's slope misses more than one with the steady slopes
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
    faint: Real  # whether b is ignored: the steady lags are the better slopes of a cubic


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
def warped_time(h: Real, l0: Real, l1: Real, a0: Real, a1: Real, c: StepConstants) -> Real:
    """Return the integral of the rate, l0 to l1, over h seconds, while log light changes with slopes a0, a1 (per h).

    This is the trapezium rule with end correction, for a rate proportional to the light except at its bounds; the mean
    rate is at least the lower one of both ends.
    """
    bend0 = l0 * a0 if (l0 > c.rate_min) & (l0 < c.rate_max) else _ZERO
    bend1 = l1 * a1 if (l1 > c.rate_min) & (l1 < c.rate_max) else _ZERO
    return h * max(_HALF * (l0 + l1) + _TWELFTH * (bend0 - bend1), min(l0, l1))


@lane
def rise_of_filter(q: Real, behind: Real, u: Course) -> Real:
    """Return v1 - v0, with behind = u0 - v0 and q = 1 - e^-s. The rounding error shrinks with s.

    With the integrals I0 = q / s, I1 = (1 - I0) / s, I2 = (1 - 2 I1) / s, k is (1/2 - I1) / s.
    """
    # v follows u, so v1 - v0 = q behind + the integral of u's slope times 1 - e^-(s - x): the moments of that weight,
    # 1 - I0 and 1/2 - I1, times the coefficients of the cubic. The series replaces differences of nearly equal numbers.
    s, d, w0, w1 = u
    inverse, short = _ONE / s, s < _SERIES_UP_TO
    series = ((_K3 * s + _K2) * s + _K1) * s + _K0
    less_i0 = s * (_HALF - s * series) if short else _ONE - q * inverse
    less_i1 = s * series if short else _HALF - less_i0 * inverse
    k = series if short else less_i1 * inverse
    bent = (_SIX * d - _FOUR * w0 - _TWO * w1) * less_i1 + (_THREE * (w0 + w1) - _SIX * d) * (_THIRD - _TWO * k)
    return q * behind + (w0 * less_i0 + bent)


_AT_REST = np.float32(1e-6)  # ln units


class Swing(NamedTuple):
    """A step: change and slopes of the log light, and how far the filter is behind at its start."""

    d: Real
    a0: Real
    a1: Real
    behind: Real


@lane
def fastest(swing: Swing, r0: Real, r1: Real) -> Real:
    """Return a bound of a filter's slope per step, at rates of r0 and r1 a step at its ends.

    A low-pass has no steeper output than its input, or than at its start: a slope of e^behind - 1 over its rate by the
    large-signal law. Nor has it a steeper one than where it is farthest behind: a slow filter hardly moves, whatever
    its light does. Rates that change in between may add a factor of 1.65.
    """
    steps = abs(swing.a0) + abs(swing.a1)
    light = max(max(abs(swing.a0), abs(swing.a1)), abs(_THREE * swing.d - swing.a0 - swing.a1))
    at_start = swing.behind
    at_most = at_start + abs(swing.d) + _OVERSHOOT * steps
    # Above e^behind - 1; none beyond _BEHIND.
    start = r0 * at_start * (_ONE + at_start * (_ONE + at_start)) if at_start < _BEHIND else _ENDLESS
    slow = max(r0, r1) * at_most * (_ONE + at_most * (_ONE + at_most)) if at_most < _BEHIND else _ENDLESS
    return min(max(light, start), slow)


@lane
def behind_high_pass(q: Real, y: Real, w: Course) -> Real:
    """Return the output of a high-pass at an interval's end, from that at its start, y, and the course of its input.

    y' = w' - y, in time constants of the high-pass. In still light the output comes to rest at 0.
    """
    after = y + (w.d - rise_of_filter(q, y, w))
    return _ZERO if (w.d == _ZERO) & (abs(after) < _AT_REST) else after


@lane
def transient(behind: Real, u: Course, allowed: Real) -> Transient:
    """Return the exponential part of the answer of a filter that starts at `behind` = u0 - v0.

    On an interval of many time constants a cubic is better without an exponential below `allowed` than with its slope,
    which it would follow for most of the interval.
    """
    # The steady answer to a cubic lags by its first derivative, less the second, plus the third; what the start has
    # beyond that lag decays as b e^-s.
    inverse = _ONE / max(u.s, _SHORTEST)
    third = _SIX * (u.w0 + u.w1 - _TWO * u.d)  # derivatives of u by s / S
    second = _TWO * (_THREE * u.d - _TWO * u.w0 - u.w1)
    lag0 = inverse * (u.w0 - inverse * (second - inverse * third))
    lag1 = inverse * (u.w1 - inverse * (second + third - inverse * third))
    b = lag0 - behind
    return Transient(b, lag0, lag1, (u.s > _FAST) & (abs(b) < allowed))


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
    """Return w1 - w0, with behind = v0 - w0, q = 1 - e^-second and second, the pole's rate times the interval."""
    # Up to S = 1 the cubic through v's own values and slopes; beyond, that of its steady part, and b e^-s apart.
    t = transient(v.behind0, u, _ZERO)
    slow = u.s < _ONE
    b = _ZERO if slow else t.b
    rise = v.rise if slow else u.d - (t.lag1 - t.lag0)
    m0, m1 = v.r0 * (v.behind0 if slow else t.lag0), v.r1 * (v.behind1 if slow else t.lag1)
    followed = rise_of_filter(q, behind - b, Course(second, rise, m0, m1))
    return followed + b * passed_by_second_pole(u.s, v.r0, second)

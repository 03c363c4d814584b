"""Time of an event: where a curve meets its level, how late the comparator is, and events too many to be followed.

An event gets its time in three steps, all as shares of a step or of a substep; `_fire` in `candidates` and `march`
makes nanoseconds of them.

1. The crossing. Over a step or substep the comparator's input is a cubic, here monotone between two bounds, so it meets
   a level between them once. `newton` makes a fixed number of iterations, without a branch, so that loops over many
   pixels become vectors; the few whose last correction exceeds SETTLED are listed and found by `bisect`.
2. The delay of the comparator, `delay_s`, from the slope at the crossing.
3. The refractory period behind it. Its end is the next time at which the pixel can fire.

A pixel that fires MOST_EVENTS times in a step is not followed further: `levels_passed` and `pass_over` count what is
left in closed form, as lost in the pixel. No light and no leak can make a step endless.

The law of the delay. A pixel's comparator is one transistor, driven by the amplified change of log light, against a
bias current. At the threshold both currents are equal. With the signal y ln units beyond it, the input transistor's
current is e^(-y/F) or e^(y/F) of the bias current, in subthreshold; the difference drives the output's capacitance:

    ON    the input transistor pulls:     C dV/dt = I_on (e^(y/F) - 1)
    OFF   the bias current pulls:         C dV/dt = I_off (1 - e^(-y/F))

F, `contrast_per_e`, is the constant of the thresholds too: theta = F ln(I_on / I_diff). With tau = C V / I, the time in
which the bias current alone swings the output, and a signal that goes on with its slope s of the crossing, the delay t
is, in units of T = F / s and with q = tau / T,

    ON    e^u - 1 - u = q        OFF   u - 1 + e^-u = q        t = u T

Both have one solution. A slow signal is late by sqrt(2 tau T), a fast one by T ln(q) for ON, and for OFF by tau + T: an
OFF event cannot come faster than its bias current drives. So the comparator's bandwidth differs by polarity; the bias
currents that set the thresholds make OFF the slow one.

Source of the circuit: Lichtsteiner, Posch and Delbruck, IEEE JSSC 2008, and the biases in Graca, McReynolds and
Delbruck, arXiv 2304.04706; the law follows from them by subthreshold currents, without an output conductance. A signal
that turns back within the delay raises its event all the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emulator.sensor.numerics.compiled import NONE, Real, kernel, lane
from emulator.sensor.pixels.state import StepConstants

SETTLED = np.float32(3e-5)
"""Largest last Newton correction of a root that is accepted; the error is of the order of its square."""

_NEWTON_TURNS = 4
_BISECTIONS = 25
_ZERO, _ONE, _TWO, _THREE, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 0.5))


class Cubic(NamedTuple):
    """The polynomial d0 + c1 x + c2 x^2 + c3 x^3."""

    d0: Real
    c1: Real
    c2: Real
    c3: Real


class Bracket(NamedTuple):
    """An interval in which a monotone cubic meets `level`, and whether it rises there."""

    low: Real
    high: Real
    level: Real
    rising: Real


@lane
def value(g: Cubic, x: Real) -> Real:
    """Return the cubic at x."""
    return ((g.c3 * x + g.c2) * x + g.c1) * x + g.d0


@lane
def newton(g: Cubic, at: Bracket, x: Real) -> tuple[Real, Real]:
    """Return the root found from the first guess x, and the size of the last correction.

    The bracket shrinks with each iteration; a correction that leaves it is replaced by its middle.
    """
    low, high, step = at.low, at.high, _ONE
    sign = _ONE if at.rising else -_ONE  # falling curves are turned over
    for _ in range(_NEWTON_TURNS):
        beyond = sign * (value(g, x) - at.level)
        slope = sign * ((_THREE * g.c3 * x + _TWO * g.c2) * x + g.c1)
        # x is a new bound of the bracket. Choices of values, as here, become vectors; branches would not.
        low = low if beyond > _ZERO else x
        high = x if beyond > _ZERO else high
        corrected = x - beyond / slope  # not finite where the slope is 0: then the comparisons below are false
        better = corrected if (corrected >= low) & (corrected <= high) else _HALF * (low + high)
        step = better - x
        x = better
    return x, abs(step)


@kernel
def bisect(g: Cubic, at: Bracket) -> Real:
    """Return the root found by bisection: the end behind it, so that the pixel has crossed its level there."""
    low, high = at.low, at.high
    for _ in range(_BISECTIONS):  # to the resolution of float32
        x = _HALF * (low + high)
        if (value(g, x) > at.level) == at.rising:
            high = x
        else:
            low = x
    return high


LONGEST_S = 0.1
"""Longest delay: of a signal that has hardly a slope."""

_TURNS = 12
_SETTLED = 1e-9


@kernel
def _units(q: float, on: bool) -> float:
    """Return u for q > 0, by Newton's method from above: both functions are convex, so it cannot overshoot."""
    slow = math.sqrt(2 * q)  # the solution for small q, above that for any q
    u = math.log1p(q + slow) if on else q + min(1.0, slow)
    for _ in range(_TURNS):
        e = math.expm1(u) if on else -math.expm1(-u)
        correction = (e - u - q) / e if on else (u - e - q) / e
        u -= correction
        if abs(correction) <= _SETTLED * u:
            break
    return u


@kernel
def delay_s(slope: float, on: bool, c: StepConstants) -> float:
    """Return the delay, s, of an event that crosses its threshold at `slope` >= 0, ln units a second."""
    tau_s = c.on_delay if on else c.off_delay
    if tau_s <= 0:
        return 0.0
    if slope <= 0:
        return LONGEST_S
    unit_s = c.contrast_per_e / slope
    return float(min(_units(tau_s / unit_s, on) * unit_s, LONGEST_S))


MOST_EVENTS = 64
"""Most events of a pixel in a step; further crossings are counted as lost in the pixel."""

MOST_LOST = 1 << 32
"""Most lost crossings of a pixel that are counted for a monotone part of its curve; a count that no int64 holds."""


@kernel
def levels_passed(level: float, end: float, threshold: float) -> tuple[int, float]:
    """Return the number of thresholds between a level and the end of a monotone curve, and the remaining change.

    That change is below a threshold; 0 where the numbers are too large for float64 to have one.
    """
    change = np.float64(end) - np.float64(level)
    step = np.float64(threshold)
    passed = np.floor(abs(change) / step)
    remaining = abs(change) - passed * step
    if not (remaining >= 0) & (remaining < step):
        remaining = 0.0
    count = MOST_LOST if passed >= MOST_LOST else int(passed)
    return count, remaining if change > 0 else -remaining


class Passed(NamedTuple):
    """Result of `pass_over`: crossings that were counted, not followed, and the state of the pixel behind them."""

    crossings: int
    climbed: float  # change of the curve since the reference was last set, >= 0; valid where `waiting` is 0
    waiting: float  # until the refractory period ends, in units of x; 0: it has ended


_PIECES = 64
_STEEPEST = 1e30  # thresholds a step: such a pixel fires as often as its dead time allows


@kernel
def pass_over(  # noqa: PLR0913, PLR0917
    g: Cubic, x: float, high: float, threshold: float, on: bool, span: float, c: StepConstants
) -> Passed:
    """Count the crossings of a pixel with a refractory period that is re-armed at x, up to `high`, on a monotone cubic.

    Each crossing takes a period: the time in which the curve climbs a threshold, then the comparator's delay and the
    refractory period. The number of periods is the integral of 1 / period: here over pieces, in each of which the curve
    is its chord. On a straight line this is exact; elsewhere the end lies within a period of the true one. The work
    does not depend on the number of crossings. `span` is the length of the unit of x, as a share of the step.
    """
    if x >= high:
        return Passed(NONE, 0.0, x - high)
    # In float64: the curve may climb by so many thresholds that two of them are one number in float32.
    c1 = np.float64(g.c1)
    c2 = np.float64(g.c2)
    c3 = np.float64(g.c3)
    width = (high - x) / _PIECES
    periods = slope = dead = 0.0
    for k in range(_PIECES):
        x0 = x + k * width
        x1 = x0 + width
        slope = abs(c1 + c2 * (x0 + x1) + c3 * (x0 * x0 + x0 * x1 + x1 * x1))  # of the chord, without a division
        if not slope <= _STEEPEST * threshold:  # nor a number
            slope = _STEEPEST * threshold
        dead = (delay_s(slope / (span * c.h), on, c) / c.h + c.refractory) / span
        periods += width * slope / (threshold + slope * dead)  # width / (threshold / slope + dead)
    crossings = int(periods)
    # The part of a period that has begun, as the climb of the curve on which its dead time would be a climb too.
    climbed = (periods - crossings) * (threshold + slope * dead)
    if climbed < threshold:
        return Passed(crossings, climbed, 0.0)
    return Passed(crossings + 1, 0.0, dead - (climbed - threshold) / slope)

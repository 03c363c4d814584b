"""Roots of a monotone cubic inside a bracket: a fixed number of Newton iterations, and bisection.

Both ways of finding crossings use it: `candidates`, one cubic a step, and `march`, one cubic a substep. A loop over the
columns of a table calls `newton` for every column, because a fixed number of iterations becomes vectors; columns whose
last correction exceeds `SETTLED` are listed and bisected afterwards, so that the others pay nothing for them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.sensor.numerics.compiled import Real, kernel, lane

__all__ = ["SETTLED", "Bracket", "Cubic", "bisect", "newton", "value"]

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
    sign = _ONE if at.rising else -_ONE
    for _ in range(_NEWTON_TURNS):
        beyond = sign * (value(g, x) - at.level)
        slope = sign * ((_THREE * g.c3 * x + _TWO * g.c2) * x + g.c1)
        low = low if beyond > _ZERO else x
        high = x if beyond > _ZERO else high
        corrected = x - beyond / slope
        better = corrected if (corrected >= low) & (corrected <= high) else _HALF * (low + high)
        step = better - x
        x = better
    return x, abs(step)


@kernel
def bisect(g: Cubic, at: Bracket) -> Real:
    """Return the root found by bisection."""
    low, high = at.low, at.high
    for _ in range(_BISECTIONS):
        x = _HALF * (low + high)
        if (value(g, x) > at.level) == at.rising:
            high = x
        else:
            low = x
    return high

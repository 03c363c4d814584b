"""How far to trust the cubic that two pictures and their time derivatives give for a pixel's log light.

d is the change over the step, a0 and a1 the slopes per step at its ends. d - (a0 + a1) / 2, the error of the trapezium
rule, is zero for a parabola, and as large as the contrast itself when an edge passed unseen between the pictures.

    plain     the cubic is taken as it is, in one piece
    suspect   that error is more than a share of a threshold, or the light turns by more: the pictures are too far apart
              here. The share is a half; a twentieth where such a pixel's light can be had in between (see `halving`)
    jump      suspect, with little slope at both ends: the change happened in between, best put at mid-step
    limited   monotone with slopes that a monotone cubic cannot have (Fritsch and Carlson): scaled down. Not where the
              light turns: a turning point inside a step is real, and its slopes hold its events
"""

from __future__ import annotations

import numpy as np

from emulator.sensor.numerics.compiled import Real, lane

__all__ = ["HALVED", "LARGEST_CHANGE", "SUSPECT", "completed", "is_jump", "is_plain", "is_suspect", "limit"]

_ZERO, _TWO, _HALF, _QUARTER, _EIGHTH = (np.float32(x) for x in (0, 2, 0.5, 0.25, 0.125))
LARGEST_CHANGE = np.float32(0.5)
"""Of u in one piece: what the fourth-order rules of `lowpass` allow."""

SUSPECT = np.float32(0.5)
"""Share of a threshold from which on a step is suspect; ..."""

HALVED = np.float32(0.05)
"""... and where it can be halved."""

_SLOPES = np.float32(3)  # together, of a monotone cubic, in changes ...
_IMMATERIAL = np.float32(0.02)  # ... and what does no harm beyond: it swings the cubic by less than 0.003
_ONE_SLOPE, _ONE_IMMATERIAL = _SLOPES * np.float32(0.7071), _IMMATERIAL * np.float32(0.7071)
_FLAT = np.float32(0.3)
_ABSURD = np.float32(1e9)  # a step
_STEEPEST = np.float32(64)  # bounds the work where slopes and light contradict each other


@lane
def is_plain(d: Real, a0: Real, a1: Real, unseen: Real) -> Real:
    """Tell whether the step can be taken in one piece, as it is; never with unknown slopes.

    `unseen` is what may go on unseen, ln units. Asks a little more than not to be suspect and not to be limited, in
    fewer operations.
    """
    steepest = max(abs(a0), abs(a1))
    one_piece = max(_TWO * abs(d), steepest) <= _TWO * LARGEST_CHANGE
    seen = max(abs(_TWO * d - (a0 + a1)), _QUARTER * abs(a0 - a1)) <= _TWO * unseen
    fits = (steepest <= _ONE_SLOPE * abs(d) + _ONE_IMMATERIAL) | (a0 * a1 < _ZERO)
    return one_piece & seen & fits


@lane
def completed(d: Real, a0: Real, a1: Real) -> tuple[Real, Real]:
    """Return both slopes: where one is not known a parabola's, where both are not, the straight line's.

    Not known are NaN and what no light has.
    """
    known0, known1 = abs(a0) <= _ABSURD, abs(a1) <= _ABSURD
    first = a0 if known0 else (_TWO * d - a1 if known1 else d)
    last = a1 if known1 else (_TWO * d - a0 if known0 else d)
    return first, last


@lane
def is_suspect(d: Real, a0: Real, a1: Real, unseen: Real) -> Real:
    """Tell whether the light did more than `unseen` (ln units) between the pictures that they do not show."""
    turns = (a0 * a1 < _ZERO) & (_EIGHTH * abs(a0 - a1) > unseen)
    return turns | (abs(d - _HALF * (a0 + a1)) > unseen)


@lane
def is_jump(d: Real, a0: Real, a1: Real) -> Real:
    """Tell whether a suspect step is a jump."""
    return max(abs(a0), abs(a1)) < _FLAT * abs(d)


@lane
def limit(d: Real, a0: Real, a1: Real) -> Real:
    """Return the factor for both slopes."""
    together = np.sqrt(a0 * a0 + a1 * a1)
    turns = min(min(a0 * d, a1 * d), a0 * a1) < _ZERO
    fits = turns | (together <= _SLOPES * abs(d) + _IMMATERIAL)
    not_too_steep = _STEEPEST / max(max(abs(a0), abs(a1)), _STEEPEST)
    return not_too_steep if fits else min(_SLOPES * abs(d) / together, not_too_steep)

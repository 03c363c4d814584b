"""Quality checks of the cubic interpolation of log light within a step.

The cubic goes through the values and time derivatives of two frames. d is the change over the step, a0 and a1 are the
slopes per step at its ends. d - (a0 + a1) / 2, the error of the trapezium rule, is zero for a parabola, and as large as
the contrast itself when an edge passed between the frames.

    smooth         the cubic is used as it is, in one piece
    undersampled   that error is more than a share of a threshold, or the light turns by more: the frames are too far
                   apart here. The share is a half; a twentieth where `refinement` can ask for the light in between
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
"""

from __future__ import annotations

import numpy as np

from emulator.sensor.numerics.compiled import Real, lane

__all__ = [
    "LARGEST_CHANGE",
    "REFINED_UNSEEN_SHARE",
    "UNSEEN_SHARE",
    "WORTH_BENDING",
    "bend_width",
    "capped",
    "completed",
    "is_jump",
    "is_smooth",
    "is_undersampled",
    "limit",
]

_ZERO, _ONE, _TWO, _THREE, _SIX = (np.float32(x) for x in (0, 1, 2, 3, 6))
_HALF, _QUARTER, _EIGHTH, _THIRD = (np.float32(x) for x in (0.5, 0.25, 0.125, 1 / 3))
LARGEST_CHANGE = np.float32(0.5)
"""Largest change of log light in one piece: the fourth-order rules of `lowpass` allow no more."""

UNSEEN_SHARE = np.float32(0.5)
"""Share of a threshold that may stay unseen between two frames; a step with more is undersampled."""

REFINED_UNSEEN_SHARE = np.float32(0.05)
"""The same share where undersampled steps can be refined."""

WORTH_BENDING = np.float32(0.05)
"""Share of a threshold that the trapezium rule may miss before the cubic is replaced by a bend."""

_SLOPES = np.float32(3)  # largest slopes of a monotone cubic, together, in changes ...
_IMMATERIAL = np.float32(0.02)  # ... and a harmless excess: it swings the cubic by less than 0.003
_ONE_SLOPE, _ONE_IMMATERIAL = _SLOPES * np.float32(0.7071), _IMMATERIAL * np.float32(0.7071)
_FLAT = np.float32(0.3)
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
    missed = abs(_TWO * d - (a0 + a1))
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
    known0, known1 = abs(a0) <= _ABSURD, abs(a1) <= _ABSURD
    first = a0 if known0 else (_TWO * d - a1 if known1 else d)
    last = a1 if known1 else (_TWO * d - a0 if known0 else d)
    return first, last


@lane
def is_undersampled(d: Real, a0: Real, a1: Real, unseen: Real) -> Real:
    """Return whether the light may have changed by more than `unseen`, ln units, unseen by the frames."""
    turns = (a0 * a1 < _ZERO) & (_EIGHTH * abs(a0 - a1) > unseen)
    return turns | (abs(d - _HALF * (a0 + a1)) > unseen)


@lane
def is_jump(d: Real, a0: Real, a1: Real) -> Real:
    """Return whether an undersampled step is a jump."""
    return max(abs(a0), abs(a1)) < _FLAT * abs(d)


@lane
def capped(a0: Real, a1: Real) -> Real:
    """Return the factor that bounds the work for both slopes."""
    return _STEEPEST / max(max(abs(a0), abs(a1)), _STEEPEST)


@lane
def bend_width(d: Real, a0: Real, a1: Real, threshold: Real) -> Real:
    """Return the width of the bend, as a share of the step; 1 where the step has none. The slopes must be capped."""
    away, gap = abs(d - _HALF * (a0 + a1)), abs(a1 - a0)
    opposed = a0 * a1 < _ZERO
    swings = (min(a0 * d, a1 * d) < _ZERO) | opposed | (a0 * a0 + a1 * a1 > _SLOPES * _SLOPES * d * d)
    no_peak = (min(abs(a0), abs(a1)) <= _ONE_SIDED * max(abs(a0), abs(a1))) | (not opposed)
    possible = (_SIX * away > gap) & (_TWO * away < gap)
    bends = (away > WORTH_BENDING * threshold) & possible & swings & no_peak
    return max(_THREE * (_HALF - away / gap), _SHARPEST) if bends else _ONE


@lane
def limit(d: Real, a0: Real, a1: Real) -> Real:
    """Return the factor that limits both slopes."""
    together = np.sqrt(a0 * a0 + a1 * a1)
    turns = min(min(a0 * d, a1 * d), a0 * a1) < _ZERO
    fits = turns | (together <= _SLOPES * abs(d) + _IMMATERIAL)
    not_too_steep = capped(a0, a1)
    return not_too_steep if fits else min(_SLOPES * abs(d) / together, not_too_steep)

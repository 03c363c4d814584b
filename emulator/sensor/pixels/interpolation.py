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
"""

from __future__ import annotations

import numpy as np

from emulator.sensor.numerics.compiled import Real, lane

__all__ = [
    "LARGEST_CHANGE",
    "REFINED_UNSEEN_SHARE",
    "UNSEEN_SHARE",
    "completed",
    "is_jump",
    "is_smooth",
    "is_undersampled",
    "limit",
]

_ZERO, _TWO, _HALF, _QUARTER, _EIGHTH = (np.float32(x) for x in (0, 2, 0.5, 0.25, 0.125))
LARGEST_CHANGE = np.float32(0.5)
"""Largest change of log light in one piece: the fourth-order rules of `lowpass` allow no more."""

UNSEEN_SHARE = np.float32(0.5)
"""Share of a threshold that may stay unseen between two frames; a step with more is undersampled."""

REFINED_UNSEEN_SHARE = np.float32(0.05)
"""The same share where undersampled steps can be refined."""

_SLOPES = np.float32(3)  # largest slopes of a monotone cubic, together, in changes ...
_IMMATERIAL = np.float32(0.02)  # ... and a harmless excess: it swings the cubic by less than 0.003
_ONE_SLOPE, _ONE_IMMATERIAL = _SLOPES * np.float32(0.7071), _IMMATERIAL * np.float32(0.7071)
_FLAT = np.float32(0.3)
_ABSURD = np.float32(1e9)  # a step
_STEEPEST = np.float32(64)  # bounds the work where slopes and light contradict each other


@lane
def is_smooth(d: Real, a0: Real, a1: Real, unseen: Real) -> Real:
    """Return whether the step can be solved in one piece with the cubic as it is; False with unknown slopes.

    `unseen` is the change that may stay unseen, ln units. The test is slightly stricter than "neither undersampled nor
    limited", and takes fewer operations.
    """
    steepest = max(abs(a0), abs(a1))
    one_piece = max(_TWO * abs(d), steepest) <= _TWO * LARGEST_CHANGE
    seen = max(abs(_TWO * d - (a0 + a1)), _QUARTER * abs(a0 - a1)) <= _TWO * unseen
    fits = (steepest <= _ONE_SLOPE * abs(d) + _ONE_IMMATERIAL) | (a0 * a1 < _ZERO)
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
def limit(d: Real, a0: Real, a1: Real) -> Real:
    """Return the factor that limits both slopes."""
    together = np.sqrt(a0 * a0 + a1 * a1)
    turns = min(min(a0 * d, a1 * d), a0 * a1) < _ZERO
    fits = turns | (together <= _SLOPES * abs(d) + _IMMATERIAL)
    not_too_steep = _STEEPEST / max(max(abs(a0), abs(a1)), _STEEPEST)
    return not_too_steep if fits else min(_SLOPES * abs(d) / together, not_too_steep)

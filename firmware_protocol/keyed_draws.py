"""Draws that are a function of (seed, purpose, index) and of nothing else: not of the step, the batch or a restart.

SplitMix64 (Steele, Lea and Flood, OOPSLA 2014; finaliser "variant 13" of D. Stafford):

    base  = mix(mix(seed) + purpose * golden)
    value = mix(base + (index + 1) * golden)          golden = 2^64 / golden ratio, made odd

A normal number is Box-Muller on the two halves of one value.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

__all__ = ["Draw", "normal"]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_WORD = (1 << 64) - 1

Words = npt.NDArray[np.uint64]


class Draw(IntEnum):
    """What a number is drawn for. Values are part of what a seed means: never reuse or renumber."""

    EDGE_JITTER = 64
    CLOCK_WALK = 65


def normal(seed: int, purpose: Draw, index: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return normal numbers of mean 0 and deviation 1, one for each of `index`, whole numbers >= 0, shape (n,)."""
    with np.errstate(over="ignore"):
        base = _mix(_mix(_words(seed & _WORD)) + _words(purpose) * _GOLDEN)
        word = _mix(base + (_words(index) + np.uint64(1)) * _GOLDEN)
    radius = np.sqrt(-2 * np.log(((word >> np.uint64(32)).astype(np.float64) + 0.5) / 2.0**32))
    return np.asarray(radius * np.cos(2 * np.pi * (word & np.uint64(0xFFFFFFFF)).astype(np.float64) / 2.0**32))


def _words(numbers: npt.ArrayLike) -> Words:
    return np.atleast_1d(np.asarray(numbers)).astype(np.uint64)


def _mix(z: Words) -> Words:
    """Scramble each 64-bit word, one to one."""
    z = (z ^ (z >> np.uint64(30))) * _MULTIPLIERS[0]
    z = (z ^ (z >> np.uint64(27))) * _MULTIPLIERS[1]
    return z ^ (z >> np.uint64(31))

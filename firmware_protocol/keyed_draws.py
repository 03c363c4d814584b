"""Keyed draws: random numbers that are a function of (seed, purpose, index) only, not of the step, batch or restart.

SplitMix64 (Steele, Lea and Flood, OOPSLA 2014; finaliser "variant 13" of D. Stafford):

    base  = mix(mix(seed) + purpose * golden)
    value = mix(base + (index + 1) * golden)          golden = 2^64 / golden ratio, made odd

A uniform number is (top 53 bits + 1/2) / 2^53, so it is never 0 nor 1. A normal number is Box-Muller on the two halves
of one value, hence within 6.8 standard deviations.

All functions take and return arrays of 64-bit words, and are the one source of the draws: the sensor's keyed numbers,
with one stream for each pixel, are made of them.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

__all__ = ["GOLDEN", "Draw", "Words", "as_words", "mix", "normal", "normal_of", "root_of", "uniform_of", "words_of"]

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""Distance between two streams, and between two numbers of a stream."""

_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_WORD = (1 << 64) - 1

Words = npt.NDArray[np.uint64]


class Draw(IntEnum):
    """Purpose of a draw. The values define the meaning of a seed: never reuse or renumber them."""

    EDGE_JITTER = 64
    CLOCK_WALK = 65


def mix(z: Words) -> Words:
    """Scramble 64-bit words, one to one; also compiled by numba for single words."""
    z = (z ^ (z >> np.uint64(30))) * _MULTIPLIERS[0]
    z = (z ^ (z >> np.uint64(27))) * _MULTIPLIERS[1]
    return z ^ (z >> np.uint64(31))


def as_words(numbers: npt.ArrayLike) -> Words:
    """Return whole numbers as 64-bit words, at least one-dimensional."""
    return np.atleast_1d(np.asarray(numbers)).astype(np.uint64)


def root_of(seed: int, purpose: int) -> Words:
    """Return the start of the streams of a seed and a purpose, (1,)."""
    with np.errstate(over="ignore"):
        return mix(mix(as_words(seed & _WORD)) + as_words(purpose) * GOLDEN)


def words_of(base: Words, index: npt.ArrayLike) -> Words:
    """Return numbers `index` >= 0 of the streams that start at `base` (broadcast)."""
    with np.errstate(over="ignore"):
        return mix(base + (as_words(index) + np.uint64(1)) * GOLDEN)


def uniform_of(words: Words) -> npt.NDArray[np.float64]:
    """Return a uniform number in (0, 1) for each word."""
    return ((words >> np.uint64(11)).astype(np.float64) + 0.5) / 2.0**53


def normal_of(words: Words) -> npt.NDArray[np.float64]:
    """Return a normal number of mean 0 and deviation 1 for each word."""
    radius = np.sqrt(-2 * np.log(((words >> np.uint64(32)).astype(np.float64) + 0.5) / 2.0**32))
    return np.asarray(radius * np.cos(2 * np.pi * (words & np.uint64(0xFFFFFFFF)).astype(np.float64) / 2.0**32))


def normal(seed: int, purpose: Draw, index: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return normal numbers of mean 0 and deviation 1, one for each of `index`, whole numbers >= 0, shape (n,)."""
    return normal_of(words_of(root_of(seed, purpose), index))

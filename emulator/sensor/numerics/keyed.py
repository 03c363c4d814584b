"""Keyed randomness: every draw is a function of (seed, purpose, pixel, index) and of nothing else.

Not of the step, the thread, the tile or the order of the draws; a restart needs no generator's state. `index` is an
event number, a grid time, or 0 for what is drawn once (mismatch, phase, spread).

Generator: SplitMix64 (Steele, Lea and Flood, OOPSLA 2014; finaliser "variant 13" of D. Stafford) twice over. The key
(seed, purpose) picks a stream of streams, the pixel one of its streams, the index a number of that:

    base  = mix(mix(mix(seed) + purpose * golden) + pixel * golden)
    value = mix(base + (index + 1) * golden)          golden = 2^64 / golden ratio, made odd

A uniform takes the top 53 bits, (bits + 1/2) / 2^53, so it is never 0 nor 1. A normal is Box-Muller on the two halves
of one value, hence within 6.8 standard deviations.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

__all__ = ["Purpose", "normal", "root_of", "uniform", "words"]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_WORD = (1 << 64) - 1


class Purpose(IntEnum):
    """What a number is drawn for. Values are part of what a seed means: never reuse or renumber."""

    THRESHOLD_ON = 1
    THRESHOLD_OFF = 2
    LEAK_RATE = 3
    LEAK_PHASE = 4
    HOT = 5
    HOT_RATE = 6
    DEAD = 7
    PHOTO_RESPONSE = 8
    DARK_CURRENT = 9
    SHOT_NOISE = 10
    NOISE_EVENTS = 11
    NOISE_VOLTAGE = 12
    NOISE_BRIDGE = 13
    LATENCY = 14
    LEAK_JITTER = 15
    PARTICLES = 16
    TRACKS = 17
    DOSE = 18
    SLOT = 32
    THRESHOLD_REDRAWN = 33


def _mix(z: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Scramble each 64-bit word, one to one."""
    z = (z ^ (z >> np.uint64(30))) * _MULTIPLIERS[0]
    z = (z ^ (z >> np.uint64(27))) * _MULTIPLIERS[1]
    return z ^ (z >> np.uint64(31))


def _as_words(numbers: npt.ArrayLike) -> npt.NDArray[np.uint64]:
    return np.atleast_1d(np.asarray(numbers)).astype(np.uint64)


def root_of(seed: int, purpose: Purpose) -> np.uint64:
    """Return where the streams of a seed and a purpose begin, for loops that draw their numbers one by one."""
    return np.uint64(_mix(_mix(_as_words(seed & _WORD)) + _as_words(purpose) * _GOLDEN)[0])


def words(seed: int, purpose: Purpose, pixel: npt.ArrayLike, index: npt.ArrayLike = 0) -> npt.NDArray[np.uint64]:
    """Return one 64-bit word for each of `pixel` and `index`, which are whole numbers >= 0 and broadcast."""
    base = _mix(np.atleast_1d(root_of(seed, purpose)) + _as_words(pixel) * _GOLDEN)
    return _mix(base + (_as_words(index) + np.uint64(1)) * _GOLDEN)


def uniform(seed: int, purpose: Purpose, pixel: npt.ArrayLike, index: npt.ArrayLike = 0) -> npt.NDArray[np.float64]:
    """Return uniform numbers in (0, 1), one for each of `pixel` and `index` (broadcast)."""
    return ((words(seed, purpose, pixel, index) >> np.uint64(11)).astype(np.float64) + 0.5) / 2.0**53


def normal(seed: int, purpose: Purpose, pixel: npt.ArrayLike, index: npt.ArrayLike = 0) -> npt.NDArray[np.float64]:
    """Return normal numbers of mean 0 and deviation 1, one for each of `pixel` and `index` (broadcast)."""
    word = words(seed, purpose, pixel, index)
    radius = np.sqrt(-2 * np.log(((word >> np.uint64(32)).astype(np.float64) + 0.5) / 2.0**32))
    angle = 2 * np.pi * (word & np.uint64(0xFFFFFFFF)).astype(np.float64) / 2.0**32
    return np.asarray(radius * np.cos(angle))

"""Keyed random numbers of the pixels: every draw is a function of (seed, purpose, pixel, index) only.

It does not depend on the step, the thread, the tile or the order of the draws, and a restart needs no generator's
state. `index` is an event number, a grid time, or 0 for a number that is drawn once (mismatch, phase, spread).

The generator is that of `firmware_protocol.keyed_draws`, with one stream for each pixel:

    base  = mix(root + pixel * golden)                root: of the seed and the purpose
    value = mix(base + (index + 1) * golden)
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from firmware_protocol import keyed_draws
from firmware_protocol.keyed_draws import GOLDEN, as_words, mix, normal_of, uniform_of, words_of

__all__ = ["Purpose", "normal", "root_of", "uniform", "words"]


class Purpose(IntEnum):
    """Purpose of a draw. The values define the meaning of a seed: never reuse or renumber them."""

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
    BACKGROUND = 19
    BACKGROUND_RATE = 20
    BACKGROUND_HOT = 21
    NOISE_BURST = 22
    SLOT = 32
    THRESHOLD_REDRAWN = 33
    IMU_NOISE = 48
    IMU_WALK = 49
    IMU_BIAS = 50
    APS_GAIN = 56
    APS_COLUMN = 57
    APS_RESET_NOISE = 58
    APS_SIGNAL_NOISE = 59
    APS_SHOT_NOISE = 60
    APS_COLUMN_NOISE = 61
    APS_ROW_NOISE = 62
    APS_KICK = 63


def root_of(seed: int, purpose: Purpose) -> np.uint64:
    """Return the start of the streams of a seed and a purpose, for loops that draw their numbers one by one."""
    return np.uint64(keyed_draws.root_of(seed, purpose)[0])


def words(seed: int, purpose: Purpose, pixel: npt.ArrayLike, index: npt.ArrayLike = 0) -> npt.NDArray[np.uint64]:
    """Return one 64-bit word for each of `pixel` and `index`, which are whole numbers >= 0 and broadcast."""
    with np.errstate(over="ignore"):
        base = mix(keyed_draws.root_of(seed, purpose) + as_words(pixel) * GOLDEN)
    return words_of(base, index)


def uniform(seed: int, purpose: Purpose, pixel: npt.ArrayLike, index: npt.ArrayLike = 0) -> npt.NDArray[np.float64]:
    """Return uniform numbers in (0, 1), one for each of `pixel` and `index` (broadcast)."""
    return uniform_of(words(seed, purpose, pixel, index))


def normal(seed: int, purpose: Purpose, pixel: npt.ArrayLike, index: npt.ArrayLike = 0) -> npt.NDArray[np.float64]:
    """Return normal numbers of mean 0 and deviation 1, one for each of `pixel` and `index` (broadcast)."""
    return normal_of(words(seed, purpose, pixel, index))

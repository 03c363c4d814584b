"""Keyed random numbers of the pixels: every draw is a function of (seed, purpose, pixel, index) only.

It does not depend on the step, the thread, the tile or the order of the draws, and a restart needs no generator's
state. `index` is an event number, a grid time, or 0 for a number that is drawn once (mismatch, phase, spread).

The generator is that of `firmware_protocol.device.clock`, with one stream for each pixel:

    base  = mix(root + pixel * golden)                root: of the seed and the purpose
    value = mix(base + (index + 1) * golden)

Compiled loops draw the same numbers one by one:

    root = keyed.root_of(seed, purpose)      once, in Python
    base = stream(root, pixel)               of a pixel; or of a slot of time, a particle
    word(base, index)                        equals keyed.words(seed, purpose, pixel, index)

Fast because a draw is two multiplications and some shifts, without a state; `normals` makes vectors of them.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import cached_entry, kernel, lane, vector_kernel
from emulator.sensor.numerics.elementary import natural_log
from firmware_protocol.device import clock as keyed_draws
from firmware_protocol.device.clock import GOLDEN, as_words, mix, normal_of, words_of


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
    DOSE = 18
    BACKGROUND = 19
    BACKGROUND_RATE = 20
    BACKGROUND_HOT = 21
    NOISE_BURST = 22
    NOISE_SPREAD = 34
    LATE = 23
    RESET_NOISE = 24
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
    return ((words(seed, purpose, pixel, index) >> np.uint64(11)).astype(np.float64) + 0.5) / 2.0**53


def normal(seed: int, purpose: Purpose, pixel: npt.ArrayLike, index: npt.ArrayLike = 0) -> npt.NDArray[np.float64]:
    """Return normal numbers of mean 0 and deviation 1, one for each of `pixel` and `index` (broadcast)."""
    return normal_of(words(seed, purpose, pixel, index))


_S32 = np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)
_ONE = np.uint64(1)
_UNIT = 2.0**-32

_S16, _S40, _MASK = (np.uint64(n) for n in (16, 40, 0xFFFFFF))
_ONE_32, _HALF, _MINUS_TWO, _UNIT_24 = (np.float32(x) for x in (1, 0.5, -2, 2.0**-24))
_UNIT_32, _FEW = np.float32(2.0**-32), np.float32(1e-3)
# cos(2 pi z) - 1 in powers of z^2, fitted to |z| <= 1/2.
_C1, _C2, _C3, _C4, _C5 = (np.float32(c) for c in (-19.7390496, 64.9302786, -85.2868440, 58.8524982, -21.1624988))


mix_word = kernel(mix)
"""Scramble a word, one to one, in compiled loops."""


@kernel
def stream(root: np.uint64, pixel: int) -> np.uint64:
    """Return the stream of a pixel (slot, particle), a whole number >= 0."""
    mixed: np.uint64 = mix_word(root + np.uint64(pixel) * GOLDEN)
    return mixed


@cached_entry
def streams(root: np.uint64, n: int) -> npt.NDArray[np.uint64]:
    """Return the streams of pixels 0 to n - 1, (n,) uint64."""
    out = np.empty(n, np.uint64)
    for pixel in range(n):
        out[pixel] = stream(root, pixel)
    return out


@kernel
def word(base: np.uint64, index: int) -> np.uint64:
    """Return number `index` >= 0 of a stream, 64 bits."""
    mixed: np.uint64 = mix_word(base + (np.uint64(index) + _ONE) * GOLDEN)
    return mixed


@kernel
def high(bits: np.uint64) -> np.uint64:
    """Return the upper 32 bits of a word."""
    return bits >> _S32


@kernel
def low(bits: np.uint64) -> np.uint64:
    """Return the lower 32 bits of a word."""
    return bits & _LOW


@kernel
def unit(half: np.uint64) -> float:
    """Return a number in (0, 1) from 32 random bits."""
    return (np.float64(half) + 0.5) * _UNIT


@kernel
def normal_from(bits: np.uint64) -> float:
    """Return the normal number that `keyed.normal` makes of a word."""
    return math.sqrt(-2 * math.log(unit(high(bits)))) * math.cos(2 * math.pi * np.float64(low(bits)) * _UNIT)


@lane
def normal_float(bits: np.uint64) -> np.float32:
    """Return a normal float32 by Box-Muller on 48 bits of a word: 24 for the radius, 24 for the angle."""
    # The angle as turns from 1/2, where the cosine is even.
    radius = np.sqrt(_MINUS_TWO * natural_log((np.float32(bits >> _S40) + _HALF) * _UNIT_24))
    half = np.float32((bits >> _S16) & _MASK) * _UNIT_24 - _HALF
    z = half * half
    cosine = -(((((_C5 * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _ONE_32)  # of 2 pi turns, within 2e-6
    return np.float32(radius * cosine)


@lane
def exponential_float(half: np.uint64) -> np.float32:
    """Return an exponential float32 from 32 random bits, with the digits of a small one."""
    u = (np.float32(half) + _HALF) * _UNIT_32
    return np.float32(-natural_log(_ONE_32 - u) if u > _FEW else u + _HALF * u * u)


@vector_kernel
def _fill(streams: npt.NDArray[np.uint64], index: int, out: npt.NDArray[np.float32]) -> None:
    for k in range(out.size):
        out[k] = normal_float(word(streams[k], index))


@cached_entry
def normals(streams: npt.NDArray[np.uint64], index: int) -> npt.NDArray[np.float32]:
    """Return normal number `index` >= 0 of each stream, (n,) float32: Box-Muller on 48 of the word's bits.

    0.8 ns each. They differ from the numbers of `keyed.normal`, which use all 64 bits.
    """
    out = np.empty(streams.size, np.float32)
    _fill(streams, index, out)
    return out

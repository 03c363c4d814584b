"""Keyed random numbers for compiled loops, which draw them one by one.

root = keyed.root_of(seed, purpose)      once, in Python
base = stream(root, pixel)               of a pixel; or of a slot of time, a particle
word(base, index)                        equals keyed.words(seed, purpose, pixel, index)
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.numerics.compiled import kernel, vector_kernel
from emulator.sensor.numerics.elementary import natural_log
from firmware_protocol.keyed_draws import GOLDEN, mix

__all__ = ["high", "low", "normal_of", "normals", "stream", "streams", "unit", "word"]

_S32 = np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)
_ONE = np.uint64(1)
_UNIT = 2.0**-32

_S16, _S40, _MASK = (np.uint64(n) for n in (16, 40, 0xFFFFFF))
_ONE_32, _HALF, _MINUS_TWO, _UNIT_24 = (np.float32(x) for x in (1, 0.5, -2, 2.0**-24))
# cos(2 pi z) - 1 in powers of z^2, fitted to |z| <= 1/2.
_C1, _C2, _C3, _C4, _C5 = (np.float32(c) for c in (-19.7390496, 64.9302786, -85.2868440, 58.8524982, -21.1624988))


_mix = kernel(mix)


@kernel
def stream(root: np.uint64, pixel: int) -> np.uint64:
    """Return the stream of a pixel (slot, particle), a whole number >= 0."""
    mixed: np.uint64 = _mix(root + np.uint64(pixel) * GOLDEN)
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
    mixed: np.uint64 = _mix(base + (np.uint64(index) + _ONE) * GOLDEN)
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
def normal_of(bits: np.uint64) -> float:
    """Return the normal number that `keyed.normal` makes of a word."""
    return math.sqrt(-2 * math.log(unit(high(bits)))) * math.cos(2 * math.pi * np.float64(low(bits)) * _UNIT)


@vector_kernel
def _cosine(turns: np.float32) -> np.float32:
    """Return cos(2 pi turns) for turns in [0, 1), within 2e-6."""
    half = turns - _HALF
    z = half * half
    return -(((((_C5 * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _ONE_32)


@vector_kernel
def _fill(streams: npt.NDArray[np.uint64], index: int, out: npt.NDArray[np.float32]) -> None:
    for k in range(out.size):
        bits = word(streams[k], index)
        radius = np.sqrt(_MINUS_TWO * natural_log((np.float32(bits >> _S40) + _HALF) * _UNIT_24))
        out[k] = radius * _cosine(np.float32((bits >> _S16) & _MASK) * _UNIT_24)


@cached_entry
def normals(streams: npt.NDArray[np.uint64], index: int) -> npt.NDArray[np.float32]:
    """Return normal number `index` >= 0 of each stream, (n,) float32: Box-Muller on 48 of the word's bits.

    0.8 ns each. They differ from the numbers of `keyed.normal`, which use all 64 bits.
    """
    out = np.empty(streams.size, np.float32)
    _fill(streams, index, out)
    return out

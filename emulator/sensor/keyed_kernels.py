"""The numbers of `keyed`, drawn one by one inside compiled loops.

root = keyed.root_of(seed, purpose)      once, in Python
base = stream(root, pixel)               the pixel, or what stands in its place: a slot of time, a particle
word(base, index)                        equals keyed.words(seed, purpose, pixel, index)
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path

import numpy as np

from emulator.sensor.compiled import SOURCES as PIXEL_SOURCES
from emulator.sensor.compiled import kernel

__all__ = ["SOURCES", "high", "low", "normal_of", "stream", "unit", "word"]

SOURCES = zlib.crc32(Path(__file__).read_bytes(), PIXEL_SOURCES)
"""Checksum for entries that use this module, see `compiled`."""

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_A, _B = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S32 = (np.uint64(n) for n in (30, 27, 31, 32))
_LOW = np.uint64(0xFFFFFFFF)
_ONE = np.uint64(1)
_UNIT = 2.0**-32


@kernel
def _mix(z: np.uint64) -> np.uint64:
    z = (z ^ (z >> _S30)) * _A
    z = (z ^ (z >> _S27)) * _B
    return z ^ (z >> _S31)


@kernel
def stream(root: np.uint64, pixel: int) -> np.uint64:
    """Return the stream of a pixel (slot, particle), a whole number >= 0."""
    mixed: np.uint64 = _mix(root + np.uint64(pixel) * _GOLDEN)
    return mixed


@kernel
def word(base: np.uint64, index: int) -> np.uint64:
    """Return number `index` >= 0 of a stream, 64 bits."""
    mixed: np.uint64 = _mix(base + (np.uint64(index) + _ONE) * _GOLDEN)
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

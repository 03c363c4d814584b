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

The second half draws random points of a pixel in time and hazard. A process of hazard h(t) fires, as anywhere in a
Poisson process, at the first point (t, u) of a field of unit density with u < h(t). The points are keyed by the pixel,
so they are the same for all steps, orders and threads of the work: an event cannot move because a step was cut, and
pixels whose events differed come back to the same ones. An integral of the hazard would depend on its summation.

The field is drawn in bands of u, each in cells of time that begin at whole multiples of their length:

    band 0     u from 0 to r                     cells of 2^28 ns, with 1/8 point in the mean    r = 1e9 / 2^31 Hz
    band i     u from r 4^(i - 1) to r 4^i       cells of 2^(28 - 2 i) ns, with 3/32             i = 1 .. 12

Beyond 7.8e6 Hz there are none.

Fast because a cell costs one scrambled word, almost all cells are empty, which the processor foresees, and no point is
stored. Cells with one point in the mean are fewer, and cost four times as much.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import cached_entry, kernel, vector_kernel
from emulator.sensor.numerics.elementary import natural_log
from firmware_protocol.device import clock as keyed_draws
from firmware_protocol.device.clock import GOLDEN, as_words, mix, normal_of, uniform_of, words_of


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
    return uniform_of(words(seed, purpose, pixel, index))


def normal(seed: int, purpose: Purpose, pixel: npt.ArrayLike, index: npt.ArrayLike = 0) -> npt.NDArray[np.float64]:
    """Return normal numbers of mean 0 and deviation 1, one for each of `pixel` and `index` (broadcast)."""
    return normal_of(words(seed, purpose, pixel, index))


_S32 = np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)
_ONE = np.uint64(1)
_UNIT = 2.0**-32

_S16, _S40, _MASK = (np.uint64(n) for n in (16, 40, 0xFFFFFF))
_ONE_32, _HALF, _MINUS_TWO, _UNIT_24 = (np.float32(x) for x in (1, 0.5, -2, 2.0**-24))
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


@vector_kernel
def _fill(streams: npt.NDArray[np.uint64], index: int, out: npt.NDArray[np.float32]) -> None:
    for k in range(out.size):
        # Box-Muller: 24 bits for the radius, 24 for the angle; the angle as turns from 1/2, where the cosine is even.
        bits = word(streams[k], index)
        radius = np.sqrt(_MINUS_TWO * natural_log((np.float32(bits >> _S40) + _HALF) * _UNIT_24))
        half = np.float32((bits >> _S16) & _MASK) * _UNIT_24 - _HALF
        z = half * half
        cosine = -(((((_C5 * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _ONE_32)  # of 2 pi turns, within 2e-6
        out[k] = radius * cosine


@cached_entry
def normals(streams: npt.NDArray[np.uint64], index: int) -> npt.NDArray[np.float32]:
    """Return normal number `index` >= 0 of each stream, (n,) float32: Box-Muller on 48 of the word's bits.

    0.8 ns each. They differ from the numbers of `keyed.normal`, which use all 64 bits.
    """
    out = np.empty(streams.size, np.float32)
    _fill(streams, index, out)
    return out


BANDS = 13
_CELL_BITS = 28
_LEAST_HZ = 1e9 / 2**31
_NEXT_BAND, _NEXT_POINT = np.uint64(0xD1342543DE82EF95), np.uint64(0x632BE59BD9B4E019)
_WORD = np.uint64(64)
_MOST = 8

TOP_HZ = _LEAST_HZ * 4 ** (BANDS - 1)
"""Largest hazard of the field's points."""

CERTAIN_HZ = 4 * TOP_HZ
"""A hazard above that of all points: the next one is an event, within 128 ns in the mean."""

NEVER_NS = 1 << 62


def _counts(mean: float) -> tuple[np.uint64, ...]:
    """Return the words from which on a cell has more than 0, 1, 2 ... points."""
    below = np.cumsum([math.exp(-mean) * mean**k / math.factorial(k) for k in range(_MOST)])
    return tuple(np.uint64(min(int(share * 2.0**64), (1 << 64) - 1)) for share in below)


_COUNTS = np.array([_counts(1 / 8), _counts(3 / 32)])
_EMPTY_0, _EMPTY = _COUNTS[0, 0], _COUNTS[1, 0]


class Point(NamedTuple):
    """A point of the field: its stream time, NEVER_NS if there is none, and its hazard."""

    t_ns: int
    hz: float


@kernel
def next_point(base: np.uint64, from_ns: int, to_ns: int, below_hz: float) -> Point:
    """Return a field's first point (stream `base`) in (from_ns, to_ns] below a hazard, the lower of two at once."""
    found_hz = 0.0
    found_ns: Any = NEVER_NS
    top_hz = _LEAST_HZ
    base_hz = 0.0
    bits = _CELL_BITS
    root = base
    empty = _EMPTY_0
    for band in range(BANDS):
        last = min(to_ns, found_ns) >> bits
        cell = from_ns >> bits
        while cell <= last:
            drawn_word = mix_word(root + np.uint64(cell) * GOLDEN)
            if drawn_word >= empty:
                kind = min(band, 1)
                n = 1
                while n < _MOST and drawn_word >= _COUNTS[kind, n]:
                    n += 1
                for _ in range(n):
                    drawn_word = mix_word(drawn_word + _NEXT_POINT)
                    t_ns = (cell << bits) + np.int64(drawn_word >> (_WORD - np.uint64(bits)))
                    hz = base_hz + (top_hz - base_hz) * (np.float64(drawn_word & _LOW) + 0.5) * _UNIT
                    if from_ns < t_ns <= min(to_ns, found_ns) and hz < (found_hz if t_ns == found_ns else below_hz):
                        found_ns, found_hz = t_ns, hz
                last = min(last, found_ns >> bits)
            cell += 1
        if top_hz >= below_hz:
            break
        base_hz = top_hz
        top_hz *= 4
        bits -= 2
        root += _NEXT_BAND
        empty = _EMPTY
    return Point(found_ns, found_hz)

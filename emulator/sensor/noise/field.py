"""Random points of each pixel, in time and hazard, that decide when its events happen.

A process of hazard h(t) fires, as anywhere in a Poisson process, at the first point (t, u) of a field of unit density
with u < h(t). Here the points of a pixel are keyed by its number, so they are the same whatever the steps, the order
and the thread of the work: an event cannot move because a step was cut in two, and pixels whose events have differed
for any reason come back to the same ones. An integral of the hazard would depend on its summation.

The field is drawn in bands of u, each in cells of time that begin at whole multiples of their length:

    band 0     u from 0 to r                     cells of 2^28 ns, with 1/8 point in the mean    r = 1e9 / 2^31 Hz
    band i     u from r 4^(i - 1) to r 4^i       cells of 2^(28 - 2 i) ns, with 3/32             i = 1 .. 12

Beyond 7.8e6 Hz there are none.

Fast because a cell costs one scrambled word, almost all cells are empty, which the processor foresees, and no point is
stored. Cells with one point in the mean are fewer, and cost four times as much.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emulator.sensor.numerics.compiled import kernel
from emulator.sensor.numerics.keyed import mix_word
from firmware_protocol.device.clock import GOLDEN

BANDS = 13
_CELL_BITS = 28
_LEAST_HZ = 1e9 / 2**31
_NEXT_BAND, _NEXT_POINT = np.uint64(0xD1342543DE82EF95), np.uint64(0x632BE59BD9B4E019)
_WORD = np.uint64(64)
_LOW = np.uint64((1 << 32) - 1)  # the bits of a word that no cell's time uses
_PER_LOW = 1.0 / (1 << 32)
_MOST = 8

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
def next_point(stream: np.uint64, from_ns: int, to_ns: int, below_hz: float) -> Point:
    """Return the first point of a pixel's field after `from_ns`, up to `to_ns`, and below a hazard.

    `stream` is the pixel's stream of random numbers.
    """
    found_ns, found_hz = NEVER_NS, 0.0
    top_hz = _LEAST_HZ
    base_hz = 0.0
    bits = np.int64(_CELL_BITS)
    root = stream
    empty = _EMPTY_0
    for band in range(BANDS):
        last = min(to_ns, found_ns) >> bits
        cell = from_ns >> bits
        while cell <= last:
            word = mix_word(root + np.uint64(cell) * GOLDEN)
            if word >= empty:
                kind = min(band, 1)
                n = 1
                while n < _MOST and word >= _COUNTS[kind, n]:
                    n += 1
                for _ in range(n):
                    word = mix_word(word + _NEXT_POINT)
                    t_ns = (cell << bits) + np.int64(word >> (_WORD - np.uint64(bits)))
                    hz = base_hz + (top_hz - base_hz) * (np.float64(word & _LOW) + 0.5) * _PER_LOW
                    if t_ns > from_ns and t_ns <= to_ns and t_ns < found_ns and hz < below_hz:
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

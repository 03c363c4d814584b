"""Random points of each pixel, in time and hazard, that decide when its events happen.

A process of hazard h(t) fires, as anywhere in a Poisson process, at the first point (t, u) of a field of unit density
with u < h(t). Here the points of a pixel are keyed by its number, so they are the same whatever the steps, the order
and the thread of the work: an event cannot move because a step was cut in two, and pixels whose events have differed
for any reason come back to the same ones. An integral of the hazard would depend on its summation.

The field is drawn in bands of u, each in cells of time that begin at whole multiples of their length:

    band 0     u from 0 to r                     cells of 2^35 ns, with 1 point in the mean      r = 1e9 / 2^35 Hz
    band i     u from r 4^(i - 1) to r 4^i       cells of 2^(35 - 2 i) ns, with 3/4              i = 1 .. 15

so that a search below a bound looks at few cells, however far apart the points are. Beyond 3.1e7 Hz there are none.

Fast because a cell costs one scrambled word, half of the cells are empty, and no point is stored.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emulator.sensor.numerics.compiled import kernel
from emulator.sensor.numerics.keyed import mix_word
from firmware_protocol.device.clock import GOLDEN

BANDS = 16
_CELL_BITS = 35
LEAST_HZ = 1e9 / 2**_CELL_BITS
"""Upper end of band 0."""

_NEXT_BAND, _NEXT_POINT = np.uint64(0xD1342543DE82EF95), np.uint64(0x632BE59BD9B4E019)
_ONE, _WORD = np.uint64(1), np.uint64(64)
_LOW = np.uint64((1 << 29) - 1)  # the bits of a word that no cell's time uses
_PER_LOW = 1.0 / (1 << 29)
_MOST = 12


def _counts(mean: float) -> tuple[np.uint64, ...]:
    """Return the words above which a cell has more than 0, 1, 2 ... points."""
    below = np.cumsum([math.exp(-mean) * mean**k / math.factorial(k) for k in range(_MOST)])
    return tuple(np.uint64(min(int(share * 2.0**64), (1 << 64) - 1)) for share in below)


_FIRST_BAND = np.array(_counts(1.0))
_OTHERS = np.array(_counts(0.75))

NEVER_NS = 1 << 62


class Point(NamedTuple):
    """A point of the field: its stream time, NEVER_NS if there is none, and its hazard."""

    t_ns: int
    hz: float


@kernel
def next_point(stream: np.uint64, from_ns: int, to_ns: int, below_hz: float) -> Point:
    """Return the first point of a pixel's field after `from_ns`, up to `to_ns`, and below a hazard.

    `stream` is the pixel's stream of random numbers.
    """
    found = Point(NEVER_NS, 0.0)
    top = LEAST_HZ
    base = 0.0
    for band in range(BANDS):
        found = _in_band(stream, band, base, top, from_ns, min(to_ns, found.t_ns), below_hz, found)
        if top >= below_hz:
            break
        base = top
        top *= 4
    return found


@kernel
def _in_band(  # noqa: PLR0913, PLR0917
    stream: np.uint64, band: int, base_hz: float, top_hz: float, from_ns: int, to_ns: int, below_hz: float, found: Point
) -> Point:  # fmt: skip
    """Return the first point of a band within a time, or `found` if it has none."""
    bits = np.int64(_CELL_BITS - 2 * band)
    root = stream + np.uint64(band) * _NEXT_BAND
    last = to_ns >> bits
    cell = from_ns >> bits
    while cell <= last:
        word = mix_word(root + np.uint64(cell) * GOLDEN)
        n = 0
        if band == 0:
            while n < _MOST and word > _FIRST_BAND[n]:
                n += 1
        else:
            while n < _MOST and word > _OTHERS[n]:
                n += 1
        any_found = False
        for _ in range(n):
            word = mix_word(word + _NEXT_POINT)
            t_ns = (cell << bits) + np.int64(word >> (_WORD - np.uint64(bits)))
            hz = base_hz + (top_hz - base_hz) * (np.float64(word & _LOW) + 0.5) * _PER_LOW
            if t_ns > from_ns and t_ns <= to_ns and t_ns < found.t_ns and hz < below_hz:
                found = Point(t_ns, hz)
                any_found = True
        if any_found:
            return found
        cell += 1
    return found

"""Marks: special words that tell of the external input and of the generator, and their place among the events.

    t       u64   stream time, us
    code    u16   word of the stream: 2 falling edge, 3 rising edge, 4 pulse, 16 and 17 generator falls, rises

The codes are those of the published logic (EventCodes.vhd: EXT_INPUT_FALLING 2, RISING 3, PULSE 4, INPUTGEN_FALLING 16,
INPUTGEN_RISING 17). A host's library numbers them otherwise (libcaer, events/special.h: rising 2, falling 3, pulse 4,
generator rising 12, falling 13), which is what `EDGE` records carry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import EDGE, EdgeKind, Edges

__all__ = [
    "GENERATOR_FALLING",
    "GENERATOR_RISING",
    "MARK",
    "NO_ROW",
    "Items",
    "Marks",
    "edges_of",
    "items_of",
    "join_marks",
    "no_marks",
]

MARK = np.dtype([("t", "<u8"), ("code", "<u2")])

Marks = npt.NDArray[np.void]
"""An array of MARK records, shape (n,), sorted by t."""

GENERATOR_RISING, GENERATOR_FALLING = 12, 13
"""Kinds of EDGE records beyond EdgeKind that only a DAVIS346's generator makes."""

NO_ROW = 0xFFFF
"""Row of a mark that comes before any event: above every address, so that the first event tells its own."""

_COLUMN_OFF = 0x2000
_KIND_OF_CODE = np.zeros(18, np.uint8)
_KIND_OF_CODE[[2, 3, 4]] = EdgeKind.FALLING, EdgeKind.RISING, EdgeKind.PULSE
_KIND_OF_CODE[[16, 17]] = GENERATOR_FALLING, GENERATOR_RISING

Words = npt.NDArray[np.uint16]
Times = npt.NDArray[np.int64]


def no_marks(n: int = 0) -> Marks:
    """Return an array of `n` zeroed marks."""
    return np.zeros(n, MARK)


def join_marks(parts: list[Marks]) -> Marks:
    """Return the (n,) MARK arrays of `parts` in one, in time order; marks of one time stay in the order given."""
    marks = np.concatenate([no_marks(), *parts])
    return marks[np.argsort(marks["t"], kind="stable")]


def edges_of(times_us: npt.NDArray[np.uint64], codes: Words) -> Edges:
    """Return the (n,) EDGE records that a reader makes of marks at `times_us` (n,) with stream codes `codes` (n,)."""
    edges = np.zeros(len(codes), EDGE)
    edges["t"] = times_us
    edges["kind"] = _KIND_OF_CODE[codes]
    return edges


@dataclass(frozen=True)
class Items:
    """What the stream tells, in order: device times (n,) us, the row in force (n,), and the word of each (n,)."""

    time_us: Times
    rows: Words
    words: Words

    def __getitem__(self, part: slice) -> Items:
        return Items(self.time_us[part], self.rows[part], self.words[part])

    def merged(self, time_us: Times, codes: Words, row: int) -> Items:
        """Return these with marks at `time_us` (m,), each before the items of its own time.

        A mark has no row: it takes that of the item before it, `row` (-1: none) before the first, so that no row word
        is written for it.
        """
        at = np.searchsorted(self.time_us, time_us, side="left")
        before = self.rows[np.maximum(at, 1) - 1] if len(self.rows) else np.empty(len(at), np.uint16)
        before[at == 0] = NO_ROW if row < 0 else row
        at += np.arange(len(at))
        old = np.ones(len(self.words) + len(at), np.bool_)
        old[at] = False
        return Items(
            _woven(self.time_us, time_us, old, at),
            _woven(self.rows, before, old, at),
            _woven(self.words, codes, old, at),
        )


def _woven(items: Any, marks: Any, old: npt.NDArray[np.bool_], at: npt.NDArray[np.intp]) -> Any:
    """Return `items` where `old` is true and `marks` at the places `at`; np.insert takes twice as long."""
    both = np.empty(len(old), items.dtype)
    both[old], both[at] = items, marks
    return both


def items_of(time_us: Times, rows: Words, columns: Words, on: npt.NDArray[np.bool_]) -> Items:
    """Return events, each array (n,), as items."""
    words = on.astype(np.uint16)
    words <<= 12
    words += _COLUMN_OFF
    words |= columns
    return Items(time_us, rows, words)

"""The words of a DAVIS346's events, and the encoder that makes its stream from events, marks and blocks.

    bits 15..12  meaning                                    bits 11..0
    0001         row (Y), in force until the next one       address
    0010         column (X), OFF: an event                  address
    0011         column (X), ON: an event                   address
    0100         APS sample                                 ADC value

`fx3.words` describes the other words, and the rules of time that drivers depend on. Source: the parsers of libcaer
3.3.15 (davis.c) and neuromorphic-drivers 0.16.1, and runs against both and dv-processing 2.0.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events
from firmware_protocol.fx3.stream import TimedEncoder
from firmware_protocol.fx3.words import (
    COLUMN_OFF,
    MAX_ADDRESS,
    ROW,
    TIMESTAMP,
    WORD,
    WRAP_BITS,
    Block,
    Encoded,
    Marks,
    Words,
    WordState,
    no_marks,
    put_in_place,
    with_places,
)

NO_ROW = 0xFFFF
"""Row of a mark before any event: above every address, so that a row word is sent for the first event."""


@dataclass(frozen=True)
class TimedWords:
    """Words of items in stream order: device times (n,) us, the row in force (n,), and the word of each (n,)."""

    time_us: npt.NDArray[np.int64]
    rows: Words
    words: Words

    def __getitem__(self, part: slice) -> TimedWords:
        return TimedWords(self.time_us[part], self.rows[part], self.words[part])

    def merged(self, time_us: npt.NDArray[np.int64], codes: Words, row: int) -> TimedWords:
        """Return these items with marks at `time_us` (m,), each before the items of the same time.

        A mark has no row: it takes that of the item before it, `row` (-1: none) before the first, so that no row word
        is written for it.
        """
        at = np.searchsorted(self.time_us, time_us, side="left")
        before = self.rows[np.maximum(at, 1) - 1] if len(self.rows) else np.empty(len(at), np.uint16)
        before[at == 0] = NO_ROW if row < 0 else row
        at += np.arange(len(at))
        old = np.ones(len(self.words) + len(at), np.bool_)
        old[at] = False
        return TimedWords(
            _merged(self.time_us, time_us, old, at),
            _merged(self.rows, before, old, at),
            _merged(self.words, codes, old, at),
        )


def _merged(items: Any, marks: Any, old: npt.NDArray[np.bool_], at: npt.NDArray[np.intp]) -> Any:
    """Return `items` where `old` is true and `marks` at positions `at`; np.insert takes twice as long."""
    merged = np.empty(len(old), items.dtype)
    merged[old], merged[at] = items, marks
    return merged


def timed_words(time_us: npt.NDArray[np.int64], rows: Words, columns: Words, on: npt.NDArray[np.bool_]) -> TimedWords:
    """Return the words of events, each array (n,)."""
    words = on.astype(np.uint16)
    words <<= 12
    words += COLUMN_OFF
    words |= columns
    return TimedWords(time_us, rows, words)


_PORTION = 16384
"""Events encoded at once, so that all intermediate arrays fit the second-level cache."""


class WordEncoder(TimedEncoder):
    """Encoder of events into the words of a DAVIS.

    Parameters
    ----------
    size : (width, height) of the array; events outside are refused.
    turned : True for the chip's own coordinates, turned by 90 degrees: the row word carries x, the column word y.
    """

    def __init__(self, size: tuple[int, int] = (MAX_ADDRESS + 1, MAX_ADDRESS + 1), turned: bool = False) -> None:
        if not all(0 < n <= MAX_ADDRESS + 1 for n in size):
            raise ValueError(f"an array of {size[0]} x {size[1]} does not fit the 12-bit addresses of DAVIS words")
        super().__init__()
        self._size = size
        self._turned = turned
        self._make_tables(_PORTION)

    def encode(
        self, events: Events, epoch_us: int = 0, marks: Marks | None = None, blocks: Sequence[Block] = ()
    ) -> Encoded:
        """Return the words of items in stream order: a row word for each new row, a column word for each event."""
        before = self.state
        pieces: list[Words] = []
        self.rows = 0
        try:
            placed = with_places(no_marks() if marks is None else marks, blocks)
            for portion, between in _portions(events, placed):
                self._encode_portion(portion, between, epoch_us, pieces)
        except ValueError:
            self.state = before
            raise
        return Encoded(*put_in_place(_joined(pieces), blocks))

    def _encode_portion(self, events: Events, marks: Marks, epoch_us: int, pieces: list[Words]) -> None:
        """Append the words of one portion to `pieces`."""
        items = timed_words(self._device_time(events["t"], epoch_us), *self._addresses(events), events["on"])
        if len(marks):
            items = items.merged(self._device_time(marks["t"], epoch_us), marks["code"], self.state.row)
        for start, stop in _between_wraps(items.time_us):
            time_us = int(items.time_us[start])
            wraps = self.advance(time_us)
            if time_us >> WRAP_BITS != self.state.time_us >> WRAP_BITS:
                gap_us = time_us - self.state.time_us
                raise ValueError(f"no event for {gap_us} us: the gap is too long to encode")
            if len(wraps):
                pieces.append(wraps)
            pieces.append(self._encode_run(items[start:stop]))

    def _device_time(self, t: npt.NDArray[np.uint64], epoch_us: int) -> npt.NDArray[np.int64]:
        time_us = t.astype(np.int64)
        time_us -= epoch_us
        if len(time_us) and time_us[0] < self.state.time_us:
            raise ValueError(f"event at {time_us[0]} us comes after device time {self.state.time_us} us has passed")
        if np.logical_or.reduce(time_us[1:] < time_us[:-1]):
            raise ValueError("events must be sorted by time")
        return time_us

    def _encode_run(self, items: TimedWords) -> Words:
        """Encode items of one wrap period: fill a table of (timestamp, row, column) words, return the needed ones."""
        n = len(items.time_us)
        if n > len(self._table):
            self._make_tables(n)
        table, needed = self._table[:n], self._wanted[:n]
        low = items.time_us.astype(WORD)
        low |= TIMESTAMP
        table[:, 0] = low
        np.bitwise_or(items.rows, ROW, out=table[:, 1])
        table[:, 2] = items.words
        needed[0, 0] = int(items.time_us[0]) != self.state.time_us
        needed[0, 1] = int(items.rows[0]) not in (self.state.row, NO_ROW)
        np.not_equal(low[1:], low[:-1], out=needed[1:, 0])
        np.not_equal(items.rows[1:], items.rows[:-1], out=needed[1:, 1])
        row = int(items.rows[-1])
        self.state = WordState(int(items.time_us[-1]), -1 if row == NO_ROW else row)
        self.rows += int(np.count_nonzero(needed[:, 1]))
        return table.ravel().compress(needed.ravel())

    def _addresses(self, events: Events) -> tuple[Words, Words]:
        """Return contiguous (rows, columns) of `events` in the coordinates that are sent."""
        x, y = events["x"].copy(), events["y"].copy()
        if len(x) and (x.max() >= self._size[0] or y.max() >= self._size[1]):
            raise ValueError(f"an event lies outside the {self._size[0]} x {self._size[1]} array")
        return (x, y) if self._turned else (y, x)

    def _make_tables(self, n: int) -> None:
        self._table = np.empty((n, 3), WORD)
        self._wanted = np.empty((n, 3), np.bool_)
        self._wanted[:, 2] = True


def _joined(pieces: list[Words]) -> Words:
    """Return the pieces one after another."""
    if len(pieces) == 1:
        return pieces[0]
    return np.concatenate(pieces) if pieces else np.empty(0, WORD)


def _portions(events: Events, marks: Marks) -> Iterator[tuple[Events, Marks]]:
    """Yield the events in portions, each with the marks that come before its last event, the last with the rest."""
    done = 0
    for first in range(0, len(events), _PORTION):
        portion, last = events[first : first + _PORTION], first + _PORTION >= len(events)
        upto = len(marks) if last else int(np.searchsorted(marks["t"], portion["t"][-1], side="right"))
        yield portion, marks[done:upto]
        done = upto
    if not len(events) and len(marks):
        yield events, marks


def _between_wraps(time_us: npt.NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield (start, stop) of the runs of sorted times that share one wrap period."""
    if time_us[0] >> WRAP_BITS == time_us[-1] >> WRAP_BITS:
        yield 0, len(time_us)
        return
    period = time_us >> WRAP_BITS
    edges = [0, *(np.flatnonzero(period[1:] != period[:-1]) + 1).tolist(), len(time_us)]
    yield from pairwise(edges)

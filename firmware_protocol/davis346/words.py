"""The 16-bit words of a DAVIS346's data stream, and the encoder that makes them from events, marks and blocks.

    bits 15..12  meaning                                    bits 11..0
    1xxx         timestamp                                  low 15 bits: microseconds since the last wrap
    0000         special                                    code, see Special
    0001         row (Y), in force until the next one       address
    0010         column (X), OFF: an event                  address
    0011         column (X), ON: an event                   address
    0100         APS sample                                 ADC value
    0101         misc, 8 bits of data                       code 11..8, data 7..0
    0110         misc, 10 bits of data                      code 11..10, data 9..0
    0111         timestamp wrap                             number of steps of 32768 us

Little-endian; the unit is the word, not the USB packet. Source: the parsers of libcaer 3.3.15 (davis.c) and
neuromorphic-drivers 0.16.1, and runs against both and dv-processing 2.0.4.

Rules that the encoder follows because drivers depend on them:

- A timestamp word comes before the words of its time, only if the time has changed, and times strictly increase:
  dv-processing 2.0.4 stops reading for good at a repeated one. A wrap sets the time to its own multiple of 32768 us, so
  an event at exactly that time needs no timestamp word.
- A mark (an edge of the external input, a pulse of the generator) is a special word with a time, like an event. In the
  same microsecond it comes before the events, as in the multiplexer of the published logic, which reads that input
  first.
- A block (part of a frame, an inertial sample) has one time, like a mark, and no other word comes between its words.
- There is one wrap word of one step for each 32.768 ms, because neuromorphic_drivers ignores the number of steps (see
  `settings`). Words of many steps are used if more than SINGLE_WRAPS wraps are due.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import pairwise
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.blocks import (
    NO_ROW,
    Block,
    Marks,
    TimedWords,
    no_marks,
    put_in_place,
    timed_words,
    with_places,
)
from firmware_protocol.events import Events

Words = npt.NDArray[np.uint16]
"""Words in stream order, shape (n,), little-endian uint16."""

WORD = np.dtype("<u2")
# Plain ints, not an IntEnum: numpy reads an enum's member as an int64 and would widen every array it meets.
ROW = 0x1000
COLUMN_OFF = 0x2000
COLUMN_ON = 0x3000
APS_SAMPLE = 0x4000
MISC8 = 0x5000
MISC10 = 0x6000
WRAP = 0x7000
TIMESTAMP = 0x8000
KIND = 0xF000
LOW_BITS = 0x7FFF
WRAP_BITS = 15
MAX_STEPS = 0xFFF
MAX_ADDRESS = 0xFFF

SINGLE_WRAPS = 4096
"""Wraps sent one by one at most: 134 s of silence. A longer gap uses words of many steps."""

_PORTION = 16384
"""Events encoded at once, so that all intermediate arrays fit the second-level cache."""


class Special(IntEnum):
    """Codes of a special word."""

    TIMESTAMP_RESET = 1
    INPUT_FALLING = 2
    INPUT_RISING = 3
    INPUT_PULSE = 4
    IMU_START = 5
    IMU_END = 7
    FRAME_START_GLOBAL = 8
    FRAME_START_ROLLING = 9
    FRAME_END = 10
    RESET_COLUMN = 11
    SIGNAL_COLUMN = 12
    COLUMN_END = 13
    EXPOSURE_START = 14
    EXPOSURE_END = 15
    GENERATOR_FALLING = 16
    GENERATOR_RISING = 17


def is_column(words: Words) -> npt.NDArray[np.bool_]:
    """Return a mask of the words that are columns, that is, complete an event."""
    columns: npt.NDArray[np.bool_] = (words & 0xE000) == COLUMN_OFF
    return columns


def is_mark(words: Words) -> npt.NDArray[np.bool_]:
    """Return a mask of the words that are marks: specials of the external input and of the generator."""
    marks: npt.NDArray[np.bool_] = (words - 2 <= 2) | (words - 16 <= 1)  # words are unsigned: 0 - 2 is large
    return marks


def is_row(words: Words) -> npt.NDArray[np.bool_]:
    """Return a mask of the words that are rows."""
    rows: npt.NDArray[np.bool_] = (words & KIND) == ROW
    return rows


@dataclass(frozen=True)
class WordState:
    """State of a reader of the stream: device time of the last timestamp or wrap, and the row (-1: none yet)."""

    time_us: int = 0
    row: int = -1

    def after(self, words: Words) -> WordState:
        """Return the state of a reader that has also read `words` (of a stream without resets)."""
        steps = int((words[words & KIND == WRAP] & MAX_STEPS).sum(dtype=np.int64))
        time_us = ((self.time_us >> WRAP_BITS) + steps) << WRAP_BITS if steps else self.time_us
        timing = words[words >= WRAP]
        if len(timing) and timing[-1] & TIMESTAMP:
            time_us = (time_us >> WRAP_BITS << WRAP_BITS) + int(timing[-1] & LOW_BITS)
        rows = words[is_row(words)]
        return WordState(time_us, int(rows[-1] & MAX_ADDRESS) if len(rows) else self.row)


@dataclass(frozen=True)
class Encoded:
    """Words of a run of events, marks and blocks, shape (n_words,); `block_ends`: one past each block's last word."""

    words: Words
    block_ends: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def ends(self) -> npt.NDArray[np.int64]:
        """(n_events + n_marks + n_blocks,): index one past the last word of each event, mark or block."""
        ends: npt.NDArray[np.int64] = np.flatnonzero(is_column(self.words) | is_mark(self.words)) + 1
        return np.sort(np.concatenate([ends, self.block_ends])) if len(self.block_ends) else ends

    def events_in(self, words: Words) -> int:
        """Return the number of events that a part of the words completes."""
        return int(np.count_nonzero(is_column(words)))

    def blocks_in(self, count: int) -> int:
        """Return the number of blocks that the first `count` words complete."""
        return int(np.searchsorted(self.block_ends, count, side="right"))


def wrap_words(steps: int, room: int = SINGLE_WRAPS) -> Words | None:
    """Return words that add `steps` wraps: single ones if at most `room` words are enough, else as few as possible.

    None if even these do not fit.
    """
    if steps <= min(room, SINGLE_WRAPS):
        return np.full(steps, WRAP | 1, WORD)
    full, rest = divmod(steps, MAX_STEPS)
    if full + bool(rest) > room:
        return None
    words = np.full(full + bool(rest), WRAP | MAX_STEPS, WORD)
    if rest:
        words[-1] = WRAP | rest
    return words


class TimedEncoder(ABC):
    """Encoder of items into words with the times of a DAVIS; it holds the state of the stream's reader.

    Attributes
    ----------
    rows
        Number of row words of the last call of `encode`.
    words_per_event
        Most words of an event, without wraps.
    """

    words_per_event: ClassVar[int] = 3

    def __init__(self) -> None:
        self.state = WordState()
        self.rows = 0

    def reset(self) -> Words:
        """Restart time with a timestamp reset word; after it device time is zero and no row is in force."""
        self.state = WordState()
        return np.full(1, Special.TIMESTAMP_RESET, WORD)

    def advance(self, now_us: int, room: int = SINGLE_WRAPS) -> Words:
        """Return the wraps due up to device time `now_us`, in at most `room` words.

        If they do not fit, none is returned and the state stays; a later call makes up for them.
        """
        steps = (now_us >> WRAP_BITS) - (self.state.time_us >> WRAP_BITS)
        if steps <= 0:
            return np.empty(0, WORD)
        words = wrap_words(steps, room)
        if words is None:
            return np.empty(0, WORD)
        self.state = WordState(now_us >> WRAP_BITS << WRAP_BITS, self.state.row)
        return words

    def count(self, queued: Words, dropped: Words) -> None:  # noqa: B027  # not every model counts more than rows
        """Count words of a call of `encode` that were queued, and those that found no room, for statistics."""

    @abstractmethod
    def encode(
        self, events: Events, epoch_us: int = 0, marks: Marks | None = None, blocks: Sequence[Block] = ()
    ) -> Encoded:
        """Return the words of `events`, (n,) EVENT, `marks`, (m,) MARK, and `blocks`, each in time order.

        Parameters
        ----------
        events
            Events in stream time.
        epoch_us
            Stream time at which device time is zero.
        marks
            Marks in stream time, placed between the events by their time.
        blocks
            Runs of words in stream time, placed likewise; at one time after marks and before events.

        Raises
        ------
        ValueError
            Events or marks go back in time, lie before the epoch or outside the array, or leave a gap of days.
        """


class WordEncoder(TimedEncoder):
    """Encoder of events into the words of a DAVIS.

    Parameters
    ----------
    size
        (width, height) of the array; events outside are refused.
    turned
        True for the chip's own coordinates, turned by 90 degrees: the row word carries x, the column word y.
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
        """See `TimedEncoder.encode`."""
        before = self.state
        pieces: list[Words] = []
        self.rows = 0
        try:
            placed = with_places(no_marks() if marks is None else marks, blocks)
            for some, between in _portions(events, placed):
                self._encode_portion(some, between, epoch_us, pieces)
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
            wraps = self._wraps_before(int(items.time_us[start]))
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

    def _wraps_before(self, time_us: int) -> Words:
        words = self.advance(time_us)
        if time_us >> WRAP_BITS != self.state.time_us >> WRAP_BITS:
            raise ValueError(f"no event for {time_us - self.state.time_us} us: the gap is too long to encode")
        return words

    def _encode_run(self, items: TimedWords) -> Words:
        """Encode items of one wrap period: fill a table of (timestamp, row, column) words, return the needed ones."""
        n = len(items.time_us)
        if n > len(self._table):
            self._make_tables(n)
        table, wanted = self._table[:n], self._wanted[:n]
        low = items.time_us.astype(WORD)
        low |= TIMESTAMP
        table[:, 0] = low
        np.bitwise_or(items.rows, ROW, out=table[:, 1])
        table[:, 2] = items.words
        wanted[0, 0] = int(items.time_us[0]) != self.state.time_us
        wanted[0, 1] = int(items.rows[0]) not in (self.state.row, NO_ROW)
        np.not_equal(low[1:], low[:-1], out=wanted[1:, 0])
        np.not_equal(items.rows[1:], items.rows[:-1], out=wanted[1:, 1])
        row = int(items.rows[-1])
        self.state = WordState(int(items.time_us[-1]), -1 if row == NO_ROW else row)
        self.rows += int(np.count_nonzero(wanted[:, 1]))
        words: Words = table.ravel().compress(wanted.ravel())
        return words

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
        some, last = events[first : first + _PORTION], first + _PORTION >= len(events)
        upto = len(marks) if last else int(np.searchsorted(marks["t"], some["t"][-1], side="right"))
        yield some, marks[done:upto]
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

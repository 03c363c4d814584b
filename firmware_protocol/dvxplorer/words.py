"""The 16-bit words of a DVXplorer's data stream (FX3), and the encoder that makes them from events, marks and blocks.

    bits 15..12  meaning                              bits 11..0
    0001         column                               9..0 x; 11 the first column of a scan
    0100         addresses of two groups of rows      5..0 y / 8 of group 1; 10..6 distance to group 2, 11 its sign
    0011         eight pixels of group 1              7..0 bit i is pixel y + i; 8: they are OFF
    0010         eight pixels of group 2              likewise

Timestamps, wraps, specials and inertial samples are those of all models (`fx3.words`), and so are the rules of
time that drivers depend on. A column holds until the next one, group addresses until the next ones.

Two grammars, by bit 7 of the chip's packet format register (see `registers`):

    compressed   column, then (addresses, group 1, group 2 or nothing) for every two groups
    plain        column, then (addresses, group 1) for every group; the distance is 0

A word of pixels holds events in the order of rising rows, as readers deliver them. So the events of one time, column,
group and polarity whose rows rise share a word, and readers get all events in the order in which they were given,
whatever that is. A column word is also sent for each new time. The first column of a scan is one that does not lie
beyond the column before it: inferred, as a scan goes through the columns in rising order.

Sources: the parsers of libcaer 3.3.15 (dvxplorer.c) and neuromorphic-drivers 0.16.1; runs of both and of dv-processing
2.0.4 against such a stream.

The encoder is a compiled kernel: one pass over the records, without allocation. Timestamp and column are always stored,
and the index of the next word advances only if they were needed, so scattered events cost no mispredicted branch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from firmware_protocol.compiled import entry_of, kernel
from firmware_protocol.events import EVENT, Bytes, Events, Int64s, bytes_of
from firmware_protocol.evt.words import EVENT_BYTES, short_at, time_at
from firmware_protocol.fx3.stream import TimedEncoder
from firmware_protocol.fx3.words import (
    LOW_BITS,
    MAX_STEPS,
    SINGLE_WRAPS,
    TIMESTAMP,
    WORD,
    WRAP,
    WRAP_BITS,
    Block,
    Encoded,
    Marks,
    Words,
    WordState,
    is_column,
    is_row,
    no_marks,
    put_in_place,
    with_places,
)

COLUMN = 0x1000
GROUP_2 = 0x2000
GROUP_1 = 0x3000
ADDRESSES = 0x4000
SCAN_START = 0x800
COLUMN_BITS = 0x3FF
OFF_BIT = 0x100
FARTHEST = 31  # groups from group 1 to group 2
ROWS_OF_GROUP = 8
LOWEST_BIT = np.array([0, *(np.log2(mask & -mask) for mask in range(1, 256))], np.uint8)
"""Number of the lowest bit that is set in a byte."""

entry = entry_of("firmware_protocol.dvxplorer", "firmware_protocol.evt", "firmware_protocol.fx3.words")

_Times = Int64s
_State = Int64s

# Content of a state: device time and column in the words so far, next event and mark of this call, the time of the
# records that is zero in the words, a flag for pairs of groups, the size of the array, and the number of column words.
_TIME, _COLUMN, _AT_EVENT, _AT_MARK, _EPOCH, _PAIRS, _WIDTH, _HEIGHT, _COLUMNS = range(9)
_BACKWARDS = -1
_OUTSIDE = -2
_TOO_LATE = -3
_MOST_WORDS = 6  # of one iteration of the loop
_LONGEST_GAP_WRAPS = 1 << 25  # 12 days: 8192 words
_NO_COLUMN = np.int64(-1)

# Compiled code holds plain numbers.
_WRAP = WRAP
_WRAP_BITS = WRAP_BITS
_TIMESTAMP = TIMESTAMP
_LOW_BITS = LOW_BITS
_MAX_STEPS = MAX_STEPS
_SINGLE = SINGLE_WRAPS


@entry
def write_words(events: Bytes, mark_times: _Times, mark_words: Words, state: _State, out: Words) -> int:
    """Write words until all events and marks are written or `out` is full, and return their number.

    A negative number is _BACKWARDS, _OUTSIDE or _TOO_LATE; `state` is then invalid.

    Parameters
    ----------
    events : (13 n,) bytes of EVENT records.
    mark_times, mark_words : (m,) times, us, and words of marks, sorted; a mark comes before events of the same time.
    state : (9,) with the layout above; on return the state after the last word.
    out : (k,) room, k at least 6.
    """
    written = 0
    while written <= len(out) - _MOST_WORDS:
        at, at_mark = state[_AT_EVENT] * EVENT_BYTES, state[_AT_MARK]
        has_event = at < len(events)
        event_us = time_at(events, at) if has_event else np.int64(0)
        is_mark = at_mark < len(mark_times) and (not has_event or mark_times[at_mark] <= event_us)
        if not (is_mark or has_event):
            break
        t = (mark_times[at_mark] if is_mark else event_us) - state[_EPOCH]
        if t < state[_TIME]:
            return _BACKWARDS
        steps = (t >> _WRAP_BITS) - (state[_TIME] >> _WRAP_BITS)
        if steps:
            if steps > _LONGEST_GAP_WRAPS:
                return _TOO_LATE
            written = _put_wrap(steps, state, out, written)
            continue
        out[np.uint64(written)] = _TIMESTAMP | t & _LOW_BITS
        is_later = t != state[_TIME]
        written += is_later
        state[_TIME] = t
        if is_mark:
            out[np.uint64(written)] = mark_words[at_mark]
            written += 1
            state[_AT_MARK] += 1
        else:
            written = _put_pixels(events, is_later, state, out, written)
            if written < 0:
                return _OUTSIDE
    return written


@kernel
def _put_wrap(steps: int, state: _State, out: Words, written: int) -> int:
    """Write one wrap word on the way over `steps` wraps; return the index of the next word."""
    taken = min(steps, _MAX_STEPS) if steps > _SINGLE else 1
    out[np.uint64(written)] = _WRAP | taken
    state[_TIME] = ((state[_TIME] >> _WRAP_BITS) + taken) << _WRAP_BITS
    return written + 1


@kernel
def _put_pixels(events: Bytes, is_later: bool, state: _State, out: Words, written: int) -> int:
    """Write the next group of events, or two; return a negative number for an event outside the array."""
    at = state[_AT_EVENT] * EVENT_BYTES
    x, y = short_at(events, at + 8), short_at(events, at + 10)
    if x >= state[_WIDTH] or y >= state[_HEIGHT]:
        return _OUTSIDE
    column = state[_COLUMN]
    begins = x <= column or column < 0
    out[np.uint64(written)] = COLUMN | begins * SCAN_START | x
    is_new = is_later or x != column
    written += is_new
    state[_COLUMNS] += is_new
    state[_COLUMN] = x
    group = y >> 3
    word, end = _group(events, at)
    address = ADDRESSES | group
    out[np.uint64(written + 1)] = GROUP_1 | word
    count = 2
    if state[_PAIRS] and _shares_column(events, at, end):
        second = short_at(events, end + 10)
        if second >= state[_HEIGHT]:
            return _OUTSIDE
        distance = (second >> 3) - group
        if abs(distance) <= FARTHEST:
            word, end = _group(events, end)
            out[np.uint64(written + 2)] = GROUP_2 | word
            address |= abs(distance) << 6 | (distance < 0) << 11
            count = 3
    out[np.uint64(written)] = address
    state[_AT_EVENT] = end // EVENT_BYTES
    return written + count


@kernel
def _shares_column(events: Bytes, at: int, other: int) -> bool:
    """Return true if record `other` exists and has the time and the column of record `at`."""
    if other >= len(events):
        return False
    same_time = time_at(events, other) == time_at(events, at)
    return same_time and short_at(events, other + 8) == short_at(events, at + 8)


@kernel
def _group(events: Bytes, at: int) -> tuple[int, int]:
    """Return polarity and pixels of the word that begins with record `at`, and the place after its last record."""
    y, off = short_at(events, at + 10), events[np.uint64(at + 12)] == 0
    word, other = off * OFF_BIT | 1 << (y & 7), at + EVENT_BYTES
    while _shares_column(events, at, other):
        row = short_at(events, other + 10)
        if row <= y or row >> 3 != y >> 3 or (events[np.uint64(other + 12)] == 0) != off:
            break
        word |= 1 << (row & 7)
        y = row
        other += EVENT_BYTES
    return word, other


_PIXELS_IN = np.array([bin(mask).count("1") for mask in range(256)], np.uint8)


@dataclass(frozen=True)
class PixelWords(Encoded):
    """Words of a run of events, marks and blocks, in which a word may complete up to eight events."""

    def events_in(self, words: Words) -> int:
        """Return the number of pixels in those of the words that complete events."""
        return int(_PIXELS_IN[words[is_column(words)] & 0xFF].sum(dtype=np.int64))


_COMPLAINTS = {
    _BACKWARDS: "events and marks must be sorted by time and not earlier than those before",
    _OUTSIDE: "an event lies outside the array",
    _TOO_LATE: "no event for more than 12 days: the gap is too long to encode",
}


class GroupEncoder(TimedEncoder):
    """Encoder of events into the words of a DVXplorer.

    Parameters
    ----------
    size : (width, height) of the array; events outside are refused.

    Attributes
    ----------
    compressed : True: two groups share their addresses.
    groups, dropped_columns, dropped_groups
        Words of pixels that were queued; columns and words of pixels that found no room.
    """

    words_per_event: ClassVar[int] = 4

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__()
        self._size = size
        self.compressed = True
        self.groups = self.dropped_columns = self.dropped_groups = 0
        self._room = np.empty(0, WORD)
        self.encode(np.zeros(0, EVENT))  # compiles the kernel now, not while events wait

    def encode(
        self, events: Events, epoch_us: int = 0, marks: Marks | None = None, blocks: Sequence[Block] = ()
    ) -> PixelWords:
        """Return the words of items in stream order, written by the kernel."""
        placed = with_places(no_marks() if marks is None else marks, blocks)
        column = int(_NO_COLUMN) if self.state.row < 0 else self.state.row & COLUMN_BITS
        state = np.array([self.state.time_us, column, 0, 0, epoch_us, self.compressed, *self._size, 0], np.int64)
        mark_times = placed["t"].astype(np.int64)
        mark_words = np.ascontiguousarray(placed["code"])
        pieces: list[Words] = []
        room = self.words_per_event * len(events) + 2 * len(placed) + _MOST_WORDS + 64
        if len(self._room) < room:
            self._room = np.empty(room, WORD)
        data = bytes_of(events)
        while state[_AT_EVENT] < len(events) or state[_AT_MARK] < len(placed):
            written = write_words(data, mark_times, mark_words, state, self._room)
            if written < 0:
                raise ValueError(_COMPLAINTS[written])
            pieces.append(self._room[:written].copy())
        self.state = WordState(int(state[_TIME]), int(state[_COLUMN]))
        words = pieces[0] if len(pieces) == 1 else np.concatenate([np.empty(0, WORD), *pieces])
        self.rows = int(state[_COLUMNS])
        return PixelWords(*put_in_place(words, blocks))

    def count(self, queued: Words, dropped: Words) -> None:
        """Count groups of pixels, and the columns that found no room."""
        self.groups += int(np.count_nonzero(is_column(queued)))
        if len(dropped):
            self.dropped_groups += int(np.count_nonzero(is_column(dropped)))
            self.dropped_columns += int(np.count_nonzero(is_row(dropped)))

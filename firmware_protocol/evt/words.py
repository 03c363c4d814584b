"""The words of EVT3, headers of files, and the encoding loop that the EVT formats share.

A word has 16 bits, little-endian:

    15..12  11         10..0
    0x0     -          y                          row of the events that follow
    0x2     polarity   x                          one event
    0x3     polarity   x                          first column of the vectors that follow; no event by itself
    0x4     12 columns, a bit each: bit i is column x + i. The next vector begins at x + 12
    0x5     8 columns in bits 7..0. The next vector begins at x + 8
    0x6     time, bits 11..0, us
    0x8     time, bits 23..12
    0xA     channel in bits 11..8, edge in bit 0 (1: rising)      external trigger
    0xE     subtype: numbers of the sensor, with 0xF and 0x7 as their digits. Not used here

Row, time and the column of vectors hold until a word changes them. The time wraps every 2^24 us (16.8 s): a reader
counts a wrap when the high part goes back by more than half its range, so every step of it must be below 2048 (8.4 s).
OpenEB requires both sides of a wrap, 0xFFF and 0x000, reads 0x4, 0x4, 0x5 as one unit of 32 columns, and by default
drops a unit that passes the sensor's last column, even if no bit beyond it is set (hal, evt3_validator.h).

Sources: docs.prophesee.ai, "EVT 3.0 Format"; OpenEB 5.1.1.

The compiled loops (see `firmware_protocol.compiled`) read EVENT and EDGE records as bytes. Indices are unsigned: numba
then adds no test for an index from the end, and the compiler joins the bytes of a number into one load or store. The
loops find the next event or edge, and the events that share words; `Coder` runs them, whatever the format of the words.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import entry_of, kernel
from firmware_protocol.events import Bytes, Edges, Events, Int64s, bytes_of, empty_edges, empty_events

ROW, SINGLE, BASE, VECTOR_12, VECTOR_8, LOW, HIGH, TRIGGER = 0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x8, 0xA
LIMIT_PX = 1 << 11
WINDOW_PX = 32
HIGH_BITS = 12  # of the time in a low word, and in a high word


def evt3_header(size: tuple[int, int]) -> bytes:
    """Return the text before the words of an EVT3 `.raw` file of a sensor of `size` = (width, height)."""
    width, height = size
    lines = ("evt 3.0", f"format EVT3;width={width};height={height}", f"geometry {width}x{height}", "end")
    return "".join(f"% {line}\n" for line in lines).encode("ascii")


def next_high(written: int, target: int, bits: int) -> int:
    """Return the full high part of a time to write next after `written`, on the way to `target` > `written`.

    A word holds `bits` bits of it. -1 stands before the first word, so every stream begins with high part 0.
    """
    wrap = 1 << bits
    quarter = wrap // 4
    if written >> bits == target >> bits and target - written < 2 * quarter:
        return target
    next_step = (written // quarter + 1) * quarter
    end_of_wrap = written | wrap - 1
    if end_of_wrap > written:
        next_step = min(next_step, end_of_wrap)
    return min(next_step, target)


entry = entry_of("firmware_protocol.evt", "firmware_protocol.events")

_Words = npt.NDArray[np.unsignedinteger]

EVENT_BYTES, EDGE_BYTES = 13, 12


@kernel
def time_at(data: Bytes, at: int) -> int:
    """Return the eight bytes from `at` on as a time; it is negative from 2**63 us on."""
    place, t = np.uint64(at), np.int64(0)
    for k in range(8):
        t |= np.int64(data[place + np.uint64(k)]) << np.int64(8 * k)
    return int(t)


@kernel
def short_at(data: Bytes, at: int) -> int:
    """Return the two bytes from `at` on."""
    place = np.uint64(at)
    return int(np.int64(data[place]) | np.int64(data[place + np.uint64(1)]) << np.int64(8))


@kernel
def put_time(data: Bytes, at: int, t: int) -> None:
    """Write eight bytes."""
    place = np.uint64(at)
    for k in range(8):
        data[place + np.uint64(k)] = (t >> (8 * k)) & 255


@kernel
def put_short(data: Bytes, at: int, value: int) -> None:
    """Write the two low bytes of `value`."""
    place = np.uint64(at)
    data[place] = value & 255
    data[place + np.uint64(1)] = (value >> 8) & 255


_State = Int64s

# Content of a state: full high part, full time and row in the words so far (-1: none), the newest time given, the next
# event and edge of this call and the number of words of a part, a flag for a high part that must be written although
# readers have it, the time of the records that is zero in the words, and the bits of a time within a period of
# repetition and the last period. All other times are those of the words.
HIGH_SENT, TIME_SENT, ROW_SENT, LAST, AT_EVENT, AT_EDGE, WRITTEN, MUST_OPEN, ORIGIN, REPEAT, PERIOD = range(11)
BACKWARDS, TOO_LATE, OUTSIDE = -1, -2, -3
LONGEST_GAP_US = 1 << 37  # 38 hours: 41 000 words

_NEVER = 63  # bits of a period that has no end
_MOST_REPEATS = 1024  # of a high part, in one call


def new_state(origin_us: int = 0, repeat_us: int = 0) -> _State:
    """Return the state before the first word; records of the time `origin_us` have time zero."""
    bits = repeat_us.bit_length() - 1 if repeat_us else _NEVER
    return np.array([-1, -1, -1, -1, 0, 0, 0, 0, origin_us, bits, 0], np.int64)


@kernel
def is_left(events: Bytes, edges: Bytes, state: _State) -> bool:
    """Return true if any event or edge is left."""
    return bool(state[AT_EVENT] * EVENT_BYTES < len(events) or state[AT_EDGE] * EDGE_BYTES < len(edges))


@kernel
def edge_is_next(events: Bytes, edges: Bytes, state: _State) -> bool:
    """Return true if an edge comes next: edges come before events of the same time."""
    at = state[AT_EDGE] * EDGE_BYTES
    if at >= len(edges):
        return False
    at_event = state[AT_EVENT] * EVENT_BYTES
    return at_event >= len(events) or time_at(edges, at) <= time_at(events, at_event)


@kernel
def run_end(t: int, low_bits: int, edges: Bytes, state: _State) -> int:
    """Return the last time of events from `t` on with its high part, in its period and before the next edge."""
    end = t | (1 << min(low_bits, state[REPEAT])) - 1
    at = state[AT_EDGE] * EDGE_BYTES
    return int(min(end, time_at(edges, at) - state[ORIGIN] - 1)) if at < len(edges) else end


@kernel
def same_group(events: Bytes, at: int, other: int, base: int) -> bool:
    """Return true if record `other` has the time, row and polarity of record `at`, in the window from `base`."""
    if other >= len(events) or time_at(events, other) != time_at(events, at):
        return False
    x, on = short_at(events, other + 8), (events[np.uint64(at + 12)] != 0) == (events[np.uint64(other + 12)] != 0)
    same_row = short_at(events, other + 10) == short_at(events, at + 10)
    return same_row and on and base <= x < base + WINDOW_PX


@kernel
def window(events: Bytes, at: int, base: int) -> tuple[int, int]:
    """Return the columns in the window from `base`, a bit each, that records from `at` on fill, and their number."""
    last, other = short_at(events, at + 8), at + EVENT_BYTES
    bits, count = 1 << (last - base), 1
    while same_group(events, at, other, base) and short_at(events, other + 8) > last:
        last = short_at(events, other + 8)
        bits |= 1 << (last - base)
        count += 1
        other += EVENT_BYTES
    return bits, count


def parts_writer(
    low_bits: int,
    most_words: int,
    put_high: Callable[[int, int, _State, _Words, int], int],
    put_edge: Callable[[Bytes, int, int, _State, _Words, int], int],
    put_events: Callable[[Bytes, int, int, _State, _Words, int], int],
) -> Callable[[Bytes, Bytes, int, _State, int, _Words], int]:
    """Return the kernel that writes parts of words in a format, one into each row, until all records are written.

    It returns the number of parts. A fault in the first one gives BACKWARDS, TOO_LATE or OUTSIDE; a later part with one
    is left out. Its arguments: (13 n,) and (12 m,) bytes of EVENT and EDGE records; the `setting` of the format's own
    kernels; states, (parts + 1, 11), that before the first part and on return that after each one; how many parts, from
    the first on, begin with time and row; and the rows, (parts, k >= `most_words`).

    Parameters
    ----------
    low_bits : of a time, beside its high part.
    most_words : of one turn of the loop.
    put_high, put_edge, put_events : kernels that write a high part on the way to the one given, an edge, and the events
        up to a time or as many as fit; they return the index of the next word, the last one also OUTSIDE.
    """

    @kernel
    def write(events: Bytes, edges: Bytes, setting: int, state: _State, out: _Words) -> int:
        written = 0
        while written <= len(out) - most_words and is_left(events, edges, state):
            is_edge = edge_is_next(events, edges, state)
            next_at = state[AT_EDGE] * EDGE_BYTES if is_edge else state[AT_EVENT] * EVENT_BYTES
            t = int(time_at(edges if is_edge else events, next_at) - state[ORIGIN])
            if t < state[LAST]:
                return BACKWARDS
            if t - state[LAST] > LONGEST_GAP_US:
                return TOO_LATE
            if t >> state[REPEAT] != state[PERIOD]:  # the first time of a period of repetition
                state[PERIOD] = t >> state[REPEAT]
                state[MUST_OPEN] = 1
                state[TIME_SENT] = state[ROW_SENT] = -1
            high = t >> low_bits
            if high != state[HIGH_SENT] or state[MUST_OPEN]:
                written = put_high(high, setting, state, out, written)
                state[MUST_OPEN] = state[MUST_OPEN] and high != state[HIGH_SENT]
                if high != state[HIGH_SENT]:
                    continue
            if is_edge:
                written = put_edge(edges, t, setting, state, out, written)
            else:
                written = put_events(events, run_end(t, low_bits, edges, state), setting, state, out, written)
            if written < 0:
                return OUTSIDE
        return written

    @kernel
    def write_parts(events: Bytes, edges: Bytes, setting: int, states: _State, opening: int, rows: _Words) -> int:
        count = 0
        while count < len(rows) and is_left(events, edges, states[count]):
            state = states[count + 1]
            for k in range(len(state)):
                state[k] = states[count, k]
            if count < opening:
                state[MUST_OPEN] = 1
                state[TIME_SENT] = state[ROW_SENT] = -1
            state[WRITTEN] = write(events, edges, setting, state, rows[count])
            if state[WRITTEN] < 0:
                return count or int(state[WRITTEN])
            count += 1
        return count

    return write_parts


_ROOM_BYTES = 1 << 16
_COMPLAINTS = {
    BACKWARDS: "time goes back",
    TOO_LATE: "nothing for more than 38 hours",
    OUTSIDE: f"the words number {LIMIT_PX} columns and rows",
}


@dataclass(frozen=True)
class Words:
    """Properties of a word format.

    Attributes
    ----------
    dtype : type of a word.
    low_bits, high_bits : bits of a time, in a low part and in a high part.
    write : kernel that writes parts of words of events and edges; see `parts_writer`.
    high_words : function that returns the words of a high part.
    """

    dtype: type[np.unsignedinteger]
    low_bits: int
    high_bits: int
    write: Callable[[Bytes, Bytes, _State, int, _Words], int]
    high_words: Callable[[int], list[int]]


class Filled(NamedTuple):
    """Words, and the numbers of the first events and edges that are in them or in parts before."""

    words: bytes
    events: int
    edges: int


class Coder:
    """Encoder; each call continues where the last one ended, or with `standalone` begins with time and row.

    With `repeat_us`, a power of two, so does each period of that length, in a silence too.

    The constructor compiles the kernels, or reads them from disk, so that no event has to wait for it.
    """

    def __init__(self, words: Words, *, standalone: bool, origin_us: int = 0, repeat_us: int = 0) -> None:
        self._words = words
        self._standalone = standalone
        self._new = new_state(origin_us, repeat_us)
        self._state = self._new.copy()
        self._out = np.empty(_ROOM_BYTES // np.dtype(words.dtype).itemsize, words.dtype)
        self.encode(empty_events())

    @property
    def last_us(self) -> int:
        """Newest time that was encoded or advanced to, -1 before the first."""
        return int(self._state[LAST])

    def begin(self, t_us: int) -> None:
        """Begin a stream at `t_us`: readers get its high part first, without those from zero on."""
        self._state = self._new.copy()
        self._state[LAST] = t_us - 1
        self._state[HIGH_SENT] = (t_us >> self._words.low_bits) - 1
        self._state[PERIOD] = t_us >> int(self._state[REPEAT])

    def encode(self, events: Events, edges: Edges | None = None) -> bytes:
        """Return the words of events (n,) EVENT and edges (m,) EDGE, each sorted and not before the time already sent.

        Edges come before events of the same time. Raises ValueError for a time that goes back, a gap of more than
        38 hours, or a place beyond 2047; the encoder then is as it was before.
        """
        edges = empty_edges() if edges is None else edges
        states, opening = self._begun(1), int(self._standalone)
        parts = list[bytes]()
        ends = [-1]
        while ends[:2] != [len(events), len(edges)]:
            self._write(events, edges, states, opening, self._out[None])
            ends = states[1, AT_EVENT : WRITTEN + 1].tolist()
            parts.append(self._out[: ends[-1]].tobytes())
            states[0], opening = states[1], 0
        self._state = states[1]
        return b"".join(parts)

    def parts(self, events: Events, edges: Edges, octets: int) -> Iterator[Filled]:
        """Yield the words in parts of at most so many octets (64 to 65536), as if each were encoded; see `encode`.

        It is fast because one call of the kernel writes dozens of them.
        """
        room = octets // self._out.itemsize
        rows = self._out[: len(self._out) // room * room].reshape(-1, room)
        states, done = self._begun(len(rows)), [0, 0]
        while done != [len(events), len(edges)]:
            count = self._write(events, edges, states, len(rows) if self._standalone else 0, rows)
            ends = states[1 : count + 1, AT_EVENT : WRITTEN + 1].tolist()
            for row, self._state, (*done, size) in zip(rows, states[1:].copy(), ends, strict=False):
                yield Filled(row[:size].tobytes(), *done)
            states[0] = states[count]

    def advance(self, t_us: int) -> bytes:
        """Return the words that advance readers to `t_us` during a silence; no later event may be before `t_us`.

        Empty if no high part is due (with `repeat_us` one in each period), or if a later time has been sent already.
        Raises ValueError for a gap of more than 38 hours.
        """
        state, format_ = self._state, self._words
        if t_us - state[LAST] > LONGEST_GAP_US:
            raise ValueError(_COMPLAINTS[TOO_LATE])
        if t_us <= state[LAST]:
            return b""
        words, written = list[int](), int(state[HIGH_SENT])
        shift = int(state[REPEAT])
        period = t_us >> shift
        begun = range(max(int(state[PERIOD]) + 1, period - _MOST_REPEATS), period + 1)
        for time in [k << shift for k in begun] if shift < _NEVER else [t_us]:
            high = time >> format_.low_bits
            words += format_.high_words(high) if begun and high == written else []
            while written < high:
                written = next_high(written, high, format_.high_bits)
                words += format_.high_words(written)
        state[LAST] = t_us
        state[HIGH_SENT] = written
        if begun:
            state[PERIOD] = period
            state[TIME_SENT] = state[ROW_SENT] = -1
        return np.array(words, format_.dtype).tobytes()

    def _begun(self, parts: int) -> _State:
        """Return the states of so many parts, and the state at the start of a call as the first."""
        states = np.empty((parts + 1, len(self._state)), np.int64)
        states[:] = self._state
        states[:, AT_EVENT : WRITTEN + 1] = 0
        return states

    def _write(self, events: Events, edges: Edges, states: _State, opening: int, rows: _Words) -> int:
        count = self._words.write(bytes_of(events), bytes_of(edges), states, opening, rows)
        if count < 0:
            raise ValueError(_COMPLAINTS[count])
        return count

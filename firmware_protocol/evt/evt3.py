"""Events and edges to EVT3 words, and back, also for the words of real sensors.

Events of the same time, row and polarity whose columns rise within one window of 32 columns, which begins at a
multiple of 32, become four words (0x3, 0x4, 0x4, 0x5) if they are five or more. So every reader gets them in the order
in which they were given.

The encoder is a compiled kernel: one pass over the records, without allocation. It is fast because the events up to
the next high part or edge are written by a loop that keeps its state in processor registers: one comparison of the time
with the end of this run stands for all the tests of faults, high parts and edges. The low part of the time, the row and
the column are always stored, and the index of the next word advances only if they were needed. One record decides by
one branch whether a vector may begin: the fourth after the present one.

The decoder is compiled too: one pass counts events and edges, the next writes the records into an array of exactly
that size. Counting is a sum without branches, so it costs little compared with a buffer that grows; the second pass
holds its whole state in processor registers.
"""

from __future__ import annotations

import numpy as np

from firmware_protocol.compiled import kernel
from firmware_protocol.events import Bytes, EdgeKind, Edges, Events, Int64s, UInt16s, empty_edges, empty_events
from firmware_protocol.evt.words import (
    AT_EDGE,
    AT_EVENT,
    BASE,
    EDGE_BYTES,
    EVENT_BYTES,
    HIGH,
    HIGH_BITS,
    HIGH_SENT,
    LAST,
    LIMIT_PX,
    LOW,
    ORIGIN,
    OUTSIDE,
    ROW,
    ROW_SENT,
    SINGLE,
    TIME_SENT,
    TRIGGER,
    VECTOR_8,
    VECTOR_12,
    WINDOW_PX,
    Coder,
    Words,
    entry,
    next_high,
    parts_writer,
    put_short,
    put_time,
    short_at,
    time_at,
    window,
)

_Words = UInt16s
_State = Int64s

_HIGH, _LOW, _ROW, _SINGLE, _BASE, _TRIGGER = (kind << 12 for kind in (HIGH, LOW, ROW, SINGLE, BASE, TRIGGER))
_VECTOR_12, _VECTOR_8 = VECTOR_12 << 12, VECTOR_8 << 12
_RISING, _PULSE = int(EdgeKind.RISING), int(EdgeKind.PULSE)
_FEWEST = 5  # events of a vector: it takes four words
_MOST_WORDS = 8  # of one iteration of the loop

_next_high = kernel(next_high)


@kernel
def _put_high(high: int, _width: int, state: _State, out: _Words, written: int) -> int:
    """Write one high part on the way to `high`, or `high` itself; return the index of the next word."""
    if high != state[HIGH_SENT]:
        state[HIGH_SENT] = _next_high(state[HIGH_SENT], high, HIGH_BITS)
    out[np.uint64(written)] = _HIGH | state[HIGH_SENT] & 0xFFF
    return written + 1


@kernel
def _put_edge(edges: Bytes, t: int, _width: int, state: _State, out: _Words, written: int) -> int:
    """Write an edge at `t`, or both edges of a pulse."""
    out[np.uint64(written)] = _LOW | t & 0xFFF
    written += t != state[TIME_SENT]
    state[LAST] = state[TIME_SENT] = t
    at = state[AT_EDGE] * EDGE_BYTES
    kind, word = edges[np.uint64(at + 8)], _TRIGGER | int(edges[np.uint64(at + 9)] & 0xF) << 8
    state[AT_EDGE] += 1
    out[np.uint64(written)] = word | (kind in (_RISING, _PULSE))
    out[np.uint64(written + 1)] = word
    return written + (2 if kind == _PULSE else 1)


@kernel
def _put_events(events: Bytes, until: int, width: int, state: _State, out: _Words, written: int) -> int:
    """Write the events up to the time `until`, or as many as fit; return a negative number for one outside."""
    at = state[AT_EVENT] * EVENT_BYTES
    t_before, row_before = state[TIME_SENT], state[ROW_SENT]
    origin, last = state[ORIGIN], state[LAST]
    t = time_at(events, at) - origin
    while last <= t <= until:
        x, y = short_at(events, at + 8), short_at(events, at + 10)
        on = events[np.uint64(at + 12)] != 0
        if (x | y) >= LIMIT_PX:
            return OUTSIDE
        out[np.uint64(written)] = _LOW | t & 0xFFF
        written += t != t_before
        out[np.uint64(written)] = _ROW | y
        written += y != row_before
        last = t_before = t
        row_before = y
        base = x - x % WINDOW_PX
        bits, count = 0, 0
        if base + WINDOW_PX <= width and _may_be_vector(events, at):
            bits, count = window(events, at, base)
        if count >= _FEWEST:
            written = _put_vector(base, on, bits, out, written)
            at += count * EVENT_BYTES
        else:
            out[np.uint64(written)] = _SINGLE | on << 11 | x
            written += 1
            at += EVENT_BYTES
        if at >= len(events) or written > len(out) - _MOST_WORDS:
            break
        t = time_at(events, at) - origin
    state[AT_EVENT] = at // EVENT_BYTES
    state[LAST], state[TIME_SENT] = last, t_before
    state[ROW_SENT] = row_before
    return written


@kernel
def _may_be_vector(events: Bytes, at: int) -> bool:
    """Return true if the fourth record after `at` has its time, row, polarity and window."""
    other = at + (_FEWEST - 1) * EVENT_BYTES
    if other >= len(events):
        return False
    differences = time_at(events, other) ^ time_at(events, at)
    differences |= short_at(events, other + 10) ^ short_at(events, at + 10)
    differences |= (short_at(events, other + 8) ^ short_at(events, at + 8)) // WINDOW_PX
    differences |= (events[np.uint64(other + 12)] != 0) ^ (events[np.uint64(at + 12)] != 0)
    return bool(differences == 0)


@kernel
def _put_vector(base: int, on: bool, bits: int, out: _Words, written: int) -> int:
    out[np.uint64(written)] = _BASE | on << 11 | base
    out[np.uint64(written + 1)] = _VECTOR_12 | bits & 0xFFF
    out[np.uint64(written + 2)] = _VECTOR_12 | bits >> 12 & 0xFFF
    out[np.uint64(written + 3)] = _VECTOR_8 | bits >> 24
    return written + 4


_write_parts = parts_writer(HIGH_BITS, _MOST_WORDS, _put_high, _put_edge, _put_events)


@entry
def write_parts(events: Bytes, edges: Bytes, width: int, states: _State, opening: int, rows: _Words) -> int:
    """Write parts of the words of a sensor of so many columns; see `parts_writer`."""
    return _write_parts(events, edges, width, states, opening, rows)


class Evt3Encoder(Coder):
    """Encoder of events and edges into words; each call continues where the last one ended.

    A high part is 4096 us; call `advance` at least every 4 s of silence.

    Parameters
    ----------
    standalone : true if the words of each call begin with their time and row, as messages and packets need it.
    width : of the sensor; no vector passes its last column. The default suits widths that are multiples of 32.
    origin_us : time of events and edges that is zero in the words; `advance` uses the time of the words.
    repeat_us : period in which time and row are repeated, a power of two, such as 16 of an IMX636; 0: none.
    """

    def __init__(
        self, *, standalone: bool = False, width: int = LIMIT_PX, origin_us: int = 0, repeat_us: int = 0
    ) -> None:
        form = Words(
            np.uint16, HIGH_BITS, HIGH_BITS,
            lambda events, edges, *parts: write_parts(events, edges, width, *parts),
            lambda high: [HIGH << 12 | high & 0xFFF],
        )  # fmt: skip
        super().__init__(form, standalone=standalone, origin_us=origin_us, repeat_us=repeat_us)


# Content of a state: full high part (-1: none yet), low part, row, column and polarity of the next vector.
HIGH_READ, _LOW_READ, _ROW_READ, _COLUMN, _POLARITY = range(5)

_FALLING = int(EdgeKind.FALLING)


def new_state() -> _State:
    """Return the state before the first word."""
    return np.array([-1, 0, 0, 0, 0], np.int64)


@entry
def count_words(words: _Words) -> tuple[int, int]:
    """Return the numbers of events and edges in (n,) words."""
    events, edges = 0, 0
    for word in words:
        kind = word >> 12
        # The column bits of a vector, none for other words; then their number.
        bits = np.int64(word & (0xFFF if kind == VECTOR_12 else 0xFF if kind == VECTOR_8 else 0))
        bits -= bits >> 1 & 0x555
        bits = (bits & 0x333) + (bits >> 2 & 0x333)
        events += (bits & 0xF) + (bits >> 4 & 0xF) + (bits >> 8) + (kind == SINGLE)
        edges += kind == TRIGGER
    return events, edges


@entry
def read_words(words: _Words, state: _State, events: Bytes, edges: Bytes) -> None:
    """Write the records of all (n,) words to `events` and `edges`, sized by `count_words`, and update `state`."""
    high, low = state[HIGH_READ], state[_LOW_READ]
    row, column = state[_ROW_READ], state[_COLUMN]
    on = state[_POLARITY]
    at = at_edge = 0
    for word in words:
        kind, value = word >> 12, int(word & 0xFFF)
        if kind == SINGLE:
            at = put_event(events, at, high << 12 | low, value & 0x7FF, row, value >> 11)
        elif kind == ROW:
            row = value & 0x7FF
        elif kind == LOW:
            low = value
        elif kind == HIGH:
            high, low = full_high(high, value, HIGH_BITS), 0  # a new high part begins at low part 0
        elif kind == BASE:
            column, on = value & 0x7FF, value >> 11
        elif kind in (VECTOR_12, VECTOR_8):
            length = 12 if kind == VECTOR_12 else 8
            bits, x = value & (1 << length) - 1, column
            while bits:
                if bits & 1:
                    at = put_event(events, at, high << 12 | low, x, row, on)
                bits >>= 1
                x += 1
            column = column + length & 0xFFFF
        elif kind == TRIGGER:
            at_edge = put_edge(edges, at_edge, high << 12 | low, value >> 8, value & 1)
    state[HIGH_READ], state[_LOW_READ] = high, low
    state[_ROW_READ], state[_COLUMN] = row, column
    state[_POLARITY] = on


@kernel
def full_high(high: int, part: int, bits: int) -> int:
    """Return the full high part that follows `high` (-1: none) and ends with the `bits` bits of `part`."""
    if high < 0:
        return part
    wrap = 1 << bits
    wraps = (high & wrap - 1) - part > wrap // 2
    return (high & ~(wrap - 1)) + wrap * wraps + part


@kernel
def put_event(events: Bytes, at: int, t: int, x: int, y: int, on: int) -> int:
    """Write an EVENT record; return the index of the next one."""
    put_time(events, at, t)
    put_short(events, at + 8, x)
    put_short(events, at + 10, y)
    events[np.uint64(at + 12)] = on
    return at + EVENT_BYTES


@kernel
def put_edge(edges: Bytes, at: int, t: int, channel: int, is_rising: int) -> int:
    """Write an EDGE record; return the index of the next one."""
    put_time(edges, at, t)
    edges[np.uint64(at + 8)] = _RISING if is_rising else _FALLING
    edges[np.uint64(at + 9)] = channel
    put_short(edges, at + 10, 0)
    return at + EDGE_BYTES


class Evt3Decoder:
    """Decoder of words in pieces. Words before the first time are skipped, as their time is unknown."""

    def __init__(self) -> None:
        self._state = new_state()
        self._rest = b""
        self.decode(b"")  # compiles the kernels now, not while words wait

    def decode(self, data: bytes) -> tuple[Events, Edges]:
        """Return (n,) EVENT and (m,) EDGE of any next bytes, even part of a word; at most 12 events a word."""
        data = self._rest + data
        complete_bytes = len(data) & ~1
        self._rest = data[complete_bytes:]
        words = np.frombuffer(data[:complete_bytes], "<u2")
        if self._state[HIGH_READ] < 0:
            starts = np.flatnonzero(words >> 12 == HIGH)
            words = words[starts[0] :] if len(starts) else words[:0]
        n_events, n_edges = count_words(words)
        events, edges = empty_events(n_events), empty_edges(n_edges)
        read_words(words, self._state, events.view(np.uint8), edges.view(np.uint8))
        return events, edges

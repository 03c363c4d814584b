"""Events and edges to EVT2 and EVT2.1 words, and back.

An EVT2 word has 32 bits, little-endian:

    31..28  27..22           21..11  10..0
    0x0     time, bits 5..0  x       y                    one OFF event
    0x1     time, bits 5..0  x       y                    one ON event
    0x8     time, bits 33..6
    0xA     time, bits 5..0  channel in bits 12..8, edge in bit 0 (1: rising)     external trigger

A word of EVT2.1 has 64 bits: the upper half is the EVT2 word, with x a multiple of 32, and the lower half a bit for
each column from x on. "evt21" is little-endian, as of the GenX320: the lower half comes first. "evt21-legacy" is what
the IMX636 sends: two little-endian words of 32 bits, the upper half first.

The time wraps every 2^34 us (4.8 h). OpenEB counts a wrap of EVT2.1 only between the last high part and 0, so both are
written.

Sources: docs.prophesee.ai, "EVT 2.0 Format" and "EVT 2.1 Format"; OpenEB 5.1.1, evt21_event_types.h.

The kernels are compiled. The encoder makes one pass over the records, in runs of events as in `evt3`, and allocates
nothing. The decoder makes one pass that counts events and edges, and one that writes the records.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import kernel
from firmware_protocol.events import Bytes, EdgeKind, Edges, Events, Int64s, empty_edges, empty_events
from firmware_protocol.evt.evt3 import full_high, put_edge, put_event
from firmware_protocol.evt.words import (
    AT_EDGE,
    AT_EVENT,
    EDGE_BYTES,
    EVENT_BYTES,
    HIGH_SENT,
    LAST,
    LIMIT_PX,
    ORIGIN,
    OUTSIDE,
    WINDOW_PX,
    Coder,
    Words,
    entry,
    next_high,
    parts_writer,
    short_at,
    time_at,
    window,
)

Form = Literal["evt2", "evt21", "evt21-legacy"]

ON, HIGH, TRIGGER = 0x1, 0x8, 0xA
LOW_BITS, HIGH_BITS = 6, 28


def evt2_header(size: tuple[int, int], form: Form) -> bytes:
    """Return the text before the words of a `.raw` file of a sensor of `size` = (width, height).

    These lines are among those that OpenEB 5.1.1 writes (psee_raw_file_header.cpp), in its order: it gives a version
    "evt" for EVT2, and an "endianness" for EVT2.1. Lines about the camera, the program and the date are left out.
    """
    width, height = size
    order = {"evt2": "", "evt21": "little", "evt21-legacy": "legacy"}[form]
    first, name = (f"endianness {order}", f"EVT21;endianness={order}") if order else ("evt 2.0", "EVT2")
    lines = (first, f"format {name};height={height};width={width}", f"geometry {width}x{height}", "end")
    return "".join(f"% {line}\n" for line in lines).encode("ascii")


_Words = npt.NDArray[np.uint32]
_State = Int64s

NO_MASK, MASK_FIRST, MASK_LAST = range(3)
"""Second half of a word: none (EVT2), or a bit for each of 32 columns, before it (EVT2.1) or after it (legacy)."""

_ON, _HIGH, _TRIGGER = ON << 28, HIGH << 28, TRIGGER << 28
_RISING, _PULSE = int(EdgeKind.RISING), int(EdgeKind.PULSE)
_MOST_WORDS = 6  # of one iteration of the loop

_next_high = kernel(next_high)


@kernel
def _put(out: _Words, written: int, mask: int, word: int, columns: int) -> int:
    """Write a word and its columns; return the index of the next word."""
    if mask == NO_MASK:
        out[np.uint64(written)] = word
        return written + 1
    out[np.uint64(written)] = columns if mask == MASK_FIRST else word
    out[np.uint64(written + 1)] = word if mask == MASK_FIRST else columns
    return written + 2


@kernel
def _put_high(high: int, mask: int, state: _State, out: _Words, written: int) -> int:
    """Write one high part on the way to `high`, or `high` itself; return the index of the next word."""
    if high != state[HIGH_SENT]:
        state[HIGH_SENT] = _next_high(state[HIGH_SENT], high, HIGH_BITS)
    return _put(out, written, mask, _HIGH | state[HIGH_SENT] & 0xFFFFFFF, 0)


@kernel
def _put_edge(edges: Bytes, t: int, mask: int, state: _State, out: _Words, written: int) -> int:
    """Write an edge at `t`, or both edges of a pulse."""
    state[LAST] = t
    at = state[AT_EDGE] * EDGE_BYTES
    kind, word = edges[np.uint64(at + 8)], _TRIGGER | (t & 0x3F) << 22 | int(edges[np.uint64(at + 9)] & 0x1F) << 8
    state[AT_EDGE] += 1
    written = _put(out, written, mask, word | (kind in (_RISING, _PULSE)), 0)
    return _put(out, written, mask, word, 0) if kind == _PULSE else written


@kernel
def _put_events(events: Bytes, until: int, mask: int, state: _State, out: _Words, written: int) -> int:
    """Write the events up to the time `until`, or as many as fit; return a negative number for one outside."""
    at = state[AT_EVENT] * EVENT_BYTES
    origin, last = state[ORIGIN], state[LAST]
    while at < len(events) and written <= len(out) - _MOST_WORDS:
        t = time_at(events, at) - origin
        if t < last or t > until:
            break
        last = t
        x, y = short_at(events, at + 8), short_at(events, at + 10)
        on = events[np.uint64(at + 12)] != 0
        if (x | y) >= LIMIT_PX:
            return OUTSIDE
        bits, column = 0, x
        count = 1
        if mask != NO_MASK:
            column = x - x % WINDOW_PX
            bits, count = window(events, at, column)
        at += count * EVENT_BYTES
        written = _put(out, written, mask, (_ON if on else 0) | (t & 0x3F) << 22 | column << 11 | y, bits)
    state[AT_EVENT], state[LAST] = at // EVENT_BYTES, last
    return written


_write_parts = parts_writer(LOW_BITS, _MOST_WORDS, _put_high, _put_edge, _put_events)


@entry
def write_evt2_parts(events: Bytes, edges: Bytes, mask: int, states: _State, opening: int, rows: _Words) -> int:
    """Write parts of words with NO_MASK, MASK_FIRST or MASK_LAST; see `parts_writer`."""
    return _write_parts(events, edges, mask, states, opening, rows)


@kernel
def _pair(words: _Words, i: int, mask: int) -> tuple[int, int]:
    """Return word `i` and its columns; a word without a mask has one column, its own."""
    if mask == NO_MASK:
        return int(np.int64(words[i])), 1
    first, second = int(np.int64(words[2 * i])), int(np.int64(words[2 * i + 1]))
    return (second, first) if mask == MASK_FIRST else (first, second)


@entry
def count_evt2(words: _Words, mask: int, is_started: bool) -> tuple[int, int]:
    """Return the numbers of events and edges in (n,) words, from the first high part on unless `is_started`."""
    events, edges = 0, 0
    for i in range(len(words) if mask == NO_MASK else len(words) // 2):
        word, columns = _pair(words, i, mask)
        kind = word >> 28
        is_started = is_started or kind == HIGH
        if is_started and kind <= ON:
            while columns:
                columns &= columns - 1
                events += 1
        edges += is_started and kind == TRIGGER
    return events, edges


@entry
def read_evt2(words: _Words, mask: int, state: _State, events: Bytes, edges: Bytes) -> None:
    """Write the records of all (n,) words; `state` is (1,), the full high part, -1 before the first."""
    at, at_edge = 0, 0
    for i in range(len(words) if mask == NO_MASK else len(words) // 2):
        word, columns = _pair(words, i, mask)
        kind, t = word >> 28, state[0] << 6 | (word >> 22 & 0x3F)
        if kind == HIGH:
            state[0] = full_high(state[0], word & 0xFFFFFFF, HIGH_BITS)
        elif state[0] < 0:
            continue
        elif kind <= ON:
            x = word >> 11 & 0x7FF
            while columns:
                if columns & 1:
                    at = put_event(events, at, t, x, word & 0x7FF, kind)
                columns >>= 1
                x += 1
        elif kind == TRIGGER:
            at_edge = put_edge(edges, at_edge, t, word >> 8 & 0x1F, word & 1)


_MASKS = {"evt2": NO_MASK, "evt21": MASK_FIRST, "evt21-legacy": MASK_LAST}


class Evt2Encoder(Coder):
    """Encoder of events and edges into words; each call continues where the last one ended. A high part is 64 us.

    Parameters
    ----------
    form : EVT2, EVT2.1, or EVT2.1 as the IMX636 sends it. In EVT2.1, events of a time, row and polarity whose columns
        rise within 32 columns from a multiple of 32 share a word.
    standalone : true if the words of each call begin with their time.
    origin_us : time of the records that is zero in the words.
    repeat_us : period in which the high part is repeated, a power of two; 0: none.
    """

    def __init__(self, form: Form, *, standalone: bool = False, origin_us: int = 0, repeat_us: int = 0) -> None:
        mask = _MASKS[form]
        beside = {NO_MASK: (), MASK_FIRST: (0,), MASK_LAST: (0,)}[mask]

        def high_words(high: int) -> list[int]:
            word = HIGH << 28 | high & 0xFFFFFFF
            return [*beside, word] if mask == MASK_FIRST else [word, *beside]

        words = Words(
            np.uint32, LOW_BITS, HIGH_BITS,
            lambda events, edges, *parts: write_evt2_parts(events, edges, mask, *parts), high_words,
        )  # fmt: skip
        super().__init__(words, standalone=standalone, origin_us=origin_us, repeat_us=repeat_us)


class Evt2Decoder:
    """Decoder of words in pieces. Words before the first time are skipped, as their time is unknown."""

    def __init__(self, form: Form) -> None:
        self._mask = _MASKS[form]
        self._high = np.array([-1], np.int64)
        self._rest = b""
        self.decode(b"")  # compiles the kernels now, not while words wait

    def decode(self, data: bytes) -> tuple[Events, Edges]:
        """Return (n,) EVENT and (m,) EDGE of any next bytes, even part of a word; at most an event for two bits."""
        data = self._rest + data
        unit = 4 if self._mask == NO_MASK else 8
        complete_bytes = len(data) - len(data) % unit
        self._rest = data[complete_bytes:]
        words = np.frombuffer(data[:complete_bytes], "<u4")
        n_events, n_edges = count_evt2(words, self._mask, bool(self._high[0] >= 0))
        events, edges = empty_events(n_events), empty_edges(n_edges)
        read_evt2(words, self._mask, self._high, events.view(np.uint8), edges.view(np.uint8))
        return events, edges

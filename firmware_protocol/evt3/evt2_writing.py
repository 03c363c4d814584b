"""EVT2 and EVT2.1 words of events, compiled: one pass over the records, and nothing is allocated."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import EdgeKind
from firmware_protocol.evt3 import evt2_words
from firmware_protocol.evt3.compiled import entry, kernel
from firmware_protocol.evt3.pending import (
    AT_EDGE,
    AT_EVENT,
    HIGH_TOLD,
    LAST,
    MUST_OPEN,
    OUTSIDE,
    edge_is_next,
    fault_of,
    is_left,
    next_time,
    window,
)
from firmware_protocol.evt3.records import EDGE_BYTES, EVENT_BYTES, short_at
from firmware_protocol.evt3.words import LIMIT_PX, WINDOW_PX, next_high

__all__ = ["MASK_FIRST", "MASK_LAST", "NO_MASK", "write_evt2"]

_Bytes = npt.NDArray[np.uint8]
_Words = npt.NDArray[np.uint32]
_State = npt.NDArray[np.int64]

NO_MASK, MASK_FIRST, MASK_LAST = range(3)
"""What goes with a word: nothing (EVT2), or a bit for each of 32 columns, before it (EVT2.1) or after it (legacy)."""

_ON, _HIGH, _TRIGGER = evt2_words.ON << 28, evt2_words.HIGH << 28, evt2_words.TRIGGER << 28
_LOW_BITS, _HIGH_BITS = evt2_words.LOW_BITS, evt2_words.HIGH_BITS
_LIMIT_PX, _WINDOW_PX = LIMIT_PX, WINDOW_PX
_RISING, _PULSE = int(EdgeKind.RISING), int(EdgeKind.PULSE)
_MOST_WORDS = 6  # of one turn of the loop

_next_high = kernel(next_high)


@entry
def write_evt2(events: _Bytes, edges: _Bytes, mask: int, state: _State, out: _Words) -> int:
    """Write words until all events and edges are told or `out` is full.

    As `write_words`, but for `mask`: NO_MASK, MASK_FIRST or MASK_LAST.
    """
    told = 0
    while told <= len(out) - _MOST_WORDS and is_left(events, edges, state):
        is_edge = edge_is_next(events, edges, state)
        t = next_time(events, edges, is_edge, state)
        fault = fault_of(t, state)
        if fault:
            return fault
        high = t >> _LOW_BITS
        if high != state[HIGH_TOLD] or state[MUST_OPEN]:
            if high != state[HIGH_TOLD]:
                state[HIGH_TOLD] = _next_high(state[HIGH_TOLD], high, _HIGH_BITS)
            told = _put(out, told, mask, _HIGH | state[HIGH_TOLD] & 0xFFFFFFF, 0)
            state[MUST_OPEN] = high != state[HIGH_TOLD]
            continue
        state[LAST] = t
        low = (t & 0x3F) << 22
        told = _put_edge(edges, mask, low, state, out, told) if is_edge else _put_event(
            events, mask, low, state, out, told
        )  # fmt: skip
        if told < 0:
            return OUTSIDE
    return told


@kernel
def _put(out: _Words, told: int, mask: int, word: int, columns: int) -> int:
    """Write a word and its columns; returns the place of the next word."""
    if mask == NO_MASK:
        out[np.uint64(told)] = word
        return told + 1
    out[np.uint64(told)] = columns if mask == MASK_FIRST else word
    out[np.uint64(told + 1)] = word if mask == MASK_FIRST else columns
    return told + 2


@kernel
def _put_edge(edges: _Bytes, mask: int, low: int, state: _State, out: _Words, told: int) -> int:
    """Write an edge, or both edges of a pulse."""
    at = state[AT_EDGE] * EDGE_BYTES
    kind, word = edges[np.uint64(at + 8)], _TRIGGER | low | int(edges[np.uint64(at + 9)] & 0x1F) << 8
    state[AT_EDGE] += 1
    told = _put(out, told, mask, word | (kind in (_RISING, _PULSE)), 0)
    return _put(out, told, mask, word, 0) if kind == _PULSE else told


@kernel
def _put_event(events: _Bytes, mask: int, low: int, state: _State, out: _Words, told: int) -> int:
    """Write the next event, or all that one mask holds; returns a negative number for one outside."""
    at = state[AT_EVENT] * EVENT_BYTES
    x, y, on = short_at(events, at + 8), short_at(events, at + 10), events[np.uint64(at + 12)] != 0
    if (x | y) >= _LIMIT_PX:
        return OUTSIDE
    bits, count, column = 0, 1, x
    if mask != NO_MASK:
        column = x - x % _WINDOW_PX
        bits, count = window(events, at, column)
    state[AT_EVENT] += count
    return _put(out, told, mask, (_ON if on else 0) | low | column << 11 | y, bits)

"""Words of events, compiled: one pass over the records, and nothing is allocated.

What makes it fast: the low part of the time, the row and the column are always stored, and the place of the next word
moves on only if they were needed. Where events are scattered, a branch for each would be guessed wrong about once an
event, which costs more than all the rest. Whether a vector may begin is seen from one record: the fourth after this.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import EdgeKind
from firmware_protocol.evt3 import words
from firmware_protocol.evt3.compiled import entry, kernel
from firmware_protocol.evt3.pending import (
    AT_EDGE,
    AT_EVENT,
    HIGH_TOLD,
    LAST,
    MUST_OPEN,
    OUTSIDE,
    ROW_TOLD,
    TIME_TOLD,
    edge_is_next,
    fault_of,
    is_left,
    next_time,
    same_group,
    window,
)
from firmware_protocol.evt3.records import EDGE_BYTES, EVENT_BYTES, short_at

__all__ = ["write_words"]

_Bytes = npt.NDArray[np.uint8]
_Words = npt.NDArray[np.uint16]
_State = npt.NDArray[np.int64]

_HIGH, _LOW, _ROW, _SINGLE, _BASE, _TRIGGER = (
    kind << 12 for kind in (words.HIGH, words.LOW, words.ROW, words.SINGLE, words.BASE, words.TRIGGER)
)
_VECTOR_12, _VECTOR_8 = words.VECTOR_12 << 12, words.VECTOR_8 << 12
_BITS, _LIMIT_PX, _WINDOW_PX = words.HIGH_BITS, words.LIMIT_PX, words.WINDOW_PX
_RISING, _PULSE = int(EdgeKind.RISING), int(EdgeKind.PULSE)
_FEWEST = 5  # events of a vector: it takes four words
_MOST_WORDS = 8  # of one turn of the loop

_next_high = kernel(words.next_high)


@entry
def write_words(events: _Bytes, edges: _Bytes, width: int, state: _State, out: _Words) -> int:
    """Write words until all events and edges are told or `out` is full.

    Parameters
    ----------
    events, edges
        (13 n,) and (12 m,) bytes of EVENT and EDGE records.
    width
        Columns of the sensor.
    state
        (8,) as `pending` draws it; where it stands when this returns.
    out
        (k,) room, k at least 8.

    Returns
    -------
    int
        How many words; negative: BACKWARDS, TOO_LATE or OUTSIDE, and `state` is of no use.
    """
    told = 0
    while told <= len(out) - _MOST_WORDS and is_left(events, edges, state):
        is_edge = edge_is_next(events, edges, state)
        t = next_time(events, edges, is_edge, state)
        fault = fault_of(t, state)
        if fault:
            return fault
        high = t >> _BITS
        if high != state[HIGH_TOLD] or state[MUST_OPEN]:
            told = _put_high(high, state, out, told)
            if high != state[HIGH_TOLD]:
                continue
        state[LAST] = t
        out[np.uint64(told)] = _LOW | t & 0xFFF
        told += t != state[TIME_TOLD]
        state[TIME_TOLD] = t
        told = _put_edge(edges, state, out, told) if is_edge else _put_events(events, width, state, out, told)
        if told < 0:
            return OUTSIDE
    return told


@kernel
def _put_high(high: int, state: _State, out: _Words, told: int) -> int:
    """Write one high part on the way to `high`, or `high` itself; returns the place of the next word."""
    if high != state[HIGH_TOLD]:
        state[HIGH_TOLD] = _next_high(state[HIGH_TOLD], high, _BITS)
    out[np.uint64(told)] = _HIGH | state[HIGH_TOLD] & 0xFFF
    state[MUST_OPEN] = state[MUST_OPEN] and high != state[HIGH_TOLD]
    return told + 1


@kernel
def _put_edge(edges: _Bytes, state: _State, out: _Words, told: int) -> int:
    """Write an edge, or both edges of a pulse."""
    at = state[AT_EDGE] * EDGE_BYTES
    kind, word = edges[np.uint64(at + 8)], _TRIGGER | int(edges[np.uint64(at + 9)] & 0xF) << 8
    state[AT_EDGE] += 1
    out[np.uint64(told)] = word | (kind in (_RISING, _PULSE))
    out[np.uint64(told + 1)] = word
    return told + (2 if kind == _PULSE else 1)


@kernel
def _put_events(events: _Bytes, width: int, state: _State, out: _Words, told: int) -> int:
    """Write the next event, or as many as one vector holds; returns a negative number for one outside."""
    at = state[AT_EVENT] * EVENT_BYTES
    x, y, on = short_at(events, at + 8), short_at(events, at + 10), events[np.uint64(at + 12)] != 0
    if (x | y) >= _LIMIT_PX:
        return OUTSIDE
    out[np.uint64(told)] = _ROW | y
    told += y != state[ROW_TOLD]
    state[ROW_TOLD] = y
    base = x - x % _WINDOW_PX
    if base + _WINDOW_PX <= width and same_group(events, at, at + (_FEWEST - 1) * EVENT_BYTES, base):
        bits, count = window(events, at, base)
        if count >= _FEWEST:
            state[AT_EVENT] += count
            return _put_vector(base, on, bits, out, told)
    out[np.uint64(told)] = _SINGLE | on << 11 | x
    state[AT_EVENT] += 1
    return told + 1


@kernel
def _put_vector(base: int, on: bool, bits: int, out: _Words, told: int) -> int:
    out[np.uint64(told)] = _BASE | on << 11 | base
    out[np.uint64(told + 1)] = _VECTOR_12 | bits & 0xFFF
    out[np.uint64(told + 2)] = _VECTOR_12 | bits >> 12 & 0xFFF
    out[np.uint64(told + 3)] = _VECTOR_8 | bits >> 24
    return told + 4

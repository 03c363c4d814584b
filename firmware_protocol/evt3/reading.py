"""Events of words, compiled: one pass counts them, the next writes the records into room of just that size.

What makes it fast: counting is a sum without branches, so it costs little beside a buffer that grows; the second pass
keeps all that words told in registers.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import EdgeKind
from firmware_protocol.evt3 import words as kinds
from firmware_protocol.evt3.compiled import entry, kernel
from firmware_protocol.evt3.records import EDGE_BYTES, EVENT_BYTES, put_short, put_time

__all__ = ["HIGH_READ", "count_words", "full_high", "new_state", "put_edge", "put_event", "read_words"]

_Bytes = npt.NDArray[np.uint8]
_Words = npt.NDArray[np.uint16]
_State = npt.NDArray[np.int64]

# What a state holds: full high part (-1: none yet), low part, row, column and polarity of the next vector.
HIGH_READ, _LOW_READ, _ROW_READ, _COLUMN, _POLARITY = range(5)

# Plain numbers are what compiled code holds.
_ROW, _SINGLE, _BASE, _LOW, _HIGH, _TRIGGER = (
    kinds.ROW, kinds.SINGLE, kinds.BASE, kinds.LOW, kinds.HIGH, kinds.TRIGGER,
)  # fmt: skip
_VECTOR_12, _VECTOR_8 = kinds.VECTOR_12, kinds.VECTOR_8
_RISING, _FALLING = int(EdgeKind.RISING), int(EdgeKind.FALLING)
_BITS = kinds.HIGH_BITS


def new_state() -> _State:
    """Return the state before the first word."""
    return np.array([-1, 0, 0, 0, 0], np.int64)


@entry
def count_words(words: _Words) -> tuple[int, int]:
    """Return how many events and edges (n,) words hold."""
    events, edges = 0, 0
    for word in words:
        kind = word >> 12
        # The column bits of a vector, none of other words; then their number.
        bits = np.int64(word & (0xFFF if kind == _VECTOR_12 else 0xFF if kind == _VECTOR_8 else 0))
        bits -= bits >> 1 & 0x555
        bits = (bits & 0x333) + (bits >> 2 & 0x333)
        events += (bits & 0xF) + (bits >> 4 & 0xF) + (bits >> 8) + (kind == _SINGLE)
        edges += kind == _TRIGGER
    return events, edges


@entry
def read_words(words: _Words, state: _State, events: _Bytes, edges: _Bytes) -> None:
    """Write the records of all (n,) words; `events` and `edges` are what `count_words` tells. The state goes on."""
    high, low, row = state[HIGH_READ], state[_LOW_READ], state[_ROW_READ]
    column, on, at, at_edge = state[_COLUMN], state[_POLARITY], 0, 0
    for word in words:
        kind, value = word >> 12, int(word & 0xFFF)
        if kind == _SINGLE:
            at = put_event(events, at, high << 12 | low, value & 0x7FF, row, value >> 11)
        elif kind == _ROW:
            row = value & 0x7FF
        elif kind == _LOW:
            low = value
        elif kind == _HIGH:
            high, low = full_high(high, value, _BITS), 0  # a new high part begins at low part 0
        elif kind == _BASE:
            column, on = value & 0x7FF, value >> 11
        elif kind in (_VECTOR_12, _VECTOR_8):
            length = 12 if kind == _VECTOR_12 else 8
            at = _put_columns(events, at, high << 12 | low, value & (1 << length) - 1, (column, row, on))
            column = column + length & 0xFFFF
        elif kind == _TRIGGER:
            at_edge = put_edge(edges, at_edge, high << 12 | low, value >> 8, value & 1)
    state[HIGH_READ], state[_LOW_READ], state[_ROW_READ] = high, low, row
    state[_COLUMN], state[_POLARITY] = column, on


@kernel
def full_high(high: int, part: int, bits: int) -> int:
    """Return the full high part that follows `high` (-1: none) and ends with the `bits` bits of `part`."""
    if high < 0:
        return part
    wrap = 1 << bits
    wraps = (high & wrap - 1) - part > wrap // 2
    return (high & ~(wrap - 1)) + wrap * wraps + part


@kernel
def put_event(events: _Bytes, at: int, t: int, x: int, y: int, on: int) -> int:
    """Write an EVENT record; returns the place of the next one."""
    put_time(events, at, t)
    put_short(events, at + 8, x)
    put_short(events, at + 10, y)
    events[np.uint64(at + 12)] = on
    return at + EVENT_BYTES


@kernel
def _put_columns(events: _Bytes, at: int, t: int, bits: int, place: tuple[int, int, int]) -> int:
    """Write an event for each bit; `place` is the column of the first, the row, the polarity."""
    column, row, on = place
    while bits:
        if bits & 1:
            at = put_event(events, at, t, column, row, on)
        bits >>= 1
        column += 1
    return at


@kernel
def put_edge(edges: _Bytes, at: int, t: int, channel: int, is_rising: int) -> int:
    """Write an EDGE record; returns the place of the next one."""
    put_time(edges, at, t)
    edges[np.uint64(at + 8)] = _RISING if is_rising else _FALLING
    edges[np.uint64(at + 9)] = channel
    put_short(edges, at + 10, 0)
    return at + EDGE_BYTES

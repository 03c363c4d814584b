"""Events and edges that wait to be coded, as compiled loops see them: which one is next, and which go together."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.evt3.compiled import kernel
from firmware_protocol.evt3.records import EDGE_BYTES, EVENT_BYTES, short_at, time_at
from firmware_protocol.evt3.words import WINDOW_PX

__all__ = [
    "AT_EDGE", "AT_EVENT", "BACKWARDS", "HIGH_TOLD", "LAST", "LONGEST_GAP_US", "MUST_OPEN", "ORIGIN", "OUTSIDE",
    "ROW_TOLD", "TIME_TOLD", "TOO_LATE", "edge_is_next", "fault_of", "is_left", "new_state", "next_time", "same_group",
    "window",
]  # fmt: skip

_Bytes = npt.NDArray[np.uint8]
_State = npt.NDArray[np.int64]

# What a state holds: full high part, full time and row that words told (-1: none), the newest time given, the next
# event and edge of this call, whether a high part must be written although it is known, and which time of the records
# is zero in the words. All other times are those of the words.
HIGH_TOLD, TIME_TOLD, ROW_TOLD, LAST, AT_EVENT, AT_EDGE, MUST_OPEN, ORIGIN = range(8)
BACKWARDS, TOO_LATE, OUTSIDE = -1, -2, -3
LONGEST_GAP_US = 1 << 37  # 38 hours: 41 000 words

_WINDOW_PX = WINDOW_PX


def new_state(origin_us: int = 0) -> _State:
    """Return the state before the first word; records of the time `origin_us` have time zero."""
    return np.array([-1, -1, -1, -1, 0, 0, 0, origin_us], np.int64)


@kernel
def is_left(events: _Bytes, edges: _Bytes, state: _State) -> bool:
    """Whether any is left."""
    return bool(state[AT_EVENT] * EVENT_BYTES < len(events) or state[AT_EDGE] * EDGE_BYTES < len(edges))


@kernel
def next_time(events: _Bytes, edges: _Bytes, is_edge: bool, state: _State) -> int:
    """Return the time of the next edge or of the next event."""
    if is_edge:
        return int(time_at(edges, state[AT_EDGE] * EDGE_BYTES) - state[ORIGIN])
    return int(time_at(events, state[AT_EVENT] * EVENT_BYTES) - state[ORIGIN])


@kernel
def fault_of(t: int, state: _State) -> int:
    """Return BACKWARDS or TOO_LATE where time `t` cannot follow, else 0."""
    if t < state[LAST]:
        return BACKWARDS
    return TOO_LATE if t - state[LAST] > LONGEST_GAP_US else 0


@kernel
def edge_is_next(events: _Bytes, edges: _Bytes, state: _State) -> bool:
    """Whether an edge comes next: those of an event's time come before it."""
    at = state[AT_EDGE] * EDGE_BYTES
    if at >= len(edges):
        return False
    at_event = state[AT_EVENT] * EVENT_BYTES
    return at_event >= len(events) or time_at(edges, at) <= time_at(events, at_event)


@kernel
def same_group(events: _Bytes, at: int, other: int, base: int) -> bool:
    """Whether a record lies at `other`, with time, row and polarity of that at `at`, in the window from `base`."""
    if other >= len(events):
        return False
    x, on = short_at(events, other + 8), (events[np.uint64(at + 12)] != 0) == (events[np.uint64(other + 12)] != 0)
    same_row = short_at(events, other + 10) == short_at(events, at + 10)
    return time_at(events, other) == time_at(events, at) and same_row and on and base <= x < base + _WINDOW_PX


@kernel
def window(events: _Bytes, at: int, base: int) -> tuple[int, int]:
    """Return the columns of the window from `base`, a bit each, that the records from `at` on fill; and how many."""
    bits, count, last, other = 0, 0, -1, at
    while same_group(events, at, other, base) and short_at(events, other + 8) > last:
        last = short_at(events, other + 8)
        bits |= 1 << (last - base)
        count += 1
        other += EVENT_BYTES
    return bits, count

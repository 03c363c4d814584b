"""The next events of bursts that are due in later windows, in a list for each of the windows to come.

In the dark a burst waits half a second for its next event, and hundreds of thousands are under way in a large array. A
step must find its own without looking at the others, so that the cost of noise follows its events:

    soon    a list for each slot of the present window, (WINDOW_SLOTS, 3, room); a step looks at those of its own slots
    ring    a list for each of the next RING windows, (RING, 3, room)
    far     a list of what comes after them, (3, room)

A window that opens has its list spread over its slots. Once in RING windows the far events are spread over the ring.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.slots import SLOT_NS
from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.numerics.compiled import NONE, kernel

__all__ = [
    "BURST",
    "KEY",
    "RING",
    "STATE_SIZE",
    "WHEN",
    "WINDOW_SLOTS",
    "State",
    "put",
    "put_ahead",
    "slot_of",
    "spread",
    "take_window",
]

WINDOW_SLOTS = 16
"""Slots of a window. Fewer: more calls; more: more memory."""

RING = 32
"""Windows that have a list of their own, half a second; a power of 2."""

WHEN, KEY, BURST = range(3)

_WINDOW_NS = WINDOW_SLOTS * SLOT_NS
_Int64s = npt.NDArray[np.int64]
_Ahead = tuple[_Int64s, _Int64s, _Int64s]


class State(IntEnum):
    """Entries of `state`; the last two are the first of WINDOW_SLOTS and of RING numbers of events in lists.

    Step and window's end, candidates used and drawn, two constants, lack of room, the list of the window that opens
    next, events in `far`, in the lists of `soon` and in those of the ring.
    """

    T0_NS = 0
    T1_NS = 1
    WINDOW_NS = 2
    FIRST = 3
    COUNT = 4
    REFRACTORY_NS = 5
    PIXEL_BITS = 6
    FULL = 7
    TURN = 8
    FAR = 9
    SOON = 10
    RING = 10 + WINDOW_SLOTS


STATE_SIZE = State.RING + RING

_WINDOW, _TURN = int(State.WINDOW_NS), int(State.TURN)
_FAR, _SOON, _RING = int(State.FAR), int(State.SOON), int(State.RING)


@kernel
def put(events: _Int64s, n: int, event: tuple[int, int, int]) -> int:
    """Write an event to place n of a list, (3, room); return the next place."""
    events[WHEN, n], events[KEY, n], events[BURST, n] = event
    return n + 1


@kernel
def _windows_ahead(t_ns: int, state: _Int64s) -> Any:
    """Return how many windows lie between the present one and that of an event due after it."""
    return np.int64(np.uint64(t_ns - state[_WINDOW]) // np.uint64(_WINDOW_NS))


@kernel
def slot_of(t_ns: int, state: _Int64s) -> Any:
    """Return the number of the slot of a time within the present window."""
    return np.int64(np.uint64(t_ns - (state[_WINDOW] - _WINDOW_NS)) // np.uint64(SLOT_NS))


@kernel
def put_ahead(ahead: _Ahead, event: tuple[int, int, int], state: _Int64s) -> None:
    """Add an event that is due later in the present window or after it; `ahead` are soon, ring and far."""
    soon, ring, far = ahead
    if event[WHEN] < state[_WINDOW]:
        slot = slot_of(event[WHEN], state)
        state[_SOON + slot] = put(soon[slot], state[_SOON + slot], event)
        return
    windows = _windows_ahead(event[WHEN], state)
    if windows >= RING:
        state[_FAR] = put(far, state[_FAR], event)
        return
    place = (state[_TURN] + windows) & (RING - 1)
    state[_RING + place] = put(ring[place], state[_RING + place], event)


@cached_entry
def spread(ring: _Int64s, far: _Int64s, state: _Int64s) -> bool:
    """Move far events to the ring, where their windows are among the next RING; call it before each RING-th window.

    Returns False if a list had no room for all of its events. They are still far: call again with more room.
    """
    remaining, fits = NONE, True
    for k in range(state[_FAR]):
        event = far[WHEN, k], far[KEY, k], far[BURST, k]
        windows = _windows_ahead(event[WHEN], state)
        place = (state[_TURN] + windows) & (RING - 1)
        if windows < RING and state[_RING + place] < ring.shape[2]:
            state[_RING + place] = put(ring[place], state[_RING + place], event)
            continue
        fits &= windows >= RING
        remaining = put(far, remaining, event)
    state[_FAR] = remaining
    return fits


@cached_entry
def take_window(soon: _Int64s, ring: _Int64s, state: _Int64s) -> None:
    """Move the events of the window that opens to `soon`, which is empty, and let the present window end with it."""
    turn = state[_TURN]
    state[_WINDOW] += _WINDOW_NS
    for k in range(state[_RING + turn]):
        slot = slot_of(ring[turn, WHEN, k], state)
        event = ring[turn, WHEN, k], ring[turn, KEY, k], ring[turn, BURST, k]
        state[_SOON + slot] = put(soon[slot], state[_SOON + slot], event)
    state[_RING + turn] = 0
    state[_TURN] = (turn + 1) & (RING - 1)

"""Compiled loops of `points`: draw a window of candidates, thin them by the light, merge them with crossings.

The candidates of a window of some slots are drawn once, whatever the steps that cross it, and are sorted by time. A
step then uses the candidates of its own time only, and the next events of bursts that are due. These are in lists by
slot and by window, so that no step searches all of them. In the dark a burst waits half a second for its next event,
and hundreds of thousands are pending in a large array; with the lists the cost of noise follows its events:

    soon    a list for each slot of the present window, (WINDOW_SLOTS, 3, room); a step reads those of its own slots
    ring    a list for each of the next RING windows, (RING, 3, room)
    far     a list of later events, (3, room)

When a window opens its list is distributed over its slots. Once in RING windows the far events are distributed over the
ring.

Numbers of one kind share an array, because each array argument costs 0.05 us a call, and each named tuple twice that
(named tuples and arrays made for the result, as elsewhere in this folder, cost 4 us):

    candidates   (3, room) int64: WHEN, KEY (pixel << 1 | on), BURST (random bits for the events that follow)
    chances      (2, room) float32: ROW of the table of rates, by the pixel's thresholds, and LOG: the candidate fires
                 if this is less than ln of the rate in the light of its step
    table        (thresholds + 2, nodes) float32: ln of the primaries' rate in Hz over (threshold, ln f); below, over
                 ln f, the probability that another event follows, and the mean wait for it in ns
    lights       (6,) float32: dark current, corner frequency at the reference, least, most, nodes a fold, last place
    soon, ring   (WINDOW_SLOTS, 3, room) and (RING, 3, room) int64: WHEN, KEY, BURST
    far          (3, room) int64, the same
    state        (STATE_SIZE,) int64, see `State`
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.sources import SLOT_NS
from emulator.sensor.numerics.compiled import NONE, cached_entry, kernel, vector_kernel
from emulator.sensor.numerics.elementary import natural_log
from emulator.sensor.numerics.keyed import high, low, stream, unit, word

__all__ = [
    "BURST",
    "KEY",
    "RING",
    "STATE_SIZE",
    "WHEN",
    "WINDOW_SLOTS",
    "State",
    "draw_window",
    "fire",
    "insert",
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

_T0, _T1, _WINDOW, _FIRST, _COUNT, _REFRACTORY, _PIXEL_BITS, _FULL = (int(place) for place in list(State)[:8])
_TURN, _FAR, _SOON, _RING = int(State.TURN), int(State.FAR), int(State.SOON), int(State.RING)


@kernel
def put(events: _Int64s, n: int, event: tuple[int, int, int]) -> int:
    """Write an event to place n of a list, (3, room); return the next place."""
    events[WHEN, n], events[KEY, n], events[BURST, n] = event
    return n + 1


@kernel
def _windows_ahead(t_ns: int, state: _Int64s) -> Any:
    """Return the number of windows between the present one and that of an event due after it."""
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


_BATCH = 256
_SECONDS = 1 << 40  # first index of the numbers that bursts are drawn from
_ONE, _S32 = np.uint64(1), np.uint64(32)
_LARGEST = np.finfo(np.float32).max
_ZERO, _UNITY, _HALF, _NAN = (np.float32(x) for x in (0, 1, 0.5, np.nan))
_ROW, _LOG = range(2)
_AGAIN, _WAIT = -2, -1  # rows of the table

_Float32s = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]

_Words = npt.NDArray[np.uint64]
_Events = tuple[_Int64s, npt.NDArray[np.uint32], npt.NDArray[np.bool_]]


@vector_kernel
def _logs(base: np.uint64, index: int, n: int, out: _Float32s) -> None:
    """Write ln of the uniform numbers of every third word from `index` on."""
    for k in range(n):
        out[k] = natural_log(np.float32(unit(high(word(base, index + 3 * k)))))


@kernel
def _words(base: np.uint64, index: int, n: int, out: _Words) -> None:
    for k in range(n):
        out[k] = word(base, index + 3 * k)


@kernel
def _times(log_gap: _Float32s, n: int, t: float, mean_gap: float, out: _Floats) -> tuple[int, float]:
    """Write the times of the next candidates as shares of the slot; return the number within it, and the last time."""
    for k in range(n):
        t -= mean_gap * np.float64(log_gap[k])
        out[k] = t
        if t >= 1:
            return k, t
    return n, t


@kernel
def _choose_pixels(bits: _Words, n: int, alias: _Words, out: _Words) -> None:
    """Write the pixel of each word: one drawn evenly, or the one that its entry [share of its own | other] names."""
    pixels = np.uint64(alias.size)
    for k in range(n):
        pixel = (high(bits[k]) * pixels) >> _S32
        entry = alias[pixel]
        out[k] = pixel if low(bits[k]) < high(entry) else low(entry)


@cached_entry
def draw_window(
    slots: tuple[int, int, np.uint64, float, float],
    alias: _Words,
    row: _Float32s,
    log_highest: _Float32s,
    candidates: _Int64s,
    chances: _Float32s,
) -> int:
    """Draw the candidates of some slots; return their number, or -1 if the buffer is too short for them.

    `slots` are the first, their number, the root of their streams, the mean gap between candidates as a share of a slot
    and the share of ON events; `alias` and `row` are (pixels,), `log_highest` ln W by row of the table.
    """
    begin, number, root, mean_gap, on_share = slots
    n, chunk = 0, min(_BATCH, max(8, int(1.2 / mean_gap)))
    log_gap, t = np.empty(chunk, np.float32), np.empty(chunk)
    drawn = np.empty((4, chunk), np.uint64)
    sign, bits, pixel, burst = drawn[0], drawn[1], drawn[2], drawn[3]
    for slot in range(begin, begin + number):
        base, first, last = stream(root, slot), 0, 0.0
        while last < 1:
            if n + chunk > candidates.shape[1]:
                return -1
            _logs(base, 3 * first, chunk, log_gap)
            some, last = _times(log_gap, chunk, last, mean_gap, t)
            _words(base, 3 * first, some, sign)
            _words(base, 3 * first + 1, some, bits)
            _words(base, 3 * first + _SECONDS, some, burst)
            _choose_pixels(bits, some, alias, pixel)
            _logs(base, 3 * first + 2, some, log_gap)
            for k in range(some):
                candidates[WHEN, n + k] = slot * SLOT_NS + np.int64(t[k] * SLOT_NS)
                candidates[KEY, n + k] = np.int64(pixel[k] << _ONE | np.uint64(unit(low(sign[k])) < on_share))
                candidates[BURST, n + k] = np.int64(burst[k])
                place = row[pixel[k]]
                i = np.uint64(np.int64(place))
                y = place - np.float32(i)
                chances[_ROW, n + k] = place
                chances[_LOG, n + k] = log_gap[k] + (log_highest[i] * (_UNITY - y) + log_highest[i + _ONE] * y)
            first, n = first + some, n + some
    return n


@vector_kernel
def _find_nodes(node: _Float32s, n: int, lights: _Float32s) -> None:
    """Replace the light of n candidates by its position among the nodes; NaN where the light is not finite."""
    dark, at_reference, lowest = lights[0], lights[1], lights[2]
    highest, a_fold, last = lights[3], lights[4], lights[5]
    for k in range(n):
        light = node[k]
        lit = light if light > _ZERO else _ZERO
        hz = min(max(at_reference * (lit + dark), lowest), highest)
        place = min(natural_log(hz / lowest) * a_fold, last)
        node[k] = max(place, _ZERO) if abs(light) <= _LARGEST else _NAN


@kernel
def _find_rates(row: _Float32s, node: _Float32s, n: int, table: _Float32s, out: _Float32s) -> None:
    """Write ln of each candidate's rate, by bilinear interpolation; NaN where the light is unreadable."""
    for k in range(n):
        place = node[k] if node[k] == node[k] else _ZERO
        i, j = np.uint64(np.int64(row[k])), np.uint64(np.int64(place))
        y, x = row[k] - np.float32(i), node[k] - np.float32(j)
        upper = table[i, j] * (_UNITY - x) + table[i, j + _ONE] * x
        lower = table[i + _ONE, j] * (_UNITY - x) + table[i + _ONE, j + _ONE] * x
        out[k] = upper * (_UNITY - y) + lower * y


@kernel
def _choose(log_chance: _Float32s, log_rate: _Float32s, n: int, chosen: _Int64s) -> int:
    """List those of n candidates that fire, return their number."""
    found = 0
    for k in range(n):
        chosen[found] = k
        found += log_chance[k] < log_rate[k]
    return found


@kernel
def _wait_ns(burst: np.uint64, node: np.float32, table: _Float32s, refractory_ns: int) -> int:
    """Return the time to the next event of a burst, ns; -1 if there is none."""
    nearest = np.int64(node + _HALF)
    if unit(low(burst)) >= table[_AGAIN, nearest]:
        return -1
    return refractory_ns - int(np.float64(natural_log(np.float32(unit(high(burst))))) * table[_WAIT, nearest])


@kernel
def _pack(t_ns: int, key: int, ends: tuple[int, int, int], keys: _Words, n: int) -> int:
    """Write an event of the step, packed as [time since t0 | pixel | on], to place n; return the next place."""
    t0_ns, t1_ns, bits = ends
    keys[n] = np.uint64(t_ns - t0_ns) << np.uint64(bits + 1) | np.uint64(key)
    return n + ((t0_ns <= t_ns) & (t_ns < t1_ns))


@kernel
def _follow(
    event: tuple[int, int, int], node: np.float32, table: _Float32s, keys: _Words, state: _Int64s, n: int
) -> tuple[tuple[int, int, int], int]:
    """Pack an event of the step and those of its burst that follow in it; return the next one, at -1 if none, and n.

    Where `keys` is full, the event that finds no room is the next one.
    """
    t_ns, key, burst = event
    ends = state[_T0], state[_T1], state[_PIXEL_BITS]
    while t_ns < ends[1]:
        if n + 1 >= keys.size:
            state[_FULL] = 1
            break
        n = _pack(t_ns, key, ends, keys, n)
        wait_ns = _wait_ns(np.uint64(burst), node, table, state[_REFRACTORY])
        if wait_ns < 0:
            return (NONE - 1, key, burst), n
        t_ns, key, burst = t_ns + wait_ns, key ^ 1, NONE + np.int64(word(np.uint64(burst), NONE))
    return (t_ns, key, burst), n


@kernel
def _due(
    light: _Float32s,
    node: _Float32s,
    rates: tuple[_Float32s, _Float32s],
    ahead: tuple[_Int64s, _Int64s, _Int64s],
    keys: _Words,
    state: _Int64s,
) -> int:
    """Pack the next events of bursts that the step reaches, and compact the rest; return the number that were packed.

    Only the lists of the step's slots are looked at. `node` is a buffer for the places of _BATCH lights.
    """
    (table, lights), found = rates, NONE
    for slot in range(slot_of(state[_T0], state), slot_of(state[_T1] - 1, state) + 1):
        events, n, remaining = ahead[0][slot], state[_SOON + slot], NONE
        for k in range(n):
            if k % _BATCH == 0:
                some = min(_BATCH, n - k)
                _look(light, events, k, some, node)
                _find_nodes(node, some, lights)
            event = events[WHEN, k], events[KEY, k], events[BURST, k]
            if event[0] < state[_T1]:
                place = node[k % _BATCH]
                event, found = _follow(event, place if place == place else _ZERO, table, keys, state, found)
            if event[0] < 0:
                continue
            if event[0] < state[_WINDOW] and slot_of(event[0], state) == slot:
                remaining = put(events, remaining, event)
            else:
                put_ahead(ahead, event, state)
        state[_SOON + slot] = remaining
    return int(found)


@kernel
def _look(light: _Float32s, events: _Int64s, first: int, n: int, out: _Float32s) -> None:
    """Write the light of n events of a list, from `first` on."""
    for k in range(n):
        out[k] = light[np.uint64(events[KEY, first + k]) >> _ONE]


@kernel
def _take(light: _Float32s, candidates: _Int64s, span: tuple[int, int, int], out: _Float32s) -> int:
    """Write the light of a step's next candidates, `span` being the first, the end and t1; return their number."""
    first, end, t1_ns = span
    n = 0
    while n < _BATCH and first + n < end and candidates[WHEN, first + n] < t1_ns:
        out[n] = light[np.uint64(candidates[KEY, first + n]) >> _ONE]
        n += 1
    return n


@cached_entry
def fire(
    light: _Float32s,
    drawn: tuple[_Int64s, _Float32s],
    rates: tuple[_Float32s, _Float32s],
    ahead: tuple[_Int64s, _Int64s, _Int64s],
    keys: _Words,
    state: _Int64s,
) -> int:
    """Pack the events of a step, unsorted, into `keys`; return their number, and update `state`.

    With FULL set in `state`, `keys` had no room for all: call again for the same step and further room. `drawn` are
    candidates and chances, `rates` table and lights, `ahead` soon, ring and far.
    """
    (candidates, chances), (table, lights) = drawn, rates
    t1_ns, first = state[_T1], state[_FIRST]
    state[_FULL] = 0
    node, rate = np.empty(_BATCH, np.float32), np.empty(_BATCH, np.float32)
    found = _due(light, node, rates, ahead, keys, state)
    chosen = np.empty(_BATCH + 1, np.int64)
    n = _take(light, candidates, (first, state[_COUNT], t1_ns), node)
    while n > 0:
        _find_nodes(node, n, lights)
        _find_rates(chances[_ROW, first:], node, n, table, rate)
        for one in range(_choose(chances[_LOG, first:], rate, n, chosen)):
            k = first + chosen[one]
            event = candidates[WHEN, k], candidates[KEY, k], candidates[BURST, k]
            event, found = _follow(event, node[chosen[one]], table, keys, state, found)
            if event[0] >= 0:
                put_ahead(ahead, event, state)
        first += n
        n = _take(light, candidates, (first, state[_COUNT], t1_ns), node)
    state[_FIRST] = first
    return int(found)


@cached_entry
def insert(keys: _Words, t0_ns: int, pixel_bits: int, crossings: _Events, out: _Events) -> None:
    """Write sorted keys and crossings to `out`, sorted by (time, pixel); of equals, crossings come first."""
    (at_ns, at, on), (out_ns, out_at, out_on) = crossings, out
    shift, mask = np.uint64(pixel_bits + 1), (_ONE << np.uint64(pixel_bits)) - _ONE
    k = n = 0
    for key in keys:
        t_ns, pixel = t0_ns + np.int64(key >> shift), (key >> _ONE) & mask
        while k < at_ns.size and (at_ns[k] < t_ns or (at_ns[k] == t_ns and np.uint64(at[k]) <= pixel)):
            out_ns[n], out_at[n], out_on[n] = at_ns[k], at[k], on[k]
            k, n = k + 1, n + 1
        out_ns[n], out_at[n], out_on[n] = t_ns, pixel, key & _ONE != 0
        n += 1
    while k < at_ns.size:
        out_ns[n], out_at[n], out_on[n] = at_ns[k], at[k], on[k]
        k, n = k + 1, n + 1

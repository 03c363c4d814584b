"""Bytes to blocks and their events, compiled. docs/packets.md describes the format and the reasons of a refusal.

The bytes may have any values. A reader accesses at most some bytes beyond the payload's end, where `read_events` has
put zeros, checks after each step that it has not passed the end, and writes no more events than the header announced.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import kernel
from firmware_protocol.events import EVENT, EdgeKind, Edges, Events, empty_edges, empty_events, make_edges
from firmware_protocol.telemetry.layout import (
    EDGE_RECORD,
    ESCAPE_ONES,
    HEADER_BYTES,
    LONGEST_US,
    MAX_K,
    BlockError,
    Form,
    Header,
    Mode,
    Polarity,
    entry,
    form_of,
)

_Bytes = npt.NDArray[np.uint8]
_Int64s = npt.NDArray[np.int64]

# Enumerations as plain numbers, as compiled code holds them.
_FLAT, _ROWS = int(Mode.FLAT), int(Mode.ROWS)
_EACH, _ALL_ON = int(Polarity.EACH), int(Polarity.ALL_ON)
_ONES = ESCAPE_ONES
_BEYOND = 32  # zeros after the payload: more than an event and the window on it take

_GOOD, _SHORT, _LONG, _OUTSIDE, _BACK, _TOO_LATE, _PARAMETER, _SPAN = range(8)
_REASONS = (
    "",
    "the payload ends before the last event",
    "the payload goes on after the last event",
    "an event lies outside the array",
    "time or place goes back",
    "it spans more than 35 minutes",
    "a Rice parameter is above its limit",
    "a span passes the end of the array or of the block",
)

# State of the reader: bit in the payload, ticks and address of the last event, number of events read.
_AT, _TICKS, _ADDRESS, _READ = range(4)


class _Facts(NamedTuple):
    """Data of the header: mode, events, polarity, time of the start in us; and the bits of the payload."""

    mode: int
    events: int
    polarity: int
    start_us: int
    bits: int


def read_events(data: bytes, header: Header, start_us: int) -> Events:
    """Return the (n,) EVENT of a block that is not of edges and starts at `start_us`; raises BlockError."""
    size = len(data) - HEADER_BYTES
    if 8 * size < header.count and header.mode != Mode.BITMAP:
        raise BlockError(f"{header.count} events do not fit {size} bytes")
    payload = np.zeros(size + _BEYOND, np.uint8)
    payload[:size] = np.frombuffer(data, np.uint8, offset=HEADER_BYTES)
    events = empty_events(header.count)
    facts = _Facts(int(header.mode), header.count, int(header.polarity), start_us, 8 * size)
    fault = read_block(payload, form_of(header.size, header.tick_us), facts, events.view(np.uint8))
    if fault:
        raise BlockError(_REASONS[fault])
    return events


@entry
def read_block(data: _Bytes, form: Form, facts: _Facts, out: _Bytes) -> int:
    """Fill `out`, (13 n,) bytes of EVENT; return a fault code for `data`, or 0."""
    state = np.zeros(4, np.int64)
    if facts.mode == _FLAT:
        fault = _read_flat(data, form, facts, state, out)
    elif facts.mode == _ROWS:
        fault = _read_rows(data, form, facts, state, out)
    else:
        fault = _read_bitmap(data, form, facts, state, out)
    if fault:
        return fault
    left = facts.bits - state[_AT]
    if left < 0:
        return _SHORT
    return _LONG if left > 7 or _take(data, state, left) else _GOOD


@kernel
def _window(data: _Bytes, at: int) -> int:
    """Return the 49 or more bits from bit `at` on, the first of them as bit 55."""
    byte = at >> 3
    bits = np.int64(data[byte])
    for i in range(1, 7):
        bits = bits << 8 | data[byte + i]
    return int(bits << (at & 7) & (1 << 56) - 1)


@kernel
def _take(data: _Bytes, state: _Int64s, width: int) -> int:
    """Read a number of `width` bits, at most 32."""
    value = _window(data, state[_AT]) >> 56 - width
    state[_AT] += width
    return int(value)


@kernel
def _rice(data: _Bytes, state: _Int64s, k: int) -> int:
    """Read a Rice code; if an escape follows, return -1 and stop after the ones."""
    window, ones = _window(data, state[_AT]), 0
    while ones < _ONES and window >> 55 - ones & 1:
        ones += 1
    if ones == _ONES:
        state[_AT] += _ONES
        return -1
    state[_AT] += ones + 1 + k
    return ones << k | window >> 55 - ones - k & (1 << k) - 1


@kernel
def _place(data: _Bytes, form: Form, state: _Int64s) -> int:
    """Read row and column; returns the address, or -1 if they lie outside the array."""
    y, x = _take(data, state, form.by), _take(data, state, form.bx)
    return y * form.width + x if x < form.width and y < form.height else -1


@kernel
def _step(data: _Bytes, form: Form, state: _Int64s, k: int) -> int:
    """Advance to the next event."""
    step, pixels = _rice(data, state, k), form.width * form.height
    if step >= 0:
        state[_ADDRESS] += step
        if state[_ADDRESS] >= pixels:
            state[_TICKS] += state[_ADDRESS] // pixels
            state[_ADDRESS] %= pixels
    else:
        ticks, address = _take(data, state, 31), _place(data, form, state)
        if address < 0:
            return _OUTSIDE
        if ticks == 0 and address < state[_ADDRESS]:
            return _BACK
        state[_TICKS] += ticks
        state[_ADDRESS] = address
    return _TOO_LATE if state[_TICKS] * form.tick_us > LONGEST_US else _GOOD


@kernel
def _emit(out: _Bytes, form: Form, facts: _Facts, state: _Int64s, on: int) -> None:
    """Write the event at the reader's position."""
    time = facts.start_us + state[_TICKS] * form.tick_us
    y = state[_ADDRESS] // form.width
    x = state[_ADDRESS] - y * form.width
    record = out[13 * state[_READ] : 13 * state[_READ] + 13]
    for i in range(8):
        record[i] = time >> 8 * i & 255
    record[8], record[9] = x & 255, x >> 8
    record[10], record[11] = y & 255, y >> 8
    record[12] = on
    state[_READ] += 1


@kernel
def _polarity(data: _Bytes, facts: _Facts, state: _Int64s) -> int:
    """Return the polarity of an event, read from the payload if each event has its own."""
    if facts.polarity == _EACH:
        return _take(data, state, 1)
    return 1 if facts.polarity == _ALL_ON else 0


@kernel
def _read_flat(data: _Bytes, form: Form, facts: _Facts, state: _Int64s, out: _Bytes) -> int:
    for i in range(facts.events):
        ticks, address = _take(data, state, 31 - form.by - form.bx), _place(data, form, state)
        on = _take(data, state, 1)
        if state[_AT] > facts.bits:
            return _SHORT
        if address < 0:
            return _OUTSIDE
        if (i == 0 and ticks) or ticks < state[_TICKS] or (ticks == state[_TICKS] and address < state[_ADDRESS]):
            return _BACK
        state[_TICKS], state[_ADDRESS] = ticks, address
        _emit(out, form, facts, state, on)
    return _GOOD


@kernel
def _read_rows(data: _Bytes, form: Form, facts: _Facts, state: _Int64s, out: _Bytes) -> int:
    k, state[_ADDRESS] = _take(data, state, 8), _place(data, form, state)
    if k > MAX_K:
        return _PARAMETER
    if state[_ADDRESS] < 0:
        return _OUTSIDE
    _emit(out, form, facts, state, _polarity(data, facts, state))
    for _ in range(1, facts.events):
        fault = _step(data, form, state, k)
        on = _polarity(data, facts, state)
        if state[_AT] > facts.bits:
            return _SHORT
        if fault:
            return fault
        _emit(out, form, facts, state, on)
    return _GOOD


@kernel
def _read_bitmap(data: _Bytes, form: Form, facts: _Facts, state: _Int64s, out: _Bytes) -> int:
    k, k_length = _take(data, state, 8), _take(data, state, 8)
    state[_ADDRESS] = _place(data, form, state)
    if k > MAX_K or k_length > MAX_K:
        return _PARAMETER
    if state[_ADDRESS] < 0:
        return _OUTSIDE
    fault = _read_span(data, form, facts, state, k_length, out)
    while fault == _GOOD and state[_READ] < facts.events:
        fault = _step(data, form, state, k)
        if fault == _GOOD:
            fault = _read_span(data, form, facts, state, k_length, out)
    return _SHORT if state[_AT] > facts.bits else fault


@kernel
def _read_span(data: _Bytes, form: Form, facts: _Facts, state: _Int64s, k: int, out: _Bytes) -> int:
    """Read the span at the reader's position, from its length on."""
    last = _rice(data, state, k)
    if last < 0 or state[_ADDRESS] + last >= form.width * form.height:
        return _SPAN
    solid = last < 2 or _take(data, state, 1)
    same = facts.polarity != _EACH or (last > 0 and _take(data, state, 1))
    on = _polarity(data, facts, state) if same else 0
    for i in range(last + 1):
        if i in (0, last) or solid or _take(data, state, 1):
            if state[_READ] == facts.events:
                return _SPAN
            if not same:
                on = _take(data, state, 1)
            _emit(out, form, facts, state, on)
        if state[_AT] > facts.bits:
            return _SHORT
        if i < last:
            state[_ADDRESS] += 1
    return _GOOD


@dataclass(frozen=True)
class Block:
    """A decoded block: `events` (n,) EVENT or `edges` (n,) EDGE, the other one empty, with full times in us."""

    header: Header
    events: Events
    edges: Edges


def decode_block(data: bytes, near_us: int = 0) -> Block:
    """Decode one block; raises BlockError for a malformed one, of which nothing may be used.

    Parameters
    ----------
    data : the block, exactly.
    near_us : a time within 35 minutes of the block's; its upper bits complete the block's 32.
    """
    header = Header.parse(data)
    start_us = _nearest(header.t_base, near_us)
    if header.mode == Mode.EDGE:
        return Block(header, empty_events(), _edges(data, header, start_us))
    return Block(header, read_events(data, header, start_us), empty_edges())


def as_received(events: Events, tick_us: int) -> Events:
    """Return a block of `events` as a receiver decodes it: times rounded down to the tick, raster order in each tick.

    A sender that applies this to waiting events, before it makes blocks of them, gets smaller blocks if a tick has more
    events than a block; the events and their times are the same.

    Parameters
    ----------
    events : (n,) EVENT, sorted by time, spanning less than 2**32 ticks.
    tick_us : the unit of time.
    """
    if not len(events):
        return events
    ticks = events["t"] // np.uint64(tick_us)
    since = ticks - ticks[0]
    if since[-1] >> np.uint64(32):
        raise ValueError(f"events that span {since[-1]} ticks of {tick_us} us: put shorter streams in order one by one")
    key = since << np.uint64(32) | events["y"].astype(np.uint64) << np.uint64(16) | events["x"]
    order = np.argsort(key, kind="stable")
    received = events.view(f"V{EVENT.itemsize}")[order].view(EVENT)
    received["t"] = ticks[order] * np.uint64(tick_us)
    return received


def _nearest(low_us: int, near_us: int) -> int:
    """Return the time that ends in the 32 bits `low_us` and is nearest to `near_us`, and not negative."""
    half = 1 << 31
    time_us = near_us - half + (low_us - near_us + half) % (1 << 32)
    return time_us if time_us >= 0 else time_us + (1 << 32)


def _edges(data: bytes, header: Header, start_us: int) -> Edges:
    size = len(data) - HEADER_BYTES
    if size != header.count * EDGE_RECORD.itemsize:
        raise BlockError(f"{header.count} edges are announced, but {size} bytes are there")
    records = np.frombuffer(data, EDGE_RECORD, offset=HEADER_BYTES)
    since_us = records["t"].astype(np.int64)
    if since_us[0] or since_us[-1] > LONGEST_US or (np.diff(since_us) < 0).any():
        raise BlockError("edges do not start with the block, go back in time, or span more than 35 minutes")
    if not np.isin(records["kind"], list(EdgeKind)).all():
        raise BlockError("an edge is of a kind that does not exist")
    return make_edges(start_us + since_us, records["kind"], records["channel"], records["seq"])

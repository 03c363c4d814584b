"""Events to blocks, compiled: number of events in a block, its smallest coding, and its payload.

docs/packets.md describes the format. The number of events that fit is estimated from the mean step, since a Rice
code's length depends on little else, then tried and corrected; mostly one trial is enough. The smallest coding is found
from the number of bits that each mode takes, with its best parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from firmware_protocol.compiled import kernel
from firmware_protocol.events import Bytes, EdgeKind, Edges, Events, Int64s, bytes_of
from firmware_protocol.telemetry.layout import (
    BACKWARDS,
    EDGE_RECORD,
    ESCAPE_ONES,
    HEADER_BYTES,
    LONGEST_US,
    MAX_COUNT,
    MAX_K,
    MAX_SIDE,
    OUTSIDE,
    TICKS_US,
    Form,
    Header,
    Mode,
    Polarity,
    Scratch,
    entry,
    form_of,
    load,
    new_scratch,
    sort,
)

# Enumerations as plain numbers, as compiled code holds them.
_FLAT, _ROWS, _BITMAP = int(Mode.FLAT), int(Mode.ROWS), int(Mode.BITMAP)
_EACH, _ALL_OFF, _ALL_ON = int(Polarity.EACH), int(Polarity.ALL_OFF), int(Polarity.ALL_ON)
_ONES = ESCAPE_ONES
_NEVER = 1 << 40  # bits of a coding that is impossible
_JOINED_STEP = 8  # nearer events share a span, unless only runs without gaps are allowed


class Plan(NamedTuple):
    """Coding of `count` events, and its number of bits."""

    mode: int
    polarity: int
    k: int
    k_length: int
    joined: int
    bits: int


@kernel
def flat_count(ticks: Int64s, count: int, form: Form) -> int:
    """Return the number of the first of `count` events that are within the time of a FLAT word."""
    longest = 1 << 31 - form.bx - form.by
    while ticks[count - 1] >= longest:
        count -= 1
    return count


@kernel
def planned(count: int, form: Form, only: int, room: Scratch) -> Plan:
    """Sort the first `count` events and find their smallest coding."""
    sort(count, form, room)
    for i in range(1, count):
        room.steps[i] = (room.keys[i] >> 1) - (room.keys[i - 1] >> 1)
    ons = 0
    for i in range(count):
        ons += room.keys[i] & 1
    polarity = _ALL_OFF if ons == 0 else _ALL_ON if ons == count else _EACH
    best = Plan(_FLAT, _EACH, 0, 0, 0, _NEVER)
    if only in (-1, _FLAT) and room.ticks[count - 1] < 1 << 31 - form.bx - form.by:
        best = Plan(_FLAT, _EACH, 0, 0, 0, 32 * count)
    if only in (-1, _ROWS):
        plan = _rows(count, form, polarity, room)
        best = plan if plan.bits < best.bits else best
    if only in (-1, _BITMAP):
        plan = _bitmaps(count, form, polarity, room, only == _BITMAP)
        best = plan if plan.bits < best.bits else best
    return best


@kernel
def _rows(count: int, form: Form, polarity: int, room: Scratch) -> Plan:
    escape = 31 + form.by + form.bx
    k, bits = _best_k(room.steps, 1, count, 0, escape)
    bits += 8 + form.by + form.bx + (count if polarity == _EACH else 0)
    return Plan(_ROWS, polarity, k, 0, 0, bits)


@kernel
def _best_k(values: Int64s, begin: int, end: int, least: int, escape: int) -> tuple[int, int]:
    """Return a Rice parameter, at least `least`, that suits `values`, and the bits that they take."""
    if begin >= end:
        return least, 0
    total = np.int64(0)
    for i in range(begin, end):
        total += values[i]
    mean = total // (end - begin)
    k = least
    while k < MAX_K and mean >> k > 1:
        k += 1
    bits = _rice_bits(values, begin, end, k, escape)
    while k > least:
        fewer = _rice_bits(values, begin, end, k - 1, escape)
        if fewer > bits:
            break
        k, bits = k - 1, fewer
    return k, bits


@kernel
def _rice_bits(values: Int64s, begin: int, end: int, k: int, escape: int) -> int:
    bits = 0
    for i in range(begin, end):
        q = values[i] >> k
        bits += q + 1 + k if q < _ONES else _ONES + escape
    return bits


@kernel
def _bitmaps(count: int, form: Form, polarity: int, room: Scratch, forced: bool) -> Plan:
    """Try spans that have gaps, and, if many events have none between them, spans without.

    An event that joins a span saves the MAX_K + 1 bits of its step at most, and its polarity; every other one costs a
    bit for a length. So a block with few neighbours needs no trial.
    """
    neighbours, touching = 0, 0
    for i in range(1, count):
        if room.ticks[i] == room.ticks[i - 1] and 1 <= room.steps[i] <= _JOINED_STEP:
            neighbours += 1
            touching += 1 if room.steps[i] == 1 else 0
    if neighbours * (MAX_K + 3) <= count and not forced:
        return Plan(_BITMAP, polarity, 0, 0, 0, _NEVER)
    best = _bitmap(count, form, polarity, _JOINED_STEP, room)
    if 2 * touching > neighbours:
        plan = _bitmap(count, form, polarity, 1, room)
        best = plan if plan.bits < best.bits else best
    return best


@kernel
def _bitmap(count: int, form: Form, polarity: int, joined: int, room: Scratch) -> Plan:
    spans = find_spans(count, form, joined, room)
    longest, bits = np.int64(0), 16 + form.by + form.bx
    for span in range(spans):
        longest = max(longest, room.lengths[span])
        begin, end = room.starts[span], room.starts[span + 1]
        bits += _span_bits(begin, end, room.lengths[span] + 1, polarity, room.keys)
    least = 0
    while longest >> least >= _ONES:
        least += 1
    k_length, length_bits = _best_k(room.lengths, 0, spans, least, _NEVER)
    k, step_bits = _best_k(room.span_steps, 1, spans, 0, 31 + form.by + form.bx)
    return Plan(_BITMAP, polarity, k, k_length, joined, bits + length_bits + step_bits)


@kernel
def find_spans(count: int, form: Form, joined: int, room: Scratch) -> int:
    """Group events of a tick that are at most `joined` pixels from the next into spans; return their number."""
    spans, begin = 0, 0
    for i in range(1, count + 1):
        if i < count and 1 <= room.steps[i] <= joined and room.ticks[i] == room.ticks[i - 1]:
            continue
        room.starts[spans] = begin
        room.span_steps[spans] = room.steps[begin]
        room.lengths[spans] = (room.keys[i - 1] >> 1) - (room.keys[begin] >> 1)
        spans, begin = spans + 1, i
    room.starts[spans] = count
    return spans


@kernel
def same_polarity(begin: int, end: int, keys: Int64s) -> bool:
    """Return true if the events from `begin` to before `end` are all ON or all OFF."""
    ons = 0
    for i in range(begin, end):
        ons += keys[i] & 1
    return ons == 0 or ons == end - begin


@kernel
def _span_bits(begin: int, end: int, length: int, polarity: int, keys: Int64s) -> int:
    """Return the bits of a span after its length."""
    bits = 0
    if length >= 3:
        bits += 1 if end - begin == length else length - 1
    if polarity == _EACH:
        if length == 1:
            bits += 1
        else:
            bits += 2 if same_polarity(begin, end, keys) else 1 + end - begin
    return bits


_NEARLY = 15 / 16  # a block filled so far is full


class Limits(NamedTuple):
    """Limits of a block: the only mode allowed, or -1; number of events; number of bytes."""

    mode: int
    events: int
    size: int


@entry
def write_block(events: Bytes, form: Form, limits: Limits, room: Scratch, out: Bytes) -> tuple[int, int, int, int]:
    """Write the payload of one block of the head of `events` into `out`.

    Parameters
    ----------
    events : (13 n,) bytes of EVENT records, n at least 1.
    form, limits, room : the sensor; the limits of the block; (max_events,) scratch.
    out : (size,) at least as many bytes as `limits` allows.

    Returns
    -------
    taken, mode, polarity, size
        Number of events, the header's fields, and the payload's bytes; `taken` negative: see OUTSIDE and BACKWARDS.
    """
    loaded = load(events, form, limits.events, room)
    if loaded < 0:
        return loaded, 0, 0, 0
    if limits.mode == _FLAT:
        loaded = flat_count(room.ticks, loaded, form)
    count, plan = _fitted(loaded, form, limits, room)
    return count, plan.mode, plan.polarity, _written(count, form, plan, room, out)


@kernel
def _fitted(available: int, form: Form, limits: Limits, room: Scratch) -> tuple[int, Plan]:
    """Return the number of `available` events that about fill the block, and their coding.

    One event always fits. Between a number that fits and one that does not: three interpolations, then bisection.
    """
    budget = 8 * (limits.size - HEADER_BYTES)
    fits, too_many = 0, available + 1
    trials = 0
    count = _guess(room, available, budget, form)
    while True:
        plan = planned(count, form, limits.mode, room)
        if plan.bits > budget:
            too_many = count
        else:
            fits = count
            if fits == too_many - 1 or plan.bits > _NEARLY * budget:
                return count, plan
        trials += 1
        trial = int(count * 0.99 * budget / plan.bits) if trials <= 3 else (fits + too_many) // 2
        count = min(max(trial, fits + 1), too_many - 1)


@kernel
def _guess(room: Scratch, available: int, budget: int, form: Form) -> int:
    """Return the approximate number of events that fill `budget` bits, from the mean step between them."""
    count = available
    for _ in range(4):
        step = max(1.0, (room.arrival[count - 1] - room.arrival[0]) / (2.0 * count))
        estimate = int((budget - 32) / (math.log2(step) + 2.55))
        if estimate >= count:
            return count
        count = max(estimate, 1)
    return count


@kernel
def _written(count: int, form: Form, plan: Plan, room: Scratch, out: Bytes) -> int:
    """Write the payload; return the number of its bytes."""
    room.bits[0] = room.bits[1] = room.bits[2] = 0
    if plan.mode == _FLAT:
        _write_flat(count, form, room, out)
    elif plan.mode == _ROWS:
        _write_rows(count, form, plan, room, out)
    else:
        _write_bitmap(count, form, plan, room, out)
    _put(room.bits, out, 0, -room.bits[1] % 8)
    while room.bits[1]:
        room.bits[1] -= 8
        out[room.bits[2]] = room.bits[0] >> room.bits[1] & 255
        room.bits[2] += 1
    return int(room.bits[2])


@kernel
def _put(bits: Int64s, out: Bytes, value: int, width: int) -> None:
    """Write the `width` low bits of `value`, at most 31; the rest of `value` must be 0."""
    held, count = bits[0] << width | value, bits[1] + width
    at = bits[2]
    if count >= 32:
        count -= 32
        word = held >> count
        out[at] = word >> 24 & 255
        out[at + 1] = word >> 16 & 255
        out[at + 2] = word >> 8 & 255
        out[at + 3] = word & 255
        held &= (1 << count) - 1
        at += 4
    bits[0] = held
    bits[1] = count
    bits[2] = at


@kernel
def _put_place(i: int, form: Form, room: Scratch, out: Bytes) -> None:
    address = (room.keys[i] >> 1) - room.ticks[i] * (form.width * form.height)
    _put(room.bits, out, address // form.width << form.bx | address % form.width, form.by + form.bx)


@kernel
def _put_step(i: int, step: int, k: int, form: Form, room: Scratch, out: Bytes) -> None:
    """Write the step that leads to event i."""
    q = step >> k
    if q < _ONES:
        _put(room.bits, out, (1 << q + 1) - 2, q + 1)
        _put(room.bits, out, step & (1 << k) - 1, k)
        return
    _put(room.bits, out, (1 << _ONES) - 1, _ONES)
    _put(room.bits, out, room.ticks[i] - room.ticks[i - 1], 31)
    _put_place(i, form, room, out)


@kernel
def _write_flat(count: int, form: Form, room: Scratch, out: Bytes) -> None:
    for i in range(count):
        _put(room.bits, out, room.ticks[i], 31 - form.by - form.bx)
        _put_place(i, form, room, out)
        _put(room.bits, out, room.keys[i] & 1, 1)


@kernel
def _write_rows(count: int, form: Form, plan: Plan, room: Scratch, out: Bytes) -> None:
    polarity_bits = 1 if plan.polarity == _EACH else 0
    _put(room.bits, out, plan.k, 8)
    _put_place(0, form, room, out)
    _put(room.bits, out, room.keys[0] & polarity_bits, polarity_bits)
    for i in range(1, count):
        _put_step(i, room.steps[i], plan.k, form, room, out)
        _put(room.bits, out, room.keys[i] & polarity_bits, polarity_bits)


@kernel
def _write_bitmap(count: int, form: Form, plan: Plan, room: Scratch, out: Bytes) -> None:
    spans = find_spans(count, form, plan.joined, room)
    _put(room.bits, out, plan.k << 8 | plan.k_length, 16)
    for span in range(spans):
        begin, end = room.starts[span], room.starts[span + 1]
        length = room.lengths[span]
        if span == 0:
            _put_place(begin, form, room, out)
        else:
            _put_step(begin, room.span_steps[span], plan.k, form, room, out)
        _put(room.bits, out, (1 << (length >> plan.k_length) + 1) - 2, (length >> plan.k_length) + 1)
        _put(room.bits, out, length & (1 << plan.k_length) - 1, plan.k_length)
        _write_span(begin, end, plan.polarity, room, out)


@kernel
def _write_span(begin: int, end: int, polarity: int, room: Scratch, out: Bytes) -> None:
    """Write the part of a span after its length."""
    bits, keys = room.bits, room.keys
    length = (keys[end - 1] >> 1) - (keys[begin] >> 1) + 1
    solid = end - begin == length
    if length >= 3:
        _put(bits, out, 1 if solid else 0, 1)
    has_polarity = polarity == _EACH
    if has_polarity and length >= 2:
        same = same_polarity(begin, end, keys)
        _put(bits, out, 2 | keys[begin] & 1 if same else 0, 2 if same else 1)
        has_polarity = not same
    for i in range(begin, end):
        if i > begin and not solid:
            zeros = room.steps[i] - 1
            _put(bits, out, 0, zeros)
            if i < end - 1:
                _put(bits, out, 1, 1)
        if has_polarity:
            _put(bits, out, keys[i] & 1, 1)


_LEAST_BYTES = 32
_MOST_BYTES = 65535
_MODES = {"smallest": -1, "flat": _FLAT, "rows": _ROWS, "bitmap": _BITMAP}
_COMPLAINTS = {
    OUTSIDE: "an event lies outside the sensor of {size[0]} x {size[1]} pixels",
    BACKWARDS: "events go back in time: a block needs them sorted",
}


@dataclass(frozen=True)
class BlockSettings:
    """Settings of blocks: the unit of time, the coding, and the largest size."""

    tick_us: int = 1
    mode: Literal["smallest", "flat", "rows", "bitmap"] = "smallest"
    max_events: int = 2048
    max_bytes: int = 1024

    def __post_init__(self) -> None:
        if self.tick_us not in TICKS_US:
            raise ValueError(f"tick_us = {self.tick_us}: a block counts ticks of 1, 10, 100 or 1000 us")
        if self.mode not in ("smallest", "flat", "rows", "bitmap"):
            raise ValueError(f'mode = "{self.mode}": choose "smallest", "flat", "rows" or "bitmap"')
        if not 1 <= self.max_events <= MAX_COUNT:
            raise ValueError(f"max_events = {self.max_events}: a block holds 1 to {MAX_COUNT} events")
        if not _LEAST_BYTES <= self.max_bytes <= _MOST_BYTES:
            raise ValueError(f"max_bytes = {self.max_bytes}: a block may have {_LEAST_BYTES} to {_MOST_BYTES} bytes")


class BlockEncoder:
    """Makes blocks of a sensor of `size` = (width, height). It has no state between blocks."""

    def __init__(self, size: tuple[int, int], settings: BlockSettings | None = None) -> None:
        if not all(1 <= side <= MAX_SIDE for side in size):
            raise ValueError(f"size = {size}: blocks carry sensors of 1 to {MAX_SIDE} pixels a side")
        self.size = size
        self.settings = settings or BlockSettings()
        self._form = form_of(size, self.settings.tick_us)
        self._limits = Limits(_MODES[self.settings.mode], self.settings.max_events, self.settings.max_bytes)
        self._room = new_scratch(self.settings.max_events)
        self._out = np.zeros(self.settings.max_bytes, np.uint8)

    @property
    def max_edges(self) -> int:
        """Most edges in a block of the set size."""
        return (self.settings.max_bytes - HEADER_BYTES) // 8

    def encode(self, events: Events, dropped: int = 0) -> tuple[bytes, int]:
        """Return the bytes of a block of the first events, and their number; without events it reports `dropped` alone.

        Raises ValueError if the first events go back in time or lie outside the sensor.

        Parameters
        ----------
        events : (n,) EVENT, sorted by time, in device time.
        dropped : events dropped since the previous block; a number above 65535 is reported as 65535.
        """
        if not len(events):
            return self._header(Mode.FLAT, Polarity.EACH, 0, 0, dropped), 0
        first_us = int(events["t"][0])
        head = bytes_of(events[: self.settings.max_events])
        taken, mode, polarity, size = write_block(head, self._form, self._limits, self._room, self._out)
        if taken < 0:
            raise ValueError(_COMPLAINTS[taken].format(size=self.size))
        start_us = first_us - first_us % self.settings.tick_us
        header = self._header(Mode(mode), Polarity(polarity), taken, start_us, dropped)
        return header + self._out[:size].tobytes(), taken

    def encode_edges(self, edges: Edges, dropped: int = 0) -> bytes:
        """Make one block of all `edges`, (n,) EDGE sorted by time; raises ValueError if they do not fit one."""
        if not 1 <= len(edges) <= self.max_edges:
            raise ValueError(
                f"{len(edges)} edges: a block of {self.settings.max_bytes} bytes holds 1 to {self.max_edges}"
            )
        times = edges["t"].astype(np.int64)
        since_us = times - times[0]
        if (np.diff(times) < 0).any() or since_us[-1] > LONGEST_US or not np.isin(edges["kind"], list(EdgeKind)).all():
            raise ValueError("edges go back in time, span more than 35 minutes, or are of unknown kind")
        records = np.empty(len(edges), EDGE_RECORD)
        records["t"] = since_us
        for name in ("kind", "channel", "seq"):
            records[name] = edges[name]
        return self._header(Mode.EDGE, Polarity.EACH, len(edges), int(times[0]), dropped) + records.tobytes()

    def _header(self, mode: Mode, polarity: Polarity, count: int, start_us: int, dropped: int) -> bytes:
        tick_us = 1 if mode == Mode.EDGE else self.settings.tick_us
        low = start_us & 0xFFFFFFFF
        return Header(mode, tick_us, polarity, count, low, min(dropped, MAX_COUNT), self.size).pack()

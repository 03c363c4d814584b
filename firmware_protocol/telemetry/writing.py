"""Blocks as bits, compiled: how many events fill a block, and their payload. The format: docs/telemetry.md.

How many events fit is guessed from the mean step, since a Rice code's length depends on little else, then tried and
corrected: mostly once is enough.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.telemetry.coding import Plan, find_spans, flat_count, planned, same_polarity
from firmware_protocol.telemetry.compiled import entry, kernel
from firmware_protocol.telemetry.layout import ESCAPE_ONES, HEADER_BYTES, Mode, Polarity
from firmware_protocol.telemetry.ordering import Form, Scratch, load

__all__ = ["Limits", "write_block"]

_Bytes = npt.NDArray[np.uint8]
_Int64s = npt.NDArray[np.int64]

_FLAT, _ROWS, _EACH = int(Mode.FLAT), int(Mode.ROWS), int(Polarity.EACH)
_ONES = ESCAPE_ONES
_NEARLY = 15 / 16  # a block filled so far is full


class Limits(NamedTuple):
    """What a block may be: the only mode allowed, or -1; how many events; how many bytes."""

    mode: int
    events: int
    size: int


@entry
def write_block(events: _Bytes, form: Form, limits: Limits, room: Scratch, out: _Bytes) -> tuple[int, int, int, int]:
    """Write the payload of one block of the head of `events` into `out`.

    Parameters
    ----------
    events
        (13 n,) bytes of EVENT records, n at least 1.
    form, limits, room
        The sensor; what the block may be; (max_events,) scratch.
    out
        (size,) at least what `limits` allows.

    Returns
    -------
    taken, mode, polarity, size
        How many events, the header's fields, and the payload's bytes; `taken` negative: see OUTSIDE and BACKWARDS.
    """
    most = load(events, form, limits.events, room)
    if most < 0:
        return most, 0, 0, 0
    if limits.mode == _FLAT:
        most = flat_count(room.ticks, most, form)
    count, plan = _fitted(most, form, limits, room)
    return count, plan.mode, plan.polarity, _written(count, form, plan, room, out)


@kernel
def _fitted(most: int, form: Form, limits: Limits, room: Scratch) -> tuple[int, Plan]:
    """Return how many of `most` events to take so that the block is about full, and how to write them.

    One event always fits. Between a number that does and one that does not, three trials in proportion, then halving.
    """
    budget = 8 * (limits.size - HEADER_BYTES)
    fits, too_many, trials = 0, most + 1, 0
    count = _guess(room, most, budget, form)
    while True:
        plan = planned(count, form, limits.mode, room)
        if plan.bits > budget:
            too_many = count
        else:
            fits = count
            if fits == too_many - 1 or plan.bits > _NEARLY * budget:
                return count, plan
        trials += 1
        wanted = int(count * 0.99 * budget / plan.bits) if trials <= 3 else (fits + too_many) // 2
        count = min(max(wanted, fits + 1), too_many - 1)


@kernel
def _guess(room: Scratch, most: int, budget: int, form: Form) -> int:
    """Return about how many events fill `budget` bits, if the steps between them are what they are on average."""
    count = most
    for _ in range(4):
        step = max(1.0, (room.given[count - 1] - room.given[0]) / (2.0 * count))
        wanted = int((budget - 32) / (math.log2(step) + 2.55))
        if wanted >= count:
            return count
        count = max(wanted, 1)
    return count


@kernel
def _written(count: int, form: Form, plan: Plan, room: Scratch, out: _Bytes) -> int:
    """Write the payload; returns its bytes."""
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
def _put(bits: _Int64s, out: _Bytes, value: int, width: int) -> None:
    """Write the `width` low bits of `value`, at most 31; the rest of `value` must be 0."""
    held, count, at = bits[0] << width | value, bits[1] + width, bits[2]
    if count >= 32:
        count -= 32
        word = held >> count
        out[at] = word >> 24 & 255
        out[at + 1] = word >> 16 & 255
        out[at + 2] = word >> 8 & 255
        out[at + 3] = word & 255
        held &= (1 << count) - 1
        at += 4
    bits[0], bits[1], bits[2] = held, count, at


@kernel
def _put_place(i: int, form: Form, room: Scratch, out: _Bytes) -> None:
    address = (room.keys[i] >> 1) - room.ticks[i] * (form.width * form.height)
    _put(room.bits, out, address // form.width << form.bx | address % form.width, form.by + form.bx)


@kernel
def _put_step(i: int, step: int, k: int, form: Form, room: Scratch, out: _Bytes) -> None:
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
def _write_flat(count: int, form: Form, room: Scratch, out: _Bytes) -> None:
    for i in range(count):
        _put(room.bits, out, room.ticks[i], 31 - form.by - form.bx)
        _put_place(i, form, room, out)
        _put(room.bits, out, room.keys[i] & 1, 1)


@kernel
def _write_rows(count: int, form: Form, plan: Plan, room: Scratch, out: _Bytes) -> None:
    polarity_bits = 1 if plan.polarity == _EACH else 0
    _put(room.bits, out, plan.k, 8)
    _put_place(0, form, room, out)
    _put(room.bits, out, room.keys[0] & polarity_bits, polarity_bits)
    for i in range(1, count):
        _put_step(i, room.steps[i], plan.k, form, room, out)
        _put(room.bits, out, room.keys[i] & polarity_bits, polarity_bits)


@kernel
def _write_bitmap(count: int, form: Form, plan: Plan, room: Scratch, out: _Bytes) -> None:
    spans = find_spans(count, form, plan.joined, room)
    _put(room.bits, out, plan.k << 8 | plan.k_length, 16)
    for span in range(spans):
        begin, end, length = room.starts[span], room.starts[span + 1], room.lengths[span]
        if span == 0:
            _put_place(begin, form, room, out)
        else:
            _put_step(begin, room.span_steps[span], plan.k, form, room, out)
        _put(room.bits, out, (1 << (length >> plan.k_length) + 1) - 2, (length >> plan.k_length) + 1)
        _put(room.bits, out, length & (1 << plan.k_length) - 1, plan.k_length)
        _write_span(begin, end, plan.polarity, room, out)


@kernel
def _write_span(begin: int, end: int, polarity: int, room: Scratch, out: _Bytes) -> None:
    """Write what follows a span's length."""
    bits, keys = room.bits, room.keys
    length = (keys[end - 1] >> 1) - (keys[begin] >> 1) + 1
    solid = end - begin == length
    if length >= 3:
        _put(bits, out, 1 if solid else 0, 1)
    each = polarity == _EACH
    if each and length >= 2:
        same = same_polarity(begin, end, keys)
        _put(bits, out, 2 | keys[begin] & 1 if same else 0, 2 if same else 1)
        each = not same
    for i in range(begin, end):
        if i > begin and not solid:
            zeros = room.steps[i] - 1
            _put(bits, out, 0, zeros)
            if i < end - 1:
                _put(bits, out, 1, 1)
        if each:
            _put(bits, out, keys[i] & 1, 1)

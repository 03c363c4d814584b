"""The smallest coding of a block, compiled: how many bits each mode takes, and with which parameters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.telemetry.compiled import kernel
from firmware_protocol.telemetry.layout import ESCAPE_ONES, MAX_K, Mode, Polarity
from firmware_protocol.telemetry.ordering import Form, Scratch, sort

__all__ = ["Plan", "find_spans", "flat_count", "planned", "same_polarity"]

_Int64s = npt.NDArray[np.int64]

# Enumerations as plain numbers, which is what compiled code holds.
_FLAT, _ROWS, _BITMAP = int(Mode.FLAT), int(Mode.ROWS), int(Mode.BITMAP)
_EACH, _ALL_OFF, _ALL_ON = int(Polarity.EACH), int(Polarity.ALL_OFF), int(Polarity.ALL_ON)
_ONES = ESCAPE_ONES
_NEVER = 1 << 40  # bits of what cannot be written
_JOINED_STEP = 8  # nearer events share a span, unless only runs without gaps are wanted


class Plan(NamedTuple):
    """How to write `count` events, and how many bits it takes."""

    mode: int
    polarity: int
    k: int
    k_length: int
    joined: int
    bits: int


@kernel
def flat_count(ticks: _Int64s, count: int, form: Form) -> int:
    """Return how many of `count` events lie within the time that a FLAT word holds."""
    longest = 1 << 31 - form.bx - form.by
    while ticks[count - 1] >= longest:
        count -= 1
    return count


@kernel
def planned(count: int, form: Form, only: int, room: Scratch) -> Plan:
    """Put the first `count` events in order and find their smallest coding."""
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
def _best_k(values: _Int64s, begin: int, end: int, least: int, escape: int) -> tuple[int, int]:
    """Return a Rice parameter, at least `least`, that is good for `values`, and the bits that they take."""
    if begin >= end:
        return least, 0
    mean = _sum(values, begin, end) // (end - begin)
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
def _sum(values: _Int64s, begin: int, end: int) -> int:
    total = np.int64(0)
    for i in range(begin, end):
        total += values[i]
    return int(total)


@kernel
def _rice_bits(values: _Int64s, begin: int, end: int, k: int, escape: int) -> int:
    bits = 0
    for i in range(begin, end):
        q = values[i] >> k
        bits += q + 1 + k if q < _ONES else _ONES + escape
    return bits


@kernel
def _bitmaps(count: int, form: Form, polarity: int, room: Scratch, forced: bool) -> Plan:
    """Try spans that have gaps, and where many events have none between them, spans without.

    An event that joins a span saves the MAX_K + 1 bits of its step at most, and its polarity; every other one pays a
    bit for a length. So few neighbours need no trial.
    """
    near, touching = 0, 0
    for i in range(1, count):
        if room.ticks[i] == room.ticks[i - 1] and 1 <= room.steps[i] <= _JOINED_STEP:
            near += 1
            touching += 1 if room.steps[i] == 1 else 0
    if near * (MAX_K + 3) <= count and not forced:
        return Plan(_BITMAP, polarity, 0, 0, 0, _NEVER)
    best = _bitmap(count, form, polarity, _JOINED_STEP, room)
    if 2 * touching > near:
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
    """Group events of a tick that are at most `joined` pixels from the next into spans; returns how many."""
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
def same_polarity(begin: int, end: int, keys: _Int64s) -> bool:
    """Whether the events from `begin` to before `end` are all ON or all OFF."""
    ons = 0
    for i in range(begin, end):
        ons += keys[i] & 1
    return ons == 0 or ons == end - begin


@kernel
def _span_bits(begin: int, end: int, length: int, polarity: int, keys: _Int64s) -> int:
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

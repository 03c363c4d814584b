"""Events in the order of a block, compiled: sorted by tick and address.

An event is one number here, its key: (ticks * N + address) << 1 | polarity. Sorting keys puts a block in order, and
differences of neighbours are the steps that ROWS writes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.telemetry.layout import LONGEST_US, kernel

OUTSIDE, BACKWARDS = -1, -2
"""Return value of `load`, in place of a count, for events that are not valid for this sensor."""

_Bytes = npt.NDArray[np.uint8]
_Int64s = npt.NDArray[np.int64]

_EVENT_BYTES = 13
_DIGIT_BITS = 11  # of a radix sort, at most
_FEW = 48  # a tick with fewer events is sorted by insertion


class Form(NamedTuple):
    """The sensor and the unit of time: pixels, bits of a column and of a row, us."""

    width: int
    height: int
    bx: int
    by: int
    tick_us: int


def form_of(size: tuple[int, int], tick_us: int) -> Form:
    """Return the form of blocks of a sensor of `size` = (width, height)."""
    return Form(*size, (size[0] - 1).bit_length(), (size[1] - 1).bit_length(), tick_us)


class Scratch(NamedTuple):
    """Room for one block; (max_events + 1,) each but the last two."""

    given: _Int64s  # keys in the order of arrival
    keys: _Int64s  # keys in order
    spare: _Int64s
    ticks: _Int64s
    steps: _Int64s  # steps[i]: from event i - 1 to event i
    starts: _Int64s  # of spans: index of the first event
    span_steps: _Int64s
    lengths: _Int64s  # of spans: pixels - 1
    counts: _Int64s  # (2048,) of a radix sort
    bits: _Int64s  # (3,) bits not yet written, their number, position in bytes


def new_scratch(max_events: int) -> Scratch:
    """Return room for blocks of up to `max_events` events."""
    given, keys, spare, ticks, steps, starts, span_steps, lengths = np.zeros((8, max_events + 1), np.int64)
    counts, bits = np.zeros(1 << _DIGIT_BITS, np.int64), np.zeros(3, np.int64)
    return Scratch(given, keys, spare, ticks, steps, starts, span_steps, lengths, counts, bits)


@kernel
def load(events: _Bytes, form: Form, limit: int, room: Scratch) -> int:
    """Make keys of the first events, as many as a block may span; return their number, or a fault code."""
    start, last = _time_of(events, 0), 0
    if start < 0:  # 2**63 us and more
        return BACKWARDS
    start -= start % form.tick_us
    pixels = form.width * form.height
    count = min(limit, len(events) // _EVENT_BYTES)
    for i in range(count):
        at = i * _EVENT_BYTES
        since = _time_of(events, at) - start
        x = events[at + 8] | np.int64(events[at + 9]) << 8
        y = events[at + 10] | np.int64(events[at + 11]) << 8
        if x >= form.width or y >= form.height:
            return OUTSIDE
        if since < last:
            return BACKWARDS
        if since > LONGEST_US:
            return i
        last = since
        tick = since if form.tick_us == 1 else since // form.tick_us
        on = np.int64(events[at + 12] != 0)
        room.ticks[i] = tick
        room.given[i] = (tick * pixels + y * form.width + x) << 1 | on
    return count


@kernel
def _time_of(events: _Bytes, at: int) -> int:
    time = np.int64(0)
    for i in range(8):
        time |= np.int64(events[at + i]) << 8 * i
    return int(time)


@kernel
def sort(count: int, form: Form, room: Scratch) -> None:
    """Sort the first `count` given keys, preserving the order of events of one pixel in one tick."""
    keys = room.keys
    for i in range(count):
        keys[i] = room.given[i]
    begin = 0
    while begin < count:
        end, sorted_so_far = begin + 1, True
        while end < count and room.ticks[end] == room.ticks[begin]:
            sorted_so_far &= keys[end - 1] >> 1 <= keys[end] >> 1
            end += 1
        if not sorted_so_far:
            if end - begin < _FEW:
                _insert(keys, begin, end)
            else:
                _radix(begin, end, form, room)
        begin = end


@kernel
def _insert(keys: _Int64s, begin: int, end: int) -> None:
    for i in range(begin + 1, end):
        key, j = keys[i], i
        while j > begin and keys[j - 1] >> 1 > key >> 1:
            keys[j] = keys[j - 1]
            j -= 1
        keys[j] = key


@kernel
def _radix(begin: int, end: int, form: Form, room: Scratch) -> None:
    """Sort keys of one tick by address, a digit of some bits at a time, the lowest first."""
    keys, counts, address_bits = room.keys, room.counts, 1
    while form.width * form.height - 1 >> address_bits:
        address_bits += 1
    passes = (address_bits + _DIGIT_BITS - 1) // _DIGIT_BITS
    width = (address_bits + passes - 1) // passes
    mask, first = (1 << width) - 1, room.ticks[begin] * (form.width * form.height)
    for shift in range(0, address_bits, width):
        for digit in range(mask + 1):
            counts[digit] = 0
        for i in range(begin, end):
            counts[((keys[i] >> 1) - first >> shift) & mask] += 1
        place = begin
        for digit in range(mask + 1):
            place, counts[digit] = place + counts[digit], place
        for i in range(begin, end):
            digit = ((keys[i] >> 1) - first >> shift) & mask
            room.spare[counts[digit]] = keys[i]
            counts[digit] += 1
        for i in range(begin, end):
            keys[i] = room.spare[i]

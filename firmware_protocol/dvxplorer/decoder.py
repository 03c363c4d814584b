"""Decoder of DVXplorer word streams: bytes in any pieces to events, edges, inertial samples and a count of faults.

`words` describes the layout. The meaning follows libcaer 3.3.15 (dvxplorer.c): a column or a group outside the array
hides the pixels up to the next good one; time is unrolled in 64 bits; a reset sets it to zero and leaves the column.

Inertial samples are sent in the unit's own axes: y, x, z, for accelerometer and gyroscope alike.

The decoder is compiled: one pass counts pixels and other words, the next writes the records into arrays of that size,
with its whole state in local variables, which the compiler keeps in registers. The loop over the pixels of a word goes
from one set bit to the next by a table, as most words have one of eight.
"""

from __future__ import annotations

import numpy as np

from firmware_protocol.compiled import kernel
from firmware_protocol.dvxplorer.words import (
    ADDRESSES,
    COLUMN,
    COLUMN_BITS,
    FARTHEST,
    GROUP_1,
    GROUP_2,
    LOWEST_BIT,
    OFF_BIT,
    ROWS_OF_GROUP,
    entry,
)
from firmware_protocol.events import Bytes, Int64s, empty_events
from firmware_protocol.evt.evt3 import put_event
from firmware_protocol.evt.words import EVENT_BYTES
from firmware_protocol.fx3.decoded import SPECIAL_EVENT, Decoded, WordFaults
from firmware_protocol.fx3.words import (
    KIND,
    LOW_BITS,
    MAX_STEPS,
    MISC8,
    TIMESTAMP,
    WORD,
    WRAP,
    WRAP_BITS,
    ImuReader,
    Words,
    is_imu,
)
from firmware_protocol.imu_samples import AXES_ON_THE_WIRE

# Content of a state: time, column and groups in force (-1: none), columns and groups of the array, and the numbers of
# words with a column outside, a group outside, and a time that does not increase.
_TIME, _COLUMN, _GROUP_1, _GROUP_2, _COLUMNS, _GROUPS, _BAD_COLUMN, _BAD_GROUP, _BAD_TIME = range(9)
_NONE = np.int64(-1)

# Compiled code holds plain numbers.
_TIMESTAMP = TIMESTAMP
_LOW_BITS = LOW_BITS
_WRAP = WRAP
_WRAP_BITS = WRAP_BITS
_MAX_STEPS = MAX_STEPS
_KIND, _RESET = KIND, 1

_INPUT_MARKS = (2, 3, 4, 16, 17)
_KNOWN_SPECIALS = (1, *_INPUT_MARKS, 5, 7)


@entry
def count_items(words: Words) -> tuple[int, int]:
    """Return the numbers of pixels and of words of other kinds, specials and misc, in (n,) words."""
    pixels, rare = 0, 0
    for word in words:
        kind = word & _KIND
        bits = np.int64(word & 0xFF if kind in (GROUP_1, GROUP_2) else 0)
        bits -= bits >> 1 & 0x55
        bits = (bits & 0x33) + (bits >> 2 & 0x33)
        pixels += int((bits & 0xF) + (bits >> 4))
        rare += kind in (0, 0x5000, 0x6000)
    return pixels, rare


@entry
def read_words(words: Words, state: Int64s, events: Bytes, rare: Int64s) -> int:
    """Write the records of all (n,) words; return the number of events.

    Parameters
    ----------
    words : words in stream order.
    state : (9,) with the layout above, updated.
    events : (13 m,) bytes of room for EVENT records, m the number of pixels.
    rare : (k, 3): word, its time, and the number of events before it; k words of other kinds.
    """
    time_us = state[_TIME]
    column = state[_COLUMN]
    first = state[_GROUP_1]
    second = state[_GROUP_2]
    columns, groups, at, at_other = state[_COLUMNS], state[_GROUPS], 0, 0
    for word in words:
        kind, value = word & _KIND, int(word & 0xFFF)
        if kind in (GROUP_1, GROUP_2):
            group = first if kind == GROUP_1 else second
            if column >= 0 and group >= 0:
                at = _put_pixels(events, at, time_us, column, group * ROWS_OF_GROUP | value << 16)
        elif word >= _WRAP:
            later = _time_after(time_us, word)
            state[_BAD_TIME] += later <= time_us and (time_us > 0 or later < 0)
            time_us = later
        elif kind == ADDRESSES:
            first = np.int64(value & 0x3F)
            second = first - (value >> 6 & FARTHEST) if value & 0x800 else first + (value >> 6 & FARTHEST)
            state[_BAD_GROUP] += first >= groups or second < 0 or second >= groups
            first = first if first < groups else _NONE
            second = second if second < groups else _NONE
        elif kind == COLUMN:
            column = np.int64(value & COLUMN_BITS)
            state[_BAD_COLUMN] += column >= columns
            column = column if column < columns else _NONE
        else:
            time_us *= word != _RESET
            rare[at_other, 0] = word
            rare[at_other, 1] = time_us
            rare[at_other, 2] = at // EVENT_BYTES
            at_other += 1
    state[_TIME] = time_us
    state[_COLUMN] = column
    state[_GROUP_1] = first
    state[_GROUP_2] = second
    return at // EVENT_BYTES


@kernel
def _time_after(before_us: int, word: int) -> int:
    """Return the time that a timestamp or a wrap sets."""
    base = before_us >> _WRAP_BITS << _WRAP_BITS
    return base + (word & _LOW_BITS) if word >= _TIMESTAMP else base + ((word & _MAX_STEPS) << _WRAP_BITS)


@kernel
def _put_pixels(events: Bytes, at: int, time_us: int, x: int, rows: int) -> int:
    """Write an EVENT for each pixel; return the next place. `rows`: the first row, from bit 16 on the pixels' word."""
    row, bits, on = rows & 0xFFFF, rows >> 16 & 0xFF, not rows >> 16 & OFF_BIT
    while bits:
        at = put_event(events, at, time_us, x, row + LOWEST_BIT[np.uint64(bits)], on)
        bits &= bits - 1
    return at


class GroupDecoder:
    """Decoder of a stream of DVXplorer words; it keeps its state between pieces.

    `size`: (width, height) of the array. `faults`: counts of words that an intact stream never contains.
    """

    def __init__(self, size: tuple[int, int] = (640, 480)) -> None:
        self._state = np.array([0, -1, -1, -1, size[0], size[1] // ROWS_OF_GROUP, 0, 0, 0], np.int64)
        self._odd = b""
        self._imu = ImuReader()
        self._resets = 0
        self.faults = WordFaults()
        self.feed(b"")  # compiles the kernels now, not while words wait

    def feed(self, data: bytes) -> Decoded:
        """Decode the next bytes of the stream; any bytes give a result."""
        data = self._odd + data if self._odd else data
        even = len(data) & ~1
        self._odd = bytes(data[even:])
        words = np.frombuffer(data, WORD, even // 2)
        n_pixels, n_others = count_items(words)
        events, rare = empty_events(n_pixels), np.empty((n_others, 3), np.int64)
        self._state[_BAD_COLUMN:] = 0
        n_events = read_words(words, self._state, events.view(np.uint8), rare)
        self._count_faults(rare[:, 0])
        seldom, times_us = rare[:, 0].astype(WORD), rare[:, 1]
        imu = self._imu.feed(seldom, times_us)
        imu["sample"]["counts"] = imu["sample"]["counts"][:, AXES_ON_THE_WIRE]
        self._resets += int(np.count_nonzero(seldom == _RESET))
        chosen = rare[np.isin(rare[:, 0], (_RESET, *_INPUT_MARKS))]
        specials = np.empty(len(chosen), SPECIAL_EVENT)
        specials["code"], specials["t"], specials["index"] = chosen.T
        return Decoded(events[:n_events], specials, (), imu, self._resets)

    def _count_faults(self, rare: Int64s) -> None:
        specials = rare[rare < COLUMN]
        misc = rare[rare >= MISC8]
        known_misc = is_imu(misc.astype(WORD))
        self.faults += WordFaults(
            row_outside=int(self._state[_BAD_GROUP]),
            column_outside=int(self._state[_BAD_COLUMN]),
            time_not_increasing=int(self._state[_BAD_TIME]),
            unknown_special=int(np.count_nonzero(~np.isin(specials, _KNOWN_SPECIALS))),
            unknown_misc=int(np.count_nonzero(~known_misc)),
        )

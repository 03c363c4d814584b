"""Decoder of DVXplorer word streams: bytes in any pieces to events, edges, inertial samples and a count of faults.

`words` describes the layout. The meaning follows libcaer 3.3.15 (dvxplorer.c): a column or a group outside the array
hides the pixels up to the next good one; time is unrolled in 64 bits; a reset sets it to zero and leaves the column.

Inertial samples are sent in the unit's own axes: y, x, z, for accelerometer and gyroscope alike.

The decoder is compiled: one pass counts pixels and other words, the next writes the records into arrays of that size.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import kernel
from firmware_protocol.davis346.blocks import ImuReader, is_imu
from firmware_protocol.davis346.decoder import SPECIAL_EVENT, Decoded, WordFaults
from firmware_protocol.davis346.words import KIND, LOW_BITS, MAX_STEPS, MISC8, TIMESTAMP, WORD, WRAP, WRAP_BITS, Words
from firmware_protocol.dvxplorer.words import (
    ADDRESSES,
    COLUMN,
    COLUMN_BITS,
    FARTHEST,
    GROUP_1,
    GROUP_2,
    OFF_BIT,
    ROWS_OF_GROUP,
    entry,
)
from firmware_protocol.events import empty_events
from firmware_protocol.evt.words import EVENT_BYTES, put_short, put_time
from firmware_protocol.imu_samples import AXES_ON_THE_WIRE

__all__ = ["GroupDecoder"]


_Bytes = npt.NDArray[np.uint8]
_Int64s = npt.NDArray[np.int64]

# Content of a state: time, column and groups in force (-1: none), columns and groups of the array, and the numbers of
# words with a column outside, a group outside, and a time that does not increase.
_TIME, _COLUMN, _GROUP_1, _GROUP_2, _COLUMNS, _GROUPS, _BAD_COLUMN, _BAD_GROUP, _BAD_TIME = range(9)
_NONE = np.int64(-1)

# Compiled code holds plain numbers.
_TIMESTAMP, _LOW_BITS, _WRAP, _WRAP_BITS, _MAX_STEPS = TIMESTAMP, LOW_BITS, WRAP, WRAP_BITS, MAX_STEPS
_KIND, _RESET = KIND, 1

_INPUT_MARKS = (2, 3, 4, 16, 17)
_KNOWN_SPECIALS = (1, *_INPUT_MARKS, 5, 7)
_MISC10 = 0x6000


@entry
def count_items(words: Words) -> tuple[int, int]:
    """Return the numbers of pixels and of words of other kinds, specials and misc, in (n,) words."""
    pixels, others = 0, 0
    for word in words:
        kind = word & _KIND
        bits = np.int64(word & 0xFF if kind in (GROUP_1, GROUP_2) else 0)
        bits -= bits >> 1 & 0x55
        bits = (bits & 0x33) + (bits >> 2 & 0x33)
        pixels += int((bits & 0xF) + (bits >> 4))
        others += kind == 0 or kind in (0x5000, 0x6000)
    return pixels, others


@entry
def read_words(words: Words, state: _Int64s, events: _Bytes, others: _Int64s) -> int:
    """Write the records of all (n,) words; return the number of events.

    Parameters
    ----------
    words
        Words in stream order.
    state
        (9,) with the layout above, updated.
    events
        (13 m,) bytes of room for EVENT records, m the number of pixels.
    others
        (k, 3): word, its time, and the number of events before it; k words of other kinds.
    """
    at, at_other = 0, 0
    for word in words:
        kind, value = word & _KIND, int(word & 0xFFF)
        if word >= _WRAP:
            _take_time(word, value, state)
        elif kind == COLUMN:
            x = value & COLUMN_BITS
            is_good = x < state[_COLUMNS]
            state[_COLUMN] = x if is_good else _NONE
            state[_BAD_COLUMN] += not is_good
        elif kind == ADDRESSES:
            _take_addresses(value, state)
        elif kind in (GROUP_1, GROUP_2):
            at = _put_pixels(events, at, value, state[_GROUP_1 if kind == GROUP_1 else _GROUP_2], state)
        elif kind in (0, 0x5000, 0x6000):
            state[_TIME] *= word != _RESET
            others[at_other, 0], others[at_other, 1], others[at_other, 2] = word, state[_TIME], at // EVENT_BYTES
            at_other += 1
    return at // EVENT_BYTES


@kernel
def _take_time(word: int, value: int, state: _Int64s) -> None:
    """Set the time to that of a timestamp or a wrap."""
    before = state[_TIME]
    base = before >> _WRAP_BITS << _WRAP_BITS
    t = base + (word & _LOW_BITS) if word >= _TIMESTAMP else base + ((value & _MAX_STEPS) << _WRAP_BITS)
    state[_BAD_TIME] += t <= before and (before > 0 or t < before)
    state[_TIME] = t


@kernel
def _take_addresses(value: int, state: _Int64s) -> None:
    """Set the groups in force."""
    first, distance = value & 0x3F, value >> 6 & FARTHEST
    second = first - distance if value & 0x800 else first + distance
    are_good = first < state[_GROUPS] and 0 <= second < state[_GROUPS]
    state[_GROUP_1] = first if first < state[_GROUPS] else _NONE
    state[_GROUP_2] = second if 0 <= second < state[_GROUPS] else _NONE
    state[_BAD_GROUP] += not are_good


@kernel
def _put_pixels(events: _Bytes, at: int, value: int, group: int, state: _Int64s) -> int:
    """Write an EVENT record for each pixel of a word; return the place of the next one."""
    if group < 0 or state[_COLUMN] < 0:
        return at
    row, bits, on = group * ROWS_OF_GROUP, value & 0xFF, not value & OFF_BIT
    while bits:
        if bits & 1:
            put_time(events, at, state[_TIME])
            put_short(events, at + 8, state[_COLUMN])
            put_short(events, at + 10, row)
            events[np.uint64(at + 12)] = on
            at += EVENT_BYTES
        bits >>= 1
        row += 1
    return at


class GroupDecoder:
    """Decoder of a stream of DVXplorer words; it keeps its state between pieces.

    Parameters
    ----------
    size
        (width, height) of the array.

    Attributes
    ----------
    faults
        Counts of words that an intact stream never contains.
    """

    def __init__(self, size: tuple[int, int] = (640, 480)) -> None:
        self._state = np.array([0, -1, -1, -1, size[0], size[1] // ROWS_OF_GROUP, 0, 0, 0], np.int64)
        self._odd = b""
        self._imu = ImuReader()
        self._resets = 0
        self.faults = WordFaults()
        self.feed(b"")  # compiles the kernels now, not while words wait

    @property
    def time_us(self) -> int:
        """Device time of the last timestamp or wrap."""
        return int(self._state[_TIME])

    def feed(self, data: bytes) -> Decoded:
        """Decode the next bytes of the stream; any bytes give a result."""
        data = self._odd + data if self._odd else data
        even = len(data) & ~1
        self._odd = bytes(data[even:])
        words = np.frombuffer(data, WORD, even // 2)
        n_pixels, n_others = count_items(words)
        events, others = empty_events(n_pixels), np.empty((n_others, 3), np.int64)
        self._state[_BAD_COLUMN:] = 0
        n_events = read_words(words, self._state, events.view(np.uint8), others)
        self._count_faults(others[:, 0])
        seldom, times_us = others[:, 0].astype(WORD), others[:, 1]
        imu = self._imu.feed(seldom, times_us)
        imu["sample"]["counts"] = imu["sample"]["counts"][:, AXES_ON_THE_WIRE]
        self._resets += int(np.count_nonzero(seldom == _RESET))
        return Decoded(events[:n_events], _specials(others), (), imu, self._resets)

    def _count_faults(self, others: _Int64s) -> None:
        specials = others[others < COLUMN]
        misc = others[others >= MISC8]
        known_misc = is_imu(misc.astype(WORD))
        self.faults += WordFaults(
            row_outside=int(self._state[_BAD_GROUP]),
            column_outside=int(self._state[_BAD_COLUMN]),
            time_not_increasing=int(self._state[_BAD_TIME]),
            unknown_special=int(np.count_nonzero(~np.isin(specials, _KNOWN_SPECIALS))),
            unknown_misc=int(np.count_nonzero(~known_misc)),
        )


def _specials(others: _Int64s) -> npt.NDArray[np.void]:
    """Return the (m,) SPECIAL_EVENT records of marks and resets."""
    chosen = others[np.isin(others[:, 0], (_RESET, *_INPUT_MARKS))]
    specials = np.empty(len(chosen), SPECIAL_EVENT)
    specials["code"], specials["t"], specials["index"] = chosen.T
    return specials

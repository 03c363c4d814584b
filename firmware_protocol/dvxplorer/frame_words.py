"""The 32-bit words of a DVXplorer Micro's data stream (CX3): their encoder and their decoder, as compiled kernels.

    bit 31       two groups of rows     30..26 distance to group 2, never negative   23..18 y / 8 of group 1
                                        17 and 16 polarity of groups 2 and 1, 0 is ON   15..8 and 7..0 their pixels
    bit 27       time                   21..0 milliseconds; one word for each millisecond
    bit 26       column                 9..0 x   20..11 microseconds of the frame, 0 to 999   21 first of a frame
    0            padding

A frame is one read-out of the chip. All its events share the time of its first column: 1000 x the last time word before
that column + its microseconds. Rules that the encoder follows because dv-processing 2.0.4 drops a frame without a
message, and libcaer 3.3.15 starts anew, where one is broken: columns of a frame increase and repeat its microseconds; a
column has at least one word of groups; a group occurs in one word of a column only, with both polarities if it has
both. Two frames have different times, none that of the first time word of a stream: dv-processing ends at such a frame.

A column's events are sent by rising group, in a group OFF before ON, in a polarity by rising row. libcaer delivers them
in this order; dv-processing delivers all OFF events of a column, then all ON events.

Sources: the parser of libcaer 3.3.15 (dvxplorer.c), runs of it and of dv-processing 2.0.4 against such a stream.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import entry_of, kernel
from firmware_protocol.dvxplorer.words import LOWEST_BIT
from firmware_protocol.events import Bytes, Events, Int32s, Int64s, bytes_of, empty_events
from firmware_protocol.evt.evt3 import put_event
from firmware_protocol.evt.words import EVENT_BYTES, put_time, short_at, time_at
from firmware_protocol.fx3.decoded import SPECIAL_EVENT, Decoded, WordFaults

FRAME_WORD = np.dtype("<u4")
FrameWords = npt.NDArray[np.uint32]

entry = entry_of("firmware_protocol.dvxplorer", "firmware_protocol.evt")

_State = Int64s
_Keys = Int32s
_Counts = Int32s

_GROUPS = 1 << 31
_TIME = 1 << 27
_COLUMN = 1 << 26
_FIRST = 1 << 21
_SUB_SHIFT = 11
_TIME_BITS = 22
_FARTHEST = 31
_MS_US = 1000
_MOST_TIMES = 1024  # time words one by one; a longer gap, a second without a reader, has two
# of a key, and the largest value of one
_DIGITS = 3
_DIGIT_BITS = 7
_DIGIT = 127
_FEW = 40  # events of one time that are sorted by insertion
_MOST_OF_COLUMN = 64  # words: one of the column, and one for each of 60 groups

# Typed, so that a kernel is compiled once; numpy's types are no int for a checker.
_NONE: Any = np.int64(-1)
_ZERO: Any = np.int64(0)
_LAST_KEY: Any = np.int64(1 << 10)

# Content of a sorter's state: time of the frame, its last column, and the time and the place in it of the last event.
_FRAME, _X = range(2)
_BACKWARDS, _OUTSIDE = -1, -2


@kernel
def _key(events: Bytes, at: int) -> int:
    """Return the place of an event in its column: group, polarity (OFF first), row."""
    y = short_at(events, at + 10)
    return int((y >> 3) << 4 | np.int64(events[np.uint64(at + 12)]) << 3 | y & 7)


@entry
def sort_keys(events: Bytes, size: tuple[int, int], keys: _Keys, counts: _Counts) -> int:
    """Write the keys of (13 n,) bytes of events into keys[0], (2, n), those of each time in order.

    Returns 0 if the events are in this order already, 1 if not, and a negative number for an event outside the array or
    back in time. `counts` is room for the sort, (3, 128).

    Events come sorted by time, so only those of one time change places, and the other 20 bits are their whole order. A
    time in order, as each single event, costs a comparison an event; few events are sorted by insertion, many digit by
    digit without comparisons, and a digit that all share, as the column of a scan, costs no pass. Events with one time
    and one key are equal, so `put_keys` makes the events of keys and reads none in a random order.
    """
    begin, last_us, before, is_unsorted, result = _ZERO, _ZERO, _NONE, _ZERO, _ZERO
    count = keys.shape[1]
    for k in range(count):
        at = k * EVENT_BYTES
        t, x = time_at(events, at), short_at(events, at + 8)
        if x >= size[0] or short_at(events, at + 10) >= size[1]:
            return _OUTSIDE
        if t != last_us or k == 0:
            if k and t < last_us:
                return _BACKWARDS
            if is_unsorted:
                _sort(keys, begin, k, counts)
            begin, last_us, before, is_unsorted = k, t, _NONE, _ZERO
        key = x << 10 | _key(events, at)
        keys[0, np.uint64(k)] = key
        is_unsorted |= key < before
        result |= is_unsorted
        before = key
    if is_unsorted:
        _sort(keys, begin, count, counts)
    return int(result)


@kernel
def _sort(keys: _Keys, begin: int, end: int, counts: _Counts) -> None:
    """Sort keys[0] from `begin` to `end`; keys[1] is room."""
    if end - begin < _FEW:
        for k in range(begin + 1, end):
            key, to = keys[0, np.uint64(k)], k
            while to > begin and keys[0, np.uint64(to - 1)] > key:
                keys[0, np.uint64(to)] = keys[0, np.uint64(to - 1)]
                to -= 1
            keys[0, np.uint64(to)] = key
    else:
        _sort_by_digits(keys, begin, end, counts)


@kernel
def _sort_by_digits(keys: _Keys, begin: int, end: int, counts: _Counts) -> None:
    """Sort keys by three digits, the lowest first; all three are counted in one pass."""
    counts[:] = 0
    for k in range(begin, end):
        key = keys[0, np.uint64(k)]
        for digit in range(_DIGITS):
            counts[np.uint64(digit), np.uint64(key >> _DIGIT_BITS * digit & _DIGIT)] += 1
    side = _ZERO
    for digit in range(_DIGITS):
        shift = _DIGIT_BITS * digit
        if counts[np.uint64(digit), np.uint64(keys[0, np.uint64(begin)] >> shift & _DIGIT)] == end - begin:
            continue
        place = begin
        for value in range(_DIGIT + 1):
            place, counts[digit, value] = place + counts[digit, value], place
        for k in range(begin, end):
            key = keys[np.uint64(side), np.uint64(k)]
            value_of_key = np.uint64(key >> shift & _DIGIT)
            keys[np.uint64(1 - side), np.uint64(counts[np.uint64(digit), value_of_key])] = key
            counts[np.uint64(digit), value_of_key] += 1
        side = 1 - side
    if side:
        for k in range(begin, end):
            keys[0, np.uint64(k)] = keys[1, np.uint64(k)]


@entry
def put_keys(events: Bytes, keys: _Keys, out: Bytes) -> None:
    """Write the events of keys[0], (2, n), with the times of (13 n,) bytes of `events`, into `out`, (13 n,)."""
    for k in range(keys.shape[1]):
        at, key = k * EVENT_BYTES, int(keys[0, np.uint64(k)])
        put_event(out, at, time_at(events, at), key >> 10, key >> 1 & 0x1F8 | key & 7, key >> 3 & 1)


@entry
def put_frame_times(events: Bytes, period_us: float, state: _State) -> None:
    """Give (13 n,) bytes of events in the order on the wire the times of their frames.

    A frame ends at a column that does not lie beyond the one before, and when `period_us` have passed since its first
    event; 0: each time is a frame of its own. The first event of a call begins a column.
    """
    frame_us, column = state[_FRAME], state[_X]
    key, at_us = _LAST_KEY, _NONE
    for k in range(len(events) // EVENT_BYTES):
        at = k * EVENT_BYTES
        t = time_at(events, at)
        x = short_at(events, at + 8)
        event_key = _key(events, at)
        same_column = x == column and t == at_us and event_key > key
        same_frame = x > column and column >= 0 and (t == frame_us or t < frame_us + period_us)
        if not (same_column or same_frame):
            frame_us = max(t, frame_us + 1)
        column = x
        at_us = t
        key = event_key
        put_time(events, at, frame_us)
    state[_FRAME], state[_X] = frame_us, column


# Content of an encoder's state: last millisecond sent, time of the frame and column in force, time that is zero.
_MS, _SENT_FRAME, _SENT_X, _EPOCH = range(4)


@entry
def write_frames(events: Bytes, state: _State, out: FrameWords) -> tuple[int, int]:
    """Write the words of whole columns while they fit (k,) `out`; return the numbers of events and of words."""
    at, written = 0, 0
    while at < len(events):
        t, x = time_at(events, at) - state[_EPOCH], short_at(events, at + 8)
        is_first = t != state[_SENT_FRAME] or x <= state[_SENT_X]
        if is_first:
            written = _put_times(t // _MS_US, state, out, written)
        if written + _MOST_OF_COLUMN > len(out) or (is_first and state[_MS] != t // _MS_US):
            break
        out[np.uint64(written)] = _COLUMN | x | t % _MS_US << _SUB_SHIFT | is_first * _FIRST
        state[_SENT_FRAME], state[_SENT_X] = t, x
        at, written = _put_column(events, at, out, written + 1)
    return at // EVENT_BYTES, written


@entry
def write_times(ms: int, state: _State, out: FrameWords) -> int:
    """Write the time words up to a millisecond while they fit `out`; return their number."""
    return _put_times(ms, state, out, 0)


@kernel
def _put_times(ms: int, state: _State, out: FrameWords, written: int) -> int:
    """Write the time words that are due; return the index of the next word. A stream begins with the one before."""
    if state[_MS] < 0 or ms - state[_MS] > _MOST_TIMES:
        state[_MS] = max(ms - 2, -1)
    while state[_MS] < ms and written < len(out):
        state[_MS] += 1
        out[np.uint64(written)] = _TIME | state[_MS] & (1 << _TIME_BITS) - 1
        written += 1
    return written


@kernel
def _put_column(events: Bytes, at: int, out: FrameWords, written: int) -> tuple[int, int]:
    """Write the groups of one column; return the places after its last event and its last word.

    Each part is read once, and the third only where it decides whether the first two share a word.
    """
    t, x = time_at(events, at), short_at(events, at + 8)
    group, off, mask, at = _part(events, at, t, x)
    second, second_off, second_mask, after = _part(events, at, t, x)
    while second_mask:
        third = _part(events, after, t, x)
        if second - group <= _FARTHEST and (second == group or third[0] != second):
            pair = second_off << 17 | off << 16 | second_mask << 8 | mask
            out[np.uint64(written)] = _GROUPS | (second - group) << 26 | group << 18 | pair
            group, off, mask, at = third
            second, second_off, second_mask, after = _part(events, at, t, x)
        else:
            out[np.uint64(written)] = _GROUPS | group << 18 | off << 16 | mask
            group, off, mask, at = second, second_off, second_mask, after
            second, second_off, second_mask, after = third
        written += 1
    if mask:
        out[np.uint64(written)] = _GROUPS | group << 18 | off << 16 | mask
        written += 1
    return at, written


@kernel
def _part(events: Bytes, at: int, t: int, x: int) -> tuple[int, int, int, int]:
    """Return group, polarity, pixels of events from `at` that share both, and the place after; no pixels: the end."""
    part, mask = _NONE, _ZERO
    while at < len(events) and time_at(events, at) == t and short_at(events, at + 8) == x:
        key = _key(events, at)
        if mask and key >> 3 != part:
            break
        part, mask, at = key >> 3, mask | 1 << (key & 7), at + EVENT_BYTES
    return part >> 1, 1 - (part & 1), mask, at


def in_wire_order(events: Events, size: tuple[int, int]) -> Events:
    """Return (n,) EVENT in the order on the wire, `events` itself if it is so; ValueError if not sorted by time."""
    keys, octets = np.empty((2, len(events)), np.int32), bytes_of(events)
    order = sort_keys(octets, size, keys, np.empty((_DIGITS, _DIGIT + 1), np.int32))
    if order < 0:
        raise ValueError("an event lies outside the array" if order == _OUTSIDE else "events must be sorted by time")
    if not order:
        return events
    ordered = empty_events(len(events))
    put_keys(octets, keys, bytes_of(ordered))
    return ordered


class FrameTimes:
    """Assignment of events to frames."""

    def __init__(self) -> None:
        self._state = np.array([-1, -1], np.int64)
        put_frame_times(np.empty(0, np.uint8), 0.0, self._state)  # compiles the kernel now

    def start(self, epoch_us: int) -> None:
        """Begin a stream; its first event begins a frame, later than the time word of `epoch_us`."""
        self._state[:] = epoch_us, int(_NONE)

    def end_frame(self) -> None:
        """End the frame; the next event begins one."""
        self._state[_X] = int(_NONE)

    def put(self, events: Events, period_us: float) -> None:
        """Give (n,) EVENT in the order on the wire the times of their frames, which last `period_us` at most."""
        put_frame_times(bytes_of(events), period_us, self._state)


class FrameEncoder:
    """Encoder of frames into words; it holds the state of the stream's reader."""

    def __init__(self) -> None:
        self._state = np.zeros(4, np.int64)
        self.reset(0)
        self.encode(empty_events(), np.empty(1, FRAME_WORD))  # compiles the kernels now, not while events wait
        self.times(0, np.empty(0, FRAME_WORD))

    def reset(self, epoch_us: int) -> None:
        """Begin a stream for a new reader; device time is zero at `epoch_us`."""
        self._state[:] = -1, -1, int(_NONE), epoch_us

    def take_back(self, words: FrameWords) -> None:
        """Go back to before the first word of time among the last `words`, (n,), which the reader does not get."""
        times = words[words & (_GROUPS | _TIME) == _TIME]
        if len(times):
            self._state[_MS] -= 1 + (self.last_ms - int(times[0]) & (1 << _TIME_BITS) - 1)

    @property
    def last_ms(self) -> int:
        """Last millisecond of device time that was sent; -1: none."""
        return int(self._state[_MS])

    def encode(self, events: Events, out: FrameWords) -> tuple[int, int]:
        """Write whole columns of `events`, (n,) with frame times, to `out`, (k >= 65,); return both numbers written."""
        n_events, n_words = write_frames(bytes_of(events), self._state, out)
        return int(n_events), int(n_words)

    def times(self, until_us: int, out: FrameWords) -> int:
        """Write the time words due up to device time `until_us` into `out`; return their number."""
        return int(write_times(until_us // _MS_US, self._state, out))


# Content of a decoder's state: time of the last time word, of the frame, and column (-1: none), size of the array,
# numbers of words with a column outside, a group outside, and a time that goes back.
_BASE, _NOW, _AT_X, _WIDTH, _ROWS, _BAD_COLUMN, _BAD_GROUP, _BAD_TIME = range(8)


@entry
def count_pixels(words: FrameWords) -> int:
    """Return the number of pixels in (n,) words."""
    pixels = _ZERO
    for word in words:
        bits = np.int64(word & 0xFFFF if word >= _GROUPS else 0)
        bits -= bits >> 1 & 0x5555
        bits = (bits & 0x3333) + (bits >> 2 & 0x3333)
        bits = (bits & 0x0F0F) + (bits >> 4 & 0x0F0F)
        pixels += (bits & 0xFF) + (bits >> 8)
    return int(pixels)


@entry
def read_frames(words: FrameWords, state: _State, events: Bytes) -> int:
    """Write the records of all (n,) words into `events`, bytes of EVENT; return their number."""
    at = 0
    for octets in words:
        word: Any = np.int64(octets)
        if word & _GROUPS:
            at = _put_groups(word, state, events, at)
        elif word & _COLUMN:
            x = word & 0x3FF
            state[_BAD_COLUMN] += x >= state[_WIDTH]
            state[_AT_X] = x if x < state[_WIDTH] else _NONE
            if word & _FIRST and state[_BASE] >= 0:
                now_us = state[_BASE] + (word >> _SUB_SHIFT & 0x3FF)
                state[_BAD_TIME] += now_us <= state[_NOW]
                state[_NOW] = now_us
        elif word & _TIME:
            span = np.int64(1 << _TIME_BITS)
            ms = word & span - 1
            if state[_BASE] < 0:
                state[_BASE] = ms * _MS_US
            steps = (ms - state[_BASE] // _MS_US) % span
            state[_BAD_TIME] += steps >= span >> 1
            state[_BASE] += (steps if steps < span >> 1 else steps - span) * _MS_US
    return at // EVENT_BYTES


@kernel
def _put_groups(word: int, state: _State, events: Bytes, at: int) -> int:
    """Write the events of a word of groups; return the place of the next one."""
    group = word >> 18 & 0x3F
    for half in range(2):
        bits, off = word >> 8 * half & 0xFF, word >> 16 + half & 1
        group += (word >> 26 & _FARTHEST) * half
        state[_BAD_GROUP] += bits != 0 and group >= state[_ROWS]
        if state[_AT_X] < 0 or state[_NOW] < 0 or group >= state[_ROWS]:
            continue
        while bits:
            at = put_event(events, at, state[_NOW], state[_AT_X], group * 8 + LOWEST_BIT[np.uint64(bits)], 1 - off)
            bits &= bits - 1
    return at


class FrameDecoder:
    """Decoder of a Micro's words; it keeps its state between pieces.

    `size`: (width, height) of the array. `faults`: counts of words that an intact stream never contains.
    """

    def __init__(self, size: tuple[int, int] = (640, 480)) -> None:
        self._state = np.array([-1, -1, -1, size[0], size[1] // 8, 0, 0, 0], np.int64)
        self._odd = b""
        self.faults = WordFaults()
        self.feed(b"")  # compiles the kernels now, not while words wait

    @property
    def time_us(self) -> int:
        """Device time of the last word of a time or of a frame."""
        return int(max(self._state[_BASE], self._state[_NOW], 0))

    def feed(self, data: bytes) -> Decoded:
        """Decode the next bytes of the stream; any bytes give a result."""
        data = self._odd + data if self._odd else data
        used = len(data) & ~3
        self._odd = bytes(data[used:])
        words = np.frombuffer(data, FRAME_WORD, used // 4)
        events = empty_events(count_pixels(words))
        self._state[_BAD_COLUMN:] = 0
        n = read_frames(words, self._state, events.view(np.uint8))
        bad_column, bad_group, bad_time = self._state[_BAD_COLUMN:].tolist()
        self.faults += WordFaults(row_outside=bad_group, column_outside=bad_column, time_not_increasing=bad_time)
        return Decoded(events[:n], np.empty(0, SPECIAL_EVENT))

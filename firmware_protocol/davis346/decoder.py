"""Decoder of DAVIS word streams: bytes in any pieces to events, specials, frames, IMU samples and a count of faults.

`words` and `fx3.words` describe the layout of the words. The meaning of events follows libcaer 3.3.15 (davis.c):

- a wrap word adds its number of steps of 32768 us and sets the time to that multiple; time is unrolled in 64 bits;
- a column before any row belongs to row 0; a row outside the array is ignored and the previous one stays in force; a
  column outside the array is no event;
- a reset sets the time to zero and leaves the row;
- a timestamp that does not increase is counted and used all the same.

APS samples and misc words are counted as not interpreted, and `FrameReader` reads frames from them. libcaer drops the
last byte of a buffer with an odd length; this decoder accepts a split inside a word.

`fx3.words` describes those of frames too. The meaning of frames follows libcaer 3.3.15 too: a frame that lacks a line
or a sample is dropped and counted; a timestamp reset ends an open frame without an image; words before a frame's start
are skipped.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import EVENT, Events, Int64s, Mask
from firmware_protocol.fx3.decoded import SPECIAL_EVENT, Decoded, FrameRead, WordFaults
from firmware_protocol.fx3.words import (
    APS_SAMPLE,
    COLUMN_ON,
    IMU_READ,
    KIND,
    LOW_BITS,
    MAX_ADDRESS,
    MAX_STEPS,
    MISC8,
    MISC10,
    ROW,
    TIMESTAMP,
    WORD,
    WRAP,
    WRAP_BITS,
    ImuReader,
    Special,
    Words,
    is_column,
    is_row,
)

Times = Int64s

_TIME_RESET = int(Special.TIMESTAMP_RESET)  # a plain number, which numpy compares without widening


@dataclass
class _Open:
    """A frame that is not complete yet."""

    start_us: int
    global_shutter: bool
    exposure: list[int] = field(default_factory=list)
    roi_bytes: list[int] = field(default_factory=list)
    moments_us: dict[int, int] = field(default_factory=dict)
    lines: dict[int, list[Words]] = field(default_factory=lambda: {Special.RESET_COLUMN: [], Special.SIGNAL_COLUMN: []})
    line: list[Words] | None = None
    line_kind: int = Special.RESET_COLUMN


class FrameReader:
    """Reads frames from words in any pieces.

    Parameters
    ----------
    turned : True if a line of the stream is a row of the image; else it is a column.
    shift : bits by which samples are shifted up, as libcaer does for a DAVIS240.

    Attributes
    ----------
    incomplete : frames that began and did not become complete.
    resets : timestamp resets so far.
    """

    def __init__(self, turned: bool = False, shift: int = 0) -> None:
        self._turned, self._shift = turned, shift
        self._open: _Open | None = None
        self.incomplete = self.resets = 0

    def feed(self, words: Words, times_us: Times) -> list[FrameRead]:
        """Read words (n,) other than events, with the time in force at each; return the frames that they complete."""
        frames: list[FrameRead] = []
        done = 0
        for at in np.flatnonzero(words < ROW).tolist():
            self._data(words[done:at])
            self._special(int(words[at]), int(times_us[at]), frames)
            done = at + 1
        self._data(words[done:])
        return frames

    def _special(self, code: int, t_us: int, frames: list[FrameRead]) -> None:
        self.resets += code == _TIME_RESET
        if code in (Special.FRAME_START_GLOBAL, Special.FRAME_START_ROLLING):
            self._abandon()
            self._open = _Open(t_us, code == Special.FRAME_START_GLOBAL)
        elif self._open is None:
            return
        elif code == _TIME_RESET:
            self._abandon()
        elif code in (Special.RESET_COLUMN, Special.SIGNAL_COLUMN):
            self._open.line, self._open.line_kind = [], code
        elif code == Special.COLUMN_END and self._open.line is not None:
            self._open.lines[self._open.line_kind].append(np.concatenate([np.empty(0, "<u2"), *self._open.line]))
            self._open.line = None
        elif code in (Special.EXPOSURE_START, Special.EXPOSURE_END):
            self._open.moments_us.setdefault(code, t_us)
        elif code == Special.FRAME_END:
            picture = self._picture(self._open, t_us)
            self._open = None
            if picture is None:
                self.incomplete += 1
            else:
                frames.append(picture)

    def _abandon(self) -> None:
        self.incomplete += self._open is not None
        self._open = None

    def _data(self, words: Words) -> None:
        if self._open is None or not len(words):
            return
        if self._open.line is not None:
            self._open.line.append((words[words & KIND == APS_SAMPLE] & 0xFFF) << self._shift)
        elif not self._open.lines[Special.RESET_COLUMN]:
            self._head(words)

    def _head(self, words: Words) -> None:
        """Read exposure and region, which come before the first line."""
        assert self._open is not None
        misc10 = words[words & 0xFC00 == MISC10]
        self._open.exposure += (misc10 & 0x3FF).tolist()
        roi = words[np.isin(words & 0xFF00, (MISC8 | 0x100, MISC8 | 0x200))]
        self._open.roi_bytes += (roi & 0xFF).tolist()

    def _picture(self, frame: _Open, end_us: int) -> FrameRead | None:
        if len(frame.roi_bytes) != 8 or len(frame.exposure) != 3 or len(frame.moments_us) != 2:
            return None
        left, top, right, bottom = (high << 8 | low for high, low in zip(*[iter(frame.roi_bytes)] * 2, strict=True))
        shape = (bottom - top + 1, right - left + 1) if self._turned else (right - left + 1, bottom - top + 1)
        reads = [_array(frame.lines[kind], shape) for kind in (Special.RESET_COLUMN, Special.SIGNAL_COLUMN)]
        if reads[0] is None or reads[1] is None:
            return None
        reset, signal = (read if self._turned else read.T for read in reads if read is not None)
        exposure = sum(part << 10 * k for k, part in enumerate(frame.exposure))
        return FrameRead(
            start_us=frame.start_us,
            exposure_start_us=frame.moments_us[Special.EXPOSURE_START],
            exposure_end_us=frame.moments_us[Special.EXPOSURE_END],
            end_us=end_us,
            exposure_cycles=exposure,
            global_shutter=frame.global_shutter,
            roi=(left, top, right, bottom),
            resets=self.resets,
            reset=reset,
            signal=signal,
        )


def _array(lines: list[Words], shape: tuple[int, int]) -> Words | None:
    """Return lines as an array (lines, samples); None if they do not fill `shape`."""
    if len(lines) != shape[0] or any(len(line) != shape[1] for line in lines):
        return None
    return np.stack(lines)


_BLOCK_WORDS = 32768

Index = Int64s


class Decoder:
    """Decoder of a stream of DAVIS words; it keeps its state between pieces.

    Parameters
    ----------
    size : (width, height) in user coordinates.
    turned : True if row words carry x and column words y (invert bit of the orientation register).
    sample_shift : bits by which samples of frames are shifted up.
    """

    def __init__(self, size: tuple[int, int] = (346, 260), turned: bool = False, sample_shift: int = 0) -> None:
        self._columns, self._rows = (size[1], size[0]) if turned else size
        self._turned = turned
        self._odd = b""
        self.time_us = 0  # of the last timestamp or wrap
        self.row = 0  # of the last row word
        self._frames = FrameReader(turned, sample_shift)
        self._imu = ImuReader()
        self.faults = WordFaults()

    def feed(self, data: bytes) -> Decoded:
        """Decode the next bytes of the stream; any bytes give a result."""
        data = self._odd + data if self._odd else data
        even = len(data) & ~1
        self._odd = bytes(data[even:])
        words = np.frombuffer(data, WORD, even // 2)
        events = np.empty(_count(is_column(words)), EVENT)
        specials = [np.empty(0, SPECIAL_EVENT)]
        frames: list[FrameRead] = []
        imu = [np.empty(0, IMU_READ)]
        filled = 0
        for first in range(0, len(words), _BLOCK_WORDS):
            count, special = self._block(words[first : first + _BLOCK_WORDS], events[filled:], frames, imu)
            special["index"] += filled
            filled += count
            specials.append(special)
        return Decoded(
            events[:filled], np.concatenate(specials), tuple(frames), np.concatenate(imu), self._frames.resets
        )

    def _block(
        self, words: Words, out: Events, frames: list[FrameRead], imu: list[npt.NDArray[np.void]]
    ) -> tuple[int, npt.NDArray[np.void]]:
        """Decode into the front of `out`, append to `frames` and `imu`; return how many events, and the specials."""
        rare = np.flatnonzero((words < ROW) | ((words >= APS_SAMPLE) & (words < TIMESTAMP)))
        at, columns = self._columns_in(words)
        stamp_of, time_us = self._timeline(words, rare)
        row_of, rows = self._rowline(words)
        events = out[: len(at)]
        events["t"] = time_us.take(stamp_of.take(at))
        address, row = columns & MAX_ADDRESS, rows.take(row_of.take(at))
        events["x"], events["y"] = (row, address) if self._turned else (address, row)
        events["on"] = columns >= COLUMN_ON
        seldom, seldom_us = words.take(rare), time_us.take(stamp_of.take(rare))
        specials = self._specials(seldom, rare, at, seldom_us)
        if len(seldom):
            frames.extend(self._frames.feed(seldom, seldom_us))
            imu.append(self._imu.feed(seldom, seldom_us))
        self.time_us, self.row = int(time_us[-1]), int(rows[-1])
        return len(at), specials

    def _columns_in(self, words: Words) -> tuple[Index, Words]:
        """Return positions and words of the columns inside the array."""
        at: Index = np.flatnonzero(is_column(words))
        columns = words.take(at)
        inside = (columns & MAX_ADDRESS) < self._columns
        if not inside.all():
            self.faults += WordFaults(column_outside=_count(~inside))
            at, columns = at[inside], columns[inside]
        return at, columns

    def _rowline(self, words: Words) -> tuple[Index, Words]:
        """Return for each word the index of the row in force, and those rows; the first is that of the last piece."""
        good = is_row(words)
        rows = np.compress(good, words) & MAX_ADDRESS
        outside = rows >= self._rows
        if outside.any():
            self.faults += WordFaults(row_outside=_count(outside))
            good[np.flatnonzero(good)[outside]] = False
            rows = rows[~outside]
        return np.cumsum(good), np.concatenate([np.array([self.row], WORD), rows])

    def _timeline(self, words: Words, rare: Index) -> tuple[Index, Index]:
        """Return for each word the index of the time in force, and those times (us), first that of the last piece."""
        moves = words >= TIMESTAMP
        kinds = words.take(rare)
        turns = rare[(kinds & KIND == WRAP) | (kinds == _TIME_RESET)]
        moves[turns] = True
        stamps = np.compress(moves, words)
        time_us = np.empty(len(stamps) + 1, np.int64)
        time_us[0] = self.time_us
        if len(turns):
            time_us[1:] = np.where(stamps >= TIMESTAMP, stamps & LOW_BITS, 0)
            time_us[1:] += self._bases(stamps)
        else:
            time_us[1:] = stamps & LOW_BITS
            time_us[1:] += self.time_us >> WRAP_BITS << WRAP_BITS
        steady = time_us[1:] > time_us[:-1]
        if not steady.all():
            self.faults += WordFaults(time_not_increasing=_count(~steady & (stamps != _TIME_RESET)))
        return np.cumsum(moves), time_us

    def _bases(self, stamps: Words) -> Index:
        """Return the multiple of 32768 us in force at each timestamp, wrap or reset, itself included."""
        reset = stamps == _TIME_RESET
        steps = np.where(stamps & KIND == WRAP, stamps & MAX_STEPS, 0)
        total = np.cumsum(steps, dtype=np.int64) + (self.time_us >> WRAP_BITS)
        total -= np.maximum.accumulate(np.where(reset, total, 0))
        return total << WRAP_BITS

    def _specials(self, words: Words, rare: Index, at: Index, time_us: Index) -> npt.NDArray[np.void]:
        """Return the specials among `words`, found at `rare`; count unknown words and words not interpreted."""
        special = words < ROW
        specials = np.empty(_count(special), SPECIAL_EVENT)
        if len(words):
            unknown_misc = (words > _LAST_MISC8) & (words < MISC10) | (words > _LAST_MISC10) & (words < WRAP)
            self.faults += WordFaults(
                unknown_special=_count(special & ~np.isin(words, _KNOWN_SPECIALS)),
                unknown_misc=_count(unknown_misc),
                not_interpreted=_count((words >= APS_SAMPLE) & (words < WRAP) & ~unknown_misc),
            )
            specials["code"] = words[special]
            specials["t"] = time_us[special]
            specials["index"] = np.searchsorted(at, rare[special])
        return specials


def _count(mask: Mask) -> int:
    return int(np.count_nonzero(mask))


_KNOWN_SPECIALS = np.array(sorted(Special), WORD)
_LAST_MISC8 = MISC8 | 0x3FF
_LAST_MISC10 = MISC10 | 0x3FF

"""Frames of a DAVIS346, read back from the words of its stream; the words are drawn in `blocks`.

The meaning follows libcaer 3.3.15: a frame that lacks a line or a sample is no frame, and is counted; a timestamp reset
ends one without a picture; what comes before a frame's start is skipped.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

__all__ = ["FrameRead", "FrameReader"]

Words = npt.NDArray[np.uint16]
Times = npt.NDArray[np.int64]

_KIND, _SPECIAL_END, _SAMPLE, _MISC8, _MISC10 = 0xF000, 0x1000, 0x4000, 0x5000, 0x6000
_TIME_RESET, _START_GLOBAL, _START_ROLLING, _END = 1, 8, 9, 10
_RESET, _SIGNAL, _LINE_END, _EXPOSURE_START, _EXPOSURE_END = 11, 12, 13, 14, 15
_WHITE_BELOW, _WHITE = 384, 1023


@dataclass(frozen=True)
class FrameRead:
    """A frame in the user's coordinates.

    Attributes
    ----------
    start_us, exposure_start_us, exposure_end_us, end_us
        Device time.
    exposure_cycles
        Exposure register, cycles of the ADC's clock.
    roi
        First column, first row, last column, last row.
    resets
        Timestamp resets that the reader had seen before.
    reset, signal
        (rows, columns) uint16, the two reads of the region.
    """

    start_us: int
    exposure_start_us: int
    exposure_end_us: int
    end_us: int
    exposure_cycles: int
    global_shutter: bool
    roi: tuple[int, int, int, int]
    resets: int
    reset: Words
    signal: Words

    @property
    def pixels(self) -> Words:
        """(rows, columns) uint16, 0 to 1023: reset less signal; white where reset is too low or signal is 0."""
        value = np.clip(self.reset.astype(np.int32) - self.signal, 0, _WHITE)
        return np.where((self.reset < _WHITE_BELOW) | (self.signal == 0), _WHITE, value).astype(np.uint16)


@dataclass
class _Open:
    """A frame in the making."""

    start_us: int
    global_shutter: bool
    exposure: list[int] = field(default_factory=list)
    roi_bytes: list[int] = field(default_factory=list)
    moments_us: dict[int, int] = field(default_factory=dict)
    lines: dict[int, list[Words]] = field(default_factory=lambda: {_RESET: [], _SIGNAL: []})
    line: list[Words] | None = None
    line_kind: int = _RESET


class FrameReader:
    """Reads frames from words in any pieces.

    Parameters
    ----------
    turned
        True where a line of the stream is a row of the user's picture; else a column.

    Attributes
    ----------
    incomplete
        Frames that began and were not whole.
    resets
        Timestamp resets so far.
    """

    def __init__(self, turned: bool = False) -> None:
        self._turned = turned
        self._open: _Open | None = None
        self.incomplete = self.resets = 0

    def feed(self, words: Words, times_us: Times) -> list[FrameRead]:
        """Take words (n,) other than events, with the time in force at each; return the frames that they complete."""
        frames: list[FrameRead] = []
        done = 0
        for at in np.flatnonzero(words < _SPECIAL_END).tolist():
            self._data(words[done:at])
            self._special(int(words[at]), int(times_us[at]), frames)
            done = at + 1
        self._data(words[done:])
        return frames

    def _special(self, code: int, t_us: int, frames: list[FrameRead]) -> None:
        self.resets += code == _TIME_RESET
        if code in (_START_GLOBAL, _START_ROLLING):
            self._abandon()
            self._open = _Open(t_us, code == _START_GLOBAL)
        elif self._open is None:
            return
        elif code == _TIME_RESET:
            self._abandon()
        elif code in (_RESET, _SIGNAL):
            self._open.line, self._open.line_kind = [], code
        elif code == _LINE_END and self._open.line is not None:
            self._open.lines[self._open.line_kind].append(np.concatenate([np.empty(0, "<u2"), *self._open.line]))
            self._open.line = None
        elif code in (_EXPOSURE_START, _EXPOSURE_END):
            self._open.moments_us.setdefault(code, t_us)
        elif code == _END:
            self._finish(self._open, t_us, frames)

    def _abandon(self) -> None:
        self.incomplete += self._open is not None
        self._open = None

    def _data(self, words: Words) -> None:
        if self._open is None or not len(words):
            return
        if self._open.line is not None:
            self._open.line.append(words[words & _KIND == _SAMPLE] & 0xFFF)
        elif not self._open.lines[_RESET]:
            self._head(words)

    def _head(self, words: Words) -> None:
        """Take in exposure and region, which come before the first line."""
        assert self._open is not None
        misc10 = words[words & 0xFC00 == _MISC10]
        self._open.exposure += (misc10 & 0x3FF).tolist()
        roi = words[np.isin(words & 0xFF00, (_MISC8 | 0x100, _MISC8 | 0x200))]
        self._open.roi_bytes += (roi & 0xFF).tolist()

    def _finish(self, frame: _Open, end_us: int, frames: list[FrameRead]) -> None:
        self._open = None
        picture = self._picture(frame, end_us)
        if picture is None:
            self.incomplete += 1
        else:
            frames.append(picture)

    def _picture(self, frame: _Open, end_us: int) -> FrameRead | None:
        if len(frame.roi_bytes) != 8 or len(frame.exposure) != 3 or len(frame.moments_us) != 2:
            return None
        left, top, right, bottom = (high << 8 | low for high, low in zip(*[iter(frame.roi_bytes)] * 2, strict=True))
        shape = (bottom - top + 1, right - left + 1) if self._turned else (right - left + 1, bottom - top + 1)
        reads = [_array(frame.lines[kind], shape) for kind in (_RESET, _SIGNAL)]
        if reads[0] is None or reads[1] is None:
            return None
        reset, signal = (read if self._turned else read.T for read in reads if read is not None)
        exposure = sum(part << 10 * k for k, part in enumerate(frame.exposure))
        return FrameRead(
            frame.start_us, frame.moments_us[_EXPOSURE_START], frame.moments_us[_EXPOSURE_END], end_us, exposure,
            frame.global_shutter, (left, top, right, bottom), self.resets, reset, signal,
        )  # fmt: skip


def _array(lines: list[Words], shape: tuple[int, int]) -> Words | None:
    """Return lines as an array (lines, samples); None where they do not fill `shape`."""
    if len(lines) != shape[0] or any(len(line) != shape[1] for line in lines):
        return None
    return np.stack(lines)

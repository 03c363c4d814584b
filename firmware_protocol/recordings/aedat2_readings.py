"""Frames and samples of an inertial unit as records of AEDAT 2.0.

    address of a read of a pixel:   31 = 1   30..22 y   21..12 x   11..10 read: 0 reset, 1 signal   9..0 ADC value
    address of a sample's value:    31 = 1   30..28 index   27..12 the value, signed   11..10 = 3   9..0 zero

A sample is seven records in a row: acceleration x, y, z (8192 a g), temperature (340 a degree, from 35 degrees on),
rate of turning x, y, z (65.5 a degree per second). A frame is the reset reads of its pixels and their signal reads; a
pixel's brightness is their difference. Its exposure begins with the last reset read, or with the first one if reset and
signal reads alternate (rolling shutter), and ends with the first signal read. Columns count from the left here, unlike
those of events, rows from the bottom.
of events, rows from the bottom.

Sources: jAER, IMUSample.java, DavisBaseCamera.java (DavisEventExtractor); docs.inivation.com, "AEDAT 2.0".
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from firmware_protocol.recordings.part import IMU, Frame, ImuRecords, ten_bits

__all__ = ["WORD", "FrameWords", "ImuWords", "Words", "frame_words", "imu_words"]

WORD = np.dtype([("address", "<u4"), ("t", "<u8")], align=True)
"""An address, and its time, us, which does not wrap."""

Words = npt.NDArray[np.void]
"""An array of WORD records, shape (n,)."""

_OTHER, _IMU, _SIGNAL = 1 << 31, 3 << 10, 1 << 10
_VALUES = (
    *(f"accelerometer_{axis}" for axis in "xyz"), "temperature", *(f"gyroscope_{axis}" for axis in "xyz"),
)  # fmt: skip
_PER_UNIT = np.array([8192.0] * 3 + [340.0] + [65.5] * 3)
_OFFSET = np.array([0.0] * 3 + [35.0] + [0.0] * 3)
_RESET_DN = 1023  # of every pixel: brightness is the difference alone
_LEAST_RESET_DN = 384  # hosts treat lower ones as saturated pixels


def imu_words(imu: ImuRecords) -> Words:
    """Return the words of samples (n,) IMU, (7 n,) WORD; values beyond 4 g and 500 deg/s are cut."""
    if not len(imu):
        return np.empty(0, WORD)
    counts = (np.stack([imu[name] for name in _VALUES], 1) - _OFFSET) * _PER_UNIT
    raw = np.clip(np.rint(counts), -32768, 32767).astype(np.int64) & 0xFFFF
    words = np.empty(raw.size, WORD)
    words["address"] = (_OTHER | _IMU | np.arange(7) << 28 | raw << 12).ravel()
    words["t"] = np.repeat(imu["t"], 7)
    return words


def frame_words(frame: Frame, height: int) -> tuple[Words, Words]:
    """Return the words of the reset reads and of the signal reads of a frame, of a sensor with `height` rows."""
    rows, columns = frame.pixels.shape[:2]
    x = frame.origin[0] + np.arange(columns)
    y = height - 1 - frame.origin[1] - np.arange(rows)
    address = (_OTHER | y[:, None] << 22 | x << 12).ravel()
    reset, signal = np.empty(rows * columns, WORD), np.empty(rows * columns, WORD)
    reset["address"], reset["t"] = address | _RESET_DN, frame.exposure_begin_us
    signal["address"] = address | _SIGNAL | (_RESET_DN - ten_bits(frame).ravel().astype(np.int64))
    signal["t"] = frame.exposure_end_us
    return reset, signal


class ImuWords:
    """Decoder of words into samples.

    Attributes
    ----------
    others : words that belong to no complete sample.
    """

    def __init__(self) -> None:
        self._rest = np.empty(0, WORD)
        self.others = 0

    def decode(self, words: Words) -> ImuRecords:
        """Return the samples (n,) IMU that the next words complete."""
        words = np.concatenate([self._rest, words])
        code = (words["address"].astype(np.int64) >> 28) & 7
        starts = np.flatnonzero(code == 0)
        starts = starts[starts + 7 <= len(words)]
        whole = (code[starts[:, None] + np.arange(7)] == np.arange(7)).all(1)
        at = starts[whole][:, None] + np.arange(7)
        self._rest = words[int(at[-1, -1]) + 1 if len(at) else 0 :][-6:]
        self.others += len(words) - len(self._rest) - at.size
        return _samples(words[at])


def _samples(words: Words) -> ImuRecords:
    """Return the samples of words (n, 7)."""
    raw = ((words["address"].astype(np.int64) >> 12) & 0xFFFF).astype(np.uint16).view(np.int16)
    values = raw / _PER_UNIT + _OFFSET
    imu = np.zeros(len(words), IMU)
    imu["t"] = words["t"][:, 0]
    for k, name in enumerate(_VALUES):
        imu[name] = values[:, k]
    return imu


class FrameWords:
    """Decoder of words into frames, of a sensor of `size` = (width, height): whole frames or rectangles of them.

    Attributes
    ----------
    others : words that belong to no complete frame, and those of reads that are neither reset nor signal.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._waiting = np.empty(0, WORD)
        self.others = 0

    def decode(self, words: Words) -> tuple[Frame, ...]:
        """Return the frames that the next words complete."""
        read = (words["address"] >> 10) & 3
        self.others += int(np.count_nonzero(read > 1))
        return tuple(self._frames(words[read <= 1]))

    def _frames(self, words: Words) -> Iterator[Frame]:
        waiting = np.concatenate([self._waiting, words]) if len(words) else self._waiting
        while len(waiting):
            skipped = int(np.argmin(_is_signal(waiting)))  # signal reads without reset reads before them
            skipped = len(waiting) if _is_signal(waiting)[skipped] else skipped
            waiting, self.others = waiting[skipped:], self.others + skipped
            end = _end_of_frame(waiting)
            if not end:
                break
            frame = self._frame(waiting[:end])
            self.others += 0 if frame is not None else end
            waiting = waiting[end:]
            if frame is not None:
                yield frame
        if len(waiting) > 4 * self._size[0] * self._size[1]:  # reads are missing
            self.others += len(waiting)
            waiting = waiting[:0]
        self._waiting = waiting

    def _frame(self, words: Words) -> Frame | None:
        """Return the frame of its words; None if these are no rectangle within the sensor."""
        address, signal = words["address"].astype(np.int64), _is_signal(words)
        x, y = (address >> 12) & 0x3FF, self._size[1] - 1 - ((address >> 22) & 0x1FF)
        left, top, right, bottom = int(x.min()), int(y.min()), int(x.max()), int(y.max())
        shape = (bottom - top + 1, right - left + 1)
        if top < 0 or right >= self._size[0] or 2 * shape[0] * shape[1] != len(words):
            return None
        reset_dn, signal_dn = np.full(shape, -1, np.int64), np.full(shape, -1, np.int64)
        for values, which in ((reset_dn, ~signal), (signal_dn, signal)):
            values[y[which] - top, x[which] - left] = address[which] & 0x3FF
        if min(int(reset_dn.min()), int(signal_dn.min())) < 0:  # a pixel was read twice, and another one not at all
            return None
        pixels = np.clip(reset_dn - signal_dn, 0, 1023)
        pixels[(reset_dn < _LEAST_RESET_DN) | (signal_dn == 0)] = 1023
        begin_us, end_us = _exposure(words["t"][~signal], words["t"][signal])
        return Frame(begin_us, begin_us, end_us, pixels.astype(np.uint16), (left, top))


def _is_signal(words: Words) -> npt.NDArray[np.bool_]:
    signal: npt.NDArray[np.bool_] = (words["address"] & _SIGNAL) != 0
    return signal


def _end_of_frame(words: Words) -> int:
    """Return the number of words with as many signal reads as reset reads; 0 if there are not as many yet."""
    open_reads = np.cumsum(np.where(_is_signal(words), -1, 1))
    ends = np.flatnonzero(open_reads == 0)
    return int(ends[0]) + 1 if len(ends) else 0


def _exposure(reset_t: npt.NDArray[np.uint64], signal_t: npt.NDArray[np.uint64]) -> tuple[int, int]:
    """Return begin and end of the exposure; both shutters end it with the first signal read."""
    end_us = int(signal_t[0])
    is_global = int(reset_t[-1]) <= end_us
    return int(reset_t[-1] if is_global else reset_t[0]), end_us

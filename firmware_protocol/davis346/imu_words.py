"""IMU samples in a DAVIS346's stream: counts of the converters to words, and back.

    special 5        start
    misc8, code 3    scale   7 accelerometer, 6 gyroscope, 5 temperature is there
                             3..2 range of the accelerometer, 2 g * 2^n   1..0 of the gyroscope, 250 deg/s * 2^n
    misc8, code 0    upper and lower byte of each count, signed 16 bits: accelerometer x, y, z, temperature,
                     gyroscope x, y, z; what is not there is left out
    special 7        end; its time is that of the sample

    acceleration, g       count * 4 * 2^range / 65536
    rate, deg/s           count * 500 * 2^range / 65536
    temperature, C        count / 340 + 35 (unit 1)    count / 333.87 + 21 (unit 2)

Source: the parsers of libcaer 3.3.15 (davis.c) and neuromorphic-drivers 0.16.1. A sample whose bytes are not as many
as its scale says is dropped by libcaer, and by this reader, which counts it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.imu_samples import IMU_SAMPLE, ImuSamples

__all__ = ["IMU_READ", "ImuReader", "imu_words", "is_imu"]

IMU_READ = np.dtype([("sample", IMU_SAMPLE), ("resets", "<u4")])
"""A sample in device time, and how many timestamp resets came before it."""

Words = npt.NDArray[np.uint16]

_WORD = np.dtype("<u2")
_RESET, _START, _END = 1, 5, 7
_SCALE, _DATA = 0x5300, 0x5000
_HIGH_BYTE = 0xFF00
_GROUPS = ((7, slice(0, 3)), (5, slice(3, 4)), (6, slice(4, 7)))


def imu_words(sample: ImuSamples) -> Words:
    """Return the words of one sample, (1,) IMU_SAMPLE, without its time."""
    scale, counts = int(sample["scale"][0]), sample["counts"][0]
    there = np.concatenate([counts[group] for _, group in _present(scale)] or [np.empty(0, np.int16)])
    data = there.astype(">i2").view(np.uint8)
    return np.concatenate(
        [[np.uint16(_START), np.uint16(_SCALE | scale)], data.astype(_WORD) | _WORD.type(_DATA), [np.uint16(_END)]]
    ).astype(_WORD)


def _present(scale: int) -> list[tuple[int, slice]]:
    return [(bit, group) for bit, group in _GROUPS if scale >> bit & 1]


def is_imu(words: Words) -> npt.NDArray[np.bool_]:
    """Return which words tell of an IMU sample."""
    kind = words & _HIGH_BYTE
    found: npt.NDArray[np.bool_] = (words == _START) | (words == _END) | (kind == _SCALE) | (kind == _DATA)
    return found


class ImuReader:
    """Reads the words of IMU samples, keeping what it has between pieces.

    Attributes
    ----------
    resets : timestamp resets seen so far.
    broken : samples that ended too early or too late, or that another one began in.
    """

    def __init__(self) -> None:
        self._scale: int | None = None
        self._data = bytearray()
        self._open = False
        self.broken = self.resets = 0

    def feed(self, words: Words, times_us: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
        """Return the samples that end in `words` (n,), at device times (n,); (m,) IMU_READ. Other words are skipped.

        A timestamp reset ends a sample, as in libcaer.
        """
        found: list[tuple[tuple[int, int, list[int]], int]] = []
        wanted = is_imu(words) | (words == _RESET)
        for word, time_us in zip(words[wanted].tolist(), times_us[wanted].tolist(), strict=True):
            if word in (_START, _RESET):
                self.broken += self._open
                self._begin(word == _START)
                self.resets += word == _RESET
            elif word == _END:
                found.extend((sample, self.resets) for sample in self._ended(time_us))
            elif word & _HIGH_BYTE == _SCALE:
                self._scale = word & 0xFF
            else:
                self._data.append(word & 0xFF)
        return np.array(found, IMU_READ)

    def _begin(self, is_open: bool) -> None:
        self._open, self._scale = is_open, None
        self._data.clear()

    def _ended(self, time_us: int) -> list[tuple[int, int, list[int]]]:
        """Return the sample that ends now, if it is whole."""
        scale, data, was_open = self._scale, bytes(self._data), self._open
        self._begin(False)
        if was_open and scale is not None:
            groups = [group for _, group in _present(scale)]
            if len(data) == 2 * sum(group.stop - group.start for group in groups):
                return [(time_us, scale, _counts(data, groups))]
        self.broken += 1
        return []


def _counts(data: bytes, groups: list[slice]) -> list[int]:
    counts, numbers = [0] * 7, iter(np.frombuffer(data, ">i2").tolist())
    for group in groups:
        for k in range(group.start, group.stop):
            counts[k] = next(numbers)
    return counts

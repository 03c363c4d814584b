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

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["IMU_SAMPLE", "PHYSICAL", "THERMOMETERS", "ImuReader", "ImuSamples", "ImuScale", "imu_words", "is_imu", "no_samples", "physical"]

IMU_SAMPLE = np.dtype([("t", "<u8"), ("scale", "u1"), ("counts", "<i2", 7)])
"""Device time of the end word in us, scale byte, counts as above; 0 for what is not there."""

ImuSamples = npt.NDArray[np.void]
"""An array of IMU_SAMPLE records, shape (n,)."""

PHYSICAL = np.dtype([("t", "<u8"), ("acceleration_g", "<f8", 3), ("temperature_c", "<f8"), ("rate_deg_s", "<f8", 3)])

Words = npt.NDArray[np.uint16]

_WORD = np.dtype("<u2")
_START, _END = 5, 7
_SCALE, _DATA = 0x5300, 0x5000
_HIGH_BYTE = 0xFF00
THERMOMETERS = {1: (340.0, 35.0), 2: (333.87, 21.0)}
_GROUPS = ((7, slice(0, 3)), (5, slice(3, 4)), (6, slice(4, 7)))


@dataclass(frozen=True)
class ImuScale:
    """The scale byte: which groups are there, and the ranges, 0 to 3."""

    accelerometer: bool = True
    gyroscope: bool = True
    temperature: bool = True
    accelerometer_range: int = 1
    gyroscope_range: int = 1

    def __int__(self) -> int:
        there = self.accelerometer << 7 | self.gyroscope << 6 | self.temperature << 5
        return there | (self.accelerometer_range & 3) << 2 | self.gyroscope_range & 3

    @classmethod
    def parse(cls, byte: int) -> ImuScale:
        """Read the byte; bit 4 is not used."""
        return cls(bool(byte & 0x80), bool(byte & 0x40), bool(byte & 0x20), byte >> 2 & 3, byte & 3)

    @property
    def acceleration_g(self) -> float:
        """One count of the accelerometer, g."""
        return (4 << self.accelerometer_range) / 65536

    @property
    def rate_deg_s(self) -> float:
        """One count of the gyroscope, deg/s."""
        return (500 << self.gyroscope_range) / 65536


def no_samples(n: int = 0) -> ImuSamples:
    """Return an array of `n` zeroed samples."""
    return np.zeros(n, IMU_SAMPLE)


def imu_words(sample: np.void) -> Words:
    """Return the words of one IMU_SAMPLE, without its time."""
    scale = int(sample["scale"])
    there = np.concatenate([sample["counts"][group] for _, group in _present(scale)] or [np.empty(0, np.int16)])
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


def physical(samples: ImuSamples, unit: int = 2) -> npt.NDArray[np.void]:
    """Return samples in g, degrees Celsius and deg/s, (n,) PHYSICAL, as a driver converts them; `unit` is its TYPE."""
    out = np.zeros(len(samples), PHYSICAL)
    scale = samples["scale"].astype(np.int64)
    counts = samples["counts"].astype(np.float64)
    steepness, offset = THERMOMETERS[unit]
    out["t"] = samples["t"]
    out["acceleration_g"] = counts[:, :3] * (4.0 * 2.0 ** (scale >> 2 & 3) / 65536)[:, None]
    out["temperature_c"] = counts[:, 3] / steepness + offset
    out["rate_deg_s"] = counts[:, 4:] * (500.0 * 2.0 ** (scale & 3) / 65536)[:, None]
    return out


class ImuReader:
    """Reads the words of IMU samples, keeping what it has between pieces.

    Attributes
    ----------
    broken : samples that ended too early or too late, or that another one began in.
    """

    def __init__(self) -> None:
        self._scale: int | None = None
        self._data = bytearray()
        self._open = False
        self.broken = 0

    def reset(self) -> None:
        """Forget an unfinished sample, as libcaer does at a timestamp reset."""
        self.broken += self._open
        self._begin(False)

    def feed(self, words: Words, times_us: npt.NDArray[np.int64]) -> ImuSamples:
        """Return the samples that end in `words` (n,), which are all of them `is_imu`, at device times (n,)."""
        found: list[tuple[int, int, list[int]]] = []
        for word, time_us in zip(words.tolist(), times_us.tolist(), strict=True):
            if word == _START:
                self.reset()
                self._begin(True)
            elif word == _END:
                found.extend(self._ended(time_us))
            elif word & _HIGH_BYTE == _SCALE:
                self._scale = word & 0xFF
            else:
                self._data.append(word & 0xFF)
        return np.array(found, IMU_SAMPLE)

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

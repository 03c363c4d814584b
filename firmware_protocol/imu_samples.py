"""Samples of an inertial measurement unit, as its converters count them, and the host's settings of the unit.

                      units 1 and 2                  unit 3
acceleration, g       count * 4 * 2^range / 65536    the same
rate, deg/s           count * 500 * 2^range / 65536  count * 2000 / 2^range / 32768
temperature, C        count / 340 + 35 (unit 1), / 333.87 + 21 (unit 2), / 512 + 23 (unit 3)

Unit 1 is an MPU-6050, 2 an MPU-9250 or MPU-6500, both of a DAVIS346; 3 a BMI160, of a DVXplorer. The scale byte has the
parts in bits 7 (accelerometer), 6 (gyroscope) and 5 (temperature); the ranges are in bits 3..2 and 1..0 for units 1 and
2, in bits 4..3 and 2..0 for unit 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

BMI160 = 3
"""Number of the unit of a DVXplorer."""

THERMOMETERS = {1: (340.0, 35.0), 2: (333.87, 21.0), BMI160: (512.0, 23.0)}
"""Counts a degree, and the temperature of count 0, by the unit."""

AXES_ON_THE_WIRE = (1, 0, 2, 3, 5, 4, 6)
"""Order of the counts in which a DVXplorer sends them: y, x, z of each group. It is its own inverse."""

IMU_SAMPLE = np.dtype([("t", "<u8"), ("scale", "u1"), ("counts", "<i2", 7)])
"""Time in us, scale byte, counts of accelerometer x, y, z, temperature, gyroscope x, y, z; 0 for an absent group."""

PHYSICAL = np.dtype([("t", "<u8"), ("acceleration_g", "<f8", 3), ("temperature_c", "<f8"), ("rate_deg_s", "<f8", 3)])
"""Time in us; g, degrees Celsius, deg/s."""

ImuSamples = npt.NDArray[np.void]
"""An array of IMU_SAMPLE records, shape (n,)."""


@dataclass(frozen=True)
class ImuScale:
    """The scale byte of a unit: the groups that are present, and the ranges, 0 to 3; a BMI160's gyroscope 0 to 4."""

    accelerometer: bool = True
    gyroscope: bool = True
    temperature: bool = True
    accelerometer_range: int = 1
    gyroscope_range: int = 1
    unit: int = 2

    def __int__(self) -> int:
        present = self.accelerometer << 7 | self.gyroscope << 6 | self.temperature << 5
        shift, mask = _RANGES[self.unit == BMI160]
        return present | (self.accelerometer_range & 3) << shift | self.gyroscope_range & mask

    @classmethod
    def parse(cls, byte: int, unit: int = 2) -> ImuScale:
        """Read the byte of a unit."""
        shift, mask = _RANGES[unit == BMI160]
        return cls(bool(byte & 0x80), bool(byte & 0x40), bool(byte & 0x20), byte >> shift & 3, byte & mask, unit)

    @property
    def acceleration_g(self) -> float:
        """One count of the accelerometer, g."""
        return (4 << self.accelerometer_range) / 65536

    @property
    def rate_deg_s(self) -> float:
        """One count of the gyroscope, deg/s."""
        if self.unit == BMI160:
            return 2000 / (1 << self.gyroscope_range) / 32768
        return (500 << self.gyroscope_range) / 65536


_RANGES = {False: (2, 3), True: (3, 7)}
"""Place of the accelerometer's range, and mask of the gyroscope's, of units 1 and 2, and of a BMI160."""


def no_samples(n: int = 0) -> ImuSamples:
    """Return an array of `n` zeroed samples."""
    return np.zeros(n, IMU_SAMPLE)


@dataclass(frozen=True)
class ImuSettings:
    """Settings of the unit in the host's registers, in whole numbers.

    Attributes
    ----------
    run : True if samples are requested now.
    unit : 1: MPU-6050, 2: MPU-9250 or MPU-6500, 3: BMI160.
    scale : the scale byte: the groups that run, and the ranges.
    accelerometer_mhz, gyroscope_mhz : bandwidths, thousandths of a hertz.
    per_ms : samples of the unit's output a millisecond, before `divider`, 1 or more.
    """

    run: bool = False
    unit: int = 0
    scale: int = 0
    accelerometer_mhz: int = 0
    gyroscope_mhz: int = 0
    per_ms: int = 1
    divider: int = 1

    def takes(self, index: int) -> bool:
        """Return true if the unit delivers a sample at millisecond `index`, at least 1, of its clock."""
        return index * self.per_ms // self.divider > (index - 1) * self.per_ms // self.divider


def physical(samples: ImuSamples, unit: int = 2) -> npt.NDArray[np.void]:
    """Return samples in g, degrees Celsius and deg/s, (n,) PHYSICAL, as a driver converts them; `unit` is its TYPE.

    A group that is absent in its sample is 0, the temperature too: while a driver starts the unit register by register,
    it first gets samples of the accelerometer alone.
    """
    out = np.zeros(len(samples), PHYSICAL)
    scale = samples["scale"].astype(np.int64)
    counts = samples["counts"].astype(np.float64)
    steepness, offset = THERMOMETERS[unit]
    out["t"] = samples["t"]
    shift, mask = _RANGES[unit == BMI160]
    of_gyroscope = 2000.0 / 2.0 ** (scale & mask) / 32768 if unit == BMI160 else 500.0 * 2.0 ** (scale & mask) / 65536
    out["acceleration_g"] = counts[:, :3] * (4.0 * 2.0 ** (scale >> shift & 3) / 65536)[:, None]
    out["temperature_c"] = np.where(scale & 0x20, counts[:, 3] / steepness + offset, 0.0)
    out["rate_deg_s"] = counts[:, 4:] * of_gyroscope[:, None]
    return out

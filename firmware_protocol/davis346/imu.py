"""The IMU of a DAVIS346: an InvenSense unit behind module 3, from what its elements feel to counts.

Registers of module 3 (see `registers`):

    2, 3, 4 run accelerometer, gyroscope, temperature   5 divider of the sample rate
    6, 9 low-pass of accelerometer, gyroscope (unit 1: 6 is for both)   7, 10 range, 2 g and 250 deg/s * 2^n

    low-pass, Hz             0      1      2     3     4     5     6     7
    unit 1  accelerometer    260    184    94    44    21    10    5     260
            gyroscope        256 *  188    98    42    20    10    5     256 *
    unit 2  accelerometer    218.1  218.1  99    44.8  21.2  10.2  5.05  420
            gyroscope        250 *  184    92    41    20    10    5     3600 *

Source: libcaer 3.3.15 (davis.h), which quotes InvenSense's register maps. The sample rate is 1 kHz / (1 + divider), and
8 kHz / (1 + divider) at * but never above 1 kHz: the bus to the unit does not carry more than some 2 kHz, and the
motion comes at 1 kHz. Unit 7 of the MPU-6050 is reserved, and taken as 0.

The filter is a Butterworth low-pass of two poles at 1 kHz; the data sheet gives only bandwidths and delays. With the
drivers' default (1) white noise gets a correlation from sample to sample of 0.72 for the gyroscope and 0.65 for the
accelerometer; a real DAVIS346 had 0.72 and 0.52. Its delay at low frequencies is 1.2 ms at 184 Hz; the data sheet tells
2.9 ms, so a part of the real delay is left out. Registers act from the next sample on; a filter that is changed or
switched on starts settled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.imu_words import THERMOMETERS, ImuSamples, ImuScale, no_samples
from firmware_protocol.davis346.registers import Module, RegisterFile
from firmware_protocol.imu_motion import ImuMotion

__all__ = ["Imu", "ImuSettings", "UnitType"]

UnitType = Literal[0, 1, 2]
"""0: there is none; 1: MPU-6050; 2: MPU-9250 or MPU-6500."""

_G_M_S2 = 9.80665
_RATE_HZ = 1000.0
_BANDWIDTHS_HZ = {
    1: ((260, 184, 94, 44, 21, 10, 5, 260), (256, 188, 98, 42, 20, 10, 5, 256)),
    2: ((218.1, 218.1, 99, 44.8, 21.2, 10.2, 5.05, 420), (250, 184, 92, 41, 20, 10, 5, 3600)),
}

_UNFILTERED_GYROSCOPE = (0, 7)

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ImuSettings:
    """What the registers ask for.

    Attributes
    ----------
    scale
        What runs, and the ranges.
    accelerometer_hz, gyroscope_hz
        Bandwidths.
    per_ms
        Samples of the unit's output a millisecond, before `divider`, 1 or more.
    """

    scale: ImuScale
    accelerometer_hz: float
    gyroscope_hz: float
    per_ms: int
    divider: int

    @classmethod
    def of(cls, values: RegisterFile) -> ImuSettings | None:
        """Read the registers; None where there is no unit or nothing of it runs."""
        kind, _, accelerometer, gyroscope, temperature, divider, low_pass = (
            values.read(Module.IMU, k) for k in range(7)
        )
        if kind not in _BANDWIDTHS_HZ or not (accelerometer or gyroscope or temperature):
            return None
        of_gyroscope = values.read(Module.IMU, 9) & 7 if kind == 2 else low_pass & 7
        ranges = values.read(Module.IMU, 7) & 3, values.read(Module.IMU, 10) & 3
        accelerometer_hz, gyroscope_hz = _BANDWIDTHS_HZ[kind]
        return cls(
            ImuScale(bool(accelerometer), bool(gyroscope), bool(temperature), *ranges),
            accelerometer_hz[low_pass & 7],
            gyroscope_hz[of_gyroscope],
            8 if of_gyroscope in _UNFILTERED_GYROSCOPE else 1,
            1 + (divider & 0xFF),
        )

    def takes(self, index: int) -> bool:
        """Say whether the unit gives a sample at millisecond `index`, at least 1, of its clock."""
        return index * self.per_ms // self.divider > (index - 1) * self.per_ms // self.divider


class Imu:
    """The unit. Motion goes in, samples in counts come out.

    Parameters
    ----------
    unit
        1 or 2, see `UnitType`; 0: nothing comes out.
    """

    def __init__(self, unit: int) -> None:
        self._unit = unit
        self._filter: _LowPass | None = None
        self.taken = 0
        """Motion records that were used or passed over, all of those offered."""

    def samples(self, motion: ImuMotion, settings: ImuSettings | None) -> ImuSamples:
        """Return the samples that `motion`, (n,) IMU_MOTION in order, leads to, (m <= n,) IMU_SAMPLE in its time."""
        self.taken += len(motion)
        if settings is None:
            self._filter = None
            return no_samples()
        taken: list[np.void] = []
        for one in motion:
            felt = np.concatenate([one["force"], one["rate"]])
            felt = self._filtered(felt, settings)
            if settings.takes(int(one["index"])):
                taken.append(self._converted(one, felt, settings.scale))
        return np.array(taken, no_samples().dtype)

    def _filtered(self, felt: Floats, settings: ImuSettings) -> Floats:
        bandwidths = settings.accelerometer_hz, settings.gyroscope_hz
        if self._filter is None or self._filter.bandwidths_hz != bandwidths:
            self._filter = _LowPass(bandwidths, felt)
        return self._filter.step(felt)

    def _converted(self, one: np.void, felt: Floats, scale: ImuScale) -> np.void:
        steepness, offset = THERMOMETERS[self._unit]
        there = [scale.accelerometer] * 3 + [scale.temperature] + [scale.gyroscope] * 3
        counts = np.concatenate(
            [
                felt[:3] / _G_M_S2 / scale.acceleration_g,
                [(float(one["temperature"]) - offset) * steepness],
                np.degrees(felt[3:]) / scale.rate_deg_s,
            ]
        )
        sample = no_samples(1)
        sample["t"], sample["scale"] = one["t"], int(scale)
        sample["counts"] = np.where(there, np.clip(np.rint(counts), -32768, 32767), 0)
        return sample[0]  # type: ignore[no-any-return]


class _LowPass:
    """A Butterworth low-pass of two poles for six signals at 1 kHz, settled at `start`; from half the rate on, nothing.

    Source: the bilinear transform with the corner kept (Oppenheim and Schafer, Discrete-Time Signal Processing, 7.1).
    """

    def __init__(self, bandwidths_hz: tuple[float, float], start: Floats) -> None:
        self.bandwidths_hz = bandwidths_hz
        b, a1, a2 = np.repeat([_coefficients(hz) for hz in bandwidths_hz], 3, axis=0).T
        self._b, self._a1, self._a2 = b, a1, a2
        bypassed = b == 1.0
        self._twice = np.where(bypassed, 0.0, 2.0)
        self._once = np.where(bypassed, 0.0, 1.0)
        self._s2 = (self._once * b - a2) * start
        self._s1 = (self._twice * b - a1) * start + self._s2

    def step(self, x: Floats) -> Floats:
        """Return what comes out as `x`, (6,), goes in."""
        y = self._b * x + self._s1
        self._s1 = self._twice * self._b * x - self._a1 * y + self._s2
        self._s2 = self._once * self._b * x - self._a2 * y
        return np.asarray(y)


def _coefficients(bandwidth_hz: float) -> tuple[float, float, float]:
    """Return b0 (b1 = 2 b0, b2 = b0), a1 and a2; (1, 0, 0) for what the rate cannot limit."""
    if bandwidth_hz >= _RATE_HZ / 2:
        return 1.0, 0.0, 0.0
    k = math.tan(math.pi * bandwidth_hz / _RATE_HZ)
    norm = 1 + math.sqrt(2) * k + k * k
    return k * k / norm, 2 * (k * k - 1) / norm, (1 - math.sqrt(2) * k + k * k) / norm

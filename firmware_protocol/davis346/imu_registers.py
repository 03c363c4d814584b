"""What module 3 asks of the inertial unit: which parts run, ranges, low-pass filters, sample rate.

    2, 3, 4 run accelerometer, gyroscope, temperature   5 divider of the sample rate
    6, 9 low-pass of accelerometer, gyroscope (unit 1: 6 is for both)   7, 10 range, 2 g and 250 deg/s * 2^n

    low-pass, Hz             0      1      2     3     4     5     6     7
    unit 1  accelerometer    260    184    94    44    21    10    5     260
            gyroscope        256 *  188    98    42    20    10    5     256 *
    unit 2  accelerometer    218.1  218.1  99    44.8  21.2  10.2  5.05  420
            gyroscope        250 *  184    92    41    20    10    5     3600 *

Source: libcaer 3.3.15 (davis.h), which quotes InvenSense's register maps. The sample rate is 1 kHz / (1 + divider), and
8 kHz / (1 + divider) at * but here never above 1 kHz; the bus to the real unit carries some 2 kHz at most. Value 7 of
unit 1 is reserved, and taken as 0.
"""

from __future__ import annotations

from firmware_protocol.davis346.registers import Module, RegisterFile
from firmware_protocol.imu_samples import ImuScale, ImuSettings

__all__ = ["driver_imu_settings", "imu_settings"]

_BANDWIDTHS_MHZ = {
    1: (
        (260_000, 184_000, 94_000, 44_000, 21_000, 10_000, 5_000, 260_000),
        (256_000, 188_000, 98_000, 42_000, 20_000, 10_000, 5_000, 256_000),
    ),
    2: (
        (218_100, 218_100, 99_000, 44_800, 21_200, 10_200, 5_050, 420_000),
        (250_000, 184_000, 92_000, 41_000, 20_000, 10_000, 5_000, 3_600_000),
    ),
}
_UNFILTERED_GYROSCOPE = (0, 7)
_DRIVER_LOW_PASS = 1  # libcaer 3.3.15, davis.c


def imu_settings(values: RegisterFile, *, words: bool) -> ImuSettings:
    """Return what the registers ask; `words`: whether the data path runs."""
    unit, _, accelerometer, gyroscope, temperature, divider, low_pass = (values.read(Module.IMU, k) for k in range(7))
    if unit not in _BANDWIDTHS_MHZ:
        return ImuSettings()
    of_gyroscope = (values.read(Module.IMU, 9) if unit == 2 else low_pass) & 7
    ranges = values.read(Module.IMU, 7) & 3, values.read(Module.IMU, 10) & 3
    accelerometer_mhz, gyroscope_mhz = _BANDWIDTHS_MHZ[unit]
    return ImuSettings(
        run=words and bool(accelerometer or gyroscope or temperature),
        unit=unit,
        scale=int(ImuScale(bool(accelerometer), bool(gyroscope), bool(temperature), *ranges)),
        accelerometer_mhz=accelerometer_mhz[low_pass & 7],
        gyroscope_mhz=gyroscope_mhz[of_gyroscope],
        per_ms=8 if of_gyroscope in _UNFILTERED_GYROSCOPE else 1,
        divider=1 + (divider & 0xFF),
    )


def driver_imu_settings(unit: int) -> ImuSettings:
    """Return what drivers ask of unit 1 or 2 by default: all of it, 1 kHz, low-pass 1, 4 g and 500 deg/s."""
    accelerometer_mhz, gyroscope_mhz = (bandwidths[_DRIVER_LOW_PASS] for bandwidths in _BANDWIDTHS_MHZ[unit])
    return ImuSettings(True, unit, int(ImuScale()), accelerometer_mhz, gyroscope_mhz)

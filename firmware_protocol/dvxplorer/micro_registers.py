"""Registers of a DVXplorer Micro with firmware 10, as declared data, and the settings that they hold.

Values have eight bytes; the firmware hides the sensor chip (module 5) behind module 1:

    3   run                          4   polarity: 0 both, 1 all are ON, 2 ON only, 3 OFF only
    5, 6   sub-sampling of columns, rows, the codes of `filters`
    8, 9, 10   global hold, reset, skip        11, 12   time-out of a buffer on, us
    13   rate of the read-out: 0-3 constant 100, 200, 500, 1000; 4-6 constant, lossy 2000, 5000, 10000;
         7-10 variable 2000, 5000, 10000, 15000 a second
    14, 15   contrast threshold ON, OFF, 0 to 17
    16, 17, 18   area block x, y; a write to 18 makes it send events (0) or not (1)
    19-22   crop: x, y, width, height in the user's frame; a write to 23 applies them
    24, 25   flips

Module 3 is that of a DVXplorer with the BMI160's own codes of rates and ranges. Power-on values are those that
dv-processing 2.0.4 writes.

Inferred: an area block has 32 x 32 pixels, and 1 blocks it; the period of a scan at a rate is that of the registers
that dv-processing writes for this rate to a DVXplorer. Flips, global hold, reset and the time-out are registers only.

With firmware below 10 a Micro has the registers of a DVXplorer (`registers`).

Source: register traffic of dv-processing 2.0.4.
"""

from __future__ import annotations

from collections.abc import Iterator

from firmware_protocol.dvxplorer.registers import SIZE, imu_settings_of
from firmware_protocol.fx3.registers import (
    Access,
    Module,
    Register,
    RegisterFile,
    Rows,
    SystemInfo,
    declare,
    imu_type_registers,
    system_registers,
)
from firmware_protocol.imu_samples import BMI160, ImuSettings

RUN, POLARITY, SUBSAMPLING, RATE, THRESHOLDS = 3, 4, 5, 13, 14
BLOCK_AREA, CROP, APPLY_CROP = 18, 19, 23

_DVS: Rows = (
    (RUN, "RUN", 0),
    (POLARITY, "POLARITY", 0, 2),
    (SUBSAMPLING, "SUBSAMPLING_HORIZONTAL", 0, 3),
    (SUBSAMPLING + 1, "SUBSAMPLING_VERTICAL", 0, 3),
    (8, "GLOBAL_HOLD", 1),
    (9, "GLOBAL_RESET", 0),
    (10, "GLOBAL_RESET_SKIP", 0),
    (11, "TIMEOUT", 1),
    (12, "TIMEOUT_US", 2000, 32),
    (RATE, "READOUT_RATE", 8, 4),
    (THRESHOLDS, "CONTRAST_THRESHOLD_ON", 9, 5),
    (THRESHOLDS + 1, "CONTRAST_THRESHOLD_OFF", 9, 5),
    (16, "AREA_BLOCK_X", 0, 5),
    (17, "AREA_BLOCK_Y", 0, 4),
    (BLOCK_AREA, "AREA_BLOCK", 0),
    (CROP, "CROP_X", 0, 10),
    (CROP + 1, "CROP_Y", 0, 10),
    (CROP + 2, "CROP_WIDTH", SIZE[0], 10),
    (CROP + 3, "CROP_HEIGHT", SIZE[1], 10),
    (APPLY_CROP, "CROP_APPLY", 0),
    (24, "FLIP_HORIZONTAL", 0),
    (25, "FLIP_VERTICAL", 0),
)

_IMU: Rows = (
    (2, "RUN_ACCELEROMETER", 0),
    (3, "RUN_GYROSCOPE", 0),
    (4, "RUN_TEMPERATURE", 0),
    (5, "ACCELEROMETER_RATE", 11, 4),
    (6, "ACCELEROMETER_FILTER", 2, 2),
    (7, "ACCELEROMETER_RANGE", 5, 4),
    (8, "GYROSCOPE_RATE", 11, 4),
    (9, "GYROSCOPE_FILTER", 2, 2),
    (10, "GYROSCOPE_RANGE", 2, 3),
)

_SCANS_US = (10_000.0, 5_000.0, 2_000.0, 1_000.0, 500.0, 200.0, 100.0, 499.0, 199.0, 99.6, 65.0)
"""Period of a scan by the rate, us: `registers.scan_us` of the values that dv-processing writes to a DVXplorer."""

_ACCELEROMETER_RANGES = {3: 0, 5: 1, 8: 2, 12: 3}
_SLOWEST_ACCELEROMETER, _SLOWEST_GYROSCOPE = 5, 6  # codes of 12.5 and of 25 Hz


def micro_registers(system: SystemInfo, imu_unit: int = 0) -> Iterator[Register]:
    """Yield every register of firmware 10; `imu_unit`: 0 none, 3 BMI160."""
    fixed = Access.READ_ONLY
    frame: Rows = ((0, "SIZE_COLUMNS", SIZE[0]), (1, "SIZE_ROWS", SIZE[1]), (2, "ORIENTATION", 0))
    yield from declare(Module.DVS, frame, fixed)
    yield from declare(Module.DVS, _DVS)
    yield from imu_type_registers(imu_unit)
    yield from declare(Module.IMU, _IMU)
    yield from system_registers(system)


def micro_scan_us(values: RegisterFile) -> float:
    """Return the period of a scan without events, us; that of the fastest rate for unknown ones."""
    return _SCANS_US[min(values.read(Module.DVS, RATE), len(_SCANS_US) - 1)]


def micro_imu_settings(values: RegisterFile, *, words: bool) -> ImuSettings:
    """Return the settings in the registers; `words`: true while the data path runs."""
    unit, _, *codes = (values.read(Module.IMU, k) for k in range(11))
    if unit != BMI160:
        return ImuSettings()
    codes[3] = min(max(codes[3] - _SLOWEST_ACCELEROMETER, 0), 7)
    codes[5] = _ACCELEROMETER_RANGES.get(codes[5], 0)  # the chip takes others as 2 g
    codes[6] = min(max(codes[6] - _SLOWEST_GYROSCOPE, 0), 7)
    return imu_settings_of(codes, words=words)

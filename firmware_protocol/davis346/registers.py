"""The registers of the DAVIS family as declared data, and their settings; `fx3.registers` has those of all models.

Source: libcaer 3.3.15 (davis.h), neuromorphic-drivers 0.16.1, register traffic of three drivers. Widths are those of
the published logic's configuration records (DVSAER, APSADC, IMU, Multiplexer, FX3 and ChipBiasConfigRecords with these
addresses; ExtInput of an older one): coordinates have 9 bits for this array, times 20 bits in cycles (exposure 22,
frame interval 23) and as many more as the clock's MHz take.

Capability registers describe this model. The presence of the background activity filter is a setting
(`Davis346Settings.activity_filter`): libcaer and neuromorphic_drivers switch that filter on if it exists, and the host
then does not get isolated events. The APS size and shutter registers describe the chip even if the camera takes no
frames (`Davis346Settings.frames`), because drivers take their image size from them.

Frames: the registers of module 2; times in cycles of the ADC's clock.

Inertial unit: the registers of module 3 select its parts, ranges, low-pass filters and sample rate.

    2, 3, 4 run accelerometer, gyroscope, temperature   5 divider of the sample rate
    6, 9 low-pass of accelerometer, gyroscope (unit 1: 6 is for both)   7, 10 range, 2 g and 250 deg/s * 2^n

    low-pass, Hz             0      1      2     3     4     5     6     7
    unit 1  accelerometer    260    184    94    44    21    10    5     260
            gyroscope        256 *  188    98    42    20    10    5     256 *
    unit 2  accelerometer    218.1  218.1  99    44.8  21.2  10.2  5.05  420
            gyroscope        250 *  184    92    41    20    10    5     3600 *

Source: libcaer 3.3.15 (davis.h), which quotes InvenSense's register maps. The sample rate is 1 kHz / (1 + divider), and
8 kHz / (1 + divider) at *, but never above 1 kHz here; the bus to the real unit carries some 2 kHz at most. Value 7 of
unit 1 is reserved, and read as 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum

from firmware_protocol.davis346.model import DAVIS346, DavisModel
from firmware_protocol.frames import FrameSettings
from firmware_protocol.fx3.registers import (
    Access,
    Module,
    Register,
    RegisterFile,
    Rows,
    SystemInfo,
    declare,
    shared_registers,
)
from firmware_protocol.imu_samples import ImuScale, ImuSettings


class Layout(Enum):
    """Relation between the array's coordinates and the user's.

    UPRIGHT: the chip's frame is the user's. TURNED: as in the real chip, turned by 90 degrees, with the invert bit (2)
    of the orientation register set; row words carry the user's x, column words the user's y.
    """

    UPRIGHT = 0
    TURNED = 4

    @property
    def turned(self) -> bool:
        """True if rows and columns are swapped."""
        return self is Layout.TURNED


class Statistic(Enum):
    """A 64-bit counter: (module, address of its upper word); the lower word follows it."""

    MUX_EXTINPUT_DROPPED = (Module.MULTIPLEXER, 81)
    MUX_DVS_DROPPED = (Module.MULTIPLEXER, 83)
    DVS_ROWS = (Module.DVS, 81)
    DVS_COLUMNS = (Module.DVS, 83)
    DVS_DROPPED = (Module.DVS, 85)
    DVS_FILTERED_PIXELS = (Module.DVS, 87)
    DVS_FILTERED_BACKGROUND_ACTIVITY = (Module.DVS, 89)
    DVS_FILTERED_REFRACTORY = (Module.DVS, 91)


_DVS: Rows = (
    (3, "RUN", 0),
    (4, "WAIT_ON_STALL", 0),
    (5, "EXTERNAL_AER_CONTROL", 0),
    (31, "BACKGROUND_ACTIVITY_FILTER", 0),
    (32, "BACKGROUND_ACTIVITY_TIME_250US", 8, 12),
    (33, "REFRACTORY_FILTER", 0),
    (34, "REFRACTORY_TIME_250US", 1, 12),
    (51, "SKIP", 0),
    (52, "SKIP_EVERY", 5, 8),
    (61, "POLARITY_FLATTEN", 0),
    (62, "POLARITY_SUPPRESS", 0),
    (63, "POLARITY_SUPPRESS_TYPE", 0),
)

_DVS_CAPABILITIES: Rows = (
    (10, "HAS_PIXEL_FILTER", 1),
    (40, "HAS_ROI_FILTER", 1),
    (50, "HAS_SKIP_FILTER", 1),
    (60, "HAS_POLARITY_FILTER", 1),
)

_APS: Rows = (
    (4, "RUN", 0),
    (5, "WAIT_ON_STALL", 1),
    (7, "GLOBAL_SHUTTER", 1),
)

_IMU: Rows = (
    (2, "RUN_ACCELEROMETER", 0),
    (3, "RUN_GYROSCOPE", 0),
    (4, "RUN_TEMPERATURE", 0),
    (5, "SAMPLE_RATE_DIVIDER", 0, 8),
    (6, "ACCELEROMETER_LOW_PASS", 1, 3),
    (7, "ACCELEROMETER_FULL_SCALE", 1, 2),
    (9, "GYROSCOPE_LOW_PASS", 1, 3),
    (10, "GYROSCOPE_FULL_SCALE", 1, 2),
)


def _geometry(size: tuple[int, int], layout: Layout) -> Iterator[Register]:
    """Sizes in the chip's frame (read only); regions and hot pixels in the user's."""
    columns, rows = size[::-1] if layout.turned else size
    frame: Rows = ((0, "SIZE_COLUMNS", columns), (1, "SIZE_ROWS", rows), (2, "ORIENTATION", layout.value))
    for module in (Module.DVS, Module.APS):
        yield from declare(module, frame, Access.READ_ONLY, "chip's frame; orientation bit 2: turned")
    width, height = size
    x_bits, y_bits = width.bit_length(), height.bit_length()
    for module, first in ((Module.DVS, 41), (Module.APS, 8)):
        region: Rows = (
            (first, "ROI_START_COLUMN", 0, x_bits),
            (first + 1, "ROI_START_ROW", 0, y_bits),
            (first + 2, "ROI_END_COLUMN", width - 1, x_bits),
            (first + 3, "ROI_END_ROW", height - 1, y_bits),
        )
        yield from declare(module, region, note="user's frame, inclusive")
    for k in range(8):
        row, column = (
            (11 + 2 * k, f"HOT_PIXEL_{k}_ROW", height, y_bits),
            (12 + 2 * k, f"HOT_PIXEL_{k}_COLUMN", width, x_bits),
        )
        yield from declare(Module.DVS, (row, column), note="user's frame; just outside = off")


def registers(
    size: tuple[int, int],
    layout: Layout,
    info: SystemInfo,
    imu_unit: int = 0,
    *,
    activity_filter: bool = False,
    model: DavisModel = DAVIS346,
) -> Iterator[Register]:
    """Yield every register of a camera with a (width, height) array; `imu_unit`: 0 none, 1 MPU-6050, 2 MPU-9250."""
    for register in _of_the_family(size, layout, info, imu_unit, activity_filter):
        if model.has(register.module, register.address):
            yield register
    for bias in model.biases:
        yield Register(Module.BIAS, bias.address, bias.name, int(bias.default), note=str(bias.default), bits=bias.bits)
    yield from declare(Module.BIAS, model.chip)


def _of_the_family(
    size: tuple[int, int], layout: Layout, info: SystemInfo, imu_unit: int, activity_filter: bool
) -> Iterator[Register]:
    """Yield the registers other than those of module 5."""
    fixed = Access.READ_ONLY
    adc = info.adc_clock_mhz
    times: Rows = (
        (12, "EXPOSURE", 4000 * adc, 22 + adc.bit_length()),
        (13, "FRAME_INTERVAL", 50000 * adc, 23 + adc.bit_length()),
    )
    yield from shared_registers(info, imu_unit, Statistic, drops_events_on_stall=True)
    yield from _geometry(size, layout)
    yield from declare(Module.DVS, _DVS)
    yield from declare(Module.DVS, _DVS_CAPABILITIES, fixed)
    yield from declare(Module.DVS, ((30, "HAS_BACKGROUND_ACTIVITY_FILTER", int(activity_filter)),), fixed)
    yield from declare(Module.APS, _APS)
    yield from declare(Module.APS, ((3, "COLOUR_FILTER", 0), (6, "HAS_GLOBAL_SHUTTER", 1)), fixed)
    yield from declare(Module.APS, times, note="ADC clock cycles")
    yield from declare(Module.IMU, _IMU)


_RUN = 4
_WAIT_ON_STALL = 5
_GLOBAL_SHUTTER = 7
_ROI = 8
_EXPOSURE = 12
_INTERVAL = 13


def lines_wait(values: RegisterFile) -> bool:
    """Return true if lines that find no room wait for it."""
    return bool(values.read(Module.APS, _WAIT_ON_STALL))


def frame_settings(values: RegisterFile, size: tuple[int, int], layout: Layout, *, words: bool) -> FrameSettings:
    """Return the frame settings in the registers; `words`: true while the data path runs.

    The region of interest is cut to the array of `size` = (width, height); an empty one gives no frames.
    """
    aps = [values.read(Module.APS, k) for k in range(14)]
    first_column, first_row, last_column, last_row = aps[_ROI : _ROI + 4]
    last_column, last_row = min(last_column, size[0] - 1), min(last_row, size[1] - 1)
    empty = first_column > last_column or first_row > last_row
    kilohertz = max(values.read(Module.SYSTEM, 4), 1) * max(values.read(Module.SYSTEM, 6), 1)
    exposure_ns, interval_ns = (cycles * 1_000_000 // kilohertz for cycles in (aps[_EXPOSURE], aps[_INTERVAL]))
    run = words and bool(aps[_RUN]) and not empty
    return FrameSettings(
        run, bool(aps[_GLOBAL_SHUTTER]), not layout.turned, aps[_EXPOSURE], exposure_ns, interval_ns,
        first_column, first_row, last_column, last_row,
    )  # fmt: skip


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
    """Return the settings in the registers; `words`: true while the data path runs."""
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
    """Return the drivers' settings for unit 1 or 2: all parts, 1 kHz, low-pass 1, 4 g, 500 deg/s."""
    accelerometer_mhz, gyroscope_mhz = (bandwidths[_DRIVER_LOW_PASS] for bandwidths in _BANDWIDTHS_MHZ[unit])
    return ImuSettings(True, unit, int(ImuScale()), accelerometer_mhz, gyroscope_mhz)

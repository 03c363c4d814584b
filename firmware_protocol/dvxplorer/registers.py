"""A DVXplorer's registers, as declared data, and the settings that they hold.

    module  0 multiplexer   1 DVS   3 IMU   4 external input   5 sensor chip   6 system information   9 USB

Modules 0, 4, 6 and 9 are those of all models (`fx3.registers`), and so are the rules for writes: a write to a
register that does not exist, or that is read-only, is ignored, and a read of one that does not exist gives 0.

Registers of the sensor chip are one byte wide; longer values take consecutive addresses, the high byte first:

    000B 000C 000D 000F-0015 0018 001C 001E   biases, see below
    3000   mode: 0 off, 1 monitor, 2 stream
    3067   format: bit 7 groups in pairs, 6 all events are ON, 5 ON events only, 4 OFF events only
    3200   bit 2 no sub-sampling, bit 1 no area blocking        3202 binning
    3204   sub-sampling: bits 2..0 of columns, 5..3 of rows
    3205   twenty words: area blocking
    323C-3262   times of the read-out, see `scan_us`
    3300-3308   crop, see `filters`

Power-on values are those that dv-processing 2.0.4 writes when it opens the camera: the chip's own are not public.

Period of a scan, from the table of rates that dv-processing writes: inferred, as it gives each of its rates,

    (1000 x [3240] + [3241-42]) us + ([325D-5E] / 50 us if [325C], else 640 x [3261-62] / 50 us)

Inertial unit (BMI160), registers of module 3:

    2, 3, 4 run accelerometer, gyroscope, temperature
    5, 6, 7 rate (12.5 Hz x 2^n), filter, range (2 g x 2^n) of the accelerometer
    8, 9, 10 rate (25 Hz x 2^n), filter, range (2000 / 2^n deg/s) of the gyroscope

    3 dB bandwidth at filter 2 ("normal"), Hz, by rate register
    accelerometer   5.06   10.12   20.25   40.5   80     162     324     684
    gyroscope       10.7   20.8    39.9    74.6   136.6  254.6   523.9   890
    Filters 1 and 0 (oversampling) have a half and a quarter of it.

Source: Bosch's data sheet of the BMI160, from memory, with halves and quarters as approximations. The camera sends
samples at the faster of the two rates that run, at most 1 kHz here: inferred.

Sources: libcaer 3.3.15 (dvxplorer.h, dvxplorer.c), neuromorphic-drivers 0.16.1, register traffic of three drivers.

The effect of the registers on the sensor is a set of factors on the parameters at dv-processing's default words:

    threshold_on     1 + STEP x (v_on - 9)      v_on  = ON current, 0 to 8, + 9 in the larger range (0x0B bit 1)
    threshold_off    1 + STEP x (v_off - 9)     v_off = 8 - OFF current, + 9 at the lower level (0x12 bit 1 is 0)

dv-processing writes such levels, 0 to 17, default 9 (observed), and libcaer's five presets of sensitivity fit the same
scale: very low 15 and 15, low 12 and 12, default 9 and 9, high 5 and 5, very high 2 and 2. A larger level is a higher
threshold.

No threshold in physical units is public. Basis of the model, all of it assumed: the two ranges of a current are a
factor of ten apart (5 and 50 uA, libcaer 3.3.15, dvxplorer.h) and nine steps go through one; a step is then a tenth of
a decade, and the threshold of a change detector rises with the logarithm of its current, F ln(I / I_d) with F = 0.0714
(jAER for a DAVIS, which cites IEEE 7962235). So a step is F ln(10) / 9 = 0.0183 ln units, 7.3 % of the preset's 0.25.

The period of a scan is proportional to that of the registers (`registers.scan_us`); at their power-on values the factor
is 1.

The other bias registers have no effect here: `without_effect` names them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from firmware_protocol.device import LEAST_FACTOR, MOST_FACTOR
from firmware_protocol.fx3.registers import (
    Access,
    Module,
    Register,
    RegisterFile,
    Rows,
    RunGate,
    SystemInfo,
    declare,
    shared_registers,
)
from firmware_protocol.imu_samples import BMI160, ImuScale, ImuSettings

SIZE = (640, 480)
CHIP_ID = 20
SYSTEM = SystemInfo(chip_id=CHIP_ID, adc_clock_mhz=0, logic_patch=4)
_ORIENTATION = 3
"""Both axes are flipped: libcaer and dv-processing then agree in the coordinates of the cropper."""

_STREAM = 2


class Chip:
    """Addresses of chip registers that have an effect. Plain numbers, because they are also bases of ranges."""

    MODE = 0x3000
    FORMAT = 0x3067
    DIGITAL = 0x3200
    SUBSAMPLING = 0x3204
    AREA = 0x3205
    EXPOSURE = 0x3240
    FIXED_READ = 0x325C
    READ_INTERVAL = 0x325D
    NEXT_COLUMN = 0x3261
    CROP_OFF = 0x3300


class ChipStatistic(Enum):
    """A 64-bit counter: (module, address of its upper word); the lower word follows it."""

    MUX_EXTINPUT_DROPPED = (Module.MULTIPLEXER, 81)
    MUX_DVS_DROPPED = (Module.MULTIPLEXER, 83)
    DVS_COLUMNS = (Module.DVS, 81)
    DVS_GROUPS = (Module.DVS, 83)
    DVS_DROPPED_COLUMNS = (Module.DVS, 85)
    DVS_DROPPED_GROUPS = (Module.DVS, 87)


_IMU: Rows = (
    (2, "RUN_ACCELEROMETER", 0),
    (3, "RUN_GYROSCOPE", 0),
    (4, "RUN_TEMPERATURE", 0),
    (5, "ACCELEROMETER_RATE", 6, 3),
    (6, "ACCELEROMETER_FILTER", 2, 2),
    (7, "ACCELEROMETER_RANGE", 1, 2),
    (8, "GYROSCOPE_RATE", 5, 3),
    (9, "GYROSCOPE_FILTER", 2, 2),
    (10, "GYROSCOPE_RANGE", 2, 3),
)

AREA_WORDS = 20
_NAMED_READOUT = frozenset((0x3242, 0x3251, 0x3255, 0x325D, 0x325E, 0x3262))

_CHIP: tuple[tuple[int, str, int], ...] = (
    (0x000B, "CURRENT_RANGES", 0x06),
    (0x000C, "CURRENT_RANGES_LOGA_LOGD", 0x14),
    (0x000D, "TRIM", 0x24),
    *((address, f"BIAS_PIN_{name}", 0) for address, name in ((0x0F, "DBGP"), (0x10, "DBGN"), (0x15, "DOB"))),
    (0x0012, "LEVELS", 0x7D),
    (0x0013, "BIAS_PIN_BUFP", 0x03),
    (0x0014, "BIAS_PIN_BUFN", 0x7F),
    (0x0018, "CURRENT_AMPLIFIER", 4),
    (0x001C, "CURRENT_ON", 0),
    (0x001E, "CURRENT_OFF", 8),
    (Chip.MODE, "MODE", 0),
    (0x3011, "CLOCK_DIVIDER", 0xA0),
    (0x3019, "PARALLEL_OUT_CONTROL", 0),
    (0x301E, "PARALLEL_OUT_ENABLE", 1),
    (Chip.FORMAT, "PACKET_FORMAT", 0x80),
    (Chip.DIGITAL, "DIGITAL", 2),
    (0x3201, "READOUT_ENGINE", 1),
    (0x3202, "BINNING", 0),
    (Chip.SUBSAMPLING, "SUBSAMPLING", 0),
    *((Chip.AREA + 2 * k, f"AREA_BLOCKING_{k}_UPPER", 0x7F) for k in range(AREA_WORDS)),
    *((Chip.AREA + 2 * k + 1, f"AREA_BLOCKING_{k}_LOWER", 0xFF) for k in range(AREA_WORDS)),
    (0x3234, "TIME_SUB_UNIT", 49),
    (0x3235, "TIME_REFERENCE_UNIT_UPPER", 0x03),
    (0x3236, "TIME_REFERENCE_UNIT_LOWER", 0xE7),
    (0x3238, "TIMESTAMP_RESET", 0),
    *((address, f"READOUT_{address:04X}", 0) for address in range(0x323C, 0x3263) if address not in _NAMED_READOUT),
    (0x3242, "READOUT_EXPOSURE_US_LOWER", 7),
    (0x3251, "READOUT_MAX_EVENTS", 10),
    (0x3255, "READOUT_GLOBAL_HOLD", 0x0D),
    (0x325D, "READOUT_INTERVAL_UPPER", 45000 >> 8),
    (0x325E, "READOUT_INTERVAL_LOWER", 45000 & 0xFF),
    (0x3262, "READOUT_NEXT_COLUMN_LOWER", 15),
    (Chip.CROP_OFF, "CROP_BYPASS", 1),
    (0x3301, "CROP_Y_START_GROUP", 0),
    (0x3302, "CROP_Y_START_MASK", 0xFF),
    (0x3303, "CROP_Y_END_GROUP", SIZE[1] // 8 - 1),
    (0x3304, "CROP_Y_END_MASK", 0xFF),
    (0x3305, "CROP_X_START_UPPER", 0),
    (0x3306, "CROP_X_START_LOWER", 0),
    (0x3307, "CROP_X_END_UPPER", SIZE[0] - 1 >> 8),
    (0x3308, "CROP_X_END_LOWER", SIZE[0] - 1 & 0xFF),
    *((address, f"ACTIVITY_DECISION_{address:04X}", int(address == 0x3500)) for address in range(0x3500, 0x3515)),
    (0x3600, "HISTOGRAM_OFF", 1),
)  # fmt: skip


def registers(system: SystemInfo = SYSTEM, imu_unit: int = 0) -> Iterator[Register]:
    """Yield every register; `imu_unit`: 0 none, 3 BMI160."""
    fixed = Access.READ_ONLY
    frame: Rows = ((0, "SIZE_COLUMNS", SIZE[0]), (1, "SIZE_ROWS", SIZE[1]), (2, "ORIENTATION", _ORIENTATION))
    yield from shared_registers(system, imu_unit, ChipStatistic, drops_events_on_stall=False)
    yield from declare(Module.DVS, frame, fixed, "events are in the user's frame whatever the orientation")
    yield from declare(Module.DVS, ((3, "RUN", 0),))
    yield from declare(Module.IMU, _IMU)
    for address, name, default in _CHIP:
        yield Register(Module.BIAS, address, name, default, bits=8)


def chip_of(values: RegisterFile) -> Callable[[int], int]:
    """Return a function that returns the chip's register at an address."""
    return lambda address: values.read(Module.BIAS, address)


def run_gate(values: RegisterFile) -> RunGate:
    """Return the run bits; events leave while the chip streams too."""
    gate = RunGate.of(values)
    return replace(gate, events=gate.events and values.read(Module.BIAS, Chip.MODE) == _STREAM)


_CLOCKS_PER_US = 50


def scan_us(values: RegisterFile) -> float:
    """Return the period of a scan without events, us, in the registers."""
    chip = chip_of(values)
    exposure_us = 1000 * chip(Chip.EXPOSURE) + _word(chip, Chip.EXPOSURE + 1)
    if chip(Chip.FIXED_READ) & 1:
        return exposure_us + _word(chip, Chip.READ_INTERVAL) / _CLOCKS_PER_US
    return exposure_us + SIZE[0] * _word(chip, Chip.NEXT_COLUMN) / _CLOCKS_PER_US


def _word(chip: Callable[[int], int], address: int) -> int:
    return chip(address) << 8 | chip(address + 1)


@dataclass(frozen=True)
class _Element:
    """Accelerometer or gyroscope: rate of code 0, in Hz, and bandwidths at filter 2, thousandths of a hertz."""

    slowest_hz: float
    bandwidths_mhz: tuple[int, ...]

    def rate_hz(self, code: int) -> float:
        """Return the rate of a code."""
        return self.slowest_hz * (1 << (code & 7))

    def bandwidth_mhz(self, code: int, oversampling: int) -> int:
        """Return the bandwidth at a rate and a filter."""
        return self.bandwidths_mhz[code & 7] >> 2 - min(oversampling, 2)


_ACCELEROMETER = _Element(12.5, (5_060, 10_120, 20_250, 40_500, 80_000, 162_000, 324_000, 684_000))
_GYROSCOPE = _Element(25.0, (10_700, 20_800, 39_900, 74_600, 136_600, 254_600, 523_900, 890_000))
_MOST_HZ = 1000.0
_SMALLEST_GYROSCOPE_RANGE = 4


def imu_settings(values: RegisterFile, *, words: bool) -> ImuSettings:
    """Return the settings in the registers; `words`: true while the data path runs."""
    if values.read(Module.IMU, 0) != BMI160:
        return ImuSettings()
    return imu_settings_of([values.read(Module.IMU, k) for k in range(2, 11)], words=words)


def imu_settings_of(codes: Sequence[int], *, words: bool) -> ImuSettings:
    """Return the settings of a BMI160 in nine numbers as those of registers 2 to 10 of module 3."""
    *parts, a_rate, a_filter, a_range, g_rate, g_filter, g_range = codes
    unit = BMI160
    accelerometer, gyroscope, temperature = map(bool, parts)
    rates = [_ACCELEROMETER.rate_hz(a_rate)] * accelerometer + [_GYROSCOPE.rate_hz(g_rate)] * gyroscope
    per_ms, divider = _rate(max(rates, default=_ACCELEROMETER.rate_hz(a_rate)))
    scale = ImuScale(accelerometer, gyroscope, temperature, a_range, min(g_range, _SMALLEST_GYROSCOPE_RANGE), unit)
    return ImuSettings(
        run=words and any(parts),
        unit=unit,
        scale=int(scale),
        accelerometer_mhz=_ACCELEROMETER.bandwidth_mhz(a_rate, a_filter),
        gyroscope_mhz=_GYROSCOPE.bandwidth_mhz(g_rate, g_filter),
        per_ms=per_ms,
        divider=divider,
    )


def _rate(hz: float) -> tuple[int, int]:
    """Return a rate as samples a millisecond, and the divider of their number: 800 Hz are 4 / 5."""
    if hz >= _MOST_HZ:
        return 1, 1
    doubled = round(2 * hz)  # of 12.5 Hz x 2^n, so whole
    return (doubled // 400, 5) if doubled >= 800 else (1, 2000 // doubled)


def driver_imu_settings(unit: int = BMI160) -> ImuSettings:
    """Return the drivers' settings: all parts, 800 Hz, 4 g, 500 deg/s."""
    values = RegisterFile(registers(imu_unit=unit))
    for address in (2, 3, 4):
        values.write(Module.IMU, address, 1)
    return imu_settings(values, words=True)


STEP = 0.073
_DEFAULT_LEVEL = 9
_DEFAULT_SCAN_US = 199.0  # of the registers' power-on values
_RANGE_LEVELS = 9
_MOST_CURRENT = 8

_RANGES = 0x0B
_LEVELS = 0x12
_ON = 0x1C
_OFF = 0x1E
_ON_RANGE, _OFF_LEVEL = 1 << 1, 1 << 1

_OTHERS = {
    "amplifier current": (0x18, 0xFF, 4),
    "logarithmic pixel and source follower ranges": (0x0B, 0x0D, 0x04),
    "logarithmic amplifier and digital ranges": (0x0C, 0xFF, 0x14),
    "source follower level": (0x12, 0x10, 0x10),
}
"""Register, bits and default of biases that are not modelled."""


def sensor_factors(chip: Callable[[int], int], scan_us: float) -> dict[str, float]:
    """Return the factors that are not 1, by sensor parameter; `chip` reads a chip register, `scan_us` is the period."""
    on = min(chip(_ON), _MOST_CURRENT) + _RANGE_LEVELS * bool(chip(_RANGES) & _ON_RANGE)
    off = _MOST_CURRENT - min(chip(_OFF), _MOST_CURRENT) + _RANGE_LEVELS * (not chip(_LEVELS) & _OFF_LEVEL)
    return level_factors(on, off, scan_us)


def level_factors(on: int, off: int, scan_us: float) -> dict[str, float]:
    """Return the factors that are not 1, by sensor parameter, of ON and OFF levels (0 to 17) and a period of a scan."""
    levels = {"threshold_on": on, "threshold_off": off}
    factors = {name: 1 + STEP * (v - _DEFAULT_LEVEL) for name, v in levels.items()}
    factors["scan_us"] = min(max(scan_us / _DEFAULT_SCAN_US, LEAST_FACTOR), MOST_FACTOR)
    return {name: factor for name, factor in factors.items() if factor != 1}


def without_effect(chip: Callable[[int], int]) -> dict[str, str]:
    """Return the biases that were changed without an effect here, each with the reason."""
    changed = [name for name, (address, bits, default) in _OTHERS.items() if (chip(address) ^ default) & bits]
    return dict.fromkeys(changed, "it is not modelled: its effect is not public")

"""USB device model of a DVXplorer Micro (CX3), 640 x 480: the camera of one chip, in the protocols of two firmwares.

    firmware   bcdDevice   opened by              registers                          runs while
    10         0x040A      dv-processing 2.0.4    below, eight bytes                 1.3 is 1
    9          0x0409      libcaer 3.3.15         those of a DVXplorer, four bytes   5.3000 is 2 ("stream")

Requests are those of a DVXplorer (`fx3.camera`), but firmware 10 has no multi-write, stalls registers of four bytes,
and has two more requests, without data: 0xC7 stores the registers in its flash memory, 0xC8 loads them from there.

It has no reset of its time, no external input and no master or slave. Events leave in frames (`frame_stream`); inertial
samples leave at the interrupt endpoint with firmware 10 only: no driver of firmware 9 that reads them is known.

dv-processing 1.7.9 cannot open it: it requests a reset of time, which its library refuses for this model.
neuromorphic_drivers has no reader of its words. Real strings and power are not public.

Values of registers have eight bytes in firmware 10, which hides the sensor chip (module 5) behind module 1:

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

Source: register traffic of dv-processing 2.0.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings
from firmware_protocol.dvxplorer.filters import ChipFilters, polarity_format, sampled
from firmware_protocol.dvxplorer.frame_stream import FrameStream, SampleOutput
from firmware_protocol.dvxplorer.registers import (
    SIZE,
    Chip,
    chip_of,
    imu_settings_of,
    level_factors,
    registers,
    sensor_factors,
)
from firmware_protocol.events import Mask
from firmware_protocol.fx3.camera import DEBUG_ENDPOINT, FLUSH, LOG_LEVEL, REGISTER
from firmware_protocol.fx3.registers import (
    Access,
    Module,
    Register,
    RegisterFile,
    Rows,
    RunGate,
    SystemInfo,
    declare,
    imu_type_registers,
    system_registers,
)
from firmware_protocol.imu_samples import BMI160, ImuSettings
from firmware_protocol.usb.device import RequestKind, SetupPacket, Stall, Transfer

_IN = 0x80
_NEW_FIRMWARE = 10
_REGISTER_BYTES = 8
_STORE, _LOAD = 0xC7, 0xC8
_STREAM = 2
_BLOCK = 32


@dataclass(frozen=True)
class DvxplorerMicroSettings(DvxplorerSettings):
    """Settings of a DVXplorer Micro.

    Attributes
    ----------
    bcd_device : low byte: firmware version, 10 for dv-processing 2, 9 for libcaer. High byte: 4, hardware with a CX3.
    has_frames : False: each time is a frame of its own; an event in the first microsecond gets the next one.
    """

    bcd_device: int = 0x040A
    product: str = "DVXplorer Micro"
    has_frames: bool = True

    @property
    def firmware(self) -> int:
        """Firmware version."""
        return self.bcd_device & 0xFF

    @property
    def has_new_firmware(self) -> bool:
        """True for firmware 10 and later."""
        return self.firmware >= _NEW_FIRMWARE

    def registers(self) -> Iterator[Register]:
        """Yield its registers."""
        if self.has_new_firmware:
            return micro_registers(self.system, self.imu_unit)
        return registers(self.system)  # without an inertial unit


class MicroFilters(ChipFilters):
    """Selection of events by firmware 10, in the user's frame."""

    def power_on(self) -> None:
        """Select the whole array."""
        self._area = np.ones(SIZE, np.bool_)
        self._crop = 0, 0, *SIZE

    def block_area(self, registers: RegisterFile) -> None:
        """Block or unblock the area in the registers."""
        x, y, is_blocked = (registers.read(Module.DVS, BLOCK_AREA - 2 + k) for k in range(3))
        self._area[x * _BLOCK : (x + 1) * _BLOCK, y * _BLOCK : (y + 1) * _BLOCK] = not is_blocked

    def apply_crop(self, registers: RegisterFile) -> None:
        """Select the region in the registers."""
        x, y, width, height = (registers.read(Module.DVS, CROP + k) for k in range(4))
        self._crop = x, y, x + width, y + height

    def follow(self, registers: RegisterFile, now_us: int) -> None:
        """Apply registers that were written at `now_us`."""
        self._format = polarity_format(registers.read(Module.DVS, POLARITY))
        self._columns, self._rows = (self._line(registers, axis) for axis in range(2))
        self._blocks = None if self._area.all() else self._area
        self._all_pixels = bool(self._columns.all() and self._rows.all()) and self._blocks is None

    def _line(self, registers: RegisterFile, axis: int) -> Mask:
        """Return a mask of the columns (axis 0) or rows that send events."""
        at = np.arange(SIZE[axis])
        inside: Mask = (at >= self._crop[axis]) & (at < self._crop[axis + 2])
        return inside & sampled(registers.read(Module.DVS, SUBSAMPLING + axis), SIZE[axis])


class DvxplorerMicro(Dvxplorer):
    """The camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    settings: DvxplorerMicroSettings

    def __init__(self, settings: DvxplorerMicroSettings | None = None) -> None:
        self._flash: dict[tuple[int, int], int] = {}
        super().__init__(settings or DvxplorerMicroSettings())

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Biases that hosts changed without an effect here, each with the reason."""
        return {} if self.settings.has_new_firmware else super().without_effect

    @property
    def scan_us(self) -> float:
        """Period of a scan without events, us, in the registers."""
        if not self.settings.has_new_firmware:
            return super().scan_us
        return _SCANS_US[min(self._registers.read(Module.DVS, RATE), len(_SCANS_US) - 1)]

    def restart_clock(self) -> bool:
        """Return false: it has no input that sets its clock."""
        return False

    def follow_reset(self, at_us: int) -> None:
        """Do nothing: see `restart_clock`."""

    def accepts(self, setup: SetupPacket) -> bool:
        """Return true if an OUT request is known and its data have the right length."""
        if not self.settings.has_new_firmware or setup.kind is not RequestKind.VENDOR:
            return super().accepts(setup)
        lengths = {REGISTER: _REGISTER_BYTES, FLUSH: 0, LOG_LEVEL: 0, _STORE: 0, _LOAD: 0}
        return setup.length == lengths.get(setup.request)

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """Take frames from endpoint 2, or an inertial sample from endpoint 1."""
        if endpoint | _IN != DEBUG_ENDPOINT:
            return super().read(endpoint, max_bytes)
        self._standard.require(endpoint | _IN)
        return self._taken(self._samples.take(max_bytes, self.epoch_us))

    def _make_parts(self) -> None:
        self._filters = MicroFilters(self._fates) if self.settings.has_new_firmware else ChipFilters(self._fates)
        self._filters.power_on()
        self._stream = self._frames = FrameStream(SIZE, self.settings.fifo_bytes)
        settings_in = micro_imu_settings if self.settings.has_new_firmware else lambda *_, **__: ImuSettings()
        has_imu = self.settings.imu_unit != 0
        self._readings = self._samples = SampleOutput(self._registers, self._fates, settings_in, has_imu=has_imu)

    def _counted(self) -> Mapping[Enum, int]:
        return {}  # it has no counters

    def _power_on(self) -> None:
        self._filters.power_on()
        super()._power_on()

    def _vendor_out(self, setup: SetupPacket, data: bytes) -> None:
        super()._vendor_out(setup, data)
        if setup.request == _STORE:
            self._flash = {key: self._registers.read(*key) for key in self._stored_keys()}
        elif setup.request == _LOAD:
            for (module, address), value in self._flash.items():
                self._write(module, address, value)

    def _stored_keys(self) -> Iterator[tuple[int, int]]:
        """Yield the registers that the flash memory has: all that can be written but the run bits."""
        runs = {(Module.DVS, RUN), *((Module.IMU, address) for address in (2, 3, 4))}
        for register in self._registers:
            if register.access is Access.READ_WRITE and (register.module, register.address) not in runs:
                yield register.module.value, register.address

    def _read_register(self, setup: SetupPacket) -> bytes:
        if not self.settings.has_new_firmware:
            return super()._read_register(setup)
        if setup.request != REGISTER or setup.length < _REGISTER_BYTES:
            raise Stall
        return self._registers.read(setup.value, setup.index).to_bytes(_REGISTER_BYTES, "big")

    def _write(self, module: int, address: int, value: int) -> None:
        self._registers.write(module, address, value)
        if isinstance(self._filters, MicroFilters) and module == Module.DVS:
            if address == BLOCK_AREA:
                self._filters.block_area(self._registers)
            elif address == APPLY_CROP:
                self._filters.apply_crop(self._registers)
        super()._write(module, address, value)
        if self.settings.has_new_firmware and module == Module.DVS:
            self._factors = self._factors_of_biases()

    def _factors_of_biases(self) -> Mapping[str, float]:
        if not self.settings.has_new_firmware:
            return sensor_factors(chip_of(self._registers), self.scan_us)
        on, off = (min(self._registers.read(Module.DVS, THRESHOLDS + k), 17) for k in range(2))
        return level_factors(on, off, self.scan_us)

    def _run_gate(self) -> RunGate:
        self._frames.period_us = self.scan_us if self.settings.has_frames else 0.0
        if self.settings.has_new_firmware:
            runs = bool(self._registers.read(Module.DVS, RUN))
        else:
            runs = chip_of(self._registers)(Chip.MODE) == _STREAM
        return RunGate(timestamps=runs, reset=False, words=runs, events=runs)


RUN = 3
POLARITY = 4
SUBSAMPLING = 5
RATE = 13
THRESHOLDS = 14
BLOCK_AREA = 18
CROP = 19
APPLY_CROP = 23

_DVS: Rows = (
    (RUN, "RUN", 0),
    (POLARITY, "POLARITY", 0, 2),
    (SUBSAMPLING, "SUBSAMPLING_HORIZONTAL", 0, 3),
    (SUBSAMPLING + 1, "SUBSAMPLING_VERTICAL", 0, 3),
    (8, "GLOBAL_HOLD", 1), (9, "GLOBAL_RESET", 0), (10, "GLOBAL_RESET_SKIP", 0),
    (11, "TIMEOUT", 1), (12, "TIMEOUT_US", 2000, 32), (RATE, "READOUT_RATE", 8, 4),
    (THRESHOLDS, "CONTRAST_THRESHOLD_ON", 9, 5), (THRESHOLDS + 1, "CONTRAST_THRESHOLD_OFF", 9, 5),
    (16, "AREA_BLOCK_X", 0, 5), (17, "AREA_BLOCK_Y", 0, 4), (BLOCK_AREA, "AREA_BLOCK", 0),
    (CROP, "CROP_X", 0, 10), (CROP + 1, "CROP_Y", 0, 10),
    (CROP + 2, "CROP_WIDTH", SIZE[0], 10), (CROP + 3, "CROP_HEIGHT", SIZE[1], 10), (APPLY_CROP, "CROP_APPLY", 0),
    (24, "FLIP_HORIZONTAL", 0), (25, "FLIP_VERTICAL", 0),
)  # fmt: skip

_IMU: Rows = (
    (2, "RUN_ACCELEROMETER", 0), (3, "RUN_GYROSCOPE", 0), (4, "RUN_TEMPERATURE", 0),
    (5, "ACCELEROMETER_RATE", 11, 4), (6, "ACCELEROMETER_FILTER", 2, 2), (7, "ACCELEROMETER_RANGE", 5, 4),
    (8, "GYROSCOPE_RATE", 11, 4), (9, "GYROSCOPE_FILTER", 2, 2), (10, "GYROSCOPE_RANGE", 2, 3),
)  # fmt: skip

_SCANS_US = (10_000.0, 5_000.0, 2_000.0, 1_000.0, 500.0, 200.0, 100.0, 499.0, 199.0, 99.6, 65.0)
"""Period of a scan by the rate, us, as `registers.scan_us` has it of dv-processing's values; unknown ones: the last."""

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


def micro_imu_settings(values: RegisterFile, *, words: bool) -> ImuSettings:
    """Return the settings in the registers; `words`: true while the data path runs."""
    unit, _, *codes = (values.read(Module.IMU, k) for k in range(11))
    if unit != BMI160:
        return ImuSettings()
    codes[3] = min(max(codes[3] - _SLOWEST_ACCELEROMETER, 0), 7)
    codes[5] = _ACCELEROMETER_RANGES.get(codes[5], 0)  # the chip takes others as 2 g
    codes[6] = min(max(codes[6] - _SLOWEST_GYROSCOPE, 0), 7)
    return imu_settings_of(codes, words=words)

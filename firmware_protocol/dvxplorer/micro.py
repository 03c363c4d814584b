"""USB device model of a DVXplorer Micro (CX3), 640 x 480: the camera of one chip, in the protocols of two firmwares.

    firmware   bcdDevice   opened by              registers                          runs while
    10         0x040A      dv-processing 2.0.4    `micro_registers`, eight bytes     1.3 is 1
    9          0x0409      libcaer 3.3.15         those of a DVXplorer, four bytes   5.3000 is 2 ("stream")

Requests are those of a DVXplorer (`fx3.camera`), but firmware 10 has no multi-write, stalls registers of four bytes,
and has two more requests, without data: 0xC7 stores the registers in its flash memory, 0xC8 loads them from there.

It has no reset of its time, no external input and no master or slave. Events leave in frames (`frame_stream`); inertial
samples leave at the interrupt endpoint with firmware 10 only: no driver of firmware 9 that reads them is known.

dv-processing 1.7.9 cannot open it: it requests a reset of time, which its library refuses for this model.
neuromorphic_drivers has no reader of its words. Real strings and power are not public.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from firmware_protocol.dvxplorer.biases import level_factors, sensor_factors
from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings
from firmware_protocol.dvxplorer.filters import ChipFilters, Mask, polarity_format, sampled
from firmware_protocol.dvxplorer.frame_stream import FrameStream, SampleOutput
from firmware_protocol.dvxplorer.micro_registers import (
    APPLY_CROP,
    BLOCK_AREA,
    CROP,
    POLARITY,
    RUN,
    SUBSAMPLING,
    THRESHOLDS,
    micro_imu_settings,
    micro_registers,
    micro_scan_us,
)
from firmware_protocol.dvxplorer.registers import SIZE, Chip, chip_of, registers, scan_us
from firmware_protocol.fx3.camera import FLUSH, LOG_LEVEL, REGISTER, Parts
from firmware_protocol.fx3.registers import Access, Module, Register, RegisterFile, RunGate, Statistics
from firmware_protocol.fx3.settings import DEBUG_ENDPOINT
from firmware_protocol.imu_samples import ImuSettings
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
    bcd_device
        Low byte: firmware version, 10 for dv-processing 2, 9 for libcaer. High byte: 4, hardware with a CX3.
    has_frames
        False: each time is a frame of its own, so that no event's time is changed.
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


class _NoStatistics(Statistics):
    """Statistics of a camera without counters."""

    def counted(self) -> Mapping[Enum, int]:
        return {}


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
        is_new = self.settings.has_new_firmware
        return micro_scan_us(self._registers) if is_new else scan_us(self._registers)

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

    def _make_parts(self) -> Parts:
        filters = MicroFilters(self._fates) if self.settings.has_new_firmware else ChipFilters(self._fates)
        filters.power_on()
        self._frames = FrameStream(SIZE, self.settings.fifo_bytes)
        settings_in = micro_imu_settings if self.settings.has_new_firmware else _no_imu
        self._samples = SampleOutput(self.settings, self._registers, self._fates, settings_in)
        return Parts(self._frames, filters, self._samples, _NoStatistics())

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
        for one in self._registers:
            if one.access is Access.READ_WRITE and (one.module, one.address) not in runs:
                yield one.module.value, one.address

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


def _no_imu(values: RegisterFile, *, words: bool) -> ImuSettings:
    """Return the settings of a camera without an inertial unit."""
    return ImuSettings()

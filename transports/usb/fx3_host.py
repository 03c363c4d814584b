"""Driver of iniVation's cameras with an FX3 on any `UsbHost`: the part that the models share.

The order of requests is that of dv-processing 2.0.4, which is the strictest of the known drivers:

    identify   configuration, serial number, system registers; refuse any other device, and other logic than 18
    stop       sources, multiplexer and USB off, chip last
    configure  biases and chip as dv-processing sets them, on-chip filters off, early packet delay (each model its own)
    queue      bulk transfers on endpoint 2
    start      chip, USB, timestamps, multiplexer, then the DVS
    reset      timestamps to zero, and wait for the reset in the stream: data before it are discarded

Register requests (vendor, device): 0xBF one register, wValue module, wIndex address, 4 bytes big-endian; 0xC2 several
registers, wValue their number, each u8 module, u8 address, u32 big-endian.
"""

from __future__ import annotations

import contextlib
import time
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from firmware_protocol.events import Events, empty_events
from firmware_protocol.fx3.camera import ENTRY, VENDOR_ID
from firmware_protocol.fx3.decoded import Decoded, FrameRead, WordFaults
from firmware_protocol.fx3.registers import Module
from firmware_protocol.imu_samples import ImuSamples, no_samples
from firmware_protocol.usb.device import SetupPacket
from transports.usb.host import (
    BulkReader,
    CameraHost,
    StallError,
    StreamSettings,
    TransferTimeout,
    UnsuitableDevice,
    UsbHost,
)

_STREAM_ENDPOINT = 2
_REGISTER = 0xBF
_REGISTERS = 0xC2
_LOG_LEVEL = 0xB1
_FLUSH = 0xC6
_LOGIC_VERSION = 18
_RESET_TIMEOUT_S = 5.0

Entry = tuple[Module, int, int]
"""(module, address, value)."""

_ENABLE_EDGES: tuple[Entry, ...] = tuple((Module.EXTERNAL_INPUT, address, 1) for address in (1, 2, 3, 0))
ENABLE_IMU: tuple[Entry, ...] = ((Module.IMU, 2, 1), (Module.IMU, 3, 1), (Module.IMU, 4, 1))
SOURCES_OFF: tuple[Entry, ...] = (
    *((Module.IMU, address, 0) for address in (2, 3, 4)),
    *((Module.EXTERNAL_INPUT, address, 0) for address in (0, 11)),
    *((Module.MULTIPLEXER, address, 0) for address in (0, 1)),
    (Module.USB, 0, 0),
    (Module.MULTIPLEXER, 3, 0),
)
"""Writes that end the stream, after the chip's own."""

_RESET_TIME: tuple[Entry, ...] = ((Module.MULTIPLEXER, 2, 1), (Module.MULTIPLEXER, 2, 0))


@dataclass(frozen=True)
class Fx3Info:
    """Identity that a camera reports. `size` is (width, height) in the user's frame."""

    serial: str
    firmware: int
    logic_version: int
    logic_patch: int
    chip_id: int
    usb_clock_mhz: int
    size: tuple[int, int]
    turned: bool
    timestamp_master: bool


class WordDecoder(Protocol):
    """Decoder of a camera's words."""

    faults: WordFaults

    def feed(self, data: bytes) -> Decoded:
        """Decode the next bytes of the stream."""
        ...


class Fx3Host(CameraHost[Fx3Info]):
    """Driver of one camera with iniVation's FX3.

    Raises UnsuitableDevice for another camera, or for firmware or logic that the known drivers refuse, and UsbHostError
    for any error of the host.

    Parameters
    ----------
    host : the device; it is closed with the driver, and when it cannot be used.

    Attributes
    ----------
    family : name of the cameras with this product number.
    product : product number of USB.
    firmware, patch : least versions of firmware and logic that the known drivers accept.
    stop_writes, start_writes : register writes that end and begin the stream.
    """

    family: ClassVar[str]
    product: ClassVar[int]
    firmware: ClassVar[int]
    patch: ClassVar[int]
    stop_writes: tuple[Entry, ...]
    start_writes: tuple[Entry, ...]
    _register_bytes = 4

    def __init__(self, host: UsbHost) -> None:
        super().__init__(host)
        self._held = empty_events()
        self._frames: list[FrameRead] = []
        self._keeps_edges = False
        self._imu: list[ImuSamples] = []
        self._keeps_imu = False
        self._decoder = self._new_decoder()

    @abstractmethod
    def _new_decoder(self) -> WordDecoder:
        """Return a decoder for a stream that begins now."""

    @abstractmethod
    def _configure(self) -> None:
        """Set the registers that are not run bits."""

    @property
    def faults(self) -> WordFaults:
        """Counts of words that an intact stream never contains, since the last start."""
        return self._decoder.faults

    def start(self, settings: StreamSettings | None = None) -> None:
        """Configure the camera and start its events; TransferTimeout without the timestamp reset within 5 s."""
        settings = settings or StreamSettings()
        self.stop()
        self._tolerated(_LOG_LEVEL, value=4)
        self._flush()
        self._configure()
        self.write_register(Module.USB, 1, settings.early_packet_us * self.info.usb_clock_mhz)
        self._decoder = self._new_decoder()
        self._edges = []
        self._keeps_edges = settings.edges
        self._frames = []
        self._imu, self._keeps_imu = [], settings.imu and self.read_register(Module.IMU, 0) != 0
        self._reader = self._host.stream(_STREAM_ENDPOINT, settings.transfer_bytes, settings.transfers)
        self._write_each(self.start_writes)
        if settings.edges:
            self._write_each(_ENABLE_EDGES)
        if self._keeps_imu:
            self._write_each(ENABLE_IMU)
        if settings.frames:
            self.write_register(Module.APS, 4, 1)
        if settings.reset_timestamps:
            self.write_registers(_RESET_TIME)
            self._held = self._after_reset(self._reader)

    def read(self, timeout_s: float) -> Events | None:
        """Return the events of the next transfer; the first ones are those after the timestamp reset."""
        if len(self._held):
            held, self._held = self._held, empty_events()
            return held
        return super().read(timeout_s)

    def take_frames(self) -> list[FrameRead]:
        """Return the frames read since the last call, if the start enabled them."""
        frames, self._frames = self._frames, []
        return frames

    def take_imu(self) -> ImuSamples:
        """Return the IMU samples since the last call, (n,) IMU_SAMPLE in device time, if the start enabled them."""
        samples, self._imu = self._imu, []
        return np.concatenate([no_samples(), *samples])

    def _decode(self, data: bytes) -> Events:
        decoded = self._decoder.feed(_whole_words(data))
        self._frames += decoded.frames
        if self._keeps_imu:
            self._imu.append(decoded.imu)
        if self._keeps_edges:
            self._edges.append(decoded.edges)
        return decoded.events

    def stop(self) -> Events:
        """Stop the camera; return the events that were still in transit."""
        remaining = super().stop()
        held, self._held = self._held, empty_events()
        return np.concatenate([held, remaining])

    def _end_stream(self) -> None:
        self._write_each(self.stop_writes)

    # Registers.

    def read_register(self, module: int, address: int) -> int:
        """Return one register. Raises UnsuitableDevice when the reply is too short."""
        octets = self._register_bytes
        data = self._host.control_in(SetupPacket(0xC0, _REGISTER, module, address, octets))
        if len(data) != octets:
            raise UnsuitableDevice(f"register {module}.{address} came with {len(data)} bytes, it has {octets}")
        return int.from_bytes(data, "big")

    def write_register(self, module: int, address: int, value: int) -> None:
        """Set one register."""
        octets = self._register_bytes
        self._host.control_out(SetupPacket(0x40, _REGISTER, module, address, octets), value.to_bytes(octets, "big"))

    def write_registers(self, entries: Iterable[Entry]) -> None:
        """Set several registers with one request."""
        data = b"".join(ENTRY.pack(*entry) for entry in entries)
        self._host.control_out(SetupPacket(0x40, _REGISTERS, len(data) // ENTRY.size, 0, len(data)), data)

    def _write_each(self, entries: Iterable[Entry]) -> None:
        for entry in entries:
            self.write_register(*entry)

    # Steps.

    def _identify(self) -> Fx3Info:
        identity = self._host.identity
        if (identity.vendor_id, identity.product_id) != (VENDOR_ID, self.product):
            expected = f"{self.family} ({VENDOR_ID:04x}:{self.product:04x})"
            raise UnsuitableDevice(f"{identity.vendor_id:04x}:{identity.product_id:04x} is not a {expected}")
        firmware = identity.bcd_device & 0xFF
        _require("firmware", firmware, firmware >= self.firmware, f"at least {self.firmware}")
        serial = self._serial()
        logic, patch = self.read_register(Module.SYSTEM, 0), self.read_register(Module.SYSTEM, 7)
        _require("logic", logic, logic == _LOGIC_VERSION, f"exactly {_LOGIC_VERSION}")
        _require("logic patch", patch, patch >= self.patch, f"at least {self.patch}")
        columns, rows, orientation = (self.read_register(Module.DVS, address) for address in range(3))
        turned = bool(orientation & 4)
        return Fx3Info(
            serial, firmware, logic, patch,
            chip_id=self.read_register(Module.SYSTEM, 1),
            usb_clock_mhz=self.read_register(Module.SYSTEM, 5),
            size=(rows, columns) if turned else (columns, rows),
            turned=turned,
            timestamp_master=bool(self.read_register(Module.SYSTEM, 2)),
        )  # fmt: skip

    def _serial(self) -> str:
        """Read string 3; empty when the device has none."""
        try:
            data = self._host.control_in(SetupPacket(0x80, 6, 0x0303, 0x0409, 255))
        except StallError:
            return ""
        return data[2 : data[0] if data else 0].decode("utf-16-le", "replace")

    def _flush(self) -> None:
        self._tolerated(_FLUSH)
        self._host.clear_halt(_STREAM_ENDPOINT)

    def _tolerated(self, request: int, value: int = 0) -> None:
        """Make a request that older firmware may refuse."""
        with contextlib.suppress(StallError):
            self._host.control_out(SetupPacket(0x40, request, value, 0, 0))

    def _after_reset(self, reader: BulkReader) -> Events:
        """Read until the timestamp reset; return the events after it."""
        deadline = time.monotonic() + _RESET_TIMEOUT_S
        while True:
            data = reader.read(max(0.0, deadline - time.monotonic()))
            if data is None:
                raise TransferTimeout(f"no timestamp reset in the stream within {_RESET_TIMEOUT_S:g} s")
            decoded = self._decoder.feed(_whole_words(data))
            if len(decoded.resets):
                after = decoded.since_reset()
                self._edges = [after.edges] if self._keeps_edges else []
                self._imu = [after.imu] if self._keeps_imu else []
                self._frames = list(after.frames)
                return after.events


def _whole_words(data: bytes) -> bytes:
    """Return a transfer without an odd byte at its end, which is damage: the camera sends whole words only."""
    return data[: len(data) & ~1]


def _require(part: str, version: int, good: bool, requirement: str) -> None:
    if not good:
        raise UnsuitableDevice(f"the camera has {part} version {version}; {requirement} is needed: update the camera")

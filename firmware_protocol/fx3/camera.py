"""Parts that iniVation's cameras with an FX3 share: vendor requests, registers, run gate, and the data endpoint.

Vendor requests, recipient device, 32-bit values big-endian (source: libcaer 3.3.15, traffic of drivers):

    0xBF  OUT  wValue module, wIndex parameter   4 bytes              write a register
    0xBF  IN   wValue module, wIndex parameter   4 bytes              read a register
    0xC2  OUT  wValue N                          N x (u8 module, u8 parameter, u32)   write N registers, in order
    0xB1  OUT  wValue level                      -                    log level, acknowledged
    0xC6  OUT                                    -                    flush the data path

Data of any other length stalls the request and writes nothing, not even the valid entries of a multi-write. Other
vendor requests (flash, FPGA load) stall.

Run gate: words leave while MUX RUN, TIMESTAMP_RUN, USB RUN and RUN_CHIP are 1; events need DVS RUN as well. Closing the
gate empties the FIFO. A change of TIMESTAMP_RUN to 1 starts device time at zero; a change of TIMESTAMP_RESET to 1 does
so too, and puts the reset word into the stream.

Edges offered to the external input go through its detectors and enter the stream in time order with the events. With
DROP_EXTINPUT_ON_STALL at 0, marks that find no room wait in that input's own FIFO, 8 deep, and get their time when they
leave it, as the multiplexer of the published logic does.

Readings (lines of frames, inertial samples) enter the stream likewise, each as a block of words. Lines that find no
room wait for it while WAIT_ON_STALL of the APS is 1; their time is then the time at which they leave.

A camera is not safe for concurrent use: one thread at a time may call it.

Sources of the settings: USB identity from libcaer 3.3.15 and three drivers' checks; endpoints from the published
firmware.

The model allows for two faults of drivers.

**neuromorphic_drivers loses the order of buffers if data flow at once.** Versions 0.16 to 0.18 start the sensor, then
submit 32 bulk transfers one after another, resubmit each as soon as it finishes, and take completions in ring order. If
a transfer finishes while the others are still being submitted, buffers are swapped or lost: 6 of 16 openings lost or
reordered events of a 50 000-event stream in a slow guest; with data held back for 0.3 s, 16 of 16 were exact. A real
camera has the same race, but its events are not compared with a reference. So the model sends nothing for
`start_delay_us` of stream time after the run gate opens, and again when the DVS is switched on, unless the host has
read by then: in the middle of a stream the DVS can be switched off and on without a silence. A timestamp reset ends the
silence at once: neuromorphic_drivers never sends one, and the drivers that do (libcaer, dv-processing) have queued all
their transfers by then; dv-processing waits 5 s for the reset.

**neuromorphic_drivers ignores the number of steps in a wrap word** and always adds 32 768 us (0.18.2). The encoder
sends wraps one by one, and uses words of many steps only when the host has not read for so long that single ones do
not fit. libcaer and dv-processing then keep the right time; neuromorphic_drivers falls behind, as it would with a real
camera.
"""

from __future__ import annotations

import struct
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar, Protocol

import numpy as np

from firmware_protocol.device.event_device import HasClockInput, HostAdjusted, StartsSilent, TakesReadings
from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import ItemEncoder, Numbers, ReadingKind, Readings
from firmware_protocol.events import Edges, Events, copy_events, empty_events
from firmware_protocol.fx3.inputs import ExternalInput, InputSettings, ReadingInput
from firmware_protocol.fx3.registers import Module, Register, RegisterFile, RunGate, SystemInfo
from firmware_protocol.fx3.stream import Late
from firmware_protocol.fx3.words import Block, Marks, join_marks, no_marks
from firmware_protocol.usb.control import Recipient, StandardControl
from firmware_protocol.usb.descriptors import (
    BOS,
    BULK_PACKET,
    OTHER_SPEED,
    Configuration,
    DescriptorSet,
    DeviceDescriptor,
    Endpoint,
    Interface,
    Speed,
    TransferType,
)
from firmware_protocol.usb.device import (
    Identity,
    RequestKind,
    SetupPacket,
    Stall,
    Transfer,
    UsbCamera,
    UsbCameraSettings,
)

VENDOR_ID = 0x152A
DEBUG_ENDPOINT = 0x81
DATA_ENDPOINT = 0x82

_DEBUG_INTERVAL = {Speed.SUPER: 4, Speed.HIGH: 4, Speed.FULL: 1}


@dataclass(frozen=True)
class Fx3Settings(UsbCameraSettings):
    """Settings that iniVation's cameras with an FX3 share.

    Attributes
    ----------
    serial : 1 to 8 ASCII characters; libcaer and dv-processing cut longer ones.
    fifo_bytes
        Room for words that wait for the host. 256 KiB is the most that the FX3 can give to DMA buffers: its memory from
        0x40040000 to 0x40080000 in the vendor's memory map (cyfxtx.c). At 12 Mev/s of a DAVIS that lasts 4 to 10 ms.
    pulse_us : length of a pulse on the external input (an EDGE of kind PULSE).
    imu_unit : its inertial unit, by the numbers of `imu_samples`; 0: none.
    frames : True if it takes frames; if not, its host may request them and gets none.
    bcd_usb : version of USB in its descriptor, where it is not that of its speed; below 2.1 there is no BOS.
    has_debug_endpoint : whether there is endpoint 0x81.
    """

    product_id: ClassVar[int]
    imu_units: ClassVar[tuple[int, ...]]
    bcd_usb: ClassVar[int | None] = None
    has_debug_endpoint: ClassVar[bool] = True

    size: tuple[int, int] = (0, 0)
    pulse_us: int = 100
    imu_unit: int = 0
    frames: bool = False
    system: SystemInfo = field(default_factory=SystemInfo)
    manufacturer: str = "iniVation"
    product: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (1 <= len(self.serial) <= 8 and self.serial.isascii() and self.serial.isprintable()):
            raise ValueError(f"serial {self.serial!r} must be 1 to 8 printable ASCII characters")
        if self.imu_unit not in (0, *self.imu_units):
            units = " or ".join(map(str, (0, *self.imu_units)))
            raise ValueError(f"imu_unit {self.imu_unit} must be {units}")
        if self.pulse_us < 1:
            raise ValueError(f"pulse_us {self.pulse_us} must be at least 1")

    @property
    def identity(self) -> Identity:
        """The camera as a host's bus lists it."""
        return Identity(VENDOR_ID, self.product_id, self.bcd_device, self.speed)

    @abstractmethod
    def registers(self) -> Iterator[Register]:
        """Yield its registers."""

    def descriptors(self) -> DescriptorSet:
        """Return all descriptors at the camera's speed."""
        other = OTHER_SPEED.get(self.speed)
        return DescriptorSet(
            device=DeviceDescriptor(self.speed, VENDOR_ID, self.product_id, self.bcd_device, bcd_usb=self.bcd_usb),
            configuration=self._configuration(self.speed),
            bos=BOS if self.bcd_usb is None else None,
            strings={1: self.manufacturer, 2: self.product, 3: self.serial},
            other_speed=self._configuration(other) if other else None,
        )

    def _configuration(self, speed: Speed) -> Configuration:
        debug = Endpoint(DEBUG_ENDPOINT, TransferType.INTERRUPT, 64, _DEBUG_INTERVAL[speed], bytes_per_interval=64)
        data = Endpoint(DATA_ENDPOINT, TransferType.BULK, max_packet=BULK_PACKET[speed], burst=7)
        return Configuration(speed, (Interface((debug, data) if self.has_debug_endpoint else (data,)),))


REGISTER = 0xBF
MULTI_WRITE = 0xC2
LOG_LEVEL = 0xB1
FLUSH = 0xC6

ENTRY = struct.Struct(">BBI")
_IN = 0x80
_INPUT_FIFO = 8
_MODULES = frozenset(map(int, Module))
_MOST_RESETS = 64  # limit of the list, which nothing empties without a second camera


class _Filters(Protocol):
    """Selection of the events that leave the array."""

    def power_on(self) -> None:
        """Clear its memory."""

    def follow(self, registers: RegisterFile, now_us: int) -> None:
        """Apply registers that were written at `now_us`."""

    def passed(self, events: Events, registers: RegisterFile) -> Events:
        """Return the part of `events`, (n,) EVENT, that passes; `events` may be changed. `take` counts the others."""
        ...

    def take(self) -> None:
        """Count the events that did not pass in the last call of `passed`."""


class _Stream(ItemEncoder[Transfer], Protocol):
    """Data path after the gate; see `EventStream`."""

    epoch_us: int

    @property
    def free_words(self) -> int:
        """Free room for words of events."""

    @property
    def room_until_us(self) -> int:
        """Stream time up to which it can advance now without dropping anything."""

    def room_beside(self, reserved_words: int) -> int:
        """Return the number of events that certainly fit beside `reserved_words`."""
        ...

    def start_time(self, now_us: int) -> None:
        """Begin device time at zero for a reader in its initial state; drop the queue."""

    def reset_time(self, now_us: int) -> None:
        """Begin device time at zero, with a reset word in the stream."""

    def put(self, events: Events, marks: Marks | None = None, blocks: Sequence[Block] = ()) -> Late:
        """Queue items in stream time, at least one in all; return those that found no room."""
        ...

    def advance(self, now_us: int) -> None:
        """Queue the words of time due at stream time `now_us`."""


class Fx3Camera(UsbCamera, StartsSilent, HostAdjusted, TakesReadings, HasClockInput):
    """A camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    settings: Fx3Settings
    data_endpoint = DATA_ENDPOINT & 15
    _stream: _Stream
    _filters: _Filters
    _readings: ReadingInput

    def __init__(self, settings: Fx3Settings) -> None:
        self.settings = settings
        self._standard = StandardControl(settings.descriptors())
        self._registers = RegisterFile(settings.registers())
        self._fates = Fates()
        self._input = ExternalInput(settings.pulse_us, self._fates.edges)
        self._stalled = no_marks()
        self._make_parts()
        self._resets_us: list[int] = []
        self._has_sent = False
        self._input_settings_of: tuple[int, int | None] | None = None
        self._input_now = InputSettings()
        self._power_on()

    @abstractmethod
    def _make_parts(self) -> None:
        """Make stream, filters and readings of this model, with its settings, registers and fates."""

    @abstractmethod
    def _factors_of_biases(self) -> Mapping[str, float]:
        """Return the effect on the pixels of the words in the bias module."""

    @abstractmethod
    def _counted(self) -> Mapping[Enum, int]:
        """Return the counts since the camera was made, which its counter registers show from power-on."""

    def name_request(self, setup: SetupPacket, data: bytes) -> str:
        """Return a vendor request in words, registers by name; `data` are those of its OUT stage."""
        if setup.kind is not RequestKind.VENDOR:
            return ""
        if setup.request == REGISTER and setup.is_in:
            return f"read {self._name(setup.value, setup.index)}"
        if setup.request == REGISTER and len(data) == 4:
            return f"write {self._name(setup.value, setup.index)} = {int.from_bytes(data, 'big')}"
        if setup.request == MULTI_WRITE and data and len(data) % ENTRY.size == 0:
            entries = (f"{self._name(module, address)} = {value}" for module, address, value in ENTRY.iter_unpack(data))
            return f"write {', '.join(entries)}"
        if setup.request == LOG_LEVEL:
            return f"log level {setup.value}"
        return "flush the data path" if setup.request == FLUSH else ""

    def name_answer(self, setup: SetupPacket, data: bytes) -> str:
        """Return the answer to a request in words; empty if it has no name."""
        if setup.kind is not RequestKind.VENDOR or setup.request != REGISTER or len(data) != 4:
            return ""
        return f"{self._name(setup.value, setup.index)} = {int.from_bytes(data, 'big')}"

    def _name(self, module: int, address: int) -> str:
        module_name = Module(module).name.lower() if module in _MODULES else f"module {module}"
        return f"{module_name}.{self._registers.name_of(module, address)} ({module}.{address})"

    def _run_gate(self) -> RunGate:
        """Return the run bits in the registers."""
        return RunGate.of(self._registers)

    @property
    def streaming(self) -> bool:
        """True while events offered now would go to the host."""
        return self._gate.events and self._now_us >= self._silent_until_us

    @property
    def at_rest(self) -> bool:
        """True while the gate for words is closed."""
        return not self._gate.words

    @property
    def room_events(self) -> int:
        """Events that certainly fit the FIFO now beside the marks expected, if none is later than `horizon_us`."""
        reserved = self._readings.reserved(self._stream.free_words)
        return max(0, self._stream.room_beside(reserved) - self._input.expected)

    @property
    def horizon_us(self) -> int:
        """Stream time to which the FIFO has room for single wraps; during the silence after the start, its end.

        During its start a host may have started the clock and not yet the words: time then advances up to half of the
        wraps that have to be made up for, so that those of the silence fit too.
        """
        if self._starting:
            return max(self._now_us, (self._stream.epoch_us + self._stream.room_until_us) // 2)
        if not self._gate.words:
            return super().horizon_us
        if self._now_us < self.silent_until_us:
            return self.silent_until_us
        return max(self._now_us, self._stream.room_until_us)

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """Effect on the pixels of the bias words that the host wrote; empty while they have their power-on values."""
        return self._factors

    @property
    def silent_until_us(self) -> int:
        """End of the silence after the start; 0 while the gate is closed."""
        return self._silent_until_us if self._gate.words else 0

    @property
    def epoch_us(self) -> int:
        """Stream time at which device time is zero."""
        return self._stream.epoch_us

    @property
    def _waiting(self) -> Numbers:
        marks = Numbers(edges=self._input.pending + len(self._stalled))
        return self._stream.waiting.plus(marks).plus(self._readings.waiting)

    def offer(self, events: Events) -> None:
        """Take the events of the array, (n,) EVENT in stream time, sorted, none before the time advanced to.

        The events are copied. Those that come while the camera does not stream are counted as not running. Raises
        ValueError if events go back in time or lie outside the array; then none of them is taken.
        """
        if not len(events):
            return
        if int(events["t"][0]) < self._now_us:
            raise ValueError(f"event at {events['t'][0]} us offered after the camera's clock reached {self._now_us} us")
        until_us = int(events["t"][-1])
        first = int(np.searchsorted(events["t"], self._silent_until_us)) if self._gate.events else len(events)
        if first < len(events):
            self._put(self._filters.passed(copy_events(events[first:]), self._registers), until_us)
            self._filters.take()
        else:
            self._put(empty_events(), until_us)
        self._fates.not_running += first
        self._fates.offered += len(events)
        self._now_us = until_us

    def offer_edges(self, edges: Edges) -> None:
        """Apply edges, (n,) EDGE in stream time, to the external input.

        They enter the stream, as the registers of module 4 select, when time reaches them; an edge before the time
        advanced to is applied now, because the camera itself assigns its time.
        """
        self._input.offer(edges, self._now_us)

    def reading_settings(self, kind: ReadingKind) -> tuple[int, ...]:
        """Settings in the registers for a kind of readings; for frames, the numbers of `FrameSettings`."""
        return self._readings.settings_of(kind)

    def room_readings(self, kind: ReadingKind) -> int:
        """Number of readings that fit half of the free room; the other half is for events."""
        if not self._readings.runs(kind):
            return super().room_readings(kind)
        return self._readings.room(kind, self._stream.free_words)

    def offer_readings(self, kind: ReadingKind, readings: Readings) -> bool:
        """Take lines of frames; see `TakesReadings.offer_readings`."""
        if self._readings.takes(kind):
            self._readings.offer(kind, readings, self._silent_until_us)
        return self._readings.takes(kind)

    def advance(self, now_us: int) -> None:
        """Set stream time to `now_us`; the clock never goes back."""
        now_us = max(self._now_us, now_us)
        self._put(empty_events(), now_us)
        self._now_us = now_us
        if self._gate.words and self._now_us >= self._silent_until_us:
            self._stream.advance(self._now_us)

    def _put(self, events: Events, until_us: int) -> None:
        """Queue events, (n,) EVENT, the marks of the external input and the readings up to `until_us`."""
        marks = self._input.marks(self._now_us, until_us, self._input_settings)
        if len(self._stalled):
            self._stalled["t"] = np.maximum(self._stalled["t"], self._now_us)
            marks, self._stalled = join_marks([self._stalled, marks]), no_marks()
        blocks = self._readings.due(self._now_us, until_us, self._stream.free_words)
        if not len(events) and not len(marks) and not blocks:
            return
        try:
            late = self._stream.put(events, marks, blocks)
        except ValueError:
            self._stalled = marks
            self._readings.put_back(blocks)
            raise
        self._fates.dropped_fifo += late.events
        keep = 0 if self._registers.read(Module.MULTIPLEXER, 4) else _INPUT_FIFO  # or drops, as the host selects
        self._stalled = late.marks[:keep]
        self._fates.edges.dropped_fifo += len(late.marks[keep:])
        self._readings.hold(late.blocks)

    @property
    def _input_settings(self) -> InputSettings:
        """Settings of the external input, read again after a change."""
        report_from_us = self._silent_until_us if self._gate.words else None
        if self._input_settings_of != (self.settings_version, report_from_us):
            self._input_settings_of = self.settings_version, report_from_us
            self._input_now = InputSettings.of(self._registers, report_from_us)
        return self._input_now

    def take_resets(self) -> tuple[int, ...]:
        """Return the stream times at which the host has reset the timestamps since the last call."""
        resets, self._resets_us = tuple(self._resets_us), []
        return resets

    def follow_reset(self, at_us: int) -> None:
        """Set device time to zero at `at_us`, as its master did then, and put a reset word into the stream.

        A silence after the start ends.
        """
        if self._gate.words:
            self._stream.reset_time(min(at_us, self._now_us))
            self._silent_until_us = self._now_us

    def restart_clock(self) -> bool:
        """Set device time to zero with a reset word in the stream, as a slave does when its master was reset."""
        if self._gate.words:
            self._stream.reset_time(self._now_us)
        else:
            self._start_time()
        return True

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Execute one control transfer; see `UsbDevice.control` and the table above."""
        if setup.kind is RequestKind.STANDARD:
            return self._standard.control(setup, data)
        if setup.kind is not RequestKind.VENDOR or setup.recipient != Recipient.DEVICE:
            raise Stall
        if setup.is_in:
            return self._read_register(setup)
        self._vendor_out(setup, data)
        return b""

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """Take data from endpoint 2; the debug endpoint, 1, never has any."""
        self._standard.require(endpoint | _IN)
        if endpoint | _IN != DATA_ENDPOINT or self._now_us < self._silent_until_us:
            return None
        transfer = self._taken(self._stream.take(self._now_us, max_bytes))
        self._has_sent = self._has_sent or transfer is not None
        return transfer

    def _power_on(self) -> None:
        self._registers.power_on()
        self._standard.power_on()
        self._follow_registers()
        self._starting = False
        self._has_sent = False
        self._factors: Mapping[str, float] = {}
        self._silent_until_us = self._now_us
        self._drop_stalled()
        self._start_time()
        self._flushes += 1
        self._filters.power_on()
        self._counted_before = self._counted()

    def accepts(self, setup: SetupPacket) -> bool:
        """Return true if an OUT request is known and its data have the right length."""
        lengths = {REGISTER: 4, MULTI_WRITE: setup.value * ENTRY.size, FLUSH: 0, LOG_LEVEL: 0}
        return setup.kind is not RequestKind.VENDOR or setup.length == lengths.get(setup.request)

    def _vendor_out(self, setup: SetupPacket, data: bytes) -> None:
        if len(data) != setup.length or not self.accepts(setup):
            raise Stall
        if setup.request == REGISTER:
            self._write(setup.value, setup.index, int.from_bytes(data, "big"))
        elif setup.request == MULTI_WRITE:
            for module, address, value in ENTRY.iter_unpack(data):
                self._write(module, address, value)
        elif setup.request == FLUSH:
            self._flush(self._stream)

    def _read_register(self, setup: SetupPacket) -> bytes:
        if setup.request != REGISTER or setup.length < 4:
            raise Stall
        for counter, count in self._counted().items():
            self._registers.count(counter, count - self._counted_before.get(counter, 0))
        return self._registers.read(setup.value, setup.index).to_bytes(4, "big")

    def _write(self, module: int, address: int, value: int) -> None:
        before = self._gate
        self._registers.write(module, address, value)
        if module == Module.BIAS:
            self._factors = self._factors_of_biases()
        self._follow_registers()
        if self._gate != before:
            self._turn(before, self._gate)

    def _follow_registers(self) -> None:
        self.settings_version += 1
        self._gate = self._run_gate()
        self._readings.follow(words=self._gate.words)
        self._filters.follow(self._registers, self._now_us)

    def _turn(self, before: RunGate, after: RunGate) -> None:
        """Apply a change of the run bits."""
        if before.words and not after.words:
            self._drop_stalled()
            self._flush(self._stream)
            self._flushes += 1
        if after.timestamps and not before.timestamps:
            self._start_time()
            self._starting = True
        if after.words or not after.timestamps:
            self._starting = False
        if after.words and not before.words:
            self._has_sent = False
        if (after.words and not before.words) or (after.events and not before.events and not self._has_sent):
            self._silent_until_us = self._now_us + self.settings.start_delay_us
        if after.reset and not before.reset and after.words:
            self._stream.reset_time(self._now_us)
            self._silent_until_us = self._now_us
            self._resets_us = [*self._resets_us[-_MOST_RESETS:], self._now_us]

    def _start_time(self) -> None:
        """Begin device time at zero; what waits is flushed."""
        self._flush(self._stream)
        self._stream.start_time(self._now_us)

    def _drop_stalled(self) -> None:
        self._fates.edges.dropped_fifo += len(self._stalled)
        self._stalled = no_marks()
        self._readings.flush()

"""USB side of Prophesee's boards, which the EVK4, its siblings and the boards with a Gen 3.1 or a GenX320 share.

Requests come on one bulk endpoint, answers and events leave on two others:

    host --bulk 02--> write ----> Board --> registers --> selection, run gate, biases, form of the words
         <-bulk 82--- read 2 <--- answers
    array ----------> offer ----> selection -> UsbOutflow --bulk 81--> read 1: EVT3, EVT2.1 or EVT2

Opening the run gate begins a stream; closing it drops waiting events, and so does another form of the words. Device
time is zero when the sensor's time starts.

Vendor request on endpoint 0, without which neuromorphic_drivers does not list a camera:

    C0  bRequest 72, wValue 0, wIndex 0     2 bytes, the first the kind of board: 31 an EVK4

A camera is not safe for concurrent use: one thread at a time may call it. During a silence, words carry the time every
4096 us.

Sources of the descriptors: the checks of OpenEB 5.1.1 and neuromorphic_drivers. Device version, release and build date
of a shipped camera are not public: those here are new enough for both.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

from firmware_protocol.device.items import Numbers
from firmware_protocol.events import Events
from firmware_protocol.evt.evt2 import Evt2Encoder
from firmware_protocol.evt.evt3 import Evt3Encoder
from firmware_protocol.evt.words import Coder
from firmware_protocol.prophesee.biases import BiasModel
from firmware_protocol.prophesee.camera import LONGEST_GAP_US, Outflow, OutflowLimits, PropheseeCamera, Selected
from firmware_protocol.prophesee.registers import ChipRegisters, Form
from firmware_protocol.prophesee.treuzell import Board, BoardDevice, BoardFacts
from firmware_protocol.usb import descriptors, device
from firmware_protocol.usb.control import Recipient, StandardControl
from firmware_protocol.usb.device import Identity, RequestKind, SetupPacket, Transfer, UsbCamera, UsbCameraSettings

_SILENCE_US = 4096  # a high part of the time
_FEWEST_EVENTS = 16  # made into words together, also for a host that requests less
_MOST_EDGES = 1024
_FIFO_BYTES_PER_EVENT = 6
_WORD_BYTES = {"evt3": 2, "evt2": 4, "evt21": 8, "evt21-legacy": 8}
_EVENT_BYTES = {"evt3": 8, "evt2": 8, "evt21": 16, "evt21-legacy": 16}  # at most: with its time


class UsbOutflow(Outflow[Transfer]):
    """Outflow to a bulk endpoint: one stream of words of a `form`, cut into transfers; `width`: the array's columns."""

    def __init__(self, epoch_us: int, fifo_bytes: int, form: Form, width: int) -> None:
        limits = OutflowLimits(fifo_bytes // _FIFO_BYTES_PER_EVENT, _MOST_EDGES, _SILENCE_US)
        encoder: Coder = (
            Evt3Encoder(width=width, origin_us=epoch_us) if form == "evt3" else Evt2Encoder(form, origin_us=epoch_us)
        )
        super().__init__(encoder, epoch_us, limits)
        self.form = form
        self._word_bytes, self._event_bytes = _WORD_BYTES[form], _EVENT_BYTES[form]
        self._cut: Transfer | None = None  # the rest of words beyond the length that the host requested

    @property
    def waiting(self) -> Numbers:
        """Numbers of events and edges in the queues."""
        waiting = super().waiting
        return waiting if self._cut is None else waiting.plus(self._cut.numbers)

    def take(self, now_us: int, room: int) -> Transfer | None:
        """Remove up to `room` octets of words; None if there is nothing to send yet."""
        if room < self._word_bytes:
            return None
        transfer = self._cut or self._next(now_us, room)
        if transfer is None or len(transfer.data) <= room:
            self._cut = None
            return transfer
        end = room - room % self._word_bytes
        self._cut = replace(transfer, data=transfer.data[end:])
        return Transfer(epoch_us=transfer.epoch_us, data=transfer.data[:end])

    def clear(self) -> None:
        """Empty the queues, and drop the part of a transfer that has not left."""
        super().clear()
        self._cut = None

    def _next(self, now_us: int, max_bytes: int) -> Transfer | None:
        first_us = self._due_us(now_us)
        if first_us is not None:
            return self._words(first_us, now_us, max_bytes)
        words = self._silence_words(now_us)
        return Transfer(epoch_us=self.epoch_us, data=words) if words else None

    def _words(self, first_us: int, now_us: int, max_bytes: int) -> Transfer:
        until_us = min(now_us, first_us + LONGEST_GAP_US)
        room = max(max_bytes // self._event_bytes - 2, _FEWEST_EVENTS)
        events = self._taken(until_us + 1, room)
        edges = self._due_edges(int(events["t"][-1]) if len(events) == room else until_us)
        words = self._encoder.encode(events, edges)
        self._reach(events, edges)
        return Transfer(events, edges, self.epoch_us, data=words)


ANSWER_ENDPOINT = 0x82
REQUEST_ENDPOINT = 0x02
DATA_ENDPOINT = 0x81

_INTERFACE_CLASS = (0xFF, 0x19, 0)


@dataclass(frozen=True)
class BoardIdentity:
    """Identity of a board.

    Attributes
    ----------
    title : its name for people.
    usb_id : (vendor, product).
    manufacturer, product : string descriptors.
    kind : kind of board, as the vendor request reports it.
    short_frames : True if hosts write registers by frames without a size (see `treuzell`).
    """

    title: str
    usb_id: tuple[int, int]
    manufacturer: str
    product: str
    kind: int = 0x31
    short_frames: bool = False


@dataclass(frozen=True)
class ChipNames:
    """Name of a sensor for people, and the names by which OpenEB finds its driver."""

    name: str
    compatible: tuple[str, ...]


class ChipSelection(Protocol):
    """The part of the events that the registers select."""

    def reset(self) -> None:
        """Return to the power-on state."""

    def written(self, address: int) -> None:
        """Apply the effect of a register that was just written."""

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the sensor's clock was zero at `epoch_us`."""


@dataclass(frozen=True)
class TreuzellSettings(UsbCameraSettings):
    """Settings of a camera on one of these boards.

    Attributes
    ----------
    serial : 1 to 8 hexadecimal digits.
    fifo_bytes : room for events that wait for the host, at 6 bytes each: time, row and column.
    release : firmware version, 0x00MMmmpp; OpenEB refuses below 0x030800.
    build_unix_s : build time of the firmware.
    biases : effect of the biases on the sensor.
    pulse_us : length of a pulse at the trigger input.
    size : (width, height) of the sensor, pixels.
    """

    size: ClassVar[tuple[int, int]]
    bcd_device: int = 0x0309
    release: int = 0x03_0900
    build_unix_s: int = 1_700_000_000
    biases: BiasModel = field(default_factory=BiasModel)
    pulse_us: int = 100

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.serial) <= 8 or set(self.serial) - set("0123456789abcdefABCDEF"):
            raise ValueError(f"the serial of this camera has 1 to 8 hexadecimal digits, got {self.serial!r}")
        if self.fifo_bytes < 1024:
            raise ValueError(f"fifo_bytes must be at least 1024, got {self.fifo_bytes}")

    @property
    @abstractmethod
    def board(self) -> BoardIdentity:
        """Identity of the board; a subclass has it as a field."""

    @property
    @abstractmethod
    def chip_names(self) -> ChipNames:
        """Names of the sensor."""

    @property
    def identity(self) -> Identity:
        """The camera as a host's bus lists it."""
        vendor, product = self.board.usb_id
        return Identity(vendor, product, self.bcd_device, self.speed, interfaces=(_INTERFACE_CLASS,))

    def descriptors(self) -> descriptors.DescriptorSet:
        """Return all descriptors at the camera's speed."""
        board, other = self.board, descriptors.OTHER_SPEED.get(self.speed)
        return descriptors.DescriptorSet(
            device=descriptors.DeviceDescriptor(self.speed, *board.usb_id, self.bcd_device, strings=(1, 2, 0)),
            configuration=_configuration(self.speed),
            strings={1: board.manufacturer, 2: board.product},
            other_speed=_configuration(other) if other else None,
        )

    @property
    def beside_sensor(self) -> tuple[BoardDevice, ...]:
        """Devices of the board beside the sensor."""
        return ()

    def facts(self) -> BoardFacts:
        """Return what the board reports of itself."""
        return BoardFacts(int(self.serial, 16), self.release, self.build_unix_s, self.board.short_frames)


def _configuration(speed: descriptors.Speed) -> descriptors.Configuration:
    """Return the configuration; OpenEB requires these three endpoints in this order."""
    addresses = (ANSWER_ENDPOINT, REQUEST_ENDPOINT, DATA_ENDPOINT)
    endpoints = tuple(
        descriptors.Endpoint(address, descriptors.TransferType.BULK, descriptors.BULK_PACKET[speed], burst=15)
        for address in addresses
    )
    return descriptors.Configuration(speed, (descriptors.Interface(endpoints, interface_class=_INTERFACE_CLASS),))


_BOARD_KIND = 0x72
_IN = 0x80
_MOST_ANSWERS = 64


class TreuzellCamera(PropheseeCamera[UsbOutflow], UsbCamera):
    """The camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    data_endpoint = DATA_ENDPOINT & 15
    settings: TreuzellSettings

    def __init__(self, settings: TreuzellSettings, registers: ChipRegisters, selection: ChipSelection) -> None:
        self.settings = settings
        self._registers, self._selection = registers, selection
        super().__init__(settings.size, settings.biases, self._new_outflow(0), settings.pulse_us)
        self._standard = StandardControl(settings.descriptors())
        self._kind = bytes((settings.board.kind, 0))
        sensor = BoardDevice(settings.chip_names.name, settings.chip_names.compatible, self)
        self._board = Board(settings.facts(), (sensor, *settings.beside_sensor))
        self._answers: deque[bytes] = deque()
        self._was_running = False

    @property
    def streaming(self) -> bool:
        """True while events offered now would go to the host."""
        return self._running and self._now_us >= self._silence_end_us

    @property
    def at_rest(self) -> bool:
        """True while the sensor is stopped."""
        return not self._running

    @property
    def horizon_us(self) -> int:
        """During the silence after the start its end; otherwise without limit."""
        silent = self._now_us < self.silent_until_us
        return self._silence_end_us if silent else super().horizon_us

    @property
    def biases(self) -> dict[str, int]:
        """Values of the biases, by Prophesee's names, as the host set them."""
        return self._registers.currents

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Execute one control transfer; see `UsbDevice.control` and the module's description."""
        if setup.kind is RequestKind.STANDARD:
            return self._standard.control(setup, data)
        board_request = (RequestKind.VENDOR, Recipient.DEVICE, True, _BOARD_KIND)
        if (setup.kind, setup.recipient, setup.is_in, setup.request) != board_request:
            raise device.Stall
        return self._kind[: setup.length]

    def write(self, endpoint: int, data: bytes) -> None:
        """Process a request; it stalls while 64 answers wait for a host that does not read them."""
        self._standard.require(endpoint)
        if endpoint != REQUEST_ENDPOINT or len(self._answers) >= _MOST_ANSWERS:
            raise device.Stall
        self._answers.append(self._board.answer(data))

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """Return an answer from endpoint 2, or words from endpoint 1."""
        self._standard.require(endpoint | _IN)
        if endpoint | _IN == ANSWER_ENDPOINT:
            return self._answer(max_bytes)
        assert endpoint | _IN == DATA_ENDPOINT
        if not self.streaming:
            return None
        return self._taken(self._outflow.take(self._now_us, max_bytes))

    def read_register(self, address: int) -> int:
        """Return the value that a host reads from the sensor; raises LookupError if there is no register."""
        return self._registers.read(address)

    def write_register(self, address: int, value: int) -> None:
        """Execute a host's write to the sensor; raises LookupError if there is no register."""
        self.settings_version += 1
        had_time = self._registers.time_runs
        self._registers.write(address, value)
        self._selection.written(address)
        if self._registers.time_runs and not had_time:
            self.epoch_us = self._now_us
        if self._registers.running != self._was_running:
            self._turn()
        elif self._registers.form != self._outflow.form:
            self._drop_waiting()

    def _turn(self) -> None:
        """Begin a stream, or end it."""
        self._drop_waiting()
        self._was_running = self._registers.running
        if self._was_running:
            self._silence_end_us = self._now_us + self.settings.start_delay_us

    def _power_on(self) -> None:
        self.settings_version += 1
        self._standard.power_on()
        self._registers.power_on()
        self._selection.reset()
        self._answers.clear()
        self._was_running = False
        self._drop_waiting()

    def _drop_waiting(self) -> None:
        self._flush(self._outflow)
        self._outflow = self._new_outflow(self.epoch_us)
        self._flushes += 1

    def _new_outflow(self, epoch_us: int) -> UsbOutflow:
        return UsbOutflow(epoch_us, self.settings.fifo_bytes, self._registers.form, self.settings.size[0])

    @property
    def _running(self) -> bool:
        return self._registers.running

    @property
    def _detects(self) -> bool:
        return self._registers.running and self._registers.has_trigger

    @property
    def _bias_steps(self) -> Mapping[str, int]:
        return self._registers.bias_steps

    def _select(self, events: Events) -> Selected:
        return self._selection.apply(events, self.epoch_us)

    def _answer(self, max_bytes: int) -> Transfer | None:
        """Return the oldest answer; of one that is too long, the first part, and the rest next time."""
        if not self._answers or max_bytes < 1:
            return None
        answer = self._answers.popleft()
        if len(answer) > max_bytes:
            self._answers.appendleft(answer[max_bytes:])
        return Transfer(epoch_us=self.epoch_us, data=answer[:max_bytes])

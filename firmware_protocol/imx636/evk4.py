"""USB device model of a Prophesee EVK4 HD (IMX636) and its siblings: see `imx636.boards` for these.

Requests come on one bulk endpoint, answers and events leave on two others:

    host --bulk 02--> write ----> Board --> Registers --> masks, rate control, run gate, biases
         <-bulk 82--- read 2 <--- answers
    array ----------> offer ----> Selection -> UsbOutflow --bulk 81--> read 1: EVT3, or EVT2.1 if the host sets it

Run gate: events leave while the array runs (register 0004 bit 10), the output is enabled (9028 bit 1 is 0) and time
runs (9008 bit 0). Opening it begins a stream; closing it drops waiting events, and so does another format (7000 bit 1).
Device time is zero when time starts.

Biases act on the sensor through `sensor_factors`; see `imx636.biases`.

Vendor request on endpoint 0, without which neuromorphic_drivers does not list the camera:

    C0  bRequest 72, wValue 0, wIndex 0     2 bytes, the first the kind of board: 31 an EVK4

A camera is not safe for concurrent use: one thread at a time may call it.

During a silence, words carry the time every 4096 us.

Sources of the descriptors: the checks of OpenEB 5.1.1 and neuromorphic_drivers. Device version, release and build date
of a shipped camera are not public: those here are new enough for both.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from firmware_protocol.device.items import Numbers
from firmware_protocol.events import EdgeKind, Edges, Events
from firmware_protocol.evt.evt2 import Evt2Encoder
from firmware_protocol.evt.evt3 import Evt3Encoder
from firmware_protocol.evt.words import Coder
from firmware_protocol.imx636.biases import BiasModel
from firmware_protocol.imx636.boards import BOARDS, BoardModel
from firmware_protocol.imx636.camera import LONGEST_GAP_US, Imx636Camera, Outflow, OutflowLimits
from firmware_protocol.imx636.registers import SIZE, Registers, Surroundings
from firmware_protocol.imx636.selection import Selected, Selection
from firmware_protocol.imx636.treuzell import Board, BoardFacts
from firmware_protocol.usb.control import Recipient, StandardControl
from firmware_protocol.usb.descriptors import (
    BULK_PACKET,
    OTHER_SPEED,
    Configuration,
    DescriptorSet,
    DeviceDescriptor,
    Endpoint,
    Interface,
    TransferType,
)
from firmware_protocol.usb.device import (
    Identity,
    RequestKind,
    SetupPacket,
    Speed,
    Stall,
    Transfer,
    UsbCamera,
    UsbCameraSettings,
)

__all__ = ["ANSWER_ENDPOINT", "DATA_ENDPOINT", "REQUEST_ENDPOINT", "Evk4", "Evk4Settings", "UsbOutflow"]


_SILENCE_US = 4096  # a high part of the time
_FEWEST_EVENTS = 16  # made into words together, also for a host that requests less
_MOST_EDGES = 1024
_FIFO_BYTES_PER_EVENT = 6
_WORD_BYTES = {"evt3": 2, "evt21-legacy": 8}
_EVENT_BYTES = {"evt3": 8, "evt21-legacy": 16}  # at most: with its time


class UsbOutflow(Outflow[Transfer]):
    """Outflow to a bulk endpoint: one stream of words, cut into transfers of any length.

    Attributes
    ----------
    form
        Form of the words.
    """

    def __init__(self, epoch_us: int, fifo_bytes: int, form: Literal["evt3", "evt21-legacy"] = "evt3") -> None:
        limits = OutflowLimits(fifo_bytes // _FIFO_BYTES_PER_EVENT, _MOST_EDGES, _SILENCE_US)
        encoder: Coder = (
            Evt3Encoder(width=SIZE[0], origin_us=epoch_us) if form == "evt3" else Evt2Encoder(form, origin_us=epoch_us)
        )
        super().__init__(encoder, epoch_us, limits)
        self.form = form
        self._word_bytes, self._event_bytes = _WORD_BYTES[form], _EVENT_BYTES[form]
        self._cut: Transfer | None = None  # the rest of words beyond the length that the host requested

    @property
    def waiting(self) -> Numbers:
        """See `ItemEncoder.waiting`."""
        waiting = super().waiting
        return waiting if self._cut is None else waiting.plus(self._cut.numbers)

    def take(self, now_us: int, room: int) -> Transfer | None:
        """Remove up to `room` octets of words; None if there is nothing to send yet."""
        if room < self._word_bytes:
            return None
        whole = self._cut or self._next(now_us, room)
        if whole is None or len(whole.data) <= room:
            self._cut = None
            return whole
        end = room - room % self._word_bytes
        self._cut = replace(whole, data=whole.data[end:])
        return Transfer(epoch_us=whole.epoch_us, data=whole.data[:end])

    def clear(self) -> None:
        """See `ItemEncoder.clear`."""
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
class Evk4Settings(UsbCameraSettings):
    """Settings of a camera.

    Attributes
    ----------
    serial
        1 to 8 hexadecimal digits.
    fifo_bytes
        Room for events that wait for the host, at 6 bytes each: time, row and column.
    release
        Firmware version, 0x00MMmmpp; OpenEB refuses below 0x030800.
    build_unix_s
        Build time of the firmware.
    biases
        Effect of the biases on the sensor.
    board
        The board: its identity and its sensor.
    pulse_us
        Length of a pulse at the trigger input.
    """

    bcd_device: int = 0x0309
    release: int = 0x03_0900
    build_unix_s: int = 1_700_000_000
    surroundings: Surroundings = field(default_factory=Surroundings)
    biases: BiasModel = field(default_factory=BiasModel)
    board: BoardModel = BOARDS["evk4"]
    pulse_us: int = 100

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.serial) <= 8 or set(self.serial) - set("0123456789abcdefABCDEF"):
            raise ValueError(f"the serial of this camera has 1 to 8 hexadecimal digits, got {self.serial!r}")
        if self.fifo_bytes < 1024:
            raise ValueError(f"fifo_bytes must be at least 1024, got {self.fifo_bytes}")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor, pixels."""
        return SIZE

    @property
    def identity(self) -> Identity:
        """The camera as a host's bus lists it."""
        vendor, product = self.board.usb_id
        return Identity(vendor, product, self.bcd_device, self.speed, interfaces=(_INTERFACE_CLASS,))

    def descriptors(self) -> DescriptorSet:
        """Return all descriptors at the camera's speed."""
        other = OTHER_SPEED.get(self.speed)
        return DescriptorSet(
            device=DeviceDescriptor(self.speed, *self.board.usb_id, self.bcd_device, strings=(1, 2, 0)),
            configuration=_configuration(self.speed),
            strings={1: self.board.manufacturer, 2: self.board.product},
            other_speed=_configuration(other) if other else None,
        )


def _configuration(speed: Speed) -> Configuration:
    """Return the configuration; OpenEB requires these three endpoints in this order."""
    addresses = (ANSWER_ENDPOINT, REQUEST_ENDPOINT, DATA_ENDPOINT)
    endpoints = tuple(Endpoint(each, TransferType.BULK, BULK_PACKET[speed], burst=15) for each in addresses)
    return Configuration(speed, (Interface(endpoints, interface_class=_INTERFACE_CLASS),))


_BOARD_KIND = 0x72
_IN = 0x80
_MOST_ANSWERS = 64


class Evk4(Imx636Camera[UsbOutflow], UsbCamera):
    """The camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    data_endpoint = DATA_ENDPOINT & 15

    def __init__(self, settings: Evk4Settings | None = None) -> None:
        self.settings = settings = settings or Evk4Settings()
        super().__init__(settings.size, settings.biases, UsbOutflow(0, settings.fifo_bytes))
        self._standard = StandardControl(settings.descriptors())
        self._pulse_us = settings.pulse_us
        board = settings.board
        self._kind = bytes((board.kind, 0))
        self._registers = Registers(settings.surroundings, settings.biases, board.chip)
        self._selection = Selection(self._registers)
        serial = int(settings.serial, 16)
        names = board.chip.name, board.chip.compatible
        facts = BoardFacts(serial, settings.release, settings.build_unix_s, *names, short_frames=board.short_frames)
        self._board = Board(facts, self)
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
        """Currents of the biases, 0 to 255, by Prophesee's names, as the host set them."""
        return self._registers.currents

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Execute one control transfer; see `UsbDevice.control` and the module's description."""
        if setup.kind is RequestKind.STANDARD:
            return self._standard.control(setup, data)
        wanted = (RequestKind.VENDOR, Recipient.DEVICE, True, _BOARD_KIND)
        if (setup.kind, setup.recipient, setup.is_in, setup.request) != wanted:
            raise Stall
        return self._kind[: setup.length]

    def write(self, endpoint: int, data: bytes) -> None:
        """Process a request; it stalls while 64 answers wait for a host that does not read them."""
        self._standard.require(endpoint)
        if endpoint != REQUEST_ENDPOINT or len(self._answers) >= _MOST_ANSWERS:
            raise Stall
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
        self._settings_version += 1
        had_time = self._registers.time_runs
        self._registers.write(address, value)
        self._selection.written(address)
        if self._registers.time_runs and not had_time:
            self._epoch_us = self._now_us
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
        self._settings_version += 1
        self._standard.power_on()
        self._registers.power_on()
        self._selection.reset()
        self._answers.clear()
        self._was_running = False
        self._drop_waiting()

    def _drop_waiting(self) -> None:
        self._flush(self._outflow)
        self._outflow = UsbOutflow(self._epoch_us, self.settings.fifo_bytes, self._registers.form)
        self._flushes += 1

    @property
    def _running(self) -> bool:
        return self._registers.running

    @property
    def _detects(self) -> bool:
        return self._registers.running and self._registers.has_trigger

    @property
    def _bias_steps(self) -> Mapping[str, int]:
        return self._registers.bias_steps

    def _put_edges(self, edges: Edges) -> None:
        """Queue edges that the input has detected; a pulse is two of them, the second one due when it ends."""
        is_pulse = edges["kind"] == EdgeKind.PULSE
        begins, ends = edges.copy(), edges[is_pulse]
        begins["kind"][is_pulse] = EdgeKind.RISING
        ends["kind"] = EdgeKind.FALLING
        ends["t"] += np.uint64(self._pulse_us)
        self._fates.edges.added += len(ends)
        both = np.concatenate([begins, ends])
        both["seq"] = 0  # of the source of triggers; a word has no room for it
        super()._put_edges(both[np.argsort(both["t"], kind="stable")])

    def _select(self, events: Events) -> Selected:
        return self._selection.apply(events, self._epoch_us)

    def _answer(self, max_bytes: int) -> Transfer | None:
        """Return the oldest answer; of one that is too long, the first part, and the rest next time."""
        if not self._answers or max_bytes < 1:
            return None
        answer = self._answers.popleft()
        if len(answer) > max_bytes:
            self._answers.appendleft(answer[max_bytes:])
        return Transfer(epoch_us=self._epoch_us, data=answer[:max_bytes])

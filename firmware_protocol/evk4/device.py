"""USB device model of a Prophesee EVK4 HD (IMX636): requests on one bulk endpoint, answers and events on two others.

    host --bulk 02--> write ----> Board --> Registers --> masks, rate control, run gate, biases
         <-bulk 82--- read 2 <--- answers
    array ----------> offer ----> Selection -> Outflow --bulk 81--> read 1: EVT3

Run gate: events leave while the array runs (register 0004 bit 10), the output is enabled (9028 bit 1 is 0) and time
runs (9008 bit 0). Opening it begins a stream; closing it drops waiting events. Device time is zero when time starts.

Biases act on the sensor through `sensor_factors`; see `imx636.biases`.

Vendor request on endpoint 0, without which neuromorphic_drivers does not list the camera:

    C0  bRequest 72, wValue 0, wIndex 0     2 bytes, the first 31: the kind of board, an EVK4

A camera is not safe for concurrent use: one thread at a time may call it.

EVT3 words are made when the host reads, so that events dropped while they wait leave no trace in the stream. During a
silence, words carry the time every 4096 us: decoders lose it after 8.4 s.

Sources of identity and descriptors: the checks of OpenEB 5.1.1 and neuromorphic_drivers. Device version, release and
build date of a shipped camera are not public: those here are new enough for both.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.device.fates import Fates
from firmware_protocol.events import Edges, Events, copy_events, empty_edges, empty_events, join_events
from firmware_protocol.evk4.treuzell import Board, BoardFacts
from firmware_protocol.evt.evt3 import Evt3Encoder
from firmware_protocol.imx636.biases import BiasModel
from firmware_protocol.imx636.registers import BIASES, SIZE, Registers, Surroundings
from firmware_protocol.imx636.selection import Selection
from firmware_protocol.usb.control import Recipient, StandardControl
from firmware_protocol.usb.descriptors import (
    Configuration,
    DescriptorSet,
    DeviceDescriptor,
    Endpoint,
    Interface,
    TransferType,
)
from firmware_protocol.usb.device import Identity, RequestKind, SetupPacket, Speed, Stall, Transfer, UsbCamera

__all__ = ["ANSWER_ENDPOINT", "DATA_ENDPOINT", "REQUEST_ENDPOINT", "Evk4", "Evk4Settings", "Outflow"]


_SILENCE_US = 4096  # a high part of the time
_LONGEST_GAP_US = 1_000_000  # between words, without time words of a silence in between
_LONGEST_SILENCE_US = 3_600_000_000  # in one transfer
_FEWEST_EVENTS = 16  # made into words together, also for a host that requests less
_MOST_EDGES = 1024


class Outflow:
    """Outgoing events and edges of one run of the sensor.

    Attributes
    ----------
    epoch_us
        Stream time at which the sensor's clock was zero.
    queued, edges_queued
        Events and edges that wait.
    """

    def __init__(self, epoch_us: int, capacity: int) -> None:
        self.epoch_us = self._reported_us = epoch_us
        self._capacity = capacity
        self._encoder = Evt3Encoder(width=SIZE[0])
        self._waiting: deque[Events] = deque()
        self._edges = empty_edges()
        self._cut: Transfer | None = None  # the rest of words beyond the length that the host requested
        self._queued = 0

    @property
    def queued(self) -> int:
        """Events that wait."""
        return self._queued + (0 if self._cut is None else len(self._cut.events))

    @property
    def edges_queued(self) -> int:
        """Edges that wait."""
        return len(self._edges) + (0 if self._cut is None else len(self._cut.edges))

    @property
    def room(self) -> int:
        """Events that fit now."""
        return max(0, self._capacity - self.queued)

    def put(self, events: Events) -> int:
        """Queue as many of events (n,) EVENT, sorted, as fit; return their number; they are copied."""
        fitting = events[: self.room]
        if len(fitting):
            self._waiting.append(copy_events(fitting))
            self._queued += len(fitting)
        return len(fitting)

    def put_edges(self, edges: Edges) -> int:
        """Queue as many of edges (n,) EDGE, sorted, as fit; return their number; old ones get the time sent last."""
        fitting = edges[: max(0, _MOST_EDGES - len(self._edges))]
        self._edges = np.concatenate([self._edges, fitting])
        return len(fitting)

    def take(self, now_us: int, max_bytes: int) -> Transfer | None:
        """Remove up to `max_bytes` of words; None if there is nothing to send yet."""
        if max_bytes < 2:
            return None
        whole = self._cut or self._next(now_us, max_bytes)
        if whole is None or len(whole.data) <= max_bytes:
            self._cut = None
            return whole
        end = max_bytes & ~1
        self._cut = dataclasses.replace(whole, data=whole.data[end:])
        return Transfer(epoch_us=whole.epoch_us, data=whole.data[:end])

    def _next(self, now_us: int, max_bytes: int) -> Transfer | None:
        begin_us = self._first_us()
        if begin_us is None or begin_us > now_us:
            return self._silence(now_us)
        if begin_us - self._reported_us > _LONGEST_GAP_US:
            return self._silence(begin_us)
        return self._words(begin_us, now_us, max_bytes)

    def _first_us(self) -> int | None:
        firsts = [int(self._waiting[0]["t"][0])] if self._waiting else []
        if len(self._edges):
            firsts.append(max(int(self._edges["t"][0].astype(np.int64)), self._reported_us))
        return min(firsts, default=None)

    def _silence(self, until_us: int) -> Transfer | None:
        if until_us - self._reported_us < _SILENCE_US:
            return None
        self._reported_us = min(until_us, self._reported_us + _LONGEST_SILENCE_US)
        words = self._encoder.advance(self._reported_us - self.epoch_us)
        return Transfer(epoch_us=self.epoch_us, data=words) if words else None

    def _words(self, begin_us: int, now_us: int, max_bytes: int) -> Transfer:
        until_us = min(now_us, begin_us + _LONGEST_GAP_US)
        room = max(max_bytes // 8 - 2, _FEWEST_EVENTS)
        events = self._taken(until_us, room)
        if len(events) == room:
            until_us = int(events["t"][-1])
        edges = self._taken_edges(until_us)
        last_us = max(int(each["t"][-1]) for each in (events, edges) if len(each))
        self._reported_us = max(self._reported_us, last_us)
        words = self._encoder.encode(self._own(events), self._own(edges))
        return Transfer(events, edges, self.epoch_us, data=words)

    def _taken(self, until_us: int, room: int) -> Events:
        """Return up to `room` events that are not later than `until_us`."""
        taken = []
        while self._waiting and room:
            first = self._waiting[0]
            count = min(room, int(np.searchsorted(first["t"], until_us, side="right")))
            if not count:
                break
            taken.append(first[:count])
            room -= count
            self._queued -= count
            self._waiting[0] = first[count:]
            if count < len(first):
                break
            self._waiting.popleft()
        return join_events(taken) if taken else empty_events()

    def _taken_edges(self, until_us: int) -> Edges:
        """Return the edges that are not later than `until_us`; the sensor itself assigns the time of late ones."""
        times = np.maximum.accumulate(np.maximum(self._edges["t"].astype(np.int64), self._reported_us))
        due = times <= until_us
        edges = self._edges[due].copy()
        edges["t"] = times[due]
        self._edges = self._edges[~due]
        return edges

    def _own(self, records: Events | Edges) -> Events | Edges:
        own = copy_events(records) if records.dtype == empty_events().dtype else records.copy()
        own["t"] -= np.uint64(self.epoch_us)
        return own


VENDOR_ID = 0x04B4
PRODUCT_ID = 0x00F5
ANSWER_ENDPOINT = 0x82
REQUEST_ENDPOINT = 0x02
DATA_ENDPOINT = 0x81

_INTERFACE_CLASS = (0xFF, 0x19, 0)
_BULK_PACKET = {Speed.SUPER: 1024, Speed.HIGH: 512, Speed.FULL: 64}
_OTHER_SPEED = {Speed.HIGH: Speed.FULL, Speed.FULL: Speed.HIGH}


@dataclass(frozen=True)
class Evk4Settings:
    """Settings of a camera.

    Attributes
    ----------
    serial
        1 to 8 hexadecimal digits.
    fifo_bytes
        Room for events that wait for the host, at 6 bytes each: time, row and column.
    start_delay_us
        Silence after the sensor starts, stream time; see `davis346.settings`, the fault of the driver is the same.
    release
        Firmware version, 0x00MMmmpp; OpenEB refuses below 0x030800.
    build_unix_s
        Build time of the firmware.
    biases
        Effect of the biases on the sensor.
    """

    serial: str = "00000346"
    speed: Speed = Speed.SUPER
    fifo_bytes: int = 256 * 1024
    start_delay_us: int = 300_000
    bcd_device: int = 0x0309
    release: int = 0x03_0900
    build_unix_s: int = 1_700_000_000
    surroundings: Surroundings = field(default_factory=Surroundings)
    biases: BiasModel = field(default_factory=BiasModel)

    def __post_init__(self) -> None:
        if not 1 <= len(self.serial) <= 8 or set(self.serial) - set("0123456789abcdefABCDEF"):
            raise ValueError(f"the serial of an EVK4 has 1 to 8 hexadecimal digits, got {self.serial!r}")
        if self.fifo_bytes < 1024:
            raise ValueError(f"fifo_bytes must be at least 1024, got {self.fifo_bytes}")
        if self.start_delay_us < 0:
            raise ValueError(f"start_delay_us {self.start_delay_us} must not be negative")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor, pixels."""
        return SIZE

    @property
    def identity(self) -> Identity:
        """The camera as a host's bus lists it."""
        return Identity(VENDOR_ID, PRODUCT_ID, self.bcd_device, self.speed, interfaces=(_INTERFACE_CLASS,))

    def descriptors(self) -> DescriptorSet:
        """Return all descriptors at the camera's speed."""
        other = _OTHER_SPEED.get(self.speed)
        return DescriptorSet(
            device=DeviceDescriptor(self.speed, VENDOR_ID, PRODUCT_ID, self.bcd_device, strings=(1, 2, 0)),
            configuration=_configuration(self.speed),
            strings={1: "Prophesee", 2: "EVK4"},
            other_speed=_configuration(other) if other else None,
        )


def _configuration(speed: Speed) -> Configuration:
    """Return the configuration; OpenEB requires these three endpoints in this order."""
    addresses = (ANSWER_ENDPOINT, REQUEST_ENDPOINT, DATA_ENDPOINT)
    endpoints = tuple(Endpoint(each, TransferType.BULK, _BULK_PACKET[speed], burst=15) for each in addresses)
    return Configuration(speed, (Interface(endpoints, interface_class=_INTERFACE_CLASS),))


_BOARD_KIND = 0x72
_KIND = b"\x31\x00"
_IN = 0x80
_MOST_ANSWERS = 64
_FIFO_BYTES_PER_EVENT = 6


class Evk4(UsbCamera):
    """The camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    data_endpoint = DATA_ENDPOINT & 15

    def __init__(self, settings: Evk4Settings | None = None) -> None:
        self.settings = settings = settings or Evk4Settings()
        self._standard = StandardControl(settings.descriptors())
        self._registers = Registers(settings.surroundings, settings.biases)
        self._selection = Selection(self._registers)
        facts = BoardFacts(int(settings.serial, 16), settings.release, settings.build_unix_s)
        self._board = Board(facts, self)
        self._answers: deque[bytes] = deque()
        self._fates = Fates()
        self._flushes = 0
        self._now_us = self._epoch_us = self._silent_until_us = 0
        self._outflow = self._new_outflow()
        self._was_running = False

    @property
    def identity(self) -> Identity:
        """Vendor, product, speed and interfaces."""
        return self.settings.identity

    @property
    def now_us(self) -> int:
        """Stream time that the camera has reached."""
        return self._now_us

    @property
    def streaming(self) -> bool:
        """True while events offered now would go to the host."""
        return self._registers.running and self._now_us >= self._silent_until_us

    @property
    def room_events(self) -> int:
        """Events that fit the buffer now."""
        return self._outflow.room

    @property
    def silent_until_us(self) -> int:
        """End of the silence after the start; 0 while the sensor is stopped."""
        return self._silent_until_us if self._registers.running else 0

    @property
    def horizon_us(self) -> int:
        """During the silence after the start its end; otherwise without limit."""
        silent = self._now_us < self.silent_until_us
        return self._silent_until_us if silent else super().horizon_us

    @property
    def epoch_us(self) -> int:
        """Stream time at which device time is zero."""
        return self._epoch_us

    @property
    def biases(self) -> dict[str, int]:
        """Currents of the biases, 0 to 255, by Prophesee's names, as the host set them."""
        return {name: self._registers[address] & 0xFF for name, (address, _) in BIASES.items()}

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """Effect on the pixels of the biases that the host wrote; empty while they are the factory's."""
        return self._registers.sensor_factors

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Biases that the host changed without an effect here, each with the reason."""
        return self.settings.biases.without_effect(self._registers.bias_steps)

    @property
    def counters(self) -> Fates:
        """Fates of all events and edges offered so far."""
        return self._fates.waiting(self._outflow.queued, self._outflow.edges_queued)

    def offer(self, events: Events) -> None:
        """Queue events (n,) EVENT; raises ValueError if they go back in time or lie outside the array."""
        if not len(events):
            return
        self._check(events)
        self._fates.offered += len(events)
        begun = events[:0]
        if self._registers.running:
            begun = events[int(np.searchsorted(events["t"], self._silent_until_us)) :]
        self._now_us = int(events["t"][-1])
        selected = self._selection.apply(begun, self._epoch_us)
        fitting = self._outflow.put(selected.events)
        self._fates.not_running += len(events) - len(begun)
        self._fates.not_selected += selected.outside
        self._fates.dropped_rate += selected.beyond_rate
        self._fates.dropped_fifo += len(selected.events) - fitting

    def offer_edges(self, edges: Edges) -> None:
        """Apply edges (n,) EDGE to the trigger input."""
        counts = self._fates.edges
        counts.offered += len(edges)
        if not (self.streaming and self._registers.has_trigger):
            counts.ignored += len(edges)
            return
        counts.dropped_fifo += len(edges) - self._outflow.put_edges(edges)

    def advance(self, now_us: int) -> None:
        """Set stream time to `now_us`; the clock never goes back."""
        self._now_us = max(self._now_us, now_us)

    def descriptors(self, speed: Speed) -> DescriptorSet:
        """Return the answers to GET_DESCRIPTOR at a speed."""
        return dataclasses.replace(self.settings, speed=speed).descriptors()

    def flushes(self, endpoint: int) -> int:
        """Number of times that the sensor was started, stopped, or lost power."""
        return self._flushes if endpoint | _IN == DATA_ENDPOINT else 0

    def attached(self) -> None:
        """Set the power-on state: a host has attached the camera."""
        self._power_on()

    def detached(self) -> None:
        """Stop the camera: the host is gone. Waiting events are dropped and counted."""
        self._power_on()

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Execute one control transfer; see `UsbDevice.control` and the module's description."""
        if setup.kind is RequestKind.STANDARD:
            return self._standard.control(setup, data)
        wanted = (RequestKind.VENDOR, Recipient.DEVICE, True, _BOARD_KIND)
        if (setup.kind, setup.recipient, setup.is_in, setup.request) != wanted:
            raise Stall
        return _KIND[: setup.length]

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
        transfer = self._outflow.take(self._now_us, max_bytes)
        if transfer is not None:
            self._fates.take(transfer)
        return transfer

    def sent(self, transfer: Transfer) -> None:
        """Count the transfer's events as delivered."""
        self._fates.leave(transfer, "delivered")

    def lost(self, transfer: Transfer) -> None:
        """Count the transfer's events as lost on the link."""
        self._fates.leave(transfer, "lost_on_link")

    def read_register(self, address: int) -> int:
        """Return the value that a host reads from the sensor; raises LookupError if there is no register."""
        return self._registers.read(address)

    def write_register(self, address: int, value: int) -> None:
        """Execute a host's write to the sensor; raises LookupError if there is no register."""
        had_time = self._registers.time_runs
        self._registers.write(address, value)
        self._selection.written(address)
        if self._registers.time_runs and not had_time:
            self._epoch_us = self._now_us
        if self._registers.running != self._was_running:
            self._turn()

    def _turn(self) -> None:
        """Begin a stream, or end it."""
        self._drop_waiting()
        self._was_running = self._registers.running
        if self._was_running:
            self._silent_until_us = self._now_us + self.settings.start_delay_us

    def _power_on(self) -> None:
        self._standard.power_on()
        self._registers.power_on()
        self._selection.reset()
        self._answers.clear()
        self._was_running = False
        self._drop_waiting()

    def _drop_waiting(self) -> None:
        self._fates.flushed += self._outflow.queued
        self._fates.edges.flushed += self._outflow.edges_queued
        self._outflow = self._new_outflow()
        self._flushes += 1

    def _new_outflow(self) -> Outflow:
        return Outflow(self._epoch_us, self.settings.fifo_bytes // _FIFO_BYTES_PER_EVENT)

    def _answer(self, max_bytes: int) -> Transfer | None:
        """Return the oldest answer; of one that is too long, the first part, and the rest next time."""
        if not self._answers or max_bytes < 1:
            return None
        answer = self._answers.popleft()
        if len(answer) > max_bytes:
            self._answers.appendleft(answer[max_bytes:])
        return Transfer(epoch_us=self._epoch_us, data=answer[:max_bytes])

    def _check(self, events: Events) -> None:
        if int(events["t"][0]) < self._now_us or bool((events["t"][1:] < events["t"][:-1]).any()):
            raise ValueError("events go back in time")
        width, height = self.settings.size
        if int(events["x"].max()) >= width or int(events["y"].max()) >= height:
            raise ValueError(f"events outside the {width} x {height} array")

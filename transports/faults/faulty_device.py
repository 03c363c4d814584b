"""Fault injection on a device on USB, between it and its host; the faults are in `usb` and `words`. Sans-I/O.

If the words of an event or edge do not arrive unchanged, it is removed from the Transfer that the host's side counts,
and is counted in the fault's record. The device still receives `sent` for all of them, as a real one believes it has
sent them.

`FalseAnswers` changes the camera's answers: its identity, its versions, and bits of its registers.

    GET_DESCRIPTOR device     bytes 12, 13: bcdDevice; its low byte is the firmware version
    GET_DESCRIPTOR string 3   the serial number: length, type 3, UTF-16
    0xBF IN, 4 bytes          a register of a DAVIS346, big-endian; see `fx3.camera`

`WordPath` passes the words through the stages, and compares the result with the original until they agree again.

`Survivors` finds the events and edges that reach an intact receiver. Two decoders read: one the words that the camera
sent, the other those that arrive. An event or edge survives when its own word arrives and gives the same time, place
and polarity. A receiver that misses a wrap therefore has no event of the camera's until the next timestamp reset: all
its times are wrong. An additional byte at the end of a transfer is discarded, as libcaer does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.model import DAVIS240C, DAVIS346
from firmware_protocol.device.items import Reading
from firmware_protocol.events import Edges, Events, Int64s, Mask
from firmware_protocol.fx3.camera import REGISTER, VENDOR_ID
from firmware_protocol.fx3.decoded import Decoded
from firmware_protocol.fx3.registers import Module
from firmware_protocol.fx3.words import MAX_ADDRESS, is_column, is_mark
from firmware_protocol.usb.control import Feature, Recipient, StandardRequest
from firmware_protocol.usb.device import Identity, RequestKind, SetupPacket, Stall, Transfer, UsbCamera, UsbDevice
from transports.faults.kinds import USB_LINK, Fault, Stage
from transports.faults.script import FaultPlan, Faulty
from transports.faults.usb import ControlStage, RegisterFlip, UsbStage, UsbUnplugged, WrongVersion
from transports.faults.words import INSERTED, SentWords, WordStage, inserted

_ANY_SIZE = (MAX_ADDRESS + 1, MAX_ADDRESS + 1)  # faults change no address


class Survivors:
    """Comparison of the words sent with the words that arrive, from its creation on."""

    def __init__(self) -> None:
        # Earlier words are the same for both, so both may begin at time zero and row zero.
        self._sent, self._arrived = Decoder(_ANY_SIZE), Decoder(_ANY_SIZE)

    @property
    def agree(self) -> bool:
        """True when a receiver is in step again: the same time and the same row."""
        states = [(decoder.time_us, decoder.row) for decoder in (self._sent, self._arrived)]
        return states[0] == states[1]

    def of(self, transfer: Transfer, arriving: SentWords) -> Transfer:
        """Return `transfer` with the arriving data, and with the events and edges that survive."""
        original = SentWords.of(transfer.data)
        sent, arrived = self._sent.feed(transfer.data), self._arrived.feed(arriving.words.tobytes())
        count = len(original.words)
        events = _is_unchanged(_event_words(original, sent), _event_words(arriving, arrived), count)
        edges = _is_unchanged(_edge_words(original, sent), _edge_words(arriving, arrived), count)
        return replace(
            transfer,
            data=arriving.data,
            events=transfer.events[events[is_column(original.words)]],
            edges=transfer.edges[edges[is_mark(original.words)]],
        )


class _DecodedWords(NamedTuple):
    """The n words of one kind of a transfer.

    Attributes
    ----------
    origin : (n,) index of each word among those that the camera sent; INSERTED: it did not send this word.
    meaning : (n,) time, and place and polarity or code, that a decoder reads from each.
    """

    origin: Int64s
    meaning: npt.NDArray[np.void]


def _event_words(words: SentWords, decoded: Decoded) -> _DecodedWords:
    return _DecodedWords(words.origin[is_column(words.words)], decoded.events)


def _edge_words(words: SentWords, decoded: Decoded) -> _DecodedWords:
    marks = decoded.specials[is_mark(decoded.specials["code"])]
    return _DecodedWords(words.origin[is_mark(words.words)], marks[["t", "code"]])


def _is_unchanged(sent: _DecodedWords, arrived: _DecodedWords, count: int) -> Mask:
    """Return for each of the `count` words sent whether it arrives with the same meaning, (count,)."""
    place_in_kind = np.full(count, -1)
    place_in_kind[sent.origin] = np.arange(len(sent.origin))
    is_of_camera = arrived.origin != INSERTED
    origin = arrived.origin[is_of_camera]
    is_same = arrived.meaning[is_of_camera] == sent.meaning[place_in_kind[origin]]
    is_unchanged = np.zeros(count, np.bool_)
    is_unchanged[origin[is_same]] = True
    return is_unchanged


class WordPath:
    """Path of the words of one camera through the faults; `front`: words inserted before the next transfer."""

    def __init__(self, camera: Identity) -> None:
        usb_id = camera.vendor_id, camera.product_id
        self._has_words = usb_id in [(VENDOR_ID, model.product_id) for model in (DAVIS346, DAVIS240C)]
        self._survivors: Survivors | None = None
        self._epoch_us = self._next_front = 0
        self.front: list[int] = []

    def needed(self, stages: Sequence[WordStage]) -> bool:
        """Return True if transfers have to take this path."""
        return self._has_words and bool(stages or self.front or self._survivors)

    def room(self, stages: Sequence[WordStage], max_bytes: int) -> int:
        """Return the number of bytes that the camera may send, so that the arriving transfer fits into `max_bytes`."""
        self._next_front = min(len(self.front), max_bytes // 4)  # half of a transfer at most
        max_bytes -= 2 * self._next_front
        for stage in reversed(stages):
            max_bytes = stage.room(max_bytes)
        return max_bytes

    def changed(self, transfer: Transfer, stages: Sequence[WordStage]) -> Transfer:
        """Return the transfer that arrives, with the events and edges that survive."""
        sent = SentWords.of(transfer.data)
        for stage in stages:
            sent = stage.change(sent)
        sent, self.front = inserted(sent, 0, self.front[: self._next_front]), self.front[self._next_front :]
        if self._survivors is None or transfer.epoch_us != self._epoch_us:
            # After a clock reset, a receiver without earlier data begins a new stream.
            self._survivors, self._epoch_us = Survivors(), transfer.epoch_us
        arrived = self._survivors.of(transfer, sent)
        if not stages and not self.front and self._survivors.agree:
            self._survivors = None
        return arrived


_DEVICE, _SERIAL = 0x0100, 0x0303
_STRING_TYPE = 3
_OUT, _IN = 0x40, 0xC0
_Address = tuple[int, int]
_LOGIC = (Module.SYSTEM, 0)
_CHIP = (Module.SYSTEM, 1)
_PATCH = (Module.SYSTEM, 7)


class FalseAnswers:
    """False answers of the camera.

    Attributes
    ----------
    serial : its serial number; empty: its own.
    versions : the faults that change its versions; the last one counts.
    """

    def __init__(self) -> None:
        self.serial = ""
        self.versions: list[WrongVersion] = []
        self._flipped: dict[_Address, int] = {}

    def power_on(self) -> None:
        """Discard the flips of registers."""
        self._flipped.clear()

    def flip(self, address: _Address, bit: int) -> None:
        """Invert one bit in each reading of a register that no host can write."""
        self._flipped[address] = self._flipped.get(address, 0) ^ 1 << bit

    def identity(self, true: Identity) -> Identity:
        """Return the identity that the host's bus lists."""
        return replace(true, bcd_device=self._firmware(true.bcd_device))

    def answer(self, setup: SetupPacket, true: bytes) -> bytes:
        """Return the answer to one IN request that the host receives."""
        if setup.kind is RequestKind.STANDARD and setup.request == StandardRequest.GET_DESCRIPTOR:
            return self._descriptor(setup, true)
        if setup.kind is RequestKind.VENDOR and setup.request == REGISTER and len(true) == 4:
            address = setup.value, setup.index
            value = self._version(address, int.from_bytes(true, "big")) ^ self._flipped.get(address, 0)
            return value.to_bytes(4, "big")
        return true

    def _descriptor(self, setup: SetupPacket, true: bytes) -> bytes:
        if setup.value == _DEVICE and len(true) >= 14:
            firmware = self._firmware(int.from_bytes(true[12:14], "little"))
            return true[:12] + firmware.to_bytes(2, "little") + true[14:]
        if setup.value == _SERIAL and self.serial:
            text = self.serial.encode("utf-16-le")
            return (bytes((len(text) + 2, _STRING_TYPE)) + text)[: setup.length]
        return true

    def _firmware(self, true: int) -> int:
        false = [fault.firmware for fault in self.versions if fault.firmware >= 0]
        return true & 0xFF00 | false[-1] if false else true

    def _version(self, address: _Address, true: int) -> int:
        values = {_LOGIC: "logic_version", _CHIP: "chip", _PATCH: "logic_patch"}
        name = values.get((Module(address[0]), address[1])) if address[0] == Module.SYSTEM else None
        false = [getattr(fault, name) for fault in self.versions if getattr(fault, name) >= 0] if name else []
        return false[-1] if false else true


def flip_register(device: UsbDevice, false: FalseAnswers, flip: RegisterFlip) -> bool:
    """Invert one bit of a register of `device`; return False if it has no such register requests."""
    get = SetupPacket(_IN, REGISTER, flip.module, flip.parameter, 4)
    put = SetupPacket(_OUT, REGISTER, flip.module, flip.parameter, 4)
    try:
        value = int.from_bytes(device.control(get, b""), "big") ^ 1 << flip.bit
        device.control(put, value.to_bytes(4, "big"))
        if int.from_bytes(device.control(get, b""), "big") != value:
            false.flip((flip.module, flip.parameter), flip.bit)
    except Stall:
        return False
    return True


Report = Callable[[Events, int, Edges, Sequence[Reading]], None]


class FaultyDevice(Faulty[Stage], UsbDevice):
    """USB device that passes all calls to a device, through the faults.

    Parameters
    ----------
    report : Called with the events, epoch, edges and readings that have reached the host with a transfer; by default,
        for a device without a link, they are not reported.
    """

    carrier = USB_LINK

    def __init__(
        self,
        device: UsbDevice,
        plan: FaultPlan,
        report: Report = lambda events, epoch_us, edges, readings: None,
    ) -> None:
        self._device = device
        self._report = report
        super().__init__(plan, self._dropped)
        self._seen: set[int] = set()
        self._halted: set[int] = set()
        self._words = WordPath(device.identity)
        self._false = FalseAnswers()
        # Transfers of the device that have no fate yet, oldest first; None: a transfer made by a fault.
        self._originals: deque[Transfer | None] = deque()
        self._data_endpoint = device.data_endpoint if isinstance(device, UsbCamera) else 2
        self._now_us = 0

    @property
    def gone(self) -> bool:
        """True while the device is unplugged."""
        return any(stage.gone for stage in self._endpoint_stages)

    @property
    def withholds(self) -> bool:  # type: ignore[override]  # read only
        """True while its data endpoint is silent."""
        return any(stage.silent and stage.endpoint == self._data_endpoint for stage in self._endpoint_stages)

    def advance(self, now_us: int) -> None:
        """Advance stream time."""
        self._now_us = max(self._now_us, now_us)
        if self._faults.stages:
            dropped = self._dropped()
            for stage in self._endpoint_stages:  # a FIFO that was to overflow
                stage.over |= bool(stage.overflow) and dropped >= stage.overflow
        for over in self._faults.advance(now_us):
            self._words.front += over.finish() if isinstance(over, WordStage) else []
        if self._faults.stages or self._seen:
            self._begin_new()

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for a fault that USB does not have."""
        super().inject(fault)
        self._begin_new()

    @property
    def identity(self) -> Identity:
        """Identity of the device, or the false one of a fault."""
        return self._false.identity(self._device.identity)

    def attached(self) -> None:
        """Set the power-on state, in which no endpoint is halted."""
        self._halted.clear()
        self._false.power_on()
        self._start_data()
        self._device.attached()

    def detached(self) -> None:
        """Pass on that the host is gone."""
        self._device.detached()

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Pass on a request, unless it is refused or answered late; the host may end a halt."""
        if setup.kind is RequestKind.VENDOR:
            self._check_request(setup)
        answer = self._device.control(setup, data)
        if _ends_halt(setup):
            self._halted.discard(setup.index & 0x0F)
            if setup.index & 0x0F == self._data_endpoint:
                self._start_data()
        return self._false.answer(setup, answer) if setup.is_in else answer

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """Return the data of the device as they arrive; None for an endpoint that is silent."""
        if not self._faults.stages and endpoint not in self._halted:
            return self._read(endpoint, max_bytes)
        for stage in [stage for stage in self._endpoint_stages if stage.endpoint == endpoint]:
            if stage.stalls and endpoint not in self._halted:
                self._halted.add(endpoint)
                stage.stalls -= 1
                stage.over = not stage.stalls
                self._hit(stage)
            if stage.silent:
                self._hit(stage)
                return None
            if stage.most_bytes and max_bytes > stage.most_bytes:
                self._hit(stage)
                max_bytes = stage.most_bytes
            if stage.empty is not None and endpoint not in self._halted and stage.empty.within(1):
                stage.over = stage.empty.over
                self._hit(stage)
                self._originals.append(None)
                return Transfer()
        if endpoint in self._halted:
            raise Stall(f"endpoint {endpoint} is halted, by a fault")
        return self._read(endpoint, max_bytes)

    def accepts(self, setup: SetupPacket) -> bool:
        """Return the device's answer: no fault refuses data."""
        return self._device.accepts(setup)

    def name_request(self, setup: SetupPacket, data: bytes) -> str:
        """Return the device's name of a request: no fault changes it."""
        return self._device.name_request(setup, data)

    def name_answer(self, setup: SetupPacket, data: bytes) -> str:
        """Return the device's name of an answer: no fault changes it."""
        return self._device.name_answer(setup, data)

    def flushes(self, endpoint: int) -> int:
        """Return the number of the device's flushes: no fault flushes."""
        return self._device.flushes(endpoint)

    def write(self, endpoint: int, data: bytes) -> None:
        """Pass on data of the host: no fault changes them."""
        self._device.write(endpoint, data)

    def sent(self, transfer: Transfer) -> None:
        """Pass on the transfer of the device; data that did not arrive are counted for the fault."""
        self._report(transfer.events, transfer.epoch_us, transfer.edges, transfer.readings)
        original = self._originals.popleft()
        if original is None:
            return
        self._faults.lose(len(original.events) - len(transfer.events), len(original.edges) - len(transfer.edges))
        self._device.sent(original)

    def lost(self, transfer: Transfer) -> None:
        """Pass on the transfer of the device, which the link has lost."""
        original = self._originals.popleft()
        if original is not None:
            self._device.lost(original)

    @property
    def _endpoint_stages(self) -> list[UsbStage]:
        return [stage for stage in self._faults.stages if isinstance(stage, UsbStage)]

    def _read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        stages = [stage for stage in self._faults.stages if isinstance(stage, WordStage) and not stage.over]
        if endpoint != self._data_endpoint or not self._words.needed(stages):
            transfer = original = self._device.read(endpoint, max_bytes)
        else:
            original = self._device.read(endpoint, self._words.room(stages, max_bytes))
            before = [stage.hits for stage in stages]
            transfer = None if original is None else self._words.changed(original, stages)
            for stage, hits in zip(stages, before, strict=True):
                if stage.hits > hits:
                    self._faults.applied(stage, [stage.hits] if not hits else [])
        if original is not None:
            self._originals.append(original)
        return transfer

    def _check_request(self, setup: SetupPacket) -> None:
        for stage in [stage for stage in self._faults.stages if isinstance(stage, ControlStage)]:
            hits = stage.hits
            try:
                stage.check(setup, self._now_us)
            finally:
                if stage.hits > hits:
                    self._faults.applied(stage, [stage.hits])

    def _begin_new(self) -> None:
        """Apply the immediate effects of new faults, and set the versions of the active ones."""
        stages = self._endpoint_stages
        for stage in [stage for stage in stages if id(stage) not in self._seen]:
            self._begin(stage)
        self._seen = {id(stage) for stage in stages}
        self._false.versions = [stage.fault for stage in stages if isinstance(stage.fault, WrongVersion)]

    def _begin(self, stage: UsbStage) -> None:
        if stage.overflow:
            stage.endpoint = self._data_endpoint
        if isinstance(stage.fault, UsbUnplugged) and stage.fault.serial:
            self._false.serial = stage.fault.serial
        if isinstance(stage.fault, RegisterFlip):
            stage.over = True
            if flip_register(self._device, self._false, stage.fault):
                self._hit(stage)

    def _start_data(self) -> None:
        for stage in self._faults.stages:
            if isinstance(stage, WordStage):
                stage.started()

    def _dropped(self) -> int:
        return self._device.counters.dropped_fifo if isinstance(self._device, UsbCamera) else 0

    def _hit(self, stage: UsbStage) -> None:
        stage.hits += 1
        self._faults.applied(stage, [stage.hits] if stage.hits == 1 else [])


def _ends_halt(setup: SetupPacket) -> bool:
    return (
        setup.kind is RequestKind.STANDARD
        and setup.recipient == Recipient.ENDPOINT
        and setup.request == StandardRequest.CLEAR_FEATURE
        and setup.value == Feature.ENDPOINT_HALT
    )

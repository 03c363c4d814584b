"""What faults do to a device on USB, between it and its host. Sans-I/O.

    host <-- control: refused, late, false answers --+
    host <-- read: halted, silent, short, empty -----+-- FaultyDevice <-- device
    host <-- read: changed words --------------------+

Events and edges whose words do not arrive as they were sent are taken out of the Transfer that the host's side counts,
and told of in the fault's record; the device hears that it has sent them all, as a real one believes.
"""

from __future__ import annotations

from collections import deque
from functools import partial

from firmware_protocol.usb.control import Feature, Recipient, StandardRequest
from firmware_protocol.usb.device import Identity, RequestKind, SetupPacket, Stall, Transfer, UsbCamera, UsbDevice
from transports.faults.davis_kinds import RegisterFlip, WrongVersion
from transports.faults.false_answers import FalseAnswers, flip_register
from transports.faults.kinds import Fault
from transports.faults.script import FaultPlan, FaultRecord, Faults, Stage
from transports.faults.usb_kinds import UsbUnplugged
from transports.faults.usb_stages import ControlStage, UsbStage, usb_stage
from transports.faults.word_path import WordPath
from transports.faults.word_stages import WordStage

__all__ = ["FaultyDevice"]


class FaultyDevice(UsbDevice):
    """Passes everything on to a device, by way of the faults."""

    def __init__(self, device: UsbDevice, plan: FaultPlan) -> None:
        self._device = device
        self._faults: Faults[Stage] = Faults(plan, partial(usb_stage, dropped=self._dropped))
        self._seen: set[int] = set()
        self._halted: set[int] = set()
        self._words = WordPath(device.identity)
        self._false = FalseAnswers()
        # What the device gave for each transfer that has no fate yet, oldest first; None: nothing, it is a fault's own.
        self._given: deque[Transfer | None] = deque()
        self._data_endpoint = device.data_endpoint if isinstance(device, UsbCamera) else 2
        self._now_us = 0

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """What each fault has done."""
        return self._faults.records

    @property
    def gone(self) -> bool:
        """True while the device is unplugged."""
        return any(stage.gone for stage in self._endpoint_stages)

    @property
    def silent(self) -> bool:
        """True while its data endpoint is silent."""
        return any(stage.silent and stage.endpoint == self._data_endpoint for stage in self._endpoint_stages)

    def advance(self, now_us: int) -> None:
        """Let stream time pass."""
        self._now_us = max(self._now_us, now_us)
        dropped = self._dropped()
        for stage in self._endpoint_stages:
            stage.over |= bool(stage.overflow) and dropped >= stage.overflow
        for over in self._faults.advance(now_us):
            self._words.front += over.finish() if isinstance(over, WordStage) else []
        self._take_up()

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for one that USB does not have."""
        self._faults.inject(fault)
        self._take_up()

    def close(self) -> None:
        """End them all."""
        self._faults.close()

    @property
    def identity(self) -> Identity:
        """The device's own, or what a fault makes of it."""
        return self._false.identity(self._device.identity)

    def attached(self) -> None:
        """See `UsbDevice.attached`; nothing is halted then."""
        self._halted.clear()
        self._false.power_on()
        self._start_data()
        self._device.attached()

    def detached(self) -> None:
        """Pass on."""
        self._device.detached()

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Pass on, unless it is to be refused or answered late; the host may end a halt."""
        if setup.kind is RequestKind.VENDOR:
            self._ask(setup)
        answer = self._device.control(setup, data)
        if _ends_halt(setup):
            self._halted.discard(setup.index & 0x0F)
            if setup.index & 0x0F == self._data_endpoint:
                self._start_data()
        return self._false.answer(setup, answer) if setup.is_in else answer

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """See `UsbDevice.read`."""
        for stage in [stage for stage in self._endpoint_stages if stage.endpoint == endpoint]:
            if stage.stalls and endpoint not in self._halted:
                self._halt(stage)
            if stage.silent:
                self._strike(stage)
                return None
            if stage.most_bytes and max_bytes > stage.most_bytes:
                self._strike(stage)
                max_bytes = stage.most_bytes
            if stage.empty is not None and endpoint not in self._halted and stage.empty.within(1):
                stage.over = stage.empty.over
                self._strike(stage)
                self._given.append(None)
                return Transfer(b"")
        if endpoint in self._halted:
            raise Stall(f"endpoint {endpoint} is halted, by a fault")
        return self._read(endpoint, max_bytes)

    def accepts(self, setup: SetupPacket) -> bool:
        """Pass on."""
        return self._device.accepts(setup)

    def flushes(self, endpoint: int) -> int:
        """Pass on."""
        return self._device.flushes(endpoint)

    def write(self, endpoint: int, data: bytes) -> None:
        """Pass on."""
        self._device.write(endpoint, data)

    def sent(self, transfer: Transfer) -> None:
        """Pass on what the device gave; what of it did not arrive is the fault's doing."""
        given = self._given.popleft()
        if given is None:
            return
        self._faults.lose(len(given.events) - len(transfer.events), len(given.edges) - len(transfer.edges))
        self._device.sent(given)

    def lost(self, transfer: Transfer) -> None:
        """Pass on what the device gave: the link has lost it."""
        given = self._given.popleft()
        if given is not None:
            self._device.lost(given)

    @property
    def _endpoint_stages(self) -> list[UsbStage]:
        return [stage for stage in self._faults.stages if isinstance(stage, UsbStage)]

    def _read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        stages = [stage for stage in self._faults.stages if isinstance(stage, WordStage) and not stage.over]
        if endpoint != self._data_endpoint or not self._words.needed(stages):
            transfer = given = self._device.read(endpoint, max_bytes)
        else:
            given = self._device.read(endpoint, self._words.room(stages, max_bytes))
            before = [stage.hits for stage in stages]
            transfer = None if given is None else self._words.changed(given, stages)
            for stage, hits in zip(stages, before, strict=True):
                if stage.hits > hits:
                    self._faults.struck(stage, [stage.hits] if not hits else [])
        if given is not None:
            self._given.append(given)
        return transfer

    def _ask(self, setup: SetupPacket) -> None:
        for stage in [stage for stage in self._faults.stages if not isinstance(stage, UsbStage | WordStage)]:
            asked: ControlStage = stage  # type: ignore[assignment]  # nothing else is left
            hits = asked.hits
            try:
                asked.ask(setup, self._now_us)
            finally:
                if asked.hits > hits:
                    self._faults.struck(stage, [asked.hits])

    def _take_up(self) -> None:
        """Do what faults that have begun do at once, and what follows from those that work."""
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
                self._strike(stage)

    def _start_data(self) -> None:
        for stage in self._faults.stages:
            if isinstance(stage, WordStage):
                stage.started()

    def _dropped(self) -> int:
        return self._device.counters.dropped_fifo if isinstance(self._device, UsbCamera) else 0

    def _halt(self, stage: UsbStage) -> None:
        self._halted.add(stage.endpoint)
        stage.stalls -= 1
        stage.over = not stage.stalls
        self._strike(stage)

    def _strike(self, stage: UsbStage) -> None:
        stage.hits += 1
        self._faults.struck(stage, [stage.hits] if stage.hits == 1 else [])


def _ends_halt(setup: SetupPacket) -> bool:
    return (
        setup.kind is RequestKind.STANDARD
        and setup.recipient == Recipient.ENDPOINT
        and setup.request == StandardRequest.CLEAR_FEATURE
        and setup.value == Feature.ENDPOINT_HALT
    )

"""Faults of packets in datagrams: their tables in a rig, and their effects between the endpoint and its socket.

    endpoint.send --> stage --> stage --> [datagrams for which the kernel had no room] --> socket

While no fault is active a datagram is sent directly. Each message has one fate: it has arrived when one intact copy of
it was sent, and is lost when no copy is left that could arrive. Bit flips are not detected by the checksum of UDP, as
in a gateway.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from firmware_protocol.instrument.instrument import Outgoing
from firmware_protocol.packets.profile import Profile
from transports.faults.kinds import DATAGRAMS, GIGE_STREAM, Delay, Fault, HitFault, ItemStage, Loss, Repetition, Stage
from transports.faults.line import ByteStage
from transports.faults.script import FaultPlan, Faulty, pass_through


@dataclass(frozen=True)
class LostDatagrams(HitFault, carriers=(DATAGRAMS, GIGE_STREAM), effect=Loss):
    """Datagrams that never arrive, as when a queue on the path is full."""


@dataclass(frozen=True)
class RepeatedDatagrams(HitFault, carriers=(DATAGRAMS, GIGE_STREAM), effect=Repetition):
    """Datagrams that arrive twice."""


@dataclass(frozen=True)
class LateDatagrams(HitFault, carriers=(DATAGRAMS, GIGE_STREAM)):
    """Datagrams that later datagrams overtake.

    Attributes
    ----------
    overtaken_by : number of datagrams that pass each.
    """

    overtaken_by: Annotated[int, Meta(ge=1, le=1000)] = 1

    def stage(self, random: np.random.Generator, carrier: None) -> Stage:
        """Return the delay of datagrams until `overtaken_by` others have passed."""
        return Delay(self, random, self.overtaken_by)


_Send = Callable[[bytes], bool]


@dataclass
class _Sent:
    """Message in progress: the number of its copies, and if one has arrived."""

    data: bytes
    outgoing: Outgoing
    copies: int = 1
    arrived: bool = False


@dataclass(frozen=True)
class _Copy:
    data: bytes
    of: _Sent


class _Flips(ItemStage[_Copy]):
    """Bit flips in the bytes of datagrams."""

    def __init__(self, bits: ByteStage) -> None:
        self._bits = bits
        self._copy_counts()

    def change(self, copy: _Copy) -> list[_Copy]:
        data = self._bits.change(copy.data)
        self._copy_counts()
        return [_Copy(data, copy.of)]

    def _copy_counts(self) -> None:
        self.hits = self._bits.hits
        self.touched = self._bits.touched
        self.over = self._bits.over


class FaultyDatagrams(Faulty[ItemStage[_Copy]]):
    """Path of datagrams with fault injection; `arrived` is called with each message that an intact receiver gets.

    Attributes
    ----------
    false : number of datagrams that a receiver accepts although they were not sent in this form, or were repeated.
    """

    carrier = DATAGRAMS

    def __init__(self, plan: FaultPlan, arrived: Callable[[Outgoing], None]) -> None:
        super().__init__(plan)
        self._arrived = arrived
        self._waiting: deque[_Copy] = deque()
        self._number = 0
        self.false = 0

    def _effect(self, fault: Fault, random: np.random.Generator) -> ItemStage[_Copy]:
        stage = super()._effect(fault, random)
        return _Flips(stage) if isinstance(stage, ByteStage) else stage

    def advance(self, now_us: int) -> None:
        """Advance stream time."""
        for stage in self._faults.advance(now_us):
            self._waiting += stage.finish()

    def send(self, data: bytes, outgoing: Outgoing, socket: _Send) -> bool | None:
        """Send a message through the faults; None: no room now, nothing is done. False: it cannot be sent at all."""
        if not self.flush(socket):
            return None
        if not self._faults.stages:
            return self._straight(data, outgoing, socket)
        self._waiting += pass_through(self._faults, _Copy(data, _Sent(data, outgoing)), self._number, self._settle)
        self._number += 1
        self.flush(socket)
        return True

    def _straight(self, data: bytes, outgoing: Outgoing, socket: _Send) -> bool | None:
        try:
            left = socket(data)
        except BlockingIOError:
            return None
        if left:
            self._arrived(outgoing)
        return left

    def flush(self, socket: _Send) -> bool:
        """Send the waiting datagrams; return True if all of them were sent."""
        while self._waiting and self._leave(self._waiting[0], socket):
            self._waiting.popleft()
        return not self._waiting

    def release(self, socket: _Send) -> None:
        """Send the datagrams that faults hold, before the link ends; those for which there is no room are lost."""
        for stage in self._faults.stages:
            self._waiting += stage.finish()
        if not self.flush(socket):
            for copy in self._waiting:
                self._drop(copy)

    def _settle(self, stage: ItemStage[_Copy], copy: _Copy, passed: list[_Copy]) -> None:
        """Count the copies that a fault has made, or drop the one that it has removed."""
        if isinstance(stage, Repetition):
            copy.of.copies += len(passed) - 1
        elif isinstance(stage, Loss) and not passed:
            self._drop(copy)

    def _leave(self, copy: _Copy, socket: _Send) -> bool:
        """Pass a datagram to the kernel; return False when it has no room now."""
        try:
            left = socket(copy.data)
        except BlockingIOError:
            return False
        if left and copy.data == copy.of.data:
            if copy.of.arrived:
                self.false += 1
            else:
                copy.of.arrived = True
                self._arrived(copy.of.outgoing)
        else:
            self.false += left and bool(Profile("ccsds").unwrapper().push(copy.data))
            if not left and self._faults.stages:  # attributed to the newest fault, for lack of another cause
                self._faults.applied(self._faults.stages[-1], [])
            self._drop(copy)
        return True

    def _drop(self, copy: _Copy) -> None:
        copy.of.copies -= 1
        if not copy.of.copies and not copy.of.arrived:
            self._faults.lose(len(copy.of.outgoing.events), len(copy.of.outgoing.edges))

"""What faults do to the packets of a GigE Vision stream, between the camera and the network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from transports.faults.datagram_kinds import LateDatagrams, LostDatagrams, RepeatedDatagrams
from transports.faults.hit_places import Places
from transports.faults.kinds import Fault, HitFault
from transports.faults.script import FaultPlan, FaultRecord, Faults

__all__ = ["PACKET_FAULTS", "FaultyPackets", "Packet"]

PACKET_FAULTS: Mapping[str, type[Fault]] = {one.kind: one for one in (LostDatagrams, RepeatedDatagrams, LateDatagrams)}
"""Faults of the stream, by kind."""


@dataclass(frozen=True)
class Packet:
    """A datagram of the stream, and which packet of which block it is; block 0: of none."""

    data: bytes
    block: int = 0
    number: int = 0


class _Stage(ABC):
    """One fault at work; see `Stage` for the attributes."""

    def __init__(self, fault: HitFault, random: np.random.Generator) -> None:
        self._where = Places(fault, random)
        self.hits = self.touched = 0
        self.over = False

    def struck(self) -> bool:
        """Tell whether the next packet is hit."""
        struck = bool(self._where.within(1))
        self.hits += struck
        self.touched += struck
        self.over = self._where.over and not self.holds
        return struck

    @property
    def holds(self) -> bool:
        """Whether packets wait in it."""
        return False

    @abstractmethod
    def change(self, packet: Packet) -> list[Packet]:
        """Return what goes on now."""

    def finish(self) -> list[Packet]:
        """Return what goes on when the fault is over."""
        return []


class _Loss(_Stage):
    def change(self, packet: Packet) -> list[Packet]:
        return [] if self.struck() else [packet]


class _Repetition(_Stage):
    def change(self, packet: Packet) -> list[Packet]:
        return [packet, packet] if self.struck() else [packet]


class _Delay(_Stage):
    def __init__(self, fault: LateDatagrams, random: np.random.Generator) -> None:
        super().__init__(fault, random)
        self._overtaken_by = fault.overtaken_by
        self._held: deque[tuple[int, Packet]] = deque()
        self._passed = 0

    @property
    def holds(self) -> bool:
        return bool(self._held)

    def change(self, packet: Packet) -> list[Packet]:
        if self.struck():
            self._held.append((self._passed + self._overtaken_by, packet))
            self.over = False
            return []
        self._passed += 1
        going = [packet]
        while self._held and self._held[0][0] <= self._passed:
            going.append(self._held.popleft()[1])
        self.over = self._where.over and not self._held
        return going

    def finish(self) -> list[Packet]:
        held, self._held = [packet for _, packet in self._held], deque()
        return held


def _stage(fault: Fault, random: np.random.Generator) -> _Stage:
    match fault:
        case LostDatagrams():
            return _Loss(fault, random)
        case RepeatedDatagrams():
            return _Repetition(fault, random)
        case LateDatagrams():
            return _Delay(fault, random)
    raise ValueError(f"{fault.kind!r} is no fault of a GigE Vision stream")


class FaultyPackets:
    """The faults of one stream."""

    def __init__(self, plan: FaultPlan) -> None:
        self._faults: Faults[_Stage] = Faults(plan, _stage)
        self._gone: list[Packet] = []

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """What each fault has done."""
        return self._faults.records

    def advance(self, now_us: int) -> list[Packet]:
        """Let stream time pass; return the packets that faults held and that go on now."""
        return [packet for stage in self._faults.advance(now_us) for packet in stage.finish()]

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for one that a stream does not have."""
        self._faults.inject(fault)

    def change(self, packet: Packet) -> list[Packet]:
        """Return the packets that go on when the camera sends one."""
        packets = [packet]
        for stage in self._faults.stages:
            before, going = stage.hits, list[Packet]()
            for each in packets:
                passed = stage.change(each)
                going += passed
                self._gone += [each] if not passed and isinstance(stage, _Loss) else []
            if stage.hits != before:
                self._faults.struck(stage, [packet.number])
            packets = going
        return packets

    def gone(self) -> list[Packet]:
        """Return the packets that were taken away since the last call."""
        gone, self._gone = self._gone, []
        return [packet for packet in gone if packet.block]

    def blame(self, events: int, edges: int) -> None:
        """Say that so many events and edges did not arrive because of the last fault that struck."""
        self._faults.lose(events, edges)

    def close(self) -> None:
        """End all faults; what they hold is lost with the link."""
        self._faults.close()

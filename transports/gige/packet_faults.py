"""Faults of the packets of a GigE Vision stream, between the camera and the network, and of its control channel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from firmware_protocol.gige.gvsp import removed
from transports.faults.datagrams import (
    DatagramStage,
    LateDatagrams,
    Loss,
    LostDatagrams,
    RepeatedDatagrams,
    datagram_stage,
)
from transports.faults.kinds import Fault, Places
from transports.faults.script import FaultPlan, FaultRecord, Faults
from transports.faults.usb_kinds import IpChange, LinkDown, LostHeartbeat, RefusedResends

__all__ = ["PACKET_FAULTS", "FaultyPackets", "Packet"]

PACKET_FAULTS: Mapping[str, type[Fault]] = {
    one.kind: one
    for one in (LostDatagrams, RepeatedDatagrams, LateDatagrams, RefusedResends, LostHeartbeat, LinkDown, IpChange)
}
"""Faults of a camera, by kind."""


@dataclass(frozen=True)
class Packet:
    """Datagram of the stream, with its block and packet number (block 0: of none); `again` if it is sent again."""

    data: bytes
    block: int = 0
    number: int = 0
    again: bool = False


class _Refusal(DatagramStage[Packet]):
    """Refusal of single packets that a host requested again: they are reported as no longer stored."""

    def __init__(self, fault: RefusedResends, random: np.random.Generator) -> None:
        super().__init__()
        self._where = Places(fault, random)

    def change(self, datagram: Packet) -> list[Packet]:
        """See `DatagramStage.change`."""
        if not datagram.again or not self._where.within(1):
            return [datagram]
        self.hits += 1
        self.touched += 1
        self.over = self._where.over
        return [Packet(removed(datagram.block, datagram.number))]


class _Down(DatagramStage[Packet]):
    """Fault that stops all packets."""

    def change(self, datagram: Packet) -> list[Packet]:
        """See `DatagramStage.change`."""
        self.hits = 1
        self.touched += 1
        return []


class _Moving(_Down):
    """Change of address: control is to be taken away, and no packet passes until the camera has its new address."""

    def __init__(self, address: str) -> None:
        super().__init__()
        self.address = address
        self.taken = False

    def take(self) -> None:
        """Record that control has been taken away."""
        self.hits, self.taken = 1, True


class _Taking(DatagramStage[Packet]):
    """Removal of control; over when it is done."""

    taken = False

    def take(self) -> None:
        """Record that control has been taken away."""
        self.hits, self.taken, self.over = 1, True, True

    def change(self, datagram: Packet) -> list[Packet]:
        """See `DatagramStage.change`."""
        return [datagram]


def _stage(fault: Fault, random: np.random.Generator) -> DatagramStage[Packet]:
    match fault:
        case RefusedResends():
            return _Refusal(fault, random)
        case LinkDown():
            return _Down()
        case IpChange():
            return _Moving(fault.address)
        case LostHeartbeat():
            return _Taking()
    return datagram_stage(fault, random)


class FaultyPackets:
    """Faults of one stream."""

    def __init__(self, plan: FaultPlan) -> None:
        self._faults: Faults[DatagramStage[Packet]] = Faults(plan, _stage)
        self._gone: list[Packet] = []
        self._address: str | None = None

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """Record of each fault."""
        return self._faults.records

    @property
    def next_us(self) -> int:
        """See `Faults.next_us`."""
        return self._faults.next_us

    def advance(self, now_us: int) -> list[Packet]:
        """Advance stream time; return the packets that faults held and that pass now."""
        over = self._faults.advance(now_us)
        self._address = next((stage.address for stage in over if isinstance(stage, _Moving)), self._address)
        return [packet for stage in over for packet in stage.finish()]

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for a fault that a stream does not have."""
        self._faults.inject(fault)

    def change(self, packet: Packet) -> list[Packet]:
        """Return the packets to be sent in place of `packet`."""
        packets = [packet]
        for stage in self._faults.stages:
            before, going = stage.hits, list[Packet]()
            for each in packets:
                passed = stage.change(each)
                going += passed
                self._gone += [each] if not passed and isinstance(stage, (Loss, _Down)) else []
            if stage.hits != before:
                self._faults.applied(stage, [packet.number])
            packets = going
        return packets

    @property
    def link_is_down(self) -> bool:
        """True while no data pass in either direction."""
        return any(isinstance(stage, _Down) for stage in self._faults.stages)

    def takes_control(self) -> bool:
        """Return True once when control is to be taken away from the host."""
        taking = [stage for stage in self._faults.stages if isinstance(stage, _Taking | _Moving) and not stage.taken]
        for stage in taking:
            stage.take()
            self._faults.applied(stage, [])
        return bool(taking)

    def new_address(self) -> str | None:
        """Return once the address that the camera has from now on; None if it keeps its address."""
        address, self._address = self._address, None
        return address

    @property
    def active(self) -> bool:
        """True while any fault is active."""
        return bool(self._faults.stages)

    def gone(self) -> list[Packet]:
        """Return the packets that were removed since the last call."""
        gone, self._gone = self._gone, []
        return [packet for packet in gone if packet.block]

    def attribute(self, events: int, edges: int) -> None:
        """Attribute the loss of events and edges to the last fault that was applied."""
        self._faults.lose(events, edges)

    def close(self) -> None:
        """End all faults; the packets that they hold are lost with the link."""
        self._faults.close()

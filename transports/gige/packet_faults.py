"""Faults of the packets of a GigE Vision stream, between the camera and the network, and of its control channel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from firmware_protocol.gige.gvsp import removed
from transports.faults.datagrams import LateDatagrams, LostDatagrams, RepeatedDatagrams, datagram_stage
from transports.faults.items import HitStage, ItemStage, Loss, pass_through
from transports.faults.kinds import Fault
from transports.faults.script import FaultPlan, Faulty
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


class _Refusal(HitStage[Packet]):
    """Refusal of single packets that a host requested again: they are reported as no longer stored."""

    def change(self, item: Packet) -> list[Packet]:
        """See `ItemStage.change`."""
        return [Packet(removed(item.block, item.number))] if item.again and self.is_hit() else [item]


class _Down(ItemStage[Packet]):
    """Fault that stops all packets."""

    def change(self, item: Packet) -> list[Packet]:
        """See `ItemStage.change`."""
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


class _Taking(ItemStage[Packet]):
    """Removal of control; over when it is done."""

    taken = False

    def take(self) -> None:
        """Record that control has been taken away."""
        self.hits, self.taken, self.over = 1, True, True


def _stage(fault: Fault, random: np.random.Generator) -> ItemStage[Packet]:
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


class FaultyPackets(Faulty[ItemStage[Packet]]):
    """Faults of one stream."""

    def __init__(self, plan: FaultPlan) -> None:
        super().__init__(plan, _stage)
        self._gone: list[Packet] = []
        self._address: str | None = None

    def advance(self, now_us: int) -> list[Packet]:
        """Advance stream time; return the packets that faults held and that pass now."""
        over = self._faults.advance(now_us)
        self._address = next((stage.address for stage in over if isinstance(stage, _Moving)), self._address)
        return [packet for stage in over for packet in stage.finish()]

    def change(self, packet: Packet) -> list[Packet]:
        """Return the packets to be sent in place of `packet`."""
        return pass_through(self._faults, packet, packet.number, self._remember)

    def _remember(self, stage: ItemStage[Packet], packet: Packet, passed: list[Packet]) -> None:
        """Collect a packet that a fault has removed."""
        self._gone += [packet] if not passed and isinstance(stage, (Loss, _Down)) else []

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

"""Faults of a GigE Vision camera: their tables in a rig, and their effects.

They act on the packets of its stream, between the camera and the network, and on its control channel; those of
`transports.faults.datagrams` can hit its packets too. See `transports.faults.kinds` for the attributes that all faults
have.
"""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from firmware_protocol.gige.gvsp import removed
from transports.faults.kinds import GIGE_STREAM, Fault, HitFault, HitStage, ItemStage, LastingFault, Length, Loss
from transports.faults.script import FaultPlan, Faulty, pass_through


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
        return [Packet(removed(item.block, item.number))] if item.again and self.is_hit() else [item]


@dataclass(frozen=True)
class RefusedResends(HitFault, carriers=(GIGE_STREAM,), effect=_Refusal):
    """Packets that a host requests again and that the camera no longer holds, like one with a small memory."""


class _Taking(ItemStage[Packet]):
    """Removal of control; over when it is done."""

    taken = False

    def take(self) -> None:
        """Record that control has been taken away."""
        self.hits = 1
        self.taken = self.over = True


@dataclass(frozen=True)
class LostHeartbeat(Fault, carriers=(GIGE_STREAM,), effect=_Taking):
    """The camera takes control away from its host, as when the host's heartbeat did not arrive in time."""

    disconnects: ClassVar[bool] = True


class _Down(ItemStage[Packet]):
    """Fault that stops all packets."""

    def change(self, item: Packet) -> list[Packet]:
        self.hits = 1
        self.touched += 1
        return []


@dataclass(frozen=True)
class LinkDown(LastingFault, carriers=(GIGE_STREAM,), effect=_Down):
    """The cable is unplugged and plugged in again: no data pass in either direction in between."""

    disconnects: ClassVar[bool] = True


class _Moving(_Down):
    """Change of address: control is to be taken away, and no packet passes until the camera has its new address."""

    def __init__(self, fault: IpChange, random: np.random.Generator, carrier: None) -> None:
        super().__init__(fault, random, carrier)
        self.address = fault.address
        self.taken = False

    def take(self) -> None:
        """Record that control has been taken away."""
        self.hits, self.taken = 1, True


@dataclass(frozen=True)
class IpChange(LastingFault, carriers=(GIGE_STREAM,), effect=_Moving):
    """The camera leaves its IP address and returns with another one, as after a new DHCP lease or a FORCEIP.

    Attributes
    ----------
    for_s : time without an address.
    address
        IPv4 address that it has afterwards, to the end of the run; one of this machine's, on loopback any 127.x.y.z.
    """

    disconnects: ClassVar[bool] = True
    for_s: Length = 0.5
    address: str = "127.0.0.254"

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            good = not ipaddress.IPv4Address(self.address).is_unspecified
        except ValueError:
            good = False
        if not good:
            raise ValueError(f"address must be an IPv4 address that the camera has afterwards, got {self.address!r}")


class FaultyPackets(Faulty[ItemStage[Packet]]):
    """Faults of one stream."""

    carrier = GIGE_STREAM

    def __init__(self, plan: FaultPlan) -> None:
        super().__init__(plan)
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

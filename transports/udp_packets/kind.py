"""The record of packets in datagrams."""

from __future__ import annotations

from typing import Any

from transports.faults.datagram_kinds import DATAGRAM_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Listener, Wiring, check_region
from transports.udp_packets.parameters import UdpPackets

__all__ = ["UDP_PACKETS"]


def _endpoint(link: UdpPackets, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.udp_packets.endpoint import UdpPacketFactory

    return UdpPacketFactory(link, wiring.faults)


UDP_PACKETS = LinkKind(
    UdpPackets,
    serves="instrument",
    endpoint=_endpoint,
    faults=DATAGRAM_FAULTS,
    listener=Listener("udp", "Read a camera whose packets come in UDP datagrams.", "emulator.cli.listen.udp:udp"),
    check=check_region,
)

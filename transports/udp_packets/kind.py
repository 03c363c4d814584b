"""The record of packets in datagrams.

What a rig says of packets in datagrams.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from firmware_protocol.instrument.settings import InstrumentSettings
from transports.faults.datagrams import DATAGRAM_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Listener, Wiring, check_region
from transports.network.datagrams import check_allow, is_loopback

__all__ = ["UDP_PACKETS", "UdpPacketsLink"]


@dataclass(frozen=True)
class UdpPacketsLink:
    """Event telemetry as space packets in UDP datagrams, and telecommands back: COSMOS, Yamcs, cFS.

    Attributes
    ----------
    host, port
        Where packets are sent, one in each datagram.
    elsewhere
        Must be true where `host` is not on this machine: whoever has that address gets the events, asked or not.
    command_host, command_port
        Address on which telecommands are taken, one or several whole packets in each datagram; port 0 takes a free one.
    allow
        Addresses and networks whose telecommands are taken; needed where `command_host` can be reached from other
        machines. There is no authentication.
    mbit_s
        Most that is sent, in Mbit/s of payload: receivers lose what comes faster than they read.
    name
        What this rig calls the link: in reports, and where faults and triggers name it.
    """

    kind: ClassVar[str] = "udp_packets"
    host: str = "127.0.0.1"
    port: int = 10_015
    elsewhere: bool = False
    command_host: str = "127.0.0.1"
    command_port: int = 10_025
    allow: tuple[str, ...] = ()
    mbit_s: float = 200.0
    name: str = "udp_packets"
    instrument: InstrumentSettings = field(default_factory=InstrumentSettings)

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65535:
            raise ValueError(f"port must be 1 to 65535, got {self.port}")
        if not 0 <= self.command_port <= 65535:
            raise ValueError(f"command_port must be 0 (any free one) to 65535, got {self.command_port}")
        if not 0.1 <= self.mbit_s <= 100_000:
            raise ValueError(f"mbit_s must be 0.1 to 100000, got {self.mbit_s}")
        if not self.host:
            raise ValueError("host is empty: say where to send, for example 127.0.0.1")
        if not (self.elsewhere or is_loopback(self.host)):
            raise ValueError(f"host {self.host!r} is another machine: say elsewhere = true if that is meant")
        if not self.command_host:
            raise ValueError("command_host is empty: say where telecommands are taken, for example 127.0.0.1")
        if (self.host, self.port) == (self.command_host, self.command_port):
            raise ValueError("port and command_port are the same: the camera would hear its own packets")
        check_allow(self.command_host, self.allow, "command_host")


def _endpoint(link: UdpPacketsLink, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.udp_packets.endpoint import UdpPacketFactory

    return UdpPacketFactory(link, wiring.faults)


UDP_PACKETS = LinkKind(
    UdpPacketsLink,
    serves="instrument",
    endpoint=_endpoint,
    faults=DATAGRAM_FAULTS,
    listener=Listener("udp", "Read a camera whose packets come in UDP datagrams.", "emulator.cli.listen.packets:udp"),
    check=check_region,
)

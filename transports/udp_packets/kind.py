"""Parameters of packets in datagrams, and their registration as a kind of link."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from firmware_protocol.bounds import check_bounds
from firmware_protocol.instrument.settings import InstrumentSettings
from transports.faults.kinds import DATAGRAMS
from transports.link.kind import CameraFacts, InstrumentLink, LinkKind, Listener, Port, check_region
from transports.network import DatagramRate, DestinationPort, check_allow, check_destination


@dataclass(frozen=True)
class UdpPacketsLink(InstrumentLink):
    """Event telemetry as space packets in UDP datagrams, and telecommands back: COSMOS, Yamcs, cFS.

    Attributes
    ----------
    host, port : destination of the packets, one in each datagram.
    elsewhere : must be true if `host` is not on this machine, which then gets events even unrequested.
    command_host, command_port : address for telecommands, whole packets in each datagram; port 0: a free one.
    allow : addresses and networks whose telecommands are accepted; required if other machines can reach `command_host`.
        There is no authentication.
    mbit_s : highest rate, in Mbit/s of payload: receivers lose data that arrive faster than they read.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "udp_packets"
    host: str = "127.0.0.1"
    port: DestinationPort = 10_015
    elsewhere: bool = False
    command_host: str = "127.0.0.1"
    command_port: Port = 10_025
    allow: tuple[str, ...] = ()
    mbit_s: DatagramRate = 200.0
    name: str = "udp_packets"
    instrument: InstrumentSettings = field(default_factory=InstrumentSettings)

    def __post_init__(self) -> None:
        check_bounds(self)
        check_destination(self.host, elsewhere=self.elsewhere)
        if not self.command_host:
            raise ValueError("command_host is empty: give the address for telecommands, for example 127.0.0.1")
        if (self.host, self.port) == (self.command_host, self.command_port):
            raise ValueError("port and command_port are the same: the camera would receive its own packets")
        check_allow(self.command_host, self.allow, "command_host")

    def carries_hz(self, camera: CameraFacts) -> float:
        """Return the events a second that its highest rate carries."""
        return self.instrument.carried_hz(self.mbit_s * 1e6, camera.size)


UDP_PACKETS = LinkKind(
    UdpPacketsLink,
    serves="instrument",
    endpoint="transports.udp_packets.endpoint:UdpPacketEndpoint",
    carrier=DATAGRAMS,
    listener=Listener("udp", "Read a camera whose packets come in UDP datagrams.", "emulator.cli.listen.packets:udp"),
    check=check_region,
)

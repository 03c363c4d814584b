"""Parameters of a CAN link, and its registration as a kind of link."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from firmware_protocol.bounds import check_bounds
from firmware_protocol.can_frames.canopen import SelectorSettings
from firmware_protocol.can_frames.dbc import Identifiers
from firmware_protocol.can_frames.frame import FD_LENGTHS, BitRates, Frame, frame_bits
from firmware_protocol.can_frames.raw_events import RAW_LIMIT_PX
from firmware_protocol.can_frames.raw_stream import RawSettings
from firmware_protocol.can_frames.transport import IsoTpSettings
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.receiver.can import CanReceiverSettings
from transports.faults.kinds import CAN_BUS
from transports.link.kind import CameraFacts, InstrumentLink, LinkKind, Listener, Port, Unsuitable, check_region
from transports.needs import Need, network_interface
from transports.network import check_allow

Option = str | int | float | bool
_Period = Annotated[int, Meta(ge=0, le=65_535)]
_CspAddress = Annotated[int, Meta(ge=0, le=16_382)]


@dataclass(frozen=True)
class CanLink(InstrumentLink):
    """One CAN bus, or two redundant ones, and the camera's behaviour on it.

    Attributes
    ----------
    interface : "served": evstim's own bus, which programs join by TCP in the protocol of socketcand; or an interface of
        python-can: socketcan, slcan, gs_usb, pcan, kvaser, udp_multicast, virtual, socketcand ...
    channel : channel of the interface: can0, /dev/ttyACM0, 239.74.163.2 ...
    channel_b : the redundant bus; "" for none. The master's heartbeat selects the active bus.
    host, port : address of a served bus, with interface = "served".
    allow : addresses and networks that may join a served bus; required if other machines can reach `host`.
    bitrate : bits a second of classic frames and of arbitration, 1000 to 1 000 000: of a served bus, of adapters
        (slcan, gs_usb, pcan, kvaser ...), and for `share`; a bus of socketcan, socketcand, virtual or udp_multicast has
        its own.
    data_bitrate : with fd: bits a second of the data, `bitrate` to 20 000 000, of adapters for which python-can can set
        it, and for `share`; no effect on a served bus.
    fd : True for CAN FD frames.
    share : highest share of the bus's time that all frames may take; above it our events wait.
    carriage : transport of the events: frames that stand alone, blocks by ISO-TP, or blocks in CSP packets.
    flow_control : with ISO-TP: wait for the peer's flow control. Without it no peer has to answer.
    answer_ms : with ISO-TP: timeout of the peer's answer.
    epoch_ms : time between two epoch frames, with raw frames.
    node : our node number for NMT, 1 to 127; the default identifiers are derived from it.
    heartbeat_ms : time between two of our heartbeats; 0 for none.
    sync_ms : time between two SYNCs that we send as the bus's master; 0 for none.
    sync_counter : True if our SYNC contains its counter.
    time_ms : time between two SCETs that we send as the bus's master; 0 for none.
    follow_time : set the camera's time by the SCET or TIME of the bus's master.
    csp_address, csp_peer : CSP addresses of camera and computer, with CFP.
    options : further options of python-can's interface, by its own names.
    identifiers : identifiers of all frames.
    redundancy : conditions for a change of the bus.
    instrument : selection and rates of the camera's messages.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "can"
    interface: str = "served"
    channel: str = "can0"
    channel_b: str = ""
    host: str = "127.0.0.1"
    port: Port = 29536
    allow: tuple[str, ...] = ()
    bitrate: int = 1_000_000
    data_bitrate: int = 5_000_000
    fd: bool = False
    share: Annotated[float, Meta(ge=0.01, le=1)] = 0.9
    carriage: Literal["raw", "isotp", "cfp"] = "raw"
    flow_control: bool = True
    answer_ms: Annotated[int, Meta(ge=1, le=60_000)] = 1000
    epoch_ms: Annotated[float, Meta(ge=0.1, le=1000)] = 10.0
    node: Annotated[int, Meta(ge=1, le=127)] = 0x22
    heartbeat_ms: _Period = 500
    sync_ms: _Period = 0
    sync_counter: bool = True
    time_ms: _Period = 0
    follow_time: bool = False
    csp_address: _CspAddress = 10
    csp_peer: _CspAddress = 1
    options: dict[str, Option] = field(default_factory=dict)
    identifiers: Identifiers = field(default_factory=Identifiers)
    redundancy: SelectorSettings = field(default_factory=SelectorSettings)
    instrument: InstrumentSettings = field(default_factory=InstrumentSettings)
    name: str = "can"

    def __post_init__(self) -> None:
        self._check_bus()
        check_bounds(self)
        try:
            BitRates(self.bitrate, self.data_bitrate)
        except ValueError as error:
            raise ValueError(f"bitrate: {error}") from error

    def _check_bus(self) -> None:
        if not self.interface or not self.channel:
            raise ValueError('interface and channel must not be empty; "served" and "can0" need nothing of the machine')
        if self.channel_b and self.interface == "served":
            raise ValueError('channel_b: a served bus is one bus; two need interface = "socketcan" or another')
        if self.channel_b == self.channel:
            raise ValueError("channel_b is the same bus as channel; leave it out, or name another")
        if self.fd and self.interface in ("served", "socketcand"):
            raise ValueError('fd: socketcand\'s protocol has classic frames only; use "udp_multicast" or "socketcan"')
        if self.fd and self.carriage == "cfp":
            raise ValueError("fd: CSP's fragmentation protocol has classic frames only")
        if self.interface == "served":
            check_allow(self.host, self.allow)

    @property
    def rates(self) -> BitRates:
        """Bit rates of the bus."""
        return BitRates(self.bitrate, self.data_bitrate)

    def carries_hz(self, camera: CameraFacts) -> float:
        """Return the events a second that its share of the bus carries, in frames of arbitrary data."""
        octets = FD_LENGTHS[-1] if self.fd else 8
        frame = Frame(0, bytes(_DATA[:octets]), extended=self.carriage == "cfp", fd=self.fd, brs=self.fd)
        frames_per_s = self.share * 1e9 / self.rates.duration_ns(frame_bits(frame))
        if self.carriage == "raw":
            return min(frames_per_s * (19 if self.fd else 2), self.instrument.rate_limit or math.inf)
        return self.instrument.carried_hz(8 * frames_per_s * (octets - (self.carriage == "isotp")), camera.size)

    @property
    def isotp(self) -> IsoTpSettings:
        """Settings of our ISO-TP channel."""
        peer = self.receiver.isotp
        return replace(peer, send=peer.receive, receive=peer.send)

    @property
    def receiver(self) -> CanReceiverSettings:
        """Settings of this link that the receiving computer needs."""
        return CanReceiverSettings(
            self.identifiers, self.fd, self.flow_control, self.answer_ms, self.csp_address, self.csp_peer
        )

    def raw(self, tick_us: int) -> RawSettings:
        """Return the settings of raw frames at a tick."""
        ids = self.identifiers
        return RawSettings(ids.events, ids.epoch, tick_us, round(self.epoch_ms * 1000), self.fd, clock=ids.clock)

    @classmethod
    def complete(cls, table: dict[str, Any]) -> dict[str, Any]:
        """Derive identifiers from the node number where the rig does not give them."""
        node, identifiers = table.get("node", cls.node), table.get("identifiers", {})
        if not isinstance(node, int) or not 1 <= node <= 127 or not isinstance(identifiers, dict):
            return table  # refused where its type is checked
        return {**table, "identifiers": {**Identifiers.of_node(node).by_name, **identifiers}}

    def impossible_faults(self) -> Collection[str]:
        """Leave out error frames where the bus is not evstim's own."""
        return () if self.interface in _OWN_BUSES else ("error_frames",)

    def listens_on(self) -> tuple[str, int] | None:
        """Return the address of a served bus, unless any free port is suitable."""
        return (self.host, self.port) if self.interface == "served" and self.port else None

    def needs(self) -> tuple[Need, ...]:
        """Return the network interfaces of socketcan."""
        if self.interface != "socketcan":
            return ()
        return tuple(network_interface(name) for name in (self.channel, self.channel_b) if name)


_DATA = b"\x3a\x91\xd4\x07\x6c\xe2\x58\xbf" * 8  # stuffed as often as random data

_OWN_BUSES = ("served", "virtual")
"""Interfaces that transmit a given error frame; with the others the controller makes its own."""


def _check(parameters: CanLink, camera: CameraFacts) -> None:
    """Raise Unsuitable for a region beyond the sensor, or a sensor beyond what raw frames can number."""
    check_region(parameters, camera)
    if parameters.carriage == "raw" and max(camera.size) > RAW_LIMIT_PX:
        raise Unsuitable(
            f"raw frames number {RAW_LIMIT_PX} columns and rows, not {camera.size[0]}x{camera.size[1]}; "
            'use carriage = "isotp" or "cfp"',
            "carriage",
        )


CAN = LinkKind(
    CanLink,
    serves="instrument",
    endpoint="transports.can_bus.endpoint:CanEndpoint",
    has_sync=True,
    carrier=CAN_BUS,
    listener=Listener("can", "Read a camera on a CAN bus.", "emulator.cli.listen.can:can"),
    check=_check,
)

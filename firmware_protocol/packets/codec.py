"""Interface of a packet standard to a profile: messages and telecommands to packets and back.

`PusCodec` is that of PUS-C packets; that of CSP is in `csp`.

    message        service, subtype   source data
    EVENTS         128, 129           the block                          on the science APID
    EDGES          128, 130           the block                          on the science APID
    HOUSEKEEPING   3, 25              the report, structure id in front
    VERIFICATION   1, 1..8            request id, failure notice
    TIME           9, 2               the report
    PONG           17, 2              nothing

Events and edges have an APID of their own, so that a gap in its sequence count is a gap in the events and nothing else.
Sequence counts run modulo 16 384 under each APID.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from firmware_protocol.packets.addresses import Addresses, Message, MessageKind, PacketError, SequenceCounts
from firmware_protocol.packets.ccsds import APID_IDLE, SEQUENCE_MODULUS, SpacePacket
from firmware_protocol.packets.pus import TC_OVERHEAD, TM_OVERHEAD, Acknowledge, TcPacket, TmPacket
from firmware_protocol.packets.telecommands import RequestId, Telecommand, Verification


@dataclass(frozen=True)
class Decoded:
    """A message, and its number under a counter."""

    message: Message
    counter: int
    number: int


@dataclass(frozen=True)
class Request:
    """A telecommand as received, not yet interpreted."""

    id: RequestId
    service: int
    subtype: int
    data: bytes
    acknowledge: Acknowledge


class PacketCodec(ABC):
    """Codec of the packets of one instrument; holds the sequence counts of the packets it encoded."""

    overhead_octets: ClassVar[int]
    """Most octets of a packet beside the payload."""
    sequence_modulus: ClassVar[int]
    """Modulus of the sequence counts."""

    @abstractmethod
    def encode(self, message: Message) -> bytes:
        """Return the packet of a message."""

    @abstractmethod
    def decode(self, octets: bytes) -> Decoded | None:
        """Read the packet of a message; None for a packet without information. Raises PacketError for any other."""

    @abstractmethod
    def encode_command(self, command: Telecommand, acknowledge: Acknowledge) -> tuple[bytes, RequestId]:
        """Return the packet of a telecommand, and its request id."""

    @abstractmethod
    def decode_command(self, octets: bytes) -> Request:
        """Read the packet of a telecommand. Raises PacketError if it is damaged or for another receiver."""


VERIFICATION_SERVICE = 1
MESSAGE_TYPES = {
    MessageKind.EVENTS: (128, 129),
    MessageKind.EDGES: (128, 130),
    MessageKind.HOUSEKEEPING: (3, 25),
    MessageKind.TIME: (9, 2),
    MessageKind.PONG: (17, 2),
}
_KINDS = {type_: kind for kind, type_ in MESSAGE_TYPES.items()}
SCIENCE = (MessageKind.EVENTS, MessageKind.EDGES)
_TYPE_COUNTS = 1 << 16


class PusCodec(PacketCodec):
    """Codec of the packets of one instrument."""

    overhead_octets = max(TM_OVERHEAD, TC_OVERHEAD)
    sequence_modulus = SEQUENCE_MODULUS

    def __init__(self, addresses: Addresses) -> None:
        self._addresses = addresses
        self._counts = SequenceCounts(SEQUENCE_MODULUS)
        self._type_counts = SequenceCounts(_TYPE_COUNTS)
        self._request_counts = SequenceCounts(SEQUENCE_MODULUS)

    def encode(self, message: Message) -> bytes:
        """Return the packet of a message."""
        data = message.payload
        if message.kind is MessageKind.VERIFICATION:
            type_, data = (VERIFICATION_SERVICE, Verification.parse(data).subtype), data[1:]
        else:
            type_ = MESSAGE_TYPES[message.kind]
        apid = self._addresses.science_apid if message.kind in SCIENCE else self._addresses.apid
        return bytes(
            TmPacket(
                apid=apid,
                sequence_count=self._counts.take(apid),
                service=type_[0],
                subtype=type_[1],
                t_us=message.t_us,
                data=data,
                type_count=self._type_counts.take(type_),
            )
        )

    def decode(self, octets: bytes) -> Decoded | None:
        """Read the packet of a message; None for an idle packet. Raises PacketError for any other."""
        if SpacePacket.parse(octets).apid == APID_IDLE:
            return None
        packet = TmPacket.parse(octets)
        if packet.apid not in (self._addresses.apid, self._addresses.science_apid):
            raise PacketError("apid")
        if packet.service == VERIFICATION_SERVICE:
            kind, payload = MessageKind.VERIFICATION, bytes([packet.subtype]) + packet.data
        elif (packet.service, packet.subtype) in _KINDS:
            kind, payload = _KINDS[packet.service, packet.subtype], packet.data
        else:
            raise PacketError("service")
        return Decoded(Message(kind, payload, packet.t_us), packet.apid, packet.sequence_count)

    def encode_command(self, command: Telecommand, acknowledge: Acknowledge) -> tuple[bytes, RequestId]:
        """Return the packet of a telecommand, and its request id."""
        service, subtype = command.TYPE
        apid = self._addresses.apid
        packet = TcPacket(apid, self._request_counts.take(apid), service, subtype, command.encode(), acknowledge)
        octets = bytes(packet)
        return octets, RequestId.parse(octets[:4])

    def decode_command(self, octets: bytes) -> Request:
        """Read the packet of a telecommand. Raises PacketError if it is damaged or for another APID."""
        packet = TcPacket.parse(octets)
        if packet.apid != self._addresses.apid:
            raise PacketError("apid")
        return Request(RequestId.parse(octets[:4]), packet.service, packet.subtype, packet.data, packet.acknowledge)

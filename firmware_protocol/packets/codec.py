"""Packet standards of a profile, PUS-C and CSP: messages and telecommands to packets and back.

PUS-C packets (see `ccsds`):

    message        service, subtype   source data
    EVENTS         128, 129           the block                          on the science APID
    EDGES          128, 130           the block                          on the science APID
    HOUSEKEEPING   3, 25              the report, structure id in front
    VERIFICATION   1, 1..8            request id, failure notice
    TIME           9, 2               the report
    PONG           17, 2              nothing

Events and edges have an APID of their own, so that a gap in its sequence count is a gap in the events and nothing else.
Sequence counts run modulo 16 384 under each APID.

Packets of the CubeSat Space Protocol (CSP), version 2, are a header of 6 octets, then data; big-endian:

    bits 47..46 priority   45..32 destination   31..18 source   17..12 destination port   11..6 source port   5..0 flags

The checksum after the data (CRC-32C of header and data) belongs to the interface (`framing.py`), as in libcsp.

Source: libcsp 2 (csp_id.c, csp_types.h).

Messages and telecommands in them:

    message       from the instrument's port 8 to the computer's port, priority normal (events low)
        u16  count of the packets to this port, modulo 65 536
        7    time: CUC, 4 + 3 octets, since the start of the stream
        ...  payload of the message
    telecommand   from the computer to the instrument's port 8, priority high
        u32  request id: 0x1800 | 0x2A0, then 0xC000 | count modulo 16 384, as in a PUS telecommand
        u8   acknowledgements requested, as in PUS-C
        u8   service    u8 subtype
        ...  application data

    port  9 EVENTS  10 EDGES  11 HOUSEKEEPING  12 VERIFICATION  13 TIME  14 PONG

Ports to bind must be below CSP_PORT_MAX_BIND of libcsp (16 by default), hence these. The framing adds the checksum.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

from firmware_protocol.packets.addresses import Addresses, Message, MessageKind, PacketError, SequenceCounts
from firmware_protocol.packets.ccsds import (
    APID_IDLE,
    OWN_EPOCH_4_3,
    SEQUENCE_MODULUS,
    TC_OVERHEAD,
    TM_OVERHEAD,
    Acknowledge,
    PacketType,
    SpacePacket,
    TcPacket,
    TmPacket,
)
from firmware_protocol.packets.telecommands import RequestId, Telecommand, Verification
from firmware_protocol.wire_layout import Field, Layout


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
    """Codec of PUS-C packets."""

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


class Priority(IntEnum):
    """Order of service."""

    CRITICAL = 0
    HIGH = 1
    NORMAL = 2
    LOW = 3


_CSP_HEADER = Layout(
    Field("priority", 2),
    Field("destination", 14),
    Field("source", 14),
    Field("destination_port", 6),
    Field("source_port", 6),
    Field("flags", 6),
)
CSP_HEADER_OCTETS = _CSP_HEADER.octets


@dataclass(frozen=True)
class CspPacket:
    """One packet without its checksum. Raises ValueError for a field that does not fit the header."""

    source: int
    destination: int
    source_port: int
    destination_port: int
    data: bytes
    priority: Priority = Priority.NORMAL
    flags: int = 0

    def __post_init__(self) -> None:
        for field in _CSP_HEADER.fields:
            field.check(getattr(self, field.name))

    def __bytes__(self) -> bytes:
        return _CSP_HEADER.pack(**{field.name: getattr(self, field.name) for field in _CSP_HEADER.fields}) + self.data

    @classmethod
    def parse(cls, octets: bytes) -> CspPacket:
        """Read one whole packet. Raises PacketError if it is shorter than a header."""
        if len(octets) < CSP_HEADER_OCTETS:
            raise PacketError("short")
        fields = _CSP_HEADER.unpack(octets[:CSP_HEADER_OCTETS])
        return cls(data=octets[CSP_HEADER_OCTETS:], priority=Priority(fields.pop("priority")), **fields)


_TELECOMMAND_PORT = 8
_PORTS = {
    MessageKind.EVENTS: 9,
    MessageKind.EDGES: 10,
    MessageKind.HOUSEKEEPING: 11,
    MessageKind.VERIFICATION: 12,
    MessageKind.TIME: 13,
    MessageKind.PONG: 14,
}
_PORT_KINDS = {port: kind for kind, port in _PORTS.items()}
_CSP_MESSAGE = struct.Struct(">H7s")
_CSP_REQUEST = struct.Struct(">4sBBB")


class CspCodec(PacketCodec):
    """Codec of CSP packets."""

    overhead_octets = CSP_HEADER_OCTETS + max(_CSP_MESSAGE.size, _CSP_REQUEST.size)
    sequence_modulus = 1 << 16

    def __init__(self, addresses: Addresses) -> None:
        self._addresses = addresses
        self._counts = SequenceCounts(self.sequence_modulus)
        self._request_counts = SequenceCounts(SEQUENCE_MODULUS)

    def encode(self, message: Message) -> bytes:
        """Return the packet of a message."""
        port = _PORTS[message.kind]
        head = _CSP_MESSAGE.pack(self._counts.take(port), OWN_EPOCH_4_3.encode_us(message.t_us))
        return bytes(
            CspPacket(
                source=self._addresses.csp_node,
                destination=self._addresses.csp_peer,
                source_port=_TELECOMMAND_PORT,
                destination_port=port,
                data=head + message.payload,
                priority=Priority.LOW if message.kind in SCIENCE else Priority.NORMAL,
            )
        )

    def decode(self, octets: bytes) -> Decoded | None:
        """Read the packet of a message. Raises PacketError for any other."""
        packet = CspPacket.parse(octets)
        if (packet.source, packet.destination) != (self._addresses.csp_node, self._addresses.csp_peer):
            raise PacketError("address")
        if packet.destination_port not in _PORT_KINDS:
            raise PacketError("port")
        if len(packet.data) < _CSP_MESSAGE.size:
            raise PacketError("short")
        number, time = _CSP_MESSAGE.unpack_from(packet.data)
        kind = _PORT_KINDS[packet.destination_port]
        message = Message(kind, packet.data[_CSP_MESSAGE.size :], OWN_EPOCH_4_3.parse_us(time))
        return Decoded(message, packet.destination_port, number)

    def encode_command(self, command: Telecommand, acknowledge: Acknowledge) -> tuple[bytes, RequestId]:
        """Return the packet of a telecommand, and its request id."""
        apid = self._addresses.apid
        request = RequestId.of(SpacePacket(PacketType.TELECOMMAND, apid, self._request_counts.take(apid), b"\0"))
        packet = CspPacket(
            source=self._addresses.csp_peer,
            destination=self._addresses.csp_node,
            source_port=_TELECOMMAND_PORT,
            destination_port=_TELECOMMAND_PORT,
            data=_CSP_REQUEST.pack(bytes(request), acknowledge, *command.TYPE) + command.encode(),
            priority=Priority.HIGH,
        )
        return bytes(packet), request

    def decode_command(self, octets: bytes) -> Request:
        """Read the packet of a telecommand. Raises PacketError if it is too short or for another receiver."""
        packet = CspPacket.parse(octets)
        if packet.destination != self._addresses.csp_node:
            raise PacketError("address")
        if packet.destination_port != _TELECOMMAND_PORT:
            raise PacketError("port")
        if len(packet.data) < _CSP_REQUEST.size:
            raise PacketError("short")
        request, acknowledge, service, subtype = _CSP_REQUEST.unpack_from(packet.data)
        data = packet.data[_CSP_REQUEST.size :]
        return Request(RequestId.parse(request), service, subtype, data, Acknowledge(acknowledge & 15))

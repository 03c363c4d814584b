"""CubeSat Space Protocol (CSP): packets of versions 2 and 1, and the instrument's messages in version 2. Big-endian.

A packet is a header, then data:

    version 2, 6 octets   bits 47..46 priority   45..32 destination   31..18 source   17..12 destination port
                               11..6  source port   5..0 flags
    version 1, 4 octets   bits 31..30 priority   29..25 source   24..20 destination   19..14 destination port
                               13..8  source port   7..0 flags

The checksum after the data (CRC-32C of header and data) belongs to the interface (`framing/framings.py`), as in libcsp.

Source: libcsp 2 (csp_id.c, csp_types.h).

Messages and telecommands in packets of version 2:

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
from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.packets.addresses import Addresses, Message, MessageKind, PacketError, SequenceCounts
from firmware_protocol.packets.ccsds import OWN_EPOCH_4_3, SEQUENCE_MODULUS, PacketType, SpacePacket
from firmware_protocol.packets.codec import Decoded, PacketCodec, Request
from firmware_protocol.packets.pus import Acknowledge
from firmware_protocol.packets.telecommands import RequestId, Telecommand

_FIELDS = ("priority", "destination", "source", "destination_port", "source_port", "flags")


class Priority(IntEnum):
    """Order of service."""

    CRITICAL = 0
    HIGH = 1
    NORMAL = 2
    LOW = 3


class CspVersion(IntEnum):
    """Version of the header."""

    ONE = 1
    TWO = 2

    @property
    def header_octets(self) -> int:
        """Length of the header."""
        return 4 if self is CspVersion.ONE else 6

    @property
    def places(self) -> dict[str, tuple[int, int]]:
        """Lowest bit and number of bits of each field."""
        return _PLACES[self]


_PLACES = {
    CspVersion.ONE: dict(zip(_FIELDS, ((30, 2), (20, 5), (25, 5), (14, 6), (8, 6), (0, 8)), strict=True)),
    CspVersion.TWO: dict(zip(_FIELDS, ((46, 2), (32, 14), (18, 14), (12, 6), (6, 6), (0, 6)), strict=True)),
}


@dataclass(frozen=True)
class CspPacket:
    """One packet without its checksum. Raises ValueError for a field that does not fit its version's header."""

    source: int
    destination: int
    source_port: int
    destination_port: int
    data: bytes
    priority: Priority = Priority.NORMAL
    flags: int = 0
    version: CspVersion = CspVersion.TWO

    def __post_init__(self) -> None:
        for name, (_, bits) in self.version.places.items():
            value = getattr(self, name)
            if not 0 <= value < 1 << bits:
                raise ValueError(f"CSP {self.version} {name.replace('_', ' ')} has {bits} bits, got {value}")

    def __bytes__(self) -> bytes:
        header = sum(getattr(self, name) << low for name, (low, _) in self.version.places.items())
        return int(header).to_bytes(self.version.header_octets, "big") + self.data

    @classmethod
    def parse(cls, octets: bytes, version: CspVersion = CspVersion.TWO) -> CspPacket:
        """Read one whole packet of a given version. Raises PacketError if it is shorter than a header."""
        length = version.header_octets
        if len(octets) < length:
            raise PacketError("short")
        header = int.from_bytes(octets[:length], "big")
        fields = {name: header >> low & (1 << bits) - 1 for name, (low, bits) in version.places.items()}
        priority = Priority(fields.pop("priority"))
        return cls(data=octets[length:], priority=priority, version=version, **fields)


_TELECOMMAND_PORT = 8
_PORTS = {
    MessageKind.EVENTS: 9,
    MessageKind.EDGES: 10,
    MessageKind.HOUSEKEEPING: 11,
    MessageKind.VERIFICATION: 12,
    MessageKind.TIME: 13,
    MessageKind.PONG: 14,
}
_KINDS = {port: kind for kind, port in _PORTS.items()}
_BULK = (MessageKind.EVENTS, MessageKind.EDGES)
_MESSAGE = struct.Struct(">H7s")
_REQUEST = struct.Struct(">4sBBB")
HEADER_OCTETS = 6
"""Length of the header of CSP version 2."""


class CspCodec(PacketCodec):
    """Codec of the packets of one instrument."""

    overhead_octets = HEADER_OCTETS + max(_MESSAGE.size, _REQUEST.size)
    sequence_modulus = 1 << 16

    def __init__(self, addresses: Addresses) -> None:
        self._addresses = addresses
        self._counts = SequenceCounts(self.sequence_modulus)
        self._request_counts = SequenceCounts(SEQUENCE_MODULUS)

    def encode(self, message: Message) -> bytes:
        """Return the packet of a message."""
        port = _PORTS[message.kind]
        head = _MESSAGE.pack(self._counts.take(port), OWN_EPOCH_4_3.encode_us(message.t_us))
        return bytes(
            CspPacket(
                source=self._addresses.csp_node,
                destination=self._addresses.csp_peer,
                source_port=_TELECOMMAND_PORT,
                destination_port=port,
                data=head + message.payload,
                priority=Priority.LOW if message.kind in _BULK else Priority.NORMAL,
            )
        )

    def decode(self, octets: bytes) -> Decoded | None:
        """Read the packet of a message. Raises PacketError for any other."""
        packet = CspPacket.parse(octets)
        if (packet.source, packet.destination) != (self._addresses.csp_node, self._addresses.csp_peer):
            raise PacketError("address")
        if packet.destination_port not in _KINDS:
            raise PacketError("port")
        if len(packet.data) < _MESSAGE.size:
            raise PacketError("short")
        number, time = _MESSAGE.unpack_from(packet.data)
        kind = _KINDS[packet.destination_port]
        message = Message(kind, packet.data[_MESSAGE.size :], OWN_EPOCH_4_3.parse_us(time))
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
            data=_REQUEST.pack(bytes(request), acknowledge, *command.TYPE) + command.encode(),
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
        if len(packet.data) < _REQUEST.size:
            raise PacketError("short")
        request, acknowledge, service, subtype = _REQUEST.unpack_from(packet.data)
        data = packet.data[_REQUEST.size :]
        return Request(RequestId.parse(request), service, subtype, data, Acknowledge(acknowledge & 15))

"""PUS-C packets: the secondary headers and the checksum that ECSS-E-ST-70-41C puts into space packets. Big-endian.

    telemetry   u8  PUS version 2 (bits 7..4), status of the time reference (bits 3..0, 0 = not told)
                u8  service      u8  subtype
                u16 count of messages of this type    u16 destination
                7   time: CUC, 4 + 3 octets, own epoch, P-field implicit
                ... source data
                u16 packet error control: CRC-16-CCITT-FALSE of all octets before it
    telecommand u8  PUS version 2 (bits 7..4), acknowledgements wanted (bit 0 acceptance, 1 start, 2 progress,
                    3 completion)
                u8  service      u8  subtype
                u16 source
                ... application data
                u16 packet error control

Source: ECSS-E-ST-70-41C, clauses 7.4.3 and 7.4.4, as the spacepackets library and the Flight Software Framework
(fsfw, tcpacket definitions) write them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntFlag

from firmware_protocol.framing.crc import crc16
from firmware_protocol.packets.ccsds import PacketType, SequenceFlags, SpacePacket
from firmware_protocol.packets.cuc import OWN_EPOCH_4_3
from firmware_protocol.packets.errors import PacketError

__all__ = ["TC_OVERHEAD", "TM_OVERHEAD", "Acknowledge", "TcPacket", "TmPacket"]

_VERSION = 2
_TM = struct.Struct(">BBBHH7s")
_TC = struct.Struct(">BBBH")
_CRC_BYTES = 2
TM_OVERHEAD = 6 + _TM.size + _CRC_BYTES
"""Octets of a telemetry packet beside its source data."""
TC_OVERHEAD = 6 + _TC.size + _CRC_BYTES
"""Octets of a telecommand packet beside its application data."""


class Acknowledge(IntFlag):
    """Which successes a telecommand wants to hear of; failures are always told."""

    NONE = 0
    ACCEPTANCE = 1
    START = 2
    PROGRESS = 4
    COMPLETION = 8
    ALL = 15


def _sealed(type_: PacketType, apid: int, sequence_count: int, data: bytes) -> bytes:
    """Return a whole packet with its error control."""
    packet = bytes(SpacePacket(type_, apid, sequence_count, data + bytes(_CRC_BYTES)))[:-_CRC_BYTES]
    return packet + crc16(packet).to_bytes(_CRC_BYTES, "big")


def _unsealed(octets: bytes, type_: PacketType, header: struct.Struct) -> SpacePacket:
    """Check a whole packet; its data then end before the error control."""
    packet = SpacePacket.parse(octets)
    if len(packet.data) < header.size + _CRC_BYTES:
        raise PacketError("short")
    if crc16(octets):
        raise PacketError("crc")
    if packet.type != type_:
        raise PacketError("type")
    if packet.sequence_flags != SequenceFlags.UNSEGMENTED:
        raise PacketError("segmented")
    if not packet.secondary_header:
        raise PacketError("no secondary header")
    if packet.data[0] >> 4 != _VERSION:
        raise PacketError("pus version")
    return packet


@dataclass(frozen=True)
class TmPacket:
    """A telemetry report.

    Attributes
    ----------
    sequence_count, type_count
        Number of the packet under its APID, and of the report under its service and subtype.
    t_us
        Time of the report in microseconds since the start of the stream.
    """

    apid: int
    sequence_count: int
    service: int
    subtype: int
    t_us: int
    data: bytes
    type_count: int = 0
    destination: int = 0
    time_status: int = 0

    def __bytes__(self) -> bytes:
        header = _TM.pack(
            _VERSION << 4 | self.time_status,
            self.service,
            self.subtype,
            self.type_count,
            self.destination,
            OWN_EPOCH_4_3.encode_us(self.t_us),
        )
        return _sealed(PacketType.TELEMETRY, self.apid, self.sequence_count, header + self.data)

    @classmethod
    def parse(cls, octets: bytes) -> TmPacket:
        """Read one whole packet. Raises PacketError when it is not a sound telemetry report."""
        packet = _unsealed(octets, PacketType.TELEMETRY, _TM)
        first, service, subtype, type_count, destination, time = _TM.unpack_from(packet.data)
        return cls(
            apid=packet.apid,
            sequence_count=packet.sequence_count,
            service=service,
            subtype=subtype,
            t_us=OWN_EPOCH_4_3.parse_us(time),
            data=packet.data[_TM.size : -_CRC_BYTES],
            type_count=type_count,
            destination=destination,
            time_status=first & 15,
        )


@dataclass(frozen=True)
class TcPacket:
    """A telecommand request."""

    apid: int
    sequence_count: int
    service: int
    subtype: int
    data: bytes
    acknowledge: Acknowledge = Acknowledge.ALL
    source: int = 0

    def __bytes__(self) -> bytes:
        header = _TC.pack(_VERSION << 4 | self.acknowledge, self.service, self.subtype, self.source)
        return _sealed(PacketType.TELECOMMAND, self.apid, self.sequence_count, header + self.data)

    @classmethod
    def parse(cls, octets: bytes) -> TcPacket:
        """Read one whole packet. Raises PacketError when it is not a sound telecommand."""
        packet = _unsealed(octets, PacketType.TELECOMMAND, _TC)
        first, service, subtype, source = _TC.unpack_from(packet.data)
        return cls(
            apid=packet.apid,
            sequence_count=packet.sequence_count,
            service=service,
            subtype=subtype,
            data=packet.data[_TC.size : -_CRC_BYTES],
            acknowledge=Acknowledge(first & 15),
            source=source,
        )

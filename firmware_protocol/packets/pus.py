"""PUS-C packets: the secondary headers and the checksum that ECSS-E-ST-70-41C puts into space packets. Big-endian.

    telemetry   u8  PUS version 2 (bits 7..4), status of the time reference (bits 3..0, 0 = not reported)
                u8  service      u8  subtype
                u16 count of messages of this type    u16 destination
                7   time: CUC, 4 + 3 octets, own epoch, P-field implicit
                ... source data
                u16 packet error control: CRC-16-CCITT-FALSE of all octets before it
    telecommand u8  PUS version 2 (bits 7..4), acknowledgements requested (bit 0 acceptance, 1 start, 2 progress,
                    3 completion)
                u8  service      u8  subtype
                u16 source
                ... application data
                u16 packet error control

Source: ECSS-E-ST-70-41C, clauses 7.4.3 and 7.4.4, as the spacepackets library and the Flight Software Framework
(fsfw, tcpacket definitions) write them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

from firmware_protocol.framing.crc import crc16
from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.ccsds import OWN_EPOCH_4_3, PRIMARY_HEADER, PacketType, SequenceFlags, SpacePacket
from firmware_protocol.wire_layout import Field, Layout

_VERSION = 2
_TYPE = (Field("service", 8, "PUS service type"), Field("subtype", 8, "PUS message subtype"))
_TM_HEAD = Layout(
    Field("pus_version", 4, "PUS version", fixed=_VERSION),
    Field("time_reference", 4, "status of the time reference; 0 is not reported"),
    *_TYPE,
    Field("type_count", 16, "number of the message under its service and subtype"),
    Field("destination", 16, "destination of the report"),
)
TM_HEADER = _TM_HEAD + OWN_EPOCH_4_3.layout("time", "the camera's own time")
"""Secondary header of telemetry."""
TC_HEADER = Layout(
    Field("pus_version", 4, "PUS version", fixed=_VERSION),
    Field("acknowledge", 4, "successes to report: 1 acceptance, 2 start, 4 progress, 8 completion"),
    *_TYPE,
    Field("source", 16, "source of the telecommand"),
)
"""Secondary header of telecommands."""
ERROR_CONTROL = Layout(Field("error_control", 16, "CRC-16-CCITT-FALSE of all octets before it"))
"""Last field of each packet."""
_CRC_BYTES = ERROR_CONTROL.octets
TM_OVERHEAD = PRIMARY_HEADER.octets + TM_HEADER.octets + _CRC_BYTES
"""Octets of a telemetry packet beside its source data."""
TC_OVERHEAD = PRIMARY_HEADER.octets + TC_HEADER.octets + _CRC_BYTES
"""Octets of a telecommand packet beside its application data."""


class Acknowledge(IntFlag):
    """Successes that the sender of a telecommand wants reported; failures are always reported."""

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


def _unsealed(octets: bytes, type_: PacketType, header: Layout) -> SpacePacket:
    """Check a whole packet; its data then end before the error control."""
    packet = SpacePacket.parse(octets)
    if len(packet.data) < header.octets + _CRC_BYTES:
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
        header = _TM_HEAD.pack(
            time_reference=self.time_status,
            service=self.service,
            subtype=self.subtype,
            type_count=self.type_count,
            destination=self.destination,
        )
        data = header + OWN_EPOCH_4_3.encode_us(self.t_us) + self.data
        return _sealed(PacketType.TELEMETRY, self.apid, self.sequence_count, data)

    @classmethod
    def parse(cls, octets: bytes) -> TmPacket:
        """Read one whole packet. Raises PacketError if it is not a valid telemetry report."""
        packet = _unsealed(octets, PacketType.TELEMETRY, TM_HEADER)
        header = _TM_HEAD.unpack(packet.data[: _TM_HEAD.octets])
        return cls(
            apid=packet.apid,
            sequence_count=packet.sequence_count,
            service=header["service"],
            subtype=header["subtype"],
            t_us=OWN_EPOCH_4_3.parse_us(packet.data[_TM_HEAD.octets : TM_HEADER.octets]),
            data=packet.data[TM_HEADER.octets : -_CRC_BYTES],
            type_count=header["type_count"],
            destination=header["destination"],
            time_status=header["time_reference"],
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
        header = TC_HEADER.pack(
            acknowledge=self.acknowledge, service=self.service, subtype=self.subtype, source=self.source
        )
        return _sealed(PacketType.TELECOMMAND, self.apid, self.sequence_count, header + self.data)

    @classmethod
    def parse(cls, octets: bytes) -> TcPacket:
        """Read one whole packet. Raises PacketError if it is not a valid telecommand."""
        packet = _unsealed(octets, PacketType.TELECOMMAND, TC_HEADER)
        header = TC_HEADER.unpack(packet.data[: TC_HEADER.octets])
        return cls(
            apid=packet.apid,
            sequence_count=packet.sequence_count,
            service=header["service"],
            subtype=header["subtype"],
            data=packet.data[TC_HEADER.octets : -_CRC_BYTES],
            acknowledge=Acknowledge(header["acknowledge"]),
            source=header["source"],
        )

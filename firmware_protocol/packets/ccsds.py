"""CCSDS space packets, the CCSDS unsegmented time code (CUC) in them, and PUS-C packets. Big-endian.

Space packet: six octets of primary header, then 1 to 65 536 octets of data:

    bits  0..2    version number, 000
          3       type, 0 telemetry, 1 telecommand
          4       secondary header flag
          5..15   application process identifier (APID); 0x7FF is an idle packet
          16..17  sequence flags, 11 unsegmented (01 first, 00 continuation, 10 last)
          18..31  sequence count, per APID, modulo 16 384
          32..47  length of the data less one
          48..    data

Source: CCSDS 133.0-B-2, section 4.1; checked against the spacepackets library.

CUC: whole seconds and binary fractions of a second since an epoch of the agency's own:

    P-field, one octet, 0x2F, left out (implicit) if both sides have the same format
        bit 7      another octet follows: 0 here
        bits 6..4  010 an epoch of the agency's own
        bits 3..2  octets of seconds less one: 3
        bits 1..0  octets of fraction: 3
    T-field
        4 octets of seconds, 3 octets of fraction

A step is 2^-24 s = 59.6 ns. All arithmetic is on integers; a time is rounded to the nearest step, halves up, and back
to the nearest microsecond, so whole microseconds are preserved exactly.

Source: CCSDS 301.0-B-4, section 3.2.

PUS-C packets: the secondary headers and the checksum that ECSS-E-ST-70-41C puts into space packets.

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

from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.wire_layout import Field, Layout, choices_of

APID_IDLE = 0x7FF
SEQUENCE_MODULUS = 1 << 14
_MOST_DATA = 1 << 16


class PacketType(IntEnum):
    """Direction of a packet."""

    TELEMETRY = 0
    TELECOMMAND = 1


class SequenceFlags(IntEnum):
    """Position of a packet in a longer message."""

    CONTINUATION = 0
    FIRST = 1
    LAST = 2
    UNSEGMENTED = 3


PRIMARY_HEADER = Layout(
    Field("version", 3, "version of the space packet", fixed=0),
    Field("type", 1, "direction of the packet", choices=choices_of(PacketType)),
    Field("secondary_header", 1, "1 if a secondary header follows"),
    Field("apid", 11, "application process identifier"),
    Field("sequence_flags", 2, "position in a longer message", choices=choices_of(SequenceFlags)),
    Field("sequence_count", 14, "number of the packet under its APID"),
    Field("length", 16, "octets that follow this header, less one"),
)
HEADER_BYTES = PRIMARY_HEADER.octets


@dataclass(frozen=True)
class SpacePacket:
    """One packet; raises ValueError for a field out of range. `data`: octets after the primary header, 1..65536."""

    type: PacketType
    apid: int
    sequence_count: int
    data: bytes
    secondary_header: bool = True
    sequence_flags: SequenceFlags = SequenceFlags.UNSEGMENTED

    def __post_init__(self) -> None:
        if not 0 <= self.apid <= APID_IDLE:
            raise ValueError(f"an APID has 11 bits, got {self.apid}")
        if not 0 <= self.sequence_count < SEQUENCE_MODULUS:
            raise ValueError(f"a sequence count has 14 bits, got {self.sequence_count}")
        if not 1 <= len(self.data) <= _MOST_DATA:
            raise ValueError(f"a space packet carries 1..{_MOST_DATA} octets, got {len(self.data)}")

    @property
    def packet_id(self) -> int:
        """The first two octets as a number."""
        return self.type << 12 | self.secondary_header << 11 | self.apid

    @property
    def sequence_control(self) -> int:
        """The second two octets as a number."""
        return self.sequence_flags << 14 | self.sequence_count

    def __bytes__(self) -> bytes:
        header = PRIMARY_HEADER.pack(
            type=self.type,
            secondary_header=self.secondary_header,
            apid=self.apid,
            sequence_flags=self.sequence_flags,
            sequence_count=self.sequence_count,
            length=len(self.data) - 1,
        )
        return header + self.data

    @classmethod
    def parse(cls, octets: bytes) -> SpacePacket:
        """Read one whole packet. Raises PacketError ("short", "version", "length") for anything else."""
        if len(octets) <= HEADER_BYTES:
            raise PacketError("short")
        header = PRIMARY_HEADER.unpack(octets[:HEADER_BYTES])
        if header["version"]:
            raise PacketError("version")
        if header["length"] + 1 != len(octets) - HEADER_BYTES:
            raise PacketError("length")
        return cls(
            type=PacketType(header["type"]),
            apid=header["apid"],
            sequence_count=header["sequence_count"],
            data=octets[HEADER_BYTES:],
            secondary_header=bool(header["secondary_header"]),
            sequence_flags=SequenceFlags(header["sequence_flags"]),
        )


def whole_packets(octets: bytes) -> list[bytes]:
    """Split octets into space packets, each as long as its header states; the last piece is an incomplete rest."""
    packets, at = [], 0
    while at < len(octets):
        head = octets[at : at + HEADER_BYTES]
        size = PRIMARY_HEADER.unpack(head)["length"] + 1 if len(head) == HEADER_BYTES else 0
        packets.append(octets[at : at + HEADER_BYTES + size])
        at += HEADER_BYTES + size
    return packets


_US = 1_000_000
_P_FIELD = 0x2F
_SECONDS_OCTETS, _FRACTION_OCTETS = 4, 3
_FRACTION_BITS = 8 * _FRACTION_OCTETS


@dataclass(frozen=True)
class CucFormat:
    """Format of a time; `p_field` is true if the P-field precedes it."""

    p_field: bool = False

    @property
    def octets(self) -> int:
        """Length of an encoded time."""
        return self.p_field + _SECONDS_OCTETS + _FRACTION_OCTETS

    def layout(self, name: str, meaning: str) -> Layout:
        """Return the fields of an encoded time: `name`_seconds and `name`_fraction."""
        p_field = Field(f"{name}_p_field", 8, "CUC: epoch and numbers of octets", fixed=_P_FIELD)
        seconds = Field(f"{name}_seconds", 8 * _SECONDS_OCTETS, f"{meaning}, whole seconds", "s")
        step_s = 2.0**-_FRACTION_BITS
        fraction = Field(f"{name}_fraction", _FRACTION_BITS, f"{meaning}, fraction of a second", "s", scale=step_s)
        return Layout(*(p_field,) * self.p_field, seconds, fraction)

    def encode_us(self, t_us: int) -> bytes:
        """Return the octets of a time in microseconds since the epoch. Raises ValueError if it does not fit."""
        steps = ((t_us << _FRACTION_BITS) + _US // 2) // _US
        if steps < 0 or steps >> _FRACTION_BITS >> 8 * _SECONDS_OCTETS:
            raise ValueError(f"{t_us / _US} s does not fit {_SECONDS_OCTETS} octets of seconds")
        t_field = steps.to_bytes(_SECONDS_OCTETS + _FRACTION_OCTETS, "big")
        return bytes([_P_FIELD]) + t_field if self.p_field else t_field

    def parse_us(self, octets: bytes) -> int:
        """Read a time, in microseconds since the epoch. Raises PacketError for a wrong length or P-field."""
        if len(octets) != self.octets:
            raise PacketError("time length")
        if self.p_field and octets[0] != _P_FIELD:
            raise PacketError("time code")
        steps = int.from_bytes(octets[self.p_field :], "big")
        return (steps * _US + (1 << _FRACTION_BITS >> 1)) >> _FRACTION_BITS


OWN_EPOCH_4_3 = CucFormat()
"""Seven octets, P-field 0x2F implicit: the time of the instrument's packets, since the start of the stream."""


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
_CRC_BYTES, _CRC_START = ERROR_CONTROL.octets, 0xFFFF
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
    return packet + crc_hqx(packet, _CRC_START).to_bytes(_CRC_BYTES, "big")


def _unsealed(octets: bytes, type_: PacketType, header: Layout) -> SpacePacket:
    """Check a whole packet; its data then end before the error control."""
    packet = SpacePacket.parse(octets)
    if len(packet.data) < header.octets + _CRC_BYTES:
        raise PacketError("short")
    if crc_hqx(octets, _CRC_START):  # it is zero over data that end in their own checksum
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
    sequence_count, type_count : number of the packet under its APID, and of the report under its service and subtype.
    t_us : time of the report in microseconds since the start of the stream.
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
        _, status, service, subtype, count, destination = _TM_HEAD.unpack(packet.data[: _TM_HEAD.octets]).values()
        t_us = OWN_EPOCH_4_3.parse_us(packet.data[_TM_HEAD.octets : TM_HEADER.octets])
        data = packet.data[TM_HEADER.octets : -_CRC_BYTES]
        return cls(packet.apid, packet.sequence_count, service, subtype, t_us, data, count, destination, status)


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
        _, acknowledge, service, subtype, source = TC_HEADER.unpack(packet.data[: TC_HEADER.octets]).values()
        data = packet.data[TC_HEADER.octets : -_CRC_BYTES]
        return cls(packet.apid, packet.sequence_count, service, subtype, data, Acknowledge(acknowledge), source)

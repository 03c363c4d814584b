"""CCSDS space packets: six octets of primary header, then 1 to 65 536 octets of data. Big-endian.

    bits  0..2    version number, 000
          3       type, 0 telemetry, 1 telecommand
          4       secondary header flag
          5..15   application process identifier (APID); 0x7FF is an idle packet
          16..17  sequence flags, 11 unsegmented (01 first, 00 continuation, 10 last)
          18..31  sequence count, per APID, modulo 16 384
          32..47  length of the data less one
          48..    data

Source: CCSDS 133.0-B-2, section 4.1; checked against the spacepackets library.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.packets.errors import PacketError
from firmware_protocol.wire_layout import Field, Layout, choices_of

__all__ = [
    "APID_IDLE",
    "PRIMARY_HEADER",
    "SEQUENCE_MODULUS",
    "PacketType",
    "SequenceFlags",
    "SpacePacket",
    "idle_packet",
    "whole_packets",
]

APID_IDLE = 0x7FF
SEQUENCE_MODULUS = 1 << 14
_MOST_DATA = 1 << 16


class PacketType(IntEnum):
    """Which way a packet goes."""

    TELEMETRY = 0
    TELECOMMAND = 1


class SequenceFlags(IntEnum):
    """Which part of a longer message a packet is."""

    CONTINUATION = 0
    FIRST = 1
    LAST = 2
    UNSEGMENTED = 3


PRIMARY_HEADER = Layout(
    Field("version", 3, "version of the space packet", fixed=0),
    Field("type", 1, "which way the packet goes", choices=choices_of(PacketType)),
    Field("secondary_header", 1, "whether a secondary header follows"),
    Field("apid", 11, "application process identifier"),
    Field("sequence_flags", 2, "which part of a longer message", choices=choices_of(SequenceFlags)),
    Field("sequence_count", 14, "number of the packet under its APID"),
    Field("length", 16, "octets that follow this header, less one"),
)
HEADER_BYTES = PRIMARY_HEADER.octets


@dataclass(frozen=True)
class SpacePacket:
    """One packet. Raises ValueError for a field out of range.

    Attributes
    ----------
    data
        Everything behind the primary header, 1..65536 octets.
    """

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


def idle_packet(data_octets: int, sequence_count: int = 0) -> SpacePacket:
    """Return a packet that fills a line and says nothing; its data are 0x55."""
    return SpacePacket(
        type=PacketType.TELEMETRY,
        apid=APID_IDLE,
        sequence_count=sequence_count,
        data=b"\x55" * data_octets,
        secondary_header=False,
    )


def whole_packets(octets: bytes) -> list[bytes]:
    """Cut octets into space packets, each as long as its header says; the last piece is what does not make one."""
    packets, at = [], 0
    while at < len(octets):
        head = octets[at : at + HEADER_BYTES]
        size = PRIMARY_HEADER.unpack(head)["length"] + 1 if len(head) == HEADER_BYTES else 0
        packets.append(octets[at : at + HEADER_BYTES + size])
        at += HEADER_BYTES + size
    return packets

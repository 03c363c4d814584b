"""CCSDS space packets, and the CCSDS unsegmented time code (CUC) in them. Big-endian.

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

CUC: whole seconds and binary fractions of a second since an epoch:

    P-field, one octet, left out (implicit) if both sides have the same format
        bit 7      another octet follows: 0 here
        bits 6..4  001 epoch 1958-01-01 TAI, 010 an epoch of the agency's own
        bits 3..2  octets of seconds less one
        bits 1..0  octets of fraction
    T-field
        1..4 octets of seconds, 0..3 octets of fraction

4 + 3 octets: P-field 0x1F (TAI) or 0x2F (own epoch), a step of 2^-24 s = 59.6 ns. All arithmetic is on integers; a time
is rounded to the nearest step, halves up, and back to the nearest unit, so three octets of fraction (not fewer)
preserve whole microseconds exactly. Nanoseconds are preserved within 30 ns.

Source: CCSDS 301.0-B-4, section 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

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
    """One packet. Raises ValueError for a field out of range.

    Attributes
    ----------
    data
        Octets after the primary header, 1..65536.
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


class Epoch(IntEnum):
    """Zero of a time."""

    TAI_1958 = 1
    OWN = 2


def _check(what: str, value: int, lowest: int, highest: int) -> None:
    if not lowest <= value <= highest:
        raise ValueError(f"CUC {what}: {value} is not in {lowest}..{highest}")


@dataclass(frozen=True)
class CucFormat:
    """Format of a time.

    Attributes
    ----------
    seconds_octets, fraction_octets
        Numbers of octets, 1..4 and 0..3.
    p_field
        True if the P-field precedes the time.
    """

    epoch: Epoch = Epoch.OWN
    seconds_octets: int = 4
    fraction_octets: int = 3
    p_field: bool = False

    def __post_init__(self) -> None:
        _check("octets of seconds", self.seconds_octets, 1, 4)
        _check("octets of fraction", self.fraction_octets, 0, 3)

    @property
    def p_field_octet(self) -> int:
        """The P-field."""
        return self.epoch << 4 | self.seconds_octets - 1 << 2 | self.fraction_octets

    @property
    def octets(self) -> int:
        """Length of an encoded time."""
        return self.p_field + self.seconds_octets + self.fraction_octets

    def layout(self, name: str, meaning: str) -> Layout:
        """Return the fields of an encoded time: `name`_seconds and `name`_fraction."""
        p_field = Field(f"{name}_p_field", 8, "CUC: epoch and numbers of octets", fixed=self.p_field_octet)
        seconds = Field(f"{name}_seconds", 8 * self.seconds_octets, f"{meaning}, whole seconds", "s")
        bits = 8 * self.fraction_octets
        fraction = Field(f"{name}_fraction", bits, f"{meaning}, fraction of a second", "s", scale=2.0**-bits)
        return Layout(*(p_field,) * self.p_field, seconds, *(fraction,) * bool(bits))

    def encode_us(self, t_us: int) -> bytes:
        """Return the octets of a time in microseconds since the epoch. Raises ValueError if it does not fit."""
        fraction_bits = 8 * self.fraction_octets
        steps = ((t_us << fraction_bits) + _US // 2) // _US
        if steps < 0 or steps >> fraction_bits >> 8 * self.seconds_octets:
            raise ValueError(f"{t_us / _US} s does not fit {self.seconds_octets} octets of seconds")
        t_field = steps.to_bytes(self.seconds_octets + self.fraction_octets, "big")
        return bytes([self.p_field_octet]) + t_field if self.p_field else t_field

    def parse_us(self, octets: bytes) -> int:
        """Read a time, in microseconds since the epoch. Raises PacketError for a wrong length or P-field."""
        if len(octets) != self.octets:
            raise PacketError("time length")
        if self.p_field and octets[0] != self.p_field_octet:
            raise PacketError("time code")
        fraction_bits = 8 * self.fraction_octets
        steps = int.from_bytes(octets[self.p_field :], "big")
        return (steps * _US + (1 << fraction_bits >> 1)) >> fraction_bits


OWN_EPOCH_4_3 = CucFormat()
"""Seven octets, P-field 0x2F implicit: the time of the instrument's packets, since the start of the stream."""

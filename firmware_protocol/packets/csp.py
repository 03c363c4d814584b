"""CubeSat Space Protocol packets, versions 2 and 1: a header, then data. Big-endian.

    version 2, 6 octets   bits 47..46 priority   45..32 destination   31..18 source   17..12 destination port
                               11..6  source port   5..0 flags
    version 1, 4 octets   bits 31..30 priority   29..25 source   24..20 destination   19..14 destination port
                               13..8  source port   7..0 flags

The checksum behind the data (CRC-32C of header and data) belongs to the interface (`framing/kiss.py`), as in libcsp.

Source: libcsp 2 (csp_id.c, csp_types.h).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.packets.errors import PacketError

__all__ = ["CspPacket", "CspVersion", "Priority"]

_FIELDS = ("priority", "destination", "source", "destination_port", "source_port", "flags")


class Priority(IntEnum):
    """Order of service."""

    CRITICAL = 0
    HIGH = 1
    NORMAL = 2
    LOW = 3


class CspVersion(IntEnum):
    """Which of the two headers."""

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
    """One packet without its checksum. Raises ValueError for a field that its version has no room for."""

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
        """Read one whole packet of a known version. Raises PacketError when it is shorter than a header."""
        length = version.header_octets
        if len(octets) < length:
            raise PacketError("short")
        header = int.from_bytes(octets[:length], "big")
        fields = {name: header >> low & (1 << bits) - 1 for name, (low, bits) in version.places.items()}
        priority = Priority(fields.pop("priority"))
        return cls(data=octets[length:], priority=priority, version=version, **fields)

"""The header that every event block begins with, and the numbers of the format.

     byte   7     6     5     4     3     2     1     0
          +-----+-----+-----+-----+-----+-----+-----+-----+
       0  |      version = 1      |         mode          |
          +-----------+-----------+-----------------------+
       1  | tick code | polarity  |       0 (reserved)    |
          +-----------+-----------+-----------------------+
     2-3  |  n: events or edges in the block              |
     4-7  |  t_base: low 32 bits of the first time, us    |
     8-9  |  dropped since the last block, saturating     |
   10-12  |  W - 1, 12 bits;  H - 1, 12 bits              |
      13  |  CRC-8/AUTOSAR of bytes 0 to 12               |
          +-----------------------------------------------+

Most significant bit and byte first. The whole format, payloads included, is drawn in docs/telemetry.md.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

__all__ = [
    "EDGE_RECORD",
    "ESCAPE_ONES",
    "HEADER_BYTES",
    "LONGEST_US",
    "MAX_COUNT",
    "MAX_K",
    "MAX_SIDE",
    "TICKS_US",
    "VERSION",
    "BlockError",
    "Header",
    "Mode",
    "Polarity",
    "crc8",
]

VERSION = 1
HEADER_BYTES = 14
MAX_COUNT = 65535  # events in a block, and what `dropped` saturates at
MAX_SIDE = 4096
LONGEST_US = (1 << 31) - 1  # from the first to the last time in a block
MAX_K = 27  # Rice parameter; steps stay below 2**31
ESCAPE_ONES = 16  # so many ones, and a Rice code has no value but is followed by an escape
TICKS_US = (1, 10, 100, 1000)

EDGE_RECORD = np.dtype([("t", ">u4"), ("kind", "u1"), ("channel", "u1"), ("seq", ">u2")])
"""The record of an edge in a block: us since t_base, and as in the EDGE record."""

_HEADER = struct.Struct(">BBHIHI")  # the last four bytes are W - 1, H - 1 and the CRC


class BlockError(ValueError):
    """The bytes are no event block. Either the line damaged them, or the sender does not keep to the format."""


class Mode(IntEnum):
    """How the payload of a block is coded."""

    FLAT = 0
    ROWS = 1
    BITMAP = 2
    EDGE = 3


class Polarity(IntEnum):
    """Where the polarity of the events is written."""

    EACH = 0
    ALL_OFF = 2
    ALL_ON = 3


def _crc8_of(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1) ^ (0x2F if byte & 0x80 else 0)
    return byte & 0xFF


_CRC8 = bytes(_crc8_of(byte) for byte in range(256))


def crc8(data: bytes) -> int:
    """Return CRC-8/AUTOSAR: polynomial 0x2F, initial value and final XOR 0xFF, not reflected; 0xDF of "123456789"."""
    crc = 0xFF
    for byte in data:
        crc = _CRC8[crc ^ byte]
    return crc ^ 0xFF


@dataclass(frozen=True)
class Header:
    """What a block says of itself; `size` = (width, height), `t_base` the low 32 bits of its first time in us."""

    mode: Mode
    tick_us: int
    polarity: Polarity
    count: int
    t_base: int
    dropped: int
    size: tuple[int, int]

    def pack(self) -> bytes:
        """Return the 14 bytes."""
        codes = TICKS_US.index(self.tick_us) << 6 | self.polarity << 4
        size = (self.size[0] - 1) << 20 | (self.size[1] - 1) << 8
        data = _HEADER.pack(VERSION << 4 | self.mode, codes, self.count, self.t_base, self.dropped, size)[:-1]
        return data + bytes((crc8(data),))

    @classmethod
    def parse(cls, data: bytes) -> Header:
        """Read the header of the block `data`; raises BlockError if it is damaged or is not one of this version."""
        if len(data) < HEADER_BYTES:
            raise BlockError(f"a block has at least {HEADER_BYTES} bytes, this has {len(data)}")
        kind, codes, count, t_base, dropped, size = _HEADER.unpack_from(data)
        if crc8(data[: HEADER_BYTES - 1]) != size & 0xFF:
            raise BlockError("the CRC-8 of the header is wrong")
        if kind >> 4 != VERSION or kind & 15 > Mode.EDGE:
            raise BlockError(
                f"version {kind >> 4}, mode {kind & 15}: this decoder knows version {VERSION}, modes 0 to 3"
            )
        mode, polarity = Mode(kind & 15), codes >> 4 & 3
        if codes & 15 or polarity == 1 or (polarity and mode in (Mode.FLAT, Mode.EDGE)):
            raise BlockError(f"reserved bits or polarity are set: 0x{codes:02x} in mode {mode.name}")
        if (not count and mode != Mode.FLAT) or (codes >> 6 and mode == Mode.EDGE):
            raise BlockError(f"a block of mode {mode.name} has no count {count} with tick code {codes >> 6}")
        where = ((size >> 20) + 1, (size >> 8 & 0xFFF) + 1)
        return cls(mode, TICKS_US[codes >> 6], Polarity(polarity), count, t_base, dropped, where)

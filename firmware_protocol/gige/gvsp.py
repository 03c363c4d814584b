"""GVSP, the stream protocol of GigE Vision: a block of data as packets.

    header    u16 status | u16 0 | u8 0x80 + format | u24 0 | u64 block | u32 packet         20 octets, big-endian
    leader    format 1, packet 0: u16 0 | u16 1 (image) | u64 time, ns | u32 pixel format | u32 width | u32 height |
              u32 0 | u32 0 | u16 0 | u16 0
    payload   format 3, packets 1 to n: data, every packet but the last one full
    trailer   format 2, packet n + 1: u16 0 | u16 1 | u32 octets of the block

A packet size, as hosts set it, counts the headers of IP (20 octets) and UDP (8) too. The ids are the long ones, which
neuromorphic_drivers needs. As the real camera: pixel format 0x81100E30 is EVT3, width 1, height 64000, the most that
a block holds.

Source: GigE Vision 2.0 as implemented in the open by Aravis; values from a published capture of a TRT009S-E.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from firmware_protocol.gige.gvcp import Status

__all__ = ["BLOCK_OCTETS", "HEADER_OCTETS", "LEAST_PACKET", "MOST_PACKET", "Block", "removed", "test_packet"]

BLOCK_OCTETS = 64_000
LEAST_PACKET, MOST_PACKET = 576, 9000
_IP_UDP = 28
_EXTENDED = 0x80
_LEADER, _TRAILER, _PAYLOAD = 1, 2, 3
_IMAGE = 1
_EVT3 = 0x81100E30
_HEADER = struct.Struct(">HHIQI")
HEADER_OCTETS = _HEADER.size
_LEADER_BODY = struct.Struct(">HHQIIIIIHH")
_TRAILER_BODY = struct.Struct(">HHI")


@dataclass(frozen=True)
class Block:
    """A block: its number (1 on), the time of its first word, its data, and the size of its packets."""

    number: int
    time_ns: int
    data: bytes
    packet_size: int

    @property
    def room(self) -> int:
        """Octets of data in a full packet."""
        return self.packet_size - _IP_UDP - HEADER_OCTETS

    @property
    def packets(self) -> int:
        """Number of packets, leader and trailer with them."""
        return -(-len(self.data) // self.room) + 2

    def packet(self, number: int, status: Status = Status.SUCCESS) -> bytes:
        """Return a packet, 0 to `packets` - 1, as a datagram."""
        if number == 0:
            body = _LEADER_BODY.pack(0, _IMAGE, self.time_ns, _EVT3, 1, BLOCK_OCTETS, 0, 0, 0, 0)
            return _header(status, _LEADER, self.number, 0) + body
        if number == self.packets - 1:
            return _header(status, _TRAILER, self.number, number) + _TRAILER_BODY.pack(0, _IMAGE, len(self.data))
        start = (number - 1) * self.room
        return _header(status, _PAYLOAD, self.number, number) + self.data[start : start + self.room]


def removed(block: int, packet: int) -> bytes:
    """Return what is sent instead of a packet that is asked for again and is not kept any more."""
    return _header(Status.PACKET_REMOVED, _PAYLOAD, block, packet)


def test_packet(packet_size: int) -> bytes:
    """Return the datagram by which a host finds out whether packets of this size arrive."""
    return _header(Status.SUCCESS, _PAYLOAD, 0, 0).ljust(packet_size - _IP_UDP, b"\0")


def _header(status: Status, kind: int, block: int, packet: int) -> bytes:
    return _HEADER.pack(status, 0, (_EXTENDED | kind) << 24, block, packet)

"""GVSP, the stream protocol of GigE Vision: a block of data as packets, and the host's assembly of blocks.

    header    u16 status | u16 0 | u8 0x80 + format | u24 0 | u64 block | u32 packet         20 octets, big-endian
    leader    format 1, packet 0: u16 0 | u16 1 (image) | u64 time, ns | u32 pixel format | u32 width | u32 height |
              u32 0 | u32 0 | u16 0 | u16 0
    payload   format 3, packets 1 to n: data, every packet but the last one full
    trailer   format 2, packet n + 1: u16 0 | u16 1 | u32 octets of the block

A packet size, as hosts set it, includes the headers of IP (20 octets) and UDP (8). The ids are the long ones, which
neuromorphic_drivers needs. As in the real camera, pixel format 0x81100E30 is EVT3, width 1, height 64000, the most
that a block holds.

Source: GigE Vision 2.0 as implemented in the open by Aravis; values from a published capture of a TRT009S-E.

Assembly at the host: packets are put in order, and missing ones are requested again.

packet --> its block --> all from leader to trailer received? --> data, in the order of blocks
missing --> Resend, several times --> given up: the block is lost
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from firmware_protocol.gige.gvcp import Resend, Status

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
        """Number of packets, leader and trailer included."""
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
    """Return the reply to a request for a packet that is no longer stored."""
    return _header(Status.PACKET_REMOVED, _PAYLOAD, block, packet)


def test_packet(packet_size: int) -> bytes:
    """Return the datagram with which a host tests whether packets of this size arrive."""
    return _header(Status.SUCCESS, _PAYLOAD, 0, 0).ljust(packet_size - _IP_UDP, b"\0")


def _header(status: Status, kind: int, block: int, packet: int) -> bytes:
    return _HEADER.pack(status, 0, (_EXTENDED | kind) << 24, block, packet)


_REQUEST_PERIOD_NS = 20_000_000
_FIRST_REQUEST_NS = 1_000_000
_MOST_REQUESTS = 5
_MOST_OPEN = 256
_MOST_PACKETS = 1 << 16  # of a block
_FARTHEST = 1 << 12  # blocks ahead of the next one: a number beyond is damaged
_GOOD = (Status.SUCCESS, Status.PACKET_RESENT)


@dataclass(frozen=True)
class StreamPacket:
    """A packet of the stream as received."""

    status: int
    kind: int
    block: int
    number: int
    data: bytes

    @classmethod
    def of(cls, datagram: bytes) -> StreamPacket | None:
        """Return the packet in a datagram; None if it is not a packet with long ids."""
        if len(datagram) < _HEADER.size:
            return None
        status, _, kind_and_number, block, number = _HEADER.unpack_from(datagram)
        kind = kind_and_number >> 24
        if not kind & _EXTENDED:
            return None
        return cls(status, kind & ~_EXTENDED, block, number, datagram[_HEADER.size :])


@dataclass
class _Open:
    request_ns: int
    requests: int = 0
    parts: dict[int, bytes] = field(default_factory=dict)
    trailer: int = -1
    newest: int = 0

    @property
    def complete(self) -> bool:
        """True if all packets from the leader to the trailer have arrived."""
        return self.trailer > 0 and len(self.parts) == self.trailer + 1

    @property
    def data(self) -> bytes:
        """Data between leader and trailer."""
        return b"".join(self.parts[number] for number in range(1, self.trailer))

    def holes(self, *, over: bool) -> list[tuple[int, int]]:
        """Return (first, last) of missing packets below the newest one, and past it if the block is over."""
        end = self.trailer if self.trailer > 0 else self.newest + (1 if over else 0)
        missing = [number for number in range(end + 1) if number not in self.parts]
        holes: list[tuple[int, int]] = []
        for number in missing:
            if holes and holes[-1][1] == number - 1:
                holes[-1] = holes[-1][0], number
            else:
                holes.append((number, number))
        return holes


class BlockAssembly:
    """Assembler of blocks from packets.

    Attributes
    ----------
    lost : blocks that were given up, or of which no packet arrived.
    repeated : packets that arrived more than once.
    requested : packets that were requested again.
    invalid : datagrams that are no packets, and packets of blocks that are over.
    """

    def __init__(self) -> None:
        self._open: dict[int, _Open] = {}
        self._next: int | None = None
        self.lost = self.repeated = self.requested = self.invalid = 0

    def push(self, datagram: bytes, now_ns: int) -> list[bytes]:
        """Process a datagram; return the data of the blocks that it completes, in order."""
        packet = StreamPacket.of(datagram)
        if packet is None or packet.kind not in (_LEADER, _TRAILER, _PAYLOAD):
            self.invalid += 1
        elif packet.block:  # block 0 is a test packet
            self._take(packet, now_ns)
        return self.done(now_ns)

    def done(self, now_ns: int) -> list[bytes]:
        """Return the data of the next complete blocks; those that stay incomplete for too long are given up."""
        data = []
        while self._open:
            first = min(self._open)
            if self._next is None:
                self._next = first
            block = self._open[first]
            hopeless = len(self._open) > _MOST_OPEN or (block.requests >= _MOST_REQUESTS and now_ns >= block.request_ns)
            if not hopeless and (first > self._next or not block.complete):
                break  # the missing packets may still arrive
            self.lost += first - self._next + (not block.complete)
            data += [block.data] if block.complete else []
            del self._open[first]
            self._next = first + 1
        return data

    @property
    def waiting(self) -> int:
        """Blocks that have begun and are neither complete nor given up."""
        return len(self._open)

    def missing(self, now_ns: int, *, over: bool = False) -> list[Resend]:
        """Return the requests to send now; `over`: the stream has ended, so the last block's end is missing too."""
        requests = []
        newest = max(self._open, default=0)
        for number, block in self._open.items():
            if not block.complete and now_ns >= block.request_ns and block.requests < _MOST_REQUESTS:
                holes = block.holes(over=over or number < newest)
                if holes:
                    block.request_ns = now_ns + _REQUEST_PERIOD_NS
                    block.requests += 1
                requests += [Resend(number, first, last) for first, last in holes]
        requests += self._whole_blocks(now_ns)
        self.requested += sum(resend.last - resend.first + 1 for resend in requests)
        return requests

    def _whole_blocks(self, now_ns: int) -> list[Resend]:
        """Return requests for the leaders of blocks without any packet: the replies open these blocks."""
        if self._next is None or not self._open:
            return []
        gone = range(self._next, min(min(self._open), self._next + 16))
        for number in gone:
            self._open[number] = _Open(now_ns + _REQUEST_PERIOD_NS)
        return [Resend(number, 0, 1) for number in gone]

    def _take(self, packet: StreamPacket, now_ns: int) -> None:
        expected = packet.block if self._next is None else self._next
        if not expected <= packet.block < expected + _FARTHEST or packet.number >= _MOST_PACKETS:
            self.invalid += 1
            return
        if packet.status not in _GOOD and packet.block not in self._open:
            self.invalid += 1  # the reply to a request of another host
            return
        block = self._open.setdefault(packet.block, _Open(now_ns + _FIRST_REQUEST_NS))
        if packet.status not in _GOOD:
            block.requests, block.request_ns = _MOST_REQUESTS, now_ns
            return
        if packet.number in block.parts:
            self.repeated += 1
        else:
            block.requests = 0  # packets still arrive, so further requests are worthwhile
        block.parts[packet.number] = packet.data
        block.newest = max(block.newest, packet.number)
        if packet.kind == _TRAILER:
            block.trailer = packet.number

"""The network stream of cAER and libcaer: AEDAT 3.1 packets behind a header of 20 bytes, little-endian.

    i64 0x1D378BC90B9A6658   i64 number   i8 version 1   i8 format, 0: as they are   i16 source

A connection begins with one such header, number 0, and goes on with bare packets. A datagram has its own: the number
goes up by one each time, and its bit 63 marks the first datagram of a packet; at most 1452 bytes follow.

Source: inivation docs, "AEDAT 3.1 network streaming"; libcaer, `network.h`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import ClassVar

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.events import Events
from firmware_protocol.network_streams.coder import ConnectionCoder, Datagram, DatagramCoder, StreamFacts
from firmware_protocol.recordings.aedat31 import encode_aedat31

__all__ = ["CHUNK_BYTES", "FIRST", "HEADER", "MAGIC", "CaerConnectionCoder", "CaerDatagramCoder", "reset_packet"]

MAGIC = 0x1D378BC90B9A6658
HEADER = struct.Struct("<QQbbh")
"""Magic, number, version, format, source."""
FIRST = 1 << 63
CHUNK_BYTES = 1452
_VERSION, _RAW, _SOURCE = 1, 0, 1
_PACKET_HEAD, _EVENT_BYTES = 28, 8
_RESET = 1  # of special events


def reset_packet() -> bytes:
    """Return a packet with the special event that says: the clock starts anew, without it readers drop what follows."""
    head = struct.pack("<hhiiiiii", 0, _SOURCE, _EVENT_BYTES, 4, 0, 1, 1, 1)
    return head + struct.pack("<Ii", _RESET << 1 | 1, 0x7FFFFFFF)


class CaerConnectionCoder(ConnectionCoder):
    """Codes events and edges for a TCP client of cAER's kind."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)
    has_edges: ClassVar[bool] = True

    @property
    def greeting(self) -> bytes:
        """The header, number 0."""
        return HEADER.pack(MAGIC, 0, _VERSION, _RAW, _SOURCE)

    def encode(self, events: Events, edges: Edges) -> bytes:
        """Return packets: edges first, then events."""
        return encode_aedat31(events, edges)

    def restart(self) -> bytes:
        """Return a packet with a time-stamp reset."""
        return reset_packet()


class CaerDatagramCoder(DatagramCoder):
    """Codes events and edges for a UDP receiver of cAER's kind: a packet in pieces, one for each datagram."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)
    has_edges: ClassVar[bool] = True

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        self._number = 0

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield the pieces of the packets of edges, then of those of events."""
        for packet in _single(encode_aedat31(events[:0], edges)):
            yield from (Datagram(data, 0) for data, _ in self._pieces(packet))
        before = 0
        for packet in _single(encode_aedat31(events, empty_edges())):
            for data, at in self._pieces(packet):
                yield Datagram(data, before + (at - _PACKET_HEAD) // _EVENT_BYTES)
            before += (len(packet) - _PACKET_HEAD) // _EVENT_BYTES

    def restart(self) -> Iterator[Datagram]:
        """Yield a time-stamp reset."""
        yield from (Datagram(data, 0) for data, _ in self._pieces(reset_packet()))

    def _pieces(self, packet: bytes) -> Iterator[tuple[bytes, int]]:
        """Yield the datagrams of one packet, each with where its piece ends."""
        for start in range(0, len(packet), CHUNK_BYTES):
            piece = packet[start : start + CHUNK_BYTES]
            number = self._number | (FIRST if start == 0 else 0)
            self._number = (self._number + 1) % FIRST
            yield HEADER.pack(MAGIC, number, _VERSION, _RAW, _SOURCE) + piece, start + len(piece)


def _single(packets: bytes) -> Iterator[bytes]:
    """Yield one packet after another."""
    start = 0
    while start < len(packets):
        (number,) = struct.unpack_from("<i", packets, start + 20)
        end = start + _PACKET_HEAD + number * _EVENT_BYTES
        yield packets[start:end]
        start = end

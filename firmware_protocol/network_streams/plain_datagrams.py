"""Datagrams that are nothing but events, without a number: those of AEStream and of faery, little-endian.

    spif                 u32: bit 31 = 1 no time, 30..16 x, 15 ON, 14..0 y      at most 128 in a datagram
    t64_x16_y16_on8      u64 us   u16 x   u16 y   u8 ON                         at most 100
    t32_x16_y15_on1      u32 us   u16 x   u16: bits 15..1 y, bit 0 ON           at most 100

AEStream's receiver takes 512 bytes of a datagram, every four of them as an event, and leaves polarity out.

Sources: aestream, `dvs_to_udp.cpp`, and aestream 0.6.4 as a receiver; faery 0.7.1 as a sender and a receiver.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from firmware_protocol.edges import Edges
from firmware_protocol.events import EVENT, Events
from firmware_protocol.network_streams.coder import Datagram, DatagramCoder

__all__ = ["FaeryLongCoder", "FaeryShortCoder", "SpifCoder"]

_NO_TIME = np.uint32(1 << 31)
_SHORT = np.dtype([("t", "<u4"), ("x", "<u2"), ("y_on", "<u2")])
_SPIF_EVENTS = 128
_FAERY_EVENTS = 100


class SpifCoder(DatagramCoder):
    """Codes events for AEStream, spiffer and SPIF boards; times are left out, an event counts when it comes."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams; edges have no place in them."""
        words = (events["x"].astype("<u4") << 16) | (events["on"].astype("<u4") << 15) | events["y"] | _NO_TIME
        yield from _cut(words.astype("<u4"), _SPIF_EVENTS)


class FaeryLongCoder(DatagramCoder):
    """Codes events as faery's `t64_x16_y16_on8`, which is the event record of this project."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 16, 1 << 16)

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams; edges have no place in them."""
        yield from _cut(events.view(f"V{EVENT.itemsize}"), _FAERY_EVENTS)


class FaeryShortCoder(DatagramCoder):
    """Codes events as faery's `t32_x16_y15_on1`: times wrap after 71 minutes."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 16, 1 << 15)

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams; edges have no place in them."""
        records = np.empty(len(events), _SHORT)
        records["t"] = events["t"] & np.uint64(0xFFFFFFFF)
        records["x"] = events["x"]
        records["y_on"] = (events["y"] << 1) | events["on"]
        yield from _cut(records, _FAERY_EVENTS)


def _cut(records: np.ndarray, most: int) -> Iterator[Datagram]:
    data, size = memoryview(records.tobytes()), records.dtype.itemsize
    for first in range(0, len(records), most):
        end = min(first + most, len(records))
        yield Datagram(bytes(data[first * size : end * size]), end)

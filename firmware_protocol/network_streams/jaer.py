"""jAER's UDP stream ("AEUnicast"): a sequence number, then addresses and times as in AEDAT 2.0, big-endian.

    i32 number (the first is 1)   (u32 address   i32 us) ...

jAER tells its user of a gap in the numbers and goes on. Its settings for this stream are in docs/streams.md.

Source: jAER, AEUnicastOutput.java, AEUnicastInput.java, AENetworkInterfaceConstants.java.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from firmware_protocol.edges import Edges
from firmware_protocol.events import Events
from firmware_protocol.network_streams.coder import Datagram, DatagramCoder, StreamFacts
from firmware_protocol.recordings.aedat2 import encode_aedat2

__all__ = ["RECORDS", "JaerCoder"]

RECORDS = 183
"""Records of a datagram: 1468 bytes, which no network of 1500 bytes takes apart."""

_NUMBER = struct.Struct(">i")
_RECORD_BYTES = 8
_LAST = (1 << 31) - 1


class JaerCoder(DatagramCoder):
    """Codes events and edges for jAER."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 10, 1 << 9)
    has_edges: ClassVar[bool] = True

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        self._number = 1

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams; an edge stands before the events of its time."""
        records = encode_aedat2(events, self.facts.size, edges)
        ends = _events_before(events, edges)
        count = len(records) // _RECORD_BYTES
        for first in range(0, count, RECORDS):
            end = min(first + RECORDS, count)
            data = _NUMBER.pack(self._number) + records[first * _RECORD_BYTES : end * _RECORD_BYTES]
            self._number = self._number + 1 if self._number < _LAST else 1
            yield Datagram(data, end if ends is None else int(ends[end]))


def _events_before(events: Events, edges: Edges) -> np.ndarray | None:
    """Return how many of the first n records are events, (records + 1,); None where all are."""
    if not len(edges):
        return None
    is_event = np.arange(len(edges) + len(events)) >= len(edges)
    order = np.argsort(np.concatenate((edges["t"], events["t"])), kind="stable")
    return np.concatenate(([0], np.cumsum(is_event[order])))

"""The way of the edges on the external input through an instrument: a small queue, and blocks of edges."""

from __future__ import annotations

import numpy as np

from firmware_protocol.edges import EDGE, Edges
from firmware_protocol.event_device import EdgeCounters
from firmware_protocol.telemetry import BlockEncoder
from firmware_protocol.telemetry.layout import LONGEST_US

__all__ = ["EdgePath"]

_MOST_WAITING = 4096
_MOST_TOLD = 0xFFFF


class EdgePath:
    """Takes edges, gives blocks."""

    def __init__(self, encoder: BlockEncoder) -> None:
        self._encoder = encoder
        self._waiting = np.empty(0, EDGE)
        self._untold = 0  # dropped since the last block
        self._offered = self._ignored = self._dropped = self._delivered = self._lost = self._in_flight = 0

    @property
    def counters(self) -> EdgeCounters:
        """Fates of all edges so far."""
        return EdgeCounters(
            offered=self._offered,
            ignored=self._ignored,
            dropped=self._dropped,
            delivered=self._delivered,
            lost_on_link=self._lost,
            queued=len(self._waiting) + self._in_flight,
        )

    @property
    def oldest_us(self) -> int | None:
        """Stream time of the earliest edge that waits; None when none waits."""
        return int(self._waiting["t"].min()) if len(self._waiting) else None

    def ignore(self, edges: Edges) -> None:
        """Count edges (n,) that came while the instrument was not running."""
        self._offered += len(edges)
        self._ignored += len(edges)

    def put(self, edges: Edges) -> None:
        """Take in edges (n,); what finds no room is dropped."""
        self._offered += len(edges)
        fitting = edges[: _MOST_WAITING - len(self._waiting)]
        self._drop(len(edges) - len(fitting))
        self._waiting = np.concatenate((self._waiting, fitting))

    def next_block(self, offset_us: int) -> tuple[bytes, Edges] | None:
        """Make a block of what waits, in the time that is `offset_us` ahead of stream time; return it and its edges."""
        if not len(self._waiting):
            return None
        ordered = self._waiting[np.argsort(self._waiting["t"], kind="stable")]
        in_reach = int(np.searchsorted(ordered["t"], ordered["t"][0] + np.uint64(LONGEST_US), side="right"))
        count = min(in_reach, self._encoder.max_edges)
        edges, self._waiting = ordered[:count], ordered[count:]
        own = edges.copy()
        own["t"] += np.uint64(offset_us % (1 << 64))
        told = min(self._untold, _MOST_TOLD)
        self._untold -= told
        self._in_flight += len(edges)
        return self._encoder.encode_edges(own, told), edges

    def sent(self, count: int) -> None:
        """Say that so many of those handed out have left."""
        self._in_flight -= count
        self._delivered += count

    def lost(self, count: int) -> None:
        """Say that so many of those handed out were lost by the link."""
        self._in_flight -= count
        self._lost += count

    def clear(self) -> None:
        """Drop what waits."""
        self._drop(len(self._waiting))
        self._waiting = self._waiting[:0]

    def _drop(self, count: int) -> None:
        self._dropped += count
        self._untold += count

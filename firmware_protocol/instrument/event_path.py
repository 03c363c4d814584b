"""Paths of events and edges through an instrument.

Events: selection of pixels, queue, rate limit, block. Edges of the external input: a small queue, blocks of edges.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from firmware_protocol.device.fates import Counts
from firmware_protocol.events import EDGE, Edges, Events, copy_events, empty_events
from firmware_protocol.instrument.queue import Dropped, EventQueue, Selection, TokenBucket
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.telemetry import BlockEncoder, BlockSettings, as_received
from firmware_protocol.telemetry.layout import LONGEST_US

__all__ = ["EdgePath", "EventPath", "Piece", "block_settings"]


_MOST_REPORTED = 0xFFFF  # dropped events in one block's header; the next block reports the rest
_BURST_S = 0.02


def block_settings(settings: InstrumentSettings) -> BlockSettings:
    """Return the block settings of an instrument."""
    return BlockSettings(settings.tick_us, settings.coding, settings.block_events, settings.block_bytes)


@dataclass(frozen=True)
class Piece:
    """Events that leave together: block, (n,) EVENT as a receiver decodes them, number of missing ones before them.

    The events are in stream time; the block is empty if the link packs them itself.
    """

    block: bytes
    events: Events
    dropped: int


class EventPath:
    """Path of the events of an array of `size` = (width, height) to blocks.

    Attributes
    ----------
    fates
        The instrument's record; events that were handed out and are neither sent nor lost yet are queued in it.
    """

    def __init__(self, size: tuple[int, int], settings: InstrumentSettings, fates: Counts) -> None:
        self.size = size
        self.fates = fates
        self._held_by_rate = False
        self._last_us = 0
        self._queue = EventQueue(settings.bounds)
        self._encoder = BlockEncoder(size, block_settings(settings))
        self.select(settings.selection(size))
        self.limit(settings.rate_limit, 0)
        self._encoder.encode(empty_events(2))  # loads the compiled code now, which takes a good part of a second

    @property
    def waiting(self) -> int:
        """Events that wait to be handed out."""
        return self._queue.waiting

    @property
    def room(self) -> int:
        """Events that certainly fit now."""
        return self._queue.room

    @property
    def patience_us(self) -> int | None:
        """Longest time that an event may wait for the line, us; None if it waits for a rate limit."""
        return None if self.rate_limit else self._queue.bounds.age_us

    @property
    def oldest_us(self) -> int | None:
        """Stream time of the event that waits longest; None if none waits."""
        return self._queue.oldest_us

    @property
    def rate_limit(self) -> int:
        """Events a second; 0 for none."""
        return int(self._bucket.per_second)

    @property
    def tick_us(self) -> int:
        """Unit of event times."""
        return self._encoder.settings.tick_us

    def select(self, selection: Selection) -> None:
        """Select the pixels that are sent from now on; raises ValueError if they lie outside the array."""
        self.selection = selection.within(self.size)
        self._all = (selection.width, selection.height, selection.keep_every) == (*self.size, 1)

    def limit(self, per_second: int, now_us: int) -> None:
        """Limit the rate from now on; 0 for no limit."""
        burst = max(self._encoder.settings.max_events, round(per_second * _BURST_S))
        self._bucket = TokenBucket(per_second, burst, now_us)

    def set_tick(self, tick_us: int) -> None:
        """Set the unit of time from the next block on."""
        self._encoder = BlockEncoder(self.size, dataclasses.replace(self._encoder.settings, tick_us=tick_us))

    def check(self, events: Events) -> None:
        """Raise ValueError if events lie outside the array or are not sorted."""
        if (events["x"] >= self.size[0]).any() or (events["y"] >= self.size[1]).any():
            raise ValueError(f"an event lies outside the {self.size[0]}x{self.size[1]} pixels")
        if (events["t"][1:] < events["t"][:-1]).any():
            raise ValueError("events are not sorted by time")

    def put(self, events: Events, now_us: int, offset_us: int = 0) -> None:
        """Queue events (n,), which are copied; the instrument's own time is `offset_us` ahead of stream time."""
        chosen = copy_events(events) if self._all else self.selection.of(events)
        self.fates.not_selected += len(events) - len(chosen)
        if self.tick_us > 1:
            chosen = self._in_block_order(chosen, offset_us)
        self._last_us = int(chosen["t"][-1]) if len(chosen) else self._last_us
        self._count(self._queue.put(chosen, now_us))

    def advance(self, now_us: int) -> None:
        """Advance stream time: the bucket fills, waiting events age."""
        self._bucket.advance(now_us)
        self._count(self._queue.trim(now_us))

    def next_block(self, offset_us: int) -> Piece | None:
        """Make a block of the events at the head, in the time that is `offset_us` ahead of stream time.

        None if nothing waits or nothing may leave.
        """
        events = self._next(self._encoder.settings.max_events)
        if events is None:
            return None
        shift = np.uint64(offset_us % (1 << 64))
        own = copy_events(events)
        own["t"] += shift
        dropped = min(self._queue.dropped_before, _MOST_REPORTED)
        block, taken = self._encoder.encode(own, dropped)
        seen = as_received(own[:taken], self.tick_us)
        seen["t"] -= shift
        return self._hand_out(Piece(block, seen, dropped))

    def next_events(self, limit: int) -> Piece | None:
        """Hand out up to `limit` events from the head, for a link that packs them itself."""
        events = self._next(limit)
        if events is None:
            return None
        return self._hand_out(Piece(b"", copy_events(events), self._queue.dropped_before))

    def clear(self) -> None:
        """Drop the events that wait."""
        self.fates.flushed += self._queue.clear()

    def _in_block_order(self, events: Events, offset_us: int) -> Events:
        """Round times down to the tick and sort each tick in raster order, which makes blocks smaller.

        Rounding never goes back before events queued earlier: a tick may span two batches, may just have become
        coarser, and may have begun before the stream did.
        """
        shift = np.uint64(offset_us % (1 << 64))
        own = copy_events(events)
        own["t"] += shift
        ordered = as_received(own, self.tick_us)
        ordered["t"] -= shift
        ordered["t"] = np.maximum(ordered["t"].astype(np.int64), self._last_us)
        return ordered

    def _next(self, limit: int) -> Events | None:
        """Return the events at the head that may leave; None if none waits or the bucket is too empty."""
        count = min(limit, self._queue.waiting)
        self._held_by_rate = count > 0 and not self._bucket.holds(count)
        return None if self._held_by_rate or not count else self._queue.head(limit)

    def _hand_out(self, piece: Piece) -> Piece:
        self._queue.remove(len(piece.events), piece.dropped)
        self._bucket.spend(len(piece.events))
        self.fates.queued += len(piece.events)
        return piece

    def _count(self, dropped: Dropped) -> None:
        """Count drops under their cause: the rate limit while it holds the queue back, else the bound."""
        if self._held_by_rate:
            self.fates.dropped_rate += dropped.total
        else:
            self.fates.dropped_fifo += dropped.full
            self.fates.dropped_late += dropped.late


_MOST_WAITING = 4096


class EdgePath:
    """Path of edges to blocks; `counts` are those of the instrument's edges."""

    def __init__(self, encoder: BlockEncoder, counts: Counts) -> None:
        self._encoder = encoder
        self._waiting = np.empty(0, EDGE)
        self._unreported = 0  # dropped since the last block
        self._counts = counts

    @property
    def waiting(self) -> int:
        """Edges that wait to be handed out."""
        return len(self._waiting)

    @property
    def oldest_us(self) -> int | None:
        """Stream time of the earliest edge that waits; None if none waits."""
        return int(self._waiting["t"].min()) if len(self._waiting) else None

    def ignore(self, edges: Edges) -> None:
        """Count edges (n,) that came while the instrument was not running."""
        self._counts.offered += len(edges)
        self._counts.ignored += len(edges)

    def put(self, edges: Edges) -> None:
        """Queue edges (n,); those that find no room are dropped."""
        self._counts.offered += len(edges)
        fitting = edges[: _MOST_WAITING - len(self._waiting)]
        dropped = len(edges) - len(fitting)
        self._counts.dropped_fifo += dropped
        self._unreported += dropped
        self._waiting = np.concatenate((self._waiting, fitting))

    def next_block(self, offset_us: int) -> tuple[bytes, Edges] | None:
        """Make a block of the waiting edges, in the time `offset_us` ahead of stream time; return it and its edges."""
        if not len(self._waiting):
            return None
        ordered = self._waiting[np.argsort(self._waiting["t"], kind="stable")]
        in_reach = int(np.searchsorted(ordered["t"], ordered["t"][0] + np.uint64(LONGEST_US), side="right"))
        count = min(in_reach, self._encoder.max_edges)
        edges, self._waiting = ordered[:count], ordered[count:]
        own = edges.copy()
        own["t"] += np.uint64(offset_us % (1 << 64))
        reported = min(self._unreported, _MOST_REPORTED)
        self._unreported -= reported
        self._counts.queued += len(edges)
        return self._encoder.encode_edges(own, reported), edges

    def clear(self) -> None:
        """Drop the edges that wait."""
        self._counts.flushed += len(self._waiting)
        self._unreported += len(self._waiting)
        self._waiting = self._waiting[:0]

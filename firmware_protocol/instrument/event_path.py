"""Paths of events and edges through an instrument.

Events: selection of pixels, queue, rate limit, block. Edges of the external input: a small queue, blocks of edges.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import Items, Numbers
from firmware_protocol.events import EDGE, Edges, Events, copy_events, empty_events
from firmware_protocol.instrument.queue import Dropped, EventQueue, OwnTime, Selection, TokenBucket
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.telemetry.layout import LONGEST_US
from firmware_protocol.telemetry.reading import as_received
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings

_MOST_REPORTED = 0xFFFF  # dropped events in one block's header; the next block reports the rest
_BURST_S = 0.02


def block_settings(settings: InstrumentSettings) -> BlockSettings:
    """Return the block settings of an instrument."""
    return BlockSettings(settings.tick_us, settings.coding, settings.block_events, settings.block_bytes)


@dataclass(frozen=True)
class Outgoing(Items):
    """A message, and the items in it as a receiver decodes them: rounded to the tick and in the order of the block.

    Attributes
    ----------
    message : message to send, with the instrument's own time. Its payload is empty if the link packs the events itself.
    """

    message: Message = field(kw_only=True)


class EventPath:
    """Path of the events of an array of `size` = (width, height) to messages with blocks: an `ItemEncoder`."""

    def __init__(self, size: tuple[int, int], settings: InstrumentSettings, fates: Fates, time: OwnTime) -> None:
        self.size = size
        self._fates = fates
        self._time = time
        self._held_by_rate = False
        self._last_us = 0
        self.queue = EventQueue(settings.bounds)
        self._encoder = BlockEncoder(size, block_settings(settings))
        self.select(settings.selection(size))
        self.limit(settings.rate_limit)
        self._encoder.encode(empty_events(2))  # loads the compiled code now, which takes a good part of a second

    @property
    def waiting(self) -> Numbers:
        """Numbers of items that wait."""
        return Numbers(self.queue.waiting)

    @property
    def patience_us(self) -> int | None:
        """Longest time that an event may wait for the line, us; None if it waits for a rate limit."""
        return None if self.rate_limit else self.queue.bounds.age_us

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

    def limit(self, per_second: int) -> None:
        """Limit the rate from now on; 0 for no limit."""
        burst = max(self._encoder.settings.max_events, round(per_second * _BURST_S))
        self._bucket = TokenBucket(per_second, burst, self._time.now_us)

    def set_tick(self, tick_us: int) -> None:
        """Set the unit of time from the next block on."""
        self._encoder = BlockEncoder(self.size, dataclasses.replace(self._encoder.settings, tick_us=tick_us))

    def check(self, events: Events) -> None:
        """Raise ValueError if events lie outside the array or are not sorted."""
        if (events["x"] >= self.size[0]).any() or (events["y"] >= self.size[1]).any():
            raise ValueError(f"an event lies outside the {self.size[0]}x{self.size[1]} pixels")
        if (events["t"][1:] < events["t"][:-1]).any():
            raise ValueError("events are not sorted by time")

    def put(self, events: Events) -> None:
        """Queue events (n,), which are copied."""
        chosen = copy_events(events) if self._all else self.selection.of(events)
        self._fates.not_selected += len(events) - len(chosen)
        if self.tick_us > 1:
            chosen = self._in_block_order(chosen)
        self._last_us = int(chosen["t"][-1]) if len(chosen) else self._last_us
        self._count(self.queue.put(chosen, self._time.now_us))

    def advance(self) -> None:
        """Follow stream time: the bucket fills, waiting events age."""
        self._bucket.advance(self._time.now_us)
        self._count(self.queue.trim(self._time.now_us))

    def take(self, now_us: int, room: int) -> Outgoing | None:
        """Return a message with a block of at most `room` events; None if nothing waits or nothing may leave."""
        events = self._next(min(room, self._encoder.settings.max_events))
        if events is None:
            return None
        shift = np.uint64(self._time.offset_us % (1 << 64))
        own_events = copy_events(events)
        own_events["t"] += shift
        dropped = min(self.queue.dropped_before, _MOST_REPORTED)
        block, taken = self._encoder.encode(own_events, dropped)
        seen = as_received(own_events[:taken], self.tick_us)
        seen["t"] -= shift
        return self._outgoing(block, seen, dropped)

    def take_unpacked(self, room: int) -> Outgoing | None:
        """Return a message without a block, for a link that packs the events itself; otherwise as `take`."""
        events = self._next(room)
        return None if events is None else self._outgoing(b"", copy_events(events), self.queue.dropped_before)

    def clear(self) -> None:
        """Drop what waits."""
        self.queue.clear()

    def _in_block_order(self, events: Events) -> Events:
        """Round times down to the tick and sort each tick in raster order, which makes blocks smaller.

        Rounding never goes back before events queued earlier: a tick may span two batches, may just have become
        coarser, and may have begun before the stream did.
        """
        shift = np.uint64(self._time.offset_us % (1 << 64))
        own_events = copy_events(events)
        own_events["t"] += shift
        ordered = as_received(own_events, self.tick_us)
        ordered["t"] -= shift
        ordered["t"] = np.maximum(ordered["t"].astype(np.int64), self._last_us)
        return ordered

    def _next(self, limit: int) -> Events | None:
        """Return the events at the head that may leave; None if none waits or the bucket is too empty."""
        count = min(limit, self.queue.waiting)
        self._held_by_rate = count > 0 and not self._bucket.holds(count)
        return None if self._held_by_rate or not count else self.queue.head(limit)

    def _outgoing(self, block: bytes, events: Events, dropped: int) -> Outgoing:
        """Remove events from the head of the queue, and return the message that carries them."""
        self.queue.remove(len(events), dropped)
        self._bucket.spend(len(events))
        message = Message(MessageKind.EVENTS, block, self._time.of(int(events["t"][0])))
        return Outgoing(events, epoch_us=self._time.epoch_us, message=message)

    def _count(self, dropped: Dropped) -> None:
        """Count drops under their cause: the rate limit while it holds the queue back, else the bound."""
        if self._held_by_rate:
            self._fates.dropped_rate += dropped.total
        else:
            self._fates.dropped_fifo += dropped.full
            self._fates.dropped_late += dropped.late


_MOST_WAITING = 4096


class EdgePath:
    """Path of edges to messages with blocks: an `ItemEncoder`."""

    def __init__(self, encoder: BlockEncoder, fates: Fates, time: OwnTime) -> None:
        self._encoder = encoder
        self._time = time
        self._waiting = np.empty(0, EDGE)
        self._unreported = 0  # dropped since the last block
        self._counts = fates.edges

    @property
    def waiting(self) -> Numbers:
        """Numbers of items that wait."""
        return Numbers(edges=len(self._waiting))

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

    def take(self, now_us: int, room: int) -> Outgoing | None:
        """Return a message with a block of at most `room` edges; None if none waits."""
        if not len(self._waiting):
            return None
        ordered = self._waiting[np.argsort(self._waiting["t"], kind="stable")]
        in_reach = int(np.searchsorted(ordered["t"], ordered["t"][0] + np.uint64(LONGEST_US), side="right"))
        count = min(in_reach, room, self._encoder.max_edges)
        edges, self._waiting = ordered[:count], ordered[count:]
        own_edges = edges.copy()
        own_edges["t"] += np.uint64(self._time.offset_us % (1 << 64))
        reported = min(self._unreported, _MOST_REPORTED)
        self._unreported -= reported
        block = self._encoder.encode_edges(own_edges, reported)
        message = Message(MessageKind.EDGES, block, self._time.of(int(edges["t"][0])))
        return Outgoing(edges=edges, epoch_us=self._time.epoch_us, message=message)

    def take_until(self, until_us: int) -> Edges:
        """Remove and return the edges (m,) not later than `until_us`, sorted, for a link that packs them itself."""
        ordered = self._waiting[np.argsort(self._waiting["t"], kind="stable")]
        count = int(np.searchsorted(ordered["t"], np.uint64(max(0, until_us)), side="right"))
        self._waiting = ordered[count:]
        return ordered[:count]

    def clear(self) -> None:
        """Drop what waits; the next block reports the edges that are missing."""
        self._unreported += len(self._waiting)
        self._waiting = self._waiting[:0]

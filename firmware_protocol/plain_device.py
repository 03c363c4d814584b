"""An event camera without electronics: what goes in waits, as it is, for whoever takes it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.event_copies import copy_events
from firmware_protocol.event_device import CameraCounters, EdgeCounters, EventDevice
from firmware_protocol.events import EVENT, Events, empty_events

__all__ = ["PlainDevice", "Taken", "own_time"]

_CAPACITY = 1 << 21  # events; edges likewise


@dataclass(frozen=True)
class Taken:
    """Events (n,) EVENT and edges (m,) EDGE in the time told to the device, whose own clock was zero at `epoch_us`."""

    events: Events
    edges: Edges
    epoch_us: int


def own_time(records: Events | Edges, epoch_us: int) -> Events | Edges:
    """Return (n,) EVENT or EDGE in the time of a device's own clock, which was zero at `epoch_us`."""
    if not epoch_us or not len(records):
        return records
    own = copy_events(records) if records.dtype == EVENT else records.copy()
    own["t"] -= np.uint64(epoch_us % (1 << 64))
    return own


class PlainDevice(EventDevice):
    """Keeps events and edges until `take`; what finds it full is dropped and counted.

    A link that cannot tell at once what becomes of them uses `carry`, and `arrived` or `failed` later.

    Attributes
    ----------
    takes_edges
        Whether its link carries edges; where not, they are ignored.
    """

    def __init__(self, capacity: int = _CAPACITY) -> None:
        self._capacity = capacity
        self.takes_edges = True
        self._running = True
        self._not_running = self._flushed = self._edges_ignored = self._edges_lost = 0
        self._waiting: deque[Taken] = deque()
        self._now_us = self._epoch_us = 0
        self._offered = self._queued = self._dropped = self._delivered = self._lost = 0
        self._edges_offered = self._edges_queued = self._edges_dropped = self._edges_delivered = 0

    @property
    def now_us(self) -> int:
        """Stream time that it has reached."""
        return self._now_us

    @property
    def streaming(self) -> bool:
        """Unless its link says that nobody is there."""
        return self._running

    @property
    def room_events(self) -> int:
        """Events that fit now."""
        return self._capacity - self._queued

    @property
    def epoch_us(self) -> int:
        """Time at which its own clock was last zero."""
        return self._epoch_us

    @property
    def counters(self) -> CameraCounters:
        """Fates of all events and edges so far."""
        edges = EdgeCounters(
            offered=self._edges_offered, dropped=self._edges_dropped, delivered=self._edges_delivered,
            queued=self._edges_queued, ignored=self._edges_ignored, lost_on_link=self._edges_lost,
        )  # fmt: skip
        return CameraCounters(
            offered=self._offered, dropped_fifo=self._dropped, delivered=self._delivered - self._lost,
            lost_on_link=self._lost, queued=self._queued, not_running=self._not_running, flushed=self._flushed,
            edges=edges,
        )  # fmt: skip

    def offer(self, events: Events) -> None:
        """Take events (n,) EVENT, as many as fit; raises ValueError when they go back in time."""
        if len(events) and (int(events["t"][0]) < self._now_us or bool((events["t"][1:] < events["t"][:-1]).any())):
            raise ValueError("events go back in time")
        if not self._running:
            self._offered += len(events)
            self._not_running += len(events)
            return
        fitting = min(len(events), self.room_events)
        self._offered += len(events)
        self._dropped += len(events) - fitting
        self._queued += fitting
        if fitting:
            self._waiting.append(Taken(copy_events(events[:fitting]), empty_edges(), self._epoch_us))
            self._now_us = int(events["t"][fitting - 1])

    def offer_edges(self, edges: Edges) -> None:
        """Take edges (n,) EDGE, as many as fit."""
        if not (self._running and self.takes_edges):
            self._edges_offered += len(edges)
            self._edges_ignored += len(edges)
            return
        fitting = min(len(edges), self._capacity - self._edges_queued)
        self._edges_offered += len(edges)
        self._edges_dropped += len(edges) - fitting
        self._edges_queued += fitting
        if fitting:
            self._waiting.append(Taken(empty_events(), edges[:fitting].copy(), self._epoch_us))

    def advance(self, now_us: int) -> None:
        """Say that stream time has reached `now_us`."""
        self._now_us = max(self._now_us, now_us)

    def restart_clock(self) -> bool:
        """Start its own clock anew at zero, now."""
        self._epoch_us = self._now_us
        return True

    def take(self, limit: int) -> Taken | None:
        """Return what waits first, at most `limit` events of it, as delivered; None when nothing waits."""
        taken = self.carry(limit)
        if taken is not None:
            self.arrived(len(taken.events), len(taken.edges))
        return taken

    def carry(self, limit: int) -> Taken | None:
        """Return what waits first, at most `limit` events of it; it counts as queued until it arrived or failed."""
        if not self._waiting or (len(self._waiting[0].events) and limit < 1):
            return None
        first = self._waiting.popleft()
        if len(first.events) > limit:
            self._waiting.appendleft(Taken(first.events[limit:], first.edges, first.epoch_us))
            first = Taken(first.events[:limit], empty_edges(), first.epoch_us)
        return first

    @property
    def waiting(self) -> bool:
        """Whether there is something to take or to carry."""
        return bool(self._waiting)

    def arrived(self, events: int, edges: int = 0) -> None:
        """Say that so many of those that are carried were delivered."""
        self._queued -= events
        self._delivered += events
        self._edges_queued -= edges
        self._edges_delivered += edges

    def failed(self, events: int, edges: int = 0) -> None:
        """Say that so many of those that are carried were lost on the link."""
        self.arrived(events)
        self._lost += events
        self._edges_queued -= edges
        self._edges_lost += edges

    def run(self, running: bool) -> None:
        """Say whether somebody is there; what waits when the last one goes is flushed."""
        self._running = running
        if not running:
            self._flushed += self._empty()

    def lost(self, count: int) -> None:
        """Say that `count` events more of those that were taken did not arrive."""
        self._lost += count

    def drop_waiting(self) -> None:
        """Drop all that waits: nobody will take it."""
        self._dropped += self._empty()

    def _empty(self) -> int:
        """Forget what waits; return how many events that were. What is carried stays."""
        events = sum(len(one.events) for one in self._waiting)
        edges = sum(len(one.edges) for one in self._waiting)
        self._waiting.clear()
        self._queued -= events
        self._edges_queued -= edges
        self._edges_dropped += edges
        return events

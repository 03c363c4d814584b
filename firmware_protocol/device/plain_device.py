"""An event camera without electronics: its input waits, unchanged, for a receiver.

    offer, offer_edges, offer_readings --> one queue for each clock --> take, carry: in the order of time

A run offers the edges and readings of a stretch of time before its events, and a stretch may be long. They leave
together with the events of their time, so that no receiver sees time go back.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Mapping

import numpy as np

from firmware_protocol.device.event_device import EventDevice
from firmware_protocol.device.fates import Counts, Fate, Fates
from firmware_protocol.device.items import Items, Reading, ReadingKind, Readings
from firmware_protocol.events import EVENT, Edges, Events, copy_events, empty_edges, empty_events

__all__ = ["PlainDevice", "own_time"]

_CAPACITY = 1 << 21  # events; edges likewise
_MOST_READINGS = 1 << 14  # of each kind: 30 frames of a DAVIS346, 16 s of an inertial unit
_FOREVER_US = 1 << 62
_NO_SETTINGS: Mapping[ReadingKind, tuple[int, ...]] = {}


def own_time(records: Events | Edges, epoch_us: int) -> Events | Edges:
    """Return (n,) EVENT or EDGE in the time of a device's own clock, which was zero at `epoch_us`."""
    if not epoch_us or not len(records):
        return records
    own = copy_events(records) if records.dtype == EVENT else records.copy()
    own["t"] -= np.uint64(epoch_us % (1 << 64))
    return own


class _Waiting:
    """Events, edges and readings of one clock, which was zero at `epoch_us`; those up to `taken_us` have left."""

    def __init__(self, epoch_us: int, taken_us: int) -> None:
        self.epoch_us = epoch_us
        self.events: deque[Events] = deque()
        self.edges = empty_edges()
        self.readings: list[Reading] = []
        self.taken_us = taken_us

    def __bool__(self) -> bool:
        return bool(self.events or len(self.edges) or self.readings)

    def add_edges(self, edges: Edges) -> None:
        """Add edges; one that is earlier than content already taken gets the earliest possible time."""
        edges = np.concatenate([self.edges, edges])
        edges["t"] = np.maximum(edges["t"], np.uint64(self.taken_us))
        self.edges = edges[np.argsort(edges["t"], kind="stable")]

    def add_readings(self, readings: list[Reading]) -> None:
        """Add readings of one kind, in the order of time."""
        self.readings = sorted([*self.readings, *readings], key=_time_of) if readings else self.readings

    def take(self, limit: int, now_us: int) -> Items | None:
        """Return the first content, at most `limit` events; None if nothing waits that is certain to be first."""
        events = self._take_events(limit)
        if self.events:
            until_us = int(events["t"][-1]) if len(events) else int(self.events[0]["t"][0]) - 1
        else:
            until_us = max(now_us, int(events["t"][-1]) if len(events) else 0)
        edges, readings = self._take_edges(until_us), self._take_readings(until_us)
        if not (len(events) or len(edges) or readings):
            return None
        times = [events["t"][-1:], edges["t"][-1:], *(one.record["t"][-1:] for one in readings[-1:])]
        self.taken_us = max(self.taken_us, *(int(t[0]) for t in times if len(t)))
        return Items(events, edges, self.epoch_us, readings)

    def _take_events(self, limit: int) -> Events:
        if not self.events or limit < 1:
            return empty_events()
        first = self.events.popleft()
        if len(first) > limit:
            self.events.appendleft(first[limit:])
        return first[:limit]

    def _take_edges(self, until_us: int) -> Edges:
        n = int(np.searchsorted(self.edges["t"], np.uint64(max(0, until_us)), "right"))
        taken, self.edges = self.edges[:n], self.edges[n:]
        return taken

    def _take_readings(self, until_us: int) -> tuple[Reading, ...]:
        n = bisect_right(self.readings, until_us, key=_time_of)
        taken, self.readings = tuple(self.readings[:n]), self.readings[n:]
        return taken


def _time_of(reading: Reading) -> int:
    return int(reading.record["t"][0])


class PlainDevice(EventDevice):
    """Holds events, edges and readings until `take`; those that find it full are dropped and counted.

    A link that learns their fate later uses `carry`, and then `arrived` or `failed`.

    Parameters
    ----------
    capacity
        Most events that it holds; edges likewise.
    readings
        Settings of each kind of readings that it takes, as `EventDevice.reading_settings`; others are refused.

    Attributes
    ----------
    takes_edges
        True if its link carries edges; if not, they are ignored.
    """

    def __init__(
        self, capacity: int = _CAPACITY, readings: Mapping[ReadingKind, tuple[int, ...]] = _NO_SETTINGS
    ) -> None:
        self._capacity = capacity
        self._settings = dict(readings)
        self.takes_edges = True
        self._running = True
        self._waiting: deque[_Waiting] = deque([_Waiting(0, 0)])
        self._now_us = 0
        self._fates = Fates(readings={str(kind): Counts() for kind in readings})

    @property
    def now_us(self) -> int:
        """Stream time that it has reached."""
        return self._now_us

    @property
    def streaming(self) -> bool:
        """True unless its link has reported that no receiver is present."""
        return self._running

    @property
    def room_events(self) -> int:
        """Events that fit now."""
        return self._capacity - self._fates.queued

    @property
    def epoch_us(self) -> int:
        """Time at which its own clock was last zero."""
        return self._waiting[-1].epoch_us

    @property
    def counters(self) -> Fates:
        """Fates of all items so far."""
        return self._fates.waiting()

    @property
    def settings_version(self) -> int:
        """A constant: its settings never change."""
        return 0

    @property
    def delivered(self) -> int:
        """See `EventDevice.delivered`."""
        return self._fates.delivered

    @property
    def waiting_items(self) -> int:
        """See `EventDevice.waiting_items`."""
        return self._fates.all_queued

    def offer(self, events: Events) -> None:
        """Queue events (n,) EVENT, as many as fit; raises ValueError if they go back in time."""
        if len(events) and (int(events["t"][0]) < self._now_us or bool((events["t"][1:] < events["t"][:-1]).any())):
            raise ValueError("events go back in time")
        self._fates.offered += len(events)
        if not self._running:
            self._fates.not_running += len(events)
            return
        fitting = min(len(events), self.room_events)
        self._fates.dropped_fifo += len(events) - fitting
        self._fates.queued += fitting
        if fitting:
            self._waiting[-1].events.append(copy_events(events[:fitting]))
            self._now_us = int(events["t"][fitting - 1])

    def offer_edges(self, edges: Edges) -> None:
        """Queue edges (n,) EDGE, as many as fit."""
        counts = self._fates.edges
        counts.offered += len(edges)
        if not (self._running and self.takes_edges):
            counts.ignored += len(edges)
            return
        fitting = min(len(edges), self._capacity - counts.queued)
        counts.dropped_fifo += len(edges) - fitting
        counts.queued += fitting
        if fitting:
            self._waiting[-1].add_edges(edges[:fitting])

    def reading_settings(self, kind: ReadingKind) -> tuple[int, ...]:
        """Settings of a kind of readings."""
        return self._settings.get(kind, ())

    def room_readings(self, kind: ReadingKind) -> int:
        """Readings of a kind that fit now."""
        return _MOST_READINGS - (self._fates.of(kind).queued if kind in self._settings else 0)

    def offer_readings(self, kind: ReadingKind, readings: Readings) -> bool:
        """Queue readings of a kind in its settings, as many as fit; False for others."""
        if kind not in self._settings:
            return False
        counts, fitting = self._fates.of(kind), 0
        counts.offered += len(readings)
        if self._running:
            fitting = min(len(readings), self.room_readings(kind))
            counts.dropped_fifo += len(readings) - fitting
        else:
            counts.not_running += len(readings)
        counts.queued += fitting
        taken = readings[:fitting].copy()
        self._waiting[-1].add_readings([Reading(kind, taken[k : k + 1]) for k in range(fitting)])
        return True

    def advance(self, now_us: int) -> None:
        """Set stream time to `now_us`."""
        self._now_us = max(self._now_us, now_us)

    def restart_clock(self) -> bool:
        """Restart its own clock at zero, now."""
        if not self._waiting[-1]:
            self._waiting.pop()
        self._waiting.append(_Waiting(self._now_us, self._now_us))
        return True

    def take(self, limit: int) -> Items | None:
        """Return the first content, at most `limit` events of it, as delivered; None if nothing waits."""
        taken = self.carry(limit)
        if taken is not None:
            self._fates.leave(taken, "delivered")
        return taken

    def carry(self, limit: int) -> Items | None:
        """Return the first content, at most `limit` events of it; it counts as queued until it arrived or failed."""
        while len(self._waiting) > 1 and not self._waiting[0]:
            self._waiting.popleft()
        return self._waiting[0].take(limit, self._now_us if len(self._waiting) == 1 else _FOREVER_US)

    @property
    def waiting(self) -> bool:
        """True if there is content to take or to carry."""
        return any(self._waiting)

    def arrived(self, events: int, edges: int = 0) -> None:
        """Count events and edges returned by `carry` as delivered."""
        self._settle(events, edges, "delivered")

    def failed(self, events: int, edges: int = 0) -> None:
        """Count events and edges returned by `carry` as lost on the link."""
        self._settle(events, edges, "lost_on_link")

    def _settle(self, events: int, edges: int, fate: Fate) -> None:
        self._fates.settle(events, fate)
        self._fates.edges.settle(edges, fate)

    def run(self, running: bool) -> None:
        """Set the presence of a receiver; the content that waits when the last one leaves is flushed."""
        self._running = running
        if not running:
            self._empty("flushed")

    def lost(self, count: int, edges: int = 0) -> None:
        """Count further events and edges that were taken as lost on the link."""
        for counts, number in ((self._fates, count), (self._fates.edges, edges)):
            counts.delivered -= number
            counts.lost_on_link += number

    def lost_readings(self, kind: ReadingKind, count: int) -> None:
        """Count `count` further readings of a kind that were taken as lost on the link."""
        if count:
            counts = self._fates.of(kind)
            counts.delivered -= count
            counts.lost_on_link += count

    def drop_waiting(self) -> None:
        """Drop everything that waits: no receiver will take it."""
        self._empty("dropped_fifo")

    def _empty(self, fate: Fate) -> None:
        """Empty the queues, and count their events under `fate`. Carried content stays."""
        for one in self._waiting:
            self._fates.settle(sum(len(piece) for piece in one.events), fate)
            self._fates.edges.settle(len(one.edges), fate)
            for reading in one.readings:
                self._fates.of(reading.kind).settle(1, "flushed")
        self._waiting = deque([_Waiting(self.epoch_us, self._waiting[-1].taken_us)])

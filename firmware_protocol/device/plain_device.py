"""An event camera without electronics: its input waits for a receiver, unchanged except that a pulse is two edges.

    offer, offer_edges, offer_readings --> ItemQueue: one for each clock --> take, in the order of time

A run offers the edges and readings of a stretch of time before its events, and a stretch may be long. They leave
together with the events of their time, so that no receiver sees time go back.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Mapping

import numpy as np

from firmware_protocol.device.event_device import EventDevice, HasClockInput, TakesReadings
from firmware_protocol.device.fates import Counts, Fates
from firmware_protocol.device.items import Items, Numbers, Reading, ReadingKind, Readings, count_kinds
from firmware_protocol.events import EVENT, Edges, Events, copy_events, empty_edges, empty_events, level_changes

_CAPACITY = 1 << 21  # events; edges likewise
_MOST_READINGS = 1 << 14  # of each kind: 30 frames of a DAVIS346, 16 s of an inertial unit
_FOREVER_US = 1 << 62
_NO_SETTINGS: Mapping[ReadingKind, tuple[int, ...]] = {}


def own_time(records: Events | Edges, epoch_us: int) -> Events | Edges:
    """Return (n,) EVENT or EDGE in the time of a device's own clock, which was zero at `epoch_us`."""
    if not epoch_us or not len(records):
        return records
    shifted = copy_events(records) if records.dtype == EVENT else records.copy()
    shifted["t"] -= np.uint64(epoch_us % (1 << 64))
    return shifted


class _ItemsOfClock:
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

    def take(self, limit: int, now_us: int) -> Items | None:
        """Return the first content, at most `limit` events; None if nothing waits that is certain to be first."""
        events = self._take_events(limit)
        if self.events:
            until_us = int(events["t"][-1]) if len(events) else int(self.events[0]["t"][0]) - 1
        else:
            until_us = max(now_us, int(events["t"][-1]) if len(events) else 0)
        edges = self._take_edges(until_us)
        n = bisect_right(self.readings, until_us, key=_time_of)
        readings, self.readings = tuple(self.readings[:n]), self.readings[n:]
        if not (len(events) or len(edges) or readings):
            return None
        times = [events["t"][-1:], edges["t"][-1:], *(reading.record["t"][-1:] for reading in readings[-1:])]
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


def _time_of(reading: Reading) -> int:
    return int(reading.record["t"][0])


class ItemQueue:
    """Items of a device in the order of time, an `ItemEncoder` that makes no bytes."""

    def __init__(self) -> None:
        self._clocks: deque[_ItemsOfClock] = deque([_ItemsOfClock(0, 0)])
        self.waiting = Numbers()

    @property
    def epoch_us(self) -> int:
        """Time at which the device's clock was last zero."""
        return self._clocks[-1].epoch_us

    def put(self, events: Events, edges: Edges, readings: list[Reading]) -> None:
        """Queue events (n,) EVENT, edges (m,) EDGE and readings of one kind."""
        clock = self._clocks[-1]
        if len(events):
            clock.events.append(events)
        if len(edges):
            clock.add_edges(edges)
        if readings:
            clock.readings = sorted([*clock.readings, *readings], key=_time_of)
        self.waiting = self.waiting.plus(Numbers(len(events), len(edges), count_kinds(readings)))

    def restart_clock(self, now_us: int) -> None:
        """Set the device's clock to zero at `now_us`."""
        if not self._clocks[-1]:
            self._clocks.pop()
        self._clocks.append(_ItemsOfClock(now_us, now_us))

    def take(self, now_us: int, room: int) -> Items | None:
        """Remove the first items, at most `room` events of them; None if nothing waits."""
        while len(self._clocks) > 1 and not self._clocks[0]:
            self._clocks.popleft()
        taken = self._clocks[0].take(room, now_us if len(self._clocks) == 1 else _FOREVER_US)
        if taken is not None:
            self.waiting = self.waiting.less(taken.numbers)
        return taken

    def clear(self) -> None:
        """Drop the items that wait; the clock keeps its epoch."""
        self._clocks = deque([_ItemsOfClock(self.epoch_us, self._clocks[-1].taken_us)])
        self.waiting = Numbers()


class PlainDevice(EventDevice, TakesReadings, HasClockInput):
    """Holds events, edges and readings until `take`; those that find it full are dropped and counted.

    Parameters
    ----------
    capacity : most events that it holds, with those whose fate is open; edges likewise.
    readings : settings of each kind of readings that it takes, as `TakesReadings.reading_settings`; others are refused.
    pulse_us : length of a pulse at its input.

    Attributes
    ----------
    takes_edges : True if its link carries edges; if not, they are ignored.
    is_watched
        True if a receiver notices when data leave: they then leave at their own time, not some milliseconds later.
    """

    settings_version = 0  # its settings never change
    streaming = True

    def __init__(
        self,
        capacity: int = _CAPACITY,
        readings: Mapping[ReadingKind, tuple[int, ...]] = _NO_SETTINGS,
        pulse_us: int = 100,
    ) -> None:
        self._capacity = capacity
        self._pulse_us = pulse_us
        self._settings = dict(readings)
        self.takes_edges = True
        self.is_watched = True
        self._queue = ItemQueue()
        self._fates = Fates(readings={str(kind): Counts() for kind in readings})

    @property
    def at_rest(self) -> bool:
        """True while no receiver notices when data leave."""
        return not (self.streaming and self.is_watched)

    @property
    def room_events(self) -> int:
        """Events that fit now."""
        return self._capacity - self._waiting.events - self._fates.queued

    @property
    def epoch_us(self) -> int:
        """Time at which its own clock was last zero."""
        return self._queue.epoch_us

    @property
    def _waiting(self) -> Numbers:
        return self._queue.waiting

    def offer(self, events: Events) -> None:
        """Queue events (n,) EVENT, as many as fit; raises ValueError if they go back in time."""
        if len(events) and (int(events["t"][0]) < self._now_us or bool((events["t"][1:] < events["t"][:-1]).any())):
            raise ValueError("events go back in time")
        fitting = self._fitting(self._fates, len(events), self.room_events)
        if fitting:
            self._queue.put(copy_events(events[:fitting]), empty_edges(), [])
            self._now_us = int(events["t"][fitting - 1])

    def offer_edges(self, edges: Edges) -> None:
        """Queue edges (n,) EDGE, as many as fit: both changes of a pulse."""
        counts = self._fates.edges
        counts.offered += len(edges)
        if self.streaming and self.takes_edges:
            changes = level_changes(edges, self._pulse_us)
            fitting = changes[: max(0, self._capacity - self._waiting.edges - counts.queued)]
            counts.added += len(changes) - len(edges)
            counts.dropped_fifo += len(changes) - len(fitting)
            self._queue.put(empty_events(), fitting, [])
        else:
            counts.ignored += len(edges)

    def reading_settings(self, kind: ReadingKind) -> tuple[int, ...]:
        """Settings of a kind of readings."""
        return self._settings.get(kind, ())

    def room_readings(self, kind: ReadingKind) -> int:
        """Readings of a kind that fit now."""
        if kind not in self._settings:
            return _MOST_READINGS
        return _MOST_READINGS - self._waiting.readings[kind] - self._fates.of(kind).queued

    def offer_readings(self, kind: ReadingKind, readings: Readings) -> bool:
        """Queue readings of a kind in its settings, as many as fit; False for others."""
        if kind not in self._settings:
            return False
        fitting = self._fitting(self._fates.of(kind), len(readings), self.room_readings(kind))
        taken = readings[:fitting].copy()
        self._queue.put(empty_events(), empty_edges(), [Reading(kind, taken[k : k + 1]) for k in range(fitting)])
        return True

    def _fitting(self, counts: Counts, offered: int, room: int) -> int:
        """Count items that were offered; return the number of those that are queued."""
        counts.offered += offered
        if not self.streaming:
            counts.not_running += offered
            return 0
        fitting = min(offered, room)
        counts.dropped_fifo += offered - fitting
        return fitting

    def restart_clock(self) -> bool:
        """Restart its own clock at zero, now."""
        self._queue.restart_clock(self._now_us)
        return True

    def take(self, limit: int) -> Items | None:
        """Return the first content, at most `limit` events of it; `sent` or `lost` must follow. None if none waits."""
        return self._taken(self._queue.take(self._now_us, limit))

    @property
    def waiting(self) -> bool:
        """True if there is content to take."""
        return self._waiting.total > 0

    def run(self, running: bool) -> None:
        """Set the presence of a receiver; the content that waits when the last one leaves is flushed."""
        self.streaming = running
        if not running:
            self._flush(self._queue)

    def drop_waiting(self) -> None:
        """Drop everything that waits, as if it had found the queue full: no receiver will take it."""
        self._fates.drop(self._waiting, "dropped_fifo")
        self._queue.clear()

    def retract(self, numbers: Numbers) -> None:
        """Count further items that were reported as sent as lost on the link."""
        self._fates.retract(numbers)

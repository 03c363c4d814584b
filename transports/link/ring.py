"""The ring of events from the sensor to one link, and where the run is in stream time.

The writer pushes events first and publishes `now_us` after them; the reader loads `now_us` before the events, so
whatever is older than `now_us` is there.
"""

from __future__ import annotations

from firmware_protocol.events import EVENT, Events
from transports.link.shared_ring import SharedRing

__all__ = ["FREE_RUNNING", "EventRing"]

FREE_RUNNING = -1
"""The origin of a run that is not paced: events may leave as soon as they are there."""

_NOW_US, _ORIGIN_NS, _CLOSED, _SETTLED_US, _CELLS = range(5)


class EventRing:
    """Events on their way from the sensor to one link; pass it to a process started by the spawn method."""

    def __init__(self, capacity: int = 1 << 20) -> None:
        self._ring = SharedRing(EVENT, capacity, _CELLS)

    @property
    def capacity(self) -> int:
        """Events that fit."""
        return self._ring.capacity

    @property
    def waiting(self) -> int:
        """Events written and not yet taken."""
        return self._ring.waiting

    @property
    def room(self) -> int:
        """Events that can be written now."""
        return self._ring.room

    @property
    def now_us(self) -> int:
        """The stream time that the writer has reached, us."""
        return int(self._ring.cells[_NOW_US])

    @property
    def settled_us(self) -> int:
        """The stream time that the camera has reached, us; what its hosts changed before has been sent to the writer.

        Written by the reader.
        """
        return int(self._ring.cells[_SETTLED_US])

    @property
    def origin_ns(self) -> int | None:
        """Monotonic time at which stream time is zero, ns; FREE_RUNNING; None before the run starts."""
        return int(self._ring.cells[_ORIGIN_NS]) or None

    @property
    def closed(self) -> bool:
        """True when the writer will write no more."""
        return bool(self._ring.cells[_CLOSED])

    @property
    def refused(self) -> int:
        """Events that found no room, counted by the writer."""
        return self._ring.refused

    def start(self, origin_ns: int) -> None:
        """Start the run: stream time zero is at monotonic time `origin_ns`, or FREE_RUNNING."""
        self._ring.cells[_ORIGIN_NS] = origin_ns

    def close(self) -> None:
        """Say that nothing more will be written."""
        self._ring.cells[_CLOSED] = 1

    def push(self, events: Events) -> int:
        """Write what fits of `events`, in order, and return how many that were; the rest is counted as refused."""
        return self._ring.push(events)

    def publish(self, now_us: int) -> None:
        """Say that every event before `now_us` has been pushed."""
        self._ring.cells[_NOW_US] = now_us

    def settle(self, until_us: int) -> None:
        """Store the stream time that the camera has reached, after what its hosts changed before has been sent."""
        self._ring.cells[_SETTLED_US] = until_us

    def take(self, until_us: int, limit: int | None = None) -> Events:
        """Take at most `limit` events with t <= `until_us`; returns a copy, shape (n,)."""
        return self._ring.take(until_us, limit)

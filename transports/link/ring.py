"""A ring of events in shared memory: one writer process, one reader process.

    head   int64[8]   written | taken | now_us | origin_ns | closed | refused | - | -
    body   EVENT[capacity]

`written` and `taken` count events since the start and never wrap (int64 lasts 24 000 years at 12 Mev/s); the slot is
the count modulo the capacity. The writer stores events first, then `written`, then `now_us`; the reader loads them in
the opposite order, so whatever is older than `now_us` is there. Both sides do aligned 8-byte loads and stores, which
are atomic and ordered on x86-64 and ordered by the interpreter's own locks elsewhere.
"""

from __future__ import annotations

import bisect
import multiprocessing
from typing import Any

import numpy as np

from firmware_protocol.events import EVENT, Events

__all__ = ["FREE_RUNNING", "EventRing"]

FREE_RUNNING = -1
"""The origin of a run that is not paced: events may leave as soon as they are there."""

_RAW_EVENT = f"V{EVENT.itemsize}"  # numpy copies these as bytes, and structured records field by field, 50 times slower

_WRITTEN, _TAKEN, _NOW_US, _ORIGIN_NS, _CLOSED, _REFUSED = range(6)


class EventRing:
    """Events on their way from the sensor to one link.

    Pass it as an argument to a process started by the spawn method; the memory goes with the last that holds it.
    """

    def __init__(self, capacity: int = 1 << 20) -> None:
        if capacity < 1:
            raise ValueError(f"a ring holds at least one event, got capacity {capacity}")
        context = multiprocessing.get_context("spawn")
        self._memory = (context.RawArray("q", 8), context.RawArray("B", capacity * EVENT.itemsize))
        self._map()

    def _map(self) -> None:
        head, body = self._memory
        self._head = np.frombuffer(head, np.int64)
        self._body = np.frombuffer(body, _RAW_EVENT)

    def __getstate__(self) -> tuple[Any, Any]:
        return self._memory

    def __setstate__(self, memory: tuple[Any, Any]) -> None:
        self._memory = memory
        self._map()

    @property
    def capacity(self) -> int:
        """Events that fit."""
        return len(self._body)

    @property
    def waiting(self) -> int:
        """Events written and not yet taken."""
        return int(self._head[_WRITTEN]) - int(self._head[_TAKEN])

    @property
    def room(self) -> int:
        """Events that can be written now."""
        return self.capacity - self.waiting

    @property
    def now_us(self) -> int:
        """The stream time that the writer has reached, us."""
        return int(self._head[_NOW_US])

    @property
    def origin_ns(self) -> int | None:
        """Monotonic time at which stream time is zero, ns; FREE_RUNNING; None before the run starts."""
        return int(self._head[_ORIGIN_NS]) or None

    @property
    def closed(self) -> bool:
        """True when the writer will write no more."""
        return bool(self._head[_CLOSED])

    @property
    def refused(self) -> int:
        """Events that found no room, counted by the writer."""
        return int(self._head[_REFUSED])

    def start(self, origin_ns: int) -> None:
        """Start the run: stream time zero is at monotonic time `origin_ns`, or FREE_RUNNING."""
        self._head[_ORIGIN_NS] = origin_ns

    def close(self) -> None:
        """Say that nothing more will be written."""
        self._head[_CLOSED] = 1

    def push(self, events: Events) -> int:
        """Write what fits of `events`, in order, and return how many that were; the rest is counted as refused."""
        n = min(len(events), self.room)
        written = int(self._head[_WRITTEN])
        start = written % self.capacity
        first = min(n, self.capacity - start)
        raw = events.view(_RAW_EVENT)
        self._body[start : start + first] = raw[:first]
        self._body[: n - first] = raw[first:n]
        self._head[_WRITTEN] = written + n
        self._head[_REFUSED] += len(events) - n
        return n

    def publish(self, now_us: int) -> None:
        """Say that every event before `now_us` has been pushed."""
        self._head[_NOW_US] = now_us

    def take(self, until_us: int, limit: int | None = None) -> Events:
        """Take at most `limit` events with t <= `until_us`; returns a copy, shape (n,)."""
        taken = int(self._head[_TAKEN])
        there = int(self._head[_WRITTEN]) - taken
        n = self._due(taken, there if limit is None else min(there, max(limit, 0)), until_us)
        start = taken % self.capacity
        first = min(n, self.capacity - start)
        events = np.concatenate((self._body[start : start + first], self._body[: n - first])).view(EVENT)
        self._head[_TAKEN] = taken + n
        return events

    def _due(self, taken: int, there: int, until_us: int) -> int:
        """Return how many of the next `there` events have t <= `until_us`."""
        times = self._body.view(EVENT)["t"]
        return bisect.bisect_right(range(there), until_us, key=lambda i: int(times[(taken + i) % self.capacity]))

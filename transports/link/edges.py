"""Edges on their way to the cameras: from a bus that another process hears, or from a period.

    bus --stamp--> EdgeSink (in the process that hears the bus) --EDGE--> an EdgeRing for each link, and the session's

An edge's time is that of the bus, less the run's origin, plus the input's latency and jitter, counted in nanoseconds
and then cut to whole microseconds, as a counter does. Jitter is keyed by the edge's number.

Edges at times that were known before the run: single ones and trains, merged in time order.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from firmware_protocol.device.clock import Draw, normal
from firmware_protocol.events import EDGE, EdgeKind, Edges, empty_edges
from transports.link.rings import FREE_RUNNING, EventRing, SharedRing

__all__ = ["EdgeRing", "EdgeSink", "EdgeSource", "EdgeTiming", "EdgeTrain", "ListedEdges", "PeriodicEdges"]


class EdgeSource(Protocol):
    """Where a link gets its edges from."""

    def take(self, until_us: int) -> Edges:
        """Return the edges up to `until_us` of stream time that have not been taken, (n,) EDGE in time order."""
        ...

    @property
    def refused(self) -> int:
        """Edges that were lost before they could be taken."""
        ...


@dataclass(frozen=True)
class EdgeTiming:
    """What a trigger looks like at a camera's input.

    Attributes
    ----------
    kind, channel
        What happens, and on which input.
    latency_us
        From the bus to the input.
    jitter_us
        Standard deviation of the latency; an edge is never early, and never comes before the one before it.
    seed
        Of the jitter.
    """

    kind: EdgeKind = EdgeKind.PULSE
    channel: int = 0
    latency_us: float = 0.0
    jitter_us: float = 0.0
    seed: int = 0

    def delay_ns(self, number: int) -> int:
        """Return how long edge `number` takes to the input, ns."""
        jitter_us = float(normal(self.seed, Draw.EDGE_JITTER, number)[0]) * self.jitter_us if self.jitter_us else 0.0
        return max(0, round((self.latency_us + jitter_us) * 1000))

    def edge(self, t_us: int, seq: int) -> Edges:
        """Return one EDGE, shape (1,)."""
        edge = empty_edges(1)
        edge["t"], edge["kind"], edge["channel"], edge["seq"] = t_us, self.kind, self.channel, seq & 0xFFFF
        return edge


class EdgeRing:
    """A few edges in shared memory; pass it as an argument to a process started by the spawn method."""

    def __init__(self, capacity: int = 4096) -> None:
        self._ring = SharedRing(EDGE, capacity)

    @property
    def written(self) -> int:
        """Edges written since the start."""
        return self._ring.written

    @property
    def waiting(self) -> int:
        """Edges written and not yet taken."""
        return self._ring.waiting

    @property
    def refused(self) -> int:
        """Edges that found no room, counted by the writer."""
        return self._ring.refused

    def push(self, edge: Edges) -> None:
        """Write one edge, (1,) EDGE, or count it as refused."""
        self._ring.push(edge)

    def take(self, until_us: int) -> Edges:
        """Return the edges up to `until_us` that have not been taken, (n,) EDGE in time order; a copy."""
        return self._ring.take(until_us)


class EdgeSink:
    """Takes what a bus says and makes edges of it, one in each ring. Lives in the process that hears the bus.

    Parameters
    ----------
    rings
        One for each reader; all are written before the last, so put the session's there.
    run
        Any of the run's event rings: it knows when stream time began.
    lockstep_us
        Above 0, the bus drives time: edge k happens k periods after the start, whenever it is heard.

    Attributes
    ----------
    last_us
        Stream time of the last edge; 0 before the first.
    heard_early
        Triggers before the start, of which no edge was made.
    """

    def __init__(self, rings: Sequence[EdgeRing], run: EventRing, timing: EdgeTiming, lockstep_us: int = 0) -> None:
        self._rings = tuple(rings)
        self._run = run
        self._timing = timing
        self._lockstep_us = lockstep_us
        self._number = 0
        self.last_us = 0
        self.heard_early = 0

    def __call__(self, bus_t_ns: int, seq: int) -> None:
        """Hear one trigger at `bus_t_ns` of CLOCK_MONOTONIC; `seq` is the bus's own number for it."""
        at_ns = self._at_ns(bus_t_ns)
        if at_ns is None:
            self.heard_early += 1
            return
        t_us = max((at_ns + self._timing.delay_ns(self._number)) // 1000, self.last_us)
        self._number += 1
        self.last_us = t_us
        edge = self._timing.edge(t_us, seq)
        for ring in self._rings:
            ring.push(edge)

    def _at_ns(self, bus_t_ns: int) -> int | None:
        """Return the stream time of the trigger, ns; None before the start."""
        origin_ns = self._run.origin_ns
        if origin_ns is None:
            return None
        if self._lockstep_us:
            return self._number * self._lockstep_us * 1000
        if origin_ns == FREE_RUNNING:
            return self._run.now_us * 1000
        return bus_t_ns - origin_ns if bus_t_ns >= origin_ns else None


class PeriodicEdges:
    """An edge each `period_us`, the first one period after the start; no bus, nothing shared."""

    def __init__(self, period_us: int, timing: EdgeTiming) -> None:
        self._period_us = period_us
        self._timing = timing
        self._number = 0
        self._next_us = self._time_us(0)

    @property
    def refused(self) -> int:
        """None: nothing is kept."""
        return 0

    def _time_us(self, after_us: int) -> int:
        at_ns = (self._number + 1) * self._period_us * 1000
        return max((at_ns + self._timing.delay_ns(self._number)) // 1000, after_us)

    def take(self, until_us: int) -> Edges:
        """Return the edges up to `until_us` that have not been taken, (n,) EDGE in time order."""
        edges = [empty_edges()]
        while self._next_us <= until_us:
            edges.append(self._timing.edge(self._next_us, self._number))
            self._number += 1
            self._next_us = self._time_us(self._next_us)
        return np.concatenate(edges)


@dataclass(frozen=True)
class EdgeTrain:
    """Edges of one kind, the first at `at_us` of stream time, then each `every_us`; `count` None: without end."""

    kind: EdgeKind
    at_us: int
    every_us: int = 0
    count: int | None = 1


class ListedEdges:
    """A source of the edges of several trains; those of one time in the order of the trains."""

    def __init__(self, trains: Sequence[EdgeTrain], channel: int = 0) -> None:
        self._trains = tuple(trains)
        self._channel = channel
        self._number = 0
        self._next = [(train.at_us, k, 0) for k, train in enumerate(self._trains)]  # time, train, number in it
        heapq.heapify(self._next)

    @property
    def refused(self) -> int:
        """None: nothing is kept."""
        return 0

    def take(self, until_us: int) -> Edges:
        """Return the edges up to `until_us` that have not been taken, (n,) EDGE in time order."""
        edges = []
        while self._next and self._next[0][0] <= until_us:
            at_us, k, number = heapq.heappop(self._next)
            train = self._trains[k]
            edges.append((at_us, train.kind, self._channel, self._number & 0xFFFF))
            self._number += 1
            if train.count is None or number + 1 < train.count:
                heapq.heappush(self._next, (at_us + train.every_us, k, number + 1))
        return np.array(edges, EDGE)

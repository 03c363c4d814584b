"""Edges for the cameras' external inputs: from a bus that another process receives, from a period, or from a list.

    bus --stamp--> EdgeSink (in the process that receives the bus) --EDGE--> an EdgeRing for each link and the session

An edge's time is that of the bus, less the run's origin, plus the input's latency and jitter, counted in nanoseconds
and then truncated to whole microseconds, as a counter does. Jitter depends on the edge's number.

`ListedEdges` gives edges at times that are known before the run: single ones and trains, merged in time order.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from firmware_protocol.device.clock import Draw, normal
from firmware_protocol.events import EDGE, EdgeKind, Edges, empty_edges, make_edges
from transports.link.rings import FOREVER_US, FREE_RUNNING, EventRing, SharedRing


class EdgeSource(Protocol):
    """Source of a link's edges."""

    def take(self, until_us: int) -> Edges:
        """Return the edges up to `until_us` of stream time that have not been taken, (n,) EDGE in time order."""

    @property
    def refused(self) -> int:
        """Number of edges that were lost before they could be taken."""

    @property
    def next_us(self) -> int | None:
        """Stream time of the next edge; None if it is not known, because edges come from another process."""


@dataclass(frozen=True)
class EdgeTiming:
    """Form and delay of a trigger at a camera's input.

    Attributes
    ----------
    kind, channel : kind of edge, and number of the input.
    latency_us : delay from the bus to the input.
    jitter_us : standard deviation of the latency; an edge is never early, and never comes before the preceding one.
    seed : seed of the jitter.
    """

    kind: EdgeKind = EdgeKind.PULSE
    channel: int = 0
    latency_us: float = 0.0
    jitter_us: float = 0.0
    seed: int = 0

    def delay_ns(self, number: int) -> int:
        """Return the delay of edge `number` to the input, ns."""
        jitter_us = float(normal(self.seed, Draw.EDGE_JITTER, number)[0]) * self.jitter_us if self.jitter_us else 0.0
        return max(0, round((self.latency_us + jitter_us) * 1000))

    def edge(self, t_us: int, seq: int) -> Edges:
        """Return one EDGE, shape (1,)."""
        return make_edges(t_us, self.kind, self.channel, seq & 0xFFFF)


class EdgeRing(SharedRing):
    """Short queue of edges in shared memory, (n,) EDGE."""

    def __init__(self, capacity: int = 4096) -> None:
        super().__init__(EDGE, capacity)


class EdgeSink:
    """Converter from SYNCs of a bus to edges, one in each ring. It runs in the process that receives the bus.

    Parameters
    ----------
    rings : one ring for each reader; all others are written before the last, so put the session's ring there.
    run : any event ring of the run; it contains the start of stream time.
    lockstep_us : above 0, the bus drives time: edge k is k periods after the start, independent of its arrival.

    Attributes
    ----------
    last_us : stream time of the last edge; 0 before the first.
    early_triggers : number of triggers before the start, for which no edge was made.
    """

    def __init__(self, rings: Sequence[EdgeRing], run: EventRing, timing: EdgeTiming, lockstep_us: int = 0) -> None:
        self._rings = tuple(rings)
        self._run = run
        self._timing = timing
        self._lockstep_us = lockstep_us
        self._number = 0
        self.last_us = 0
        self.early_triggers = 0

    def __call__(self, bus_t_ns: int, seq: int) -> None:
        """Make the edges of one trigger at `bus_t_ns` of CLOCK_MONOTONIC; `seq` is the bus's own number for it."""
        at_ns = self._at_ns(bus_t_ns)
        if at_ns is None:
            self.early_triggers += 1
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
    """Edges at a constant period, the first one period after the start; without a bus and shared memory."""

    refused = 0  # it has no queue

    def __init__(self, period_us: int, timing: EdgeTiming) -> None:
        self._period_us = period_us
        self._timing = timing
        self._number = 0
        self.next_us = self._time_us(0)

    def _time_us(self, after_us: int) -> int:
        at_ns = (self._number + 1) * self._period_us * 1000
        return max((at_ns + self._timing.delay_ns(self._number)) // 1000, after_us)

    def take(self, until_us: int) -> Edges:
        """Return the edges up to `until_us` that have not been taken, (n,) EDGE in time order."""
        if self.next_us > until_us:
            return empty_edges()
        edges = [empty_edges()]
        while self.next_us <= until_us:
            edges.append(self._timing.edge(self.next_us, self._number))
            self._number += 1
            self.next_us = self._time_us(self.next_us)
        return np.concatenate(edges)


@dataclass(frozen=True)
class EdgeTrain:
    """Edges of one kind: the first at `at_us` of stream time, then one each `every_us`; `count` None: unlimited."""

    kind: EdgeKind
    at_us: int
    every_us: int = 0
    count: int | None = 1


class ListedEdges:
    """Source of the edges of several trains; edges of equal time are in the order of the trains."""

    refused = 0  # it has no queue

    def __init__(self, trains: Sequence[EdgeTrain], channel: int = 0) -> None:
        self._trains = tuple(trains)
        self._channel = channel
        self._number = 0
        self._next = [(train.at_us, k, 0) for k, train in enumerate(self._trains)]  # time, train, number in the train
        heapq.heapify(self._next)

    @property
    def next_us(self) -> int:
        """Stream time of the next edge."""
        return self._next[0][0] if self._next else FOREVER_US

    def take(self, until_us: int) -> Edges:
        """Return the edges up to `until_us` that have not been taken, (n,) EDGE in time order."""
        if self.next_us > until_us:
            return empty_edges()
        edges = []
        while self._next and self._next[0][0] <= until_us:
            at_us, k, number = heapq.heappop(self._next)
            train = self._trains[k]
            edges.append((at_us, train.kind, self._channel, self._number & 0xFFFF))
            self._number += 1
            if train.count is None or number + 1 < train.count:
                heapq.heappush(self._next, (at_us + train.every_us, k, number + 1))
        return np.array(edges, EDGE)

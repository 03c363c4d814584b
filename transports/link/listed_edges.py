"""Edges at times that were known before the run: single ones and trains, merged in time order."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_protocol.edges import EDGE, EdgeKind, Edges

__all__ = ["EdgeTrain", "ListedEdges"]


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

"""Bounded store of received events, edges and reports, until the caller takes them."""

from __future__ import annotations

from collections import deque

import numpy as np

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.event_copies import join_events
from firmware_protocol.events import Events

__all__ = ["Inbox"]

_MOST_EVENTS = 1 << 22
_MOST_EDGES = 1 << 16
_MOST_REPORTS = 1024


class Inbox:
    """Keeps what was received, and drops the oldest of each kind beyond a bound.

    Parameters
    ----------
    most_events, most_edges
        Most events and edges that wait to be taken.

    Attributes
    ----------
    events_not_taken, edges_not_taken, reports_not_taken
        Received, and dropped because nobody took them in time.
    """

    def __init__(self, most_events: int = _MOST_EVENTS, most_edges: int = _MOST_EDGES) -> None:
        self._most = most_events, most_edges
        self._events: deque[Events] = deque()
        self._edges: deque[Edges] = deque()
        self._reports: deque[str] = deque()
        self._waiting_events = self._waiting_edges = 0
        self.events_not_taken = self.edges_not_taken = self.reports_not_taken = 0

    def put_events(self, events: Events) -> None:
        """Keep events (n,), without a copy."""
        if not len(events):
            return
        self._events.append(events)
        dropped = _drop_oldest(self._events, self._waiting_events + len(events) - self._most[0])
        self._waiting_events += len(events) - dropped
        self.events_not_taken += dropped

    def put_edges(self, edges: Edges) -> None:
        """Keep edges (n,), without a copy."""
        if not len(edges):
            return
        self._edges.append(edges)
        dropped = _drop_oldest(self._edges, self._waiting_edges + len(edges) - self._most[1])
        self._waiting_edges += len(edges) - dropped
        self.edges_not_taken += dropped

    def put_report(self, report: str) -> None:
        """Keep a line of text for people."""
        if len(self._reports) == _MOST_REPORTS:
            self._reports.popleft()
            self.reports_not_taken += 1
        self._reports.append(report)

    def take_events(self) -> Events:
        """Return what was received since the last call, (n,) EVENT in the camera's time, in the order of arrival."""
        taken = join_events(list(self._events))
        self._events.clear()
        self._waiting_events = 0
        return taken

    def take_edges(self) -> Edges:
        """Return what was received since the last call, (n,) EDGE in the camera's time, in the order of arrival."""
        taken = np.concatenate(list(self._edges)) if self._edges else empty_edges()
        self._edges.clear()
        self._waiting_edges = 0
        return taken

    def take_reports(self) -> tuple[str, ...]:
        """Return the reports received since the last call."""
        taken = tuple(self._reports)
        self._reports.clear()
        return taken

    @property
    def counts(self) -> dict[str, int]:
        """What was not taken in time, by name; only what is not zero."""
        counts = {
            "events not taken": self.events_not_taken,
            "edges not taken": self.edges_not_taken,
            "reports not taken": self.reports_not_taken,
        }
        return {name: count for name, count in counts.items() if count}


def _drop_oldest(parts: deque[Events], excess: int) -> int:
    """Drop `excess` records from the front of `parts`; return how many that were."""
    left = excess = max(0, excess)
    while left:
        gone = min(left, len(parts[0]))
        parts[0] = parts[0][gone:]
        left -= gone
        if not len(parts[0]):
            parts.popleft()
    return excess

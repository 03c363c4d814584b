"""The arrivals of one listener: how many, their digest, how late the later ones were, and their record."""

from __future__ import annotations

import numpy as np

from firmware_protocol.edges import Edges
from firmware_protocol.events import Events
from transports.link.digest import digest_of
from transports.link.latency import LatencySummary
from transports.link.pacing import Clock
from transports.recording.part import Part
from transports.recording.record import Recorder

__all__ = ["Arrivals"]

_MOST_DELAYS = 1_000_000


class Arrivals:
    """Counts and records what a listener has received.

    Attributes
    ----------
    events, edges
        Received so far.
    last_t_us
        The camera's time of the newest event; None before the first.
    digest
        Of all events, see `digest_of`.
    """

    def __init__(self, clock: Clock, recorder: Recorder | None = None) -> None:
        self._clock = clock
        self._recorder = recorder
        self._start_ns = clock.now_ns()
        self._delays_us: list[float] = []
        self.events = self.edges = 0
        self.last_t_us: int | None = None
        self.digest = 0

    @property
    def seconds(self) -> float:
        """Wall time since the start."""
        return (self._clock.now_ns() - self._start_ns) * 1e-9

    def add(self, events: Events, edges: Edges, t_ns: int) -> None:
        """Take note of events (n,) EVENT and edges (m,) EDGE that came together at `t_ns`."""
        if self._recorder is not None and (len(events) or len(edges)):
            self._recorder.append(Part(events, edges))
        self.edges += len(edges)
        if not len(events):
            return
        self.events += len(events)
        self.last_t_us = int(events["t"][-1])
        self.digest = digest_of(events, self.digest)
        if len(self._delays_us) < _MOST_DELAYS:
            self._delays_us.append(t_ns / 1000 - float(events["t"][-1]))

    def jitter(self) -> LatencySummary:
        """Return how much later than the quickest each came, us: the camera's own clock is not known."""
        if not self._delays_us:
            return LatencySummary()
        above = np.array(self._delays_us) - min(self._delays_us)
        return LatencySummary(float(np.quantile(above, 0.5)), float(np.quantile(above, 0.99)), float(above.max()))

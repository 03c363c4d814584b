"""What a computer has received of an instrument, on whatever carries the packets.

The arrivals of one listener: how many, their digest, how late the later ones were, and their record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from firmware_protocol.events import Edges, Events
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.receiver.instrument import SerialReceiver
from transports.link.deliveries import LatencySummary, digest_of
from transports.link.pacing import Clock
from transports.recording.part import Part
from transports.recording.record import Recorder

__all__ = ["Arrivals", "Receiving", "Reception"]


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


_MOST_TOLD = 1024


@dataclass(frozen=True)
class Reception:
    """What has come so far.

    Attributes
    ----------
    seconds
        Wall time since the reception began.
    last_t_us
        The camera's time of the newest event; None before the first.
    digest
        Of all events, see `digest_of`.
    faults
        Things that a sound link never shows: damaged frames, gaps in the counts, blocks that are wrong.
    counts
        Everything by name; `events_dropped` is what the camera says that it dropped.
    jitter_us
        How much later than the quickest block each came: the camera's clock is not known.
    housekeeping
        The newest report.
    answers
        Number of answers to telecommands.
    told
        The newest of them in words, at most 1024.
    gone
        True when the other side went away.
    """

    events: int = 0
    edges: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    faults: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)
    jitter_us: LatencySummary = field(default_factory=LatencySummary)
    housekeeping: Housekeeping | None = None
    answers: int = 0
    told: tuple[str, ...] = ()
    gone: bool = False


class Receiving:
    """What comes in during one visit to an instrument; `receiver` decodes it and wraps telecommands."""

    def __init__(self, profile: str, clock: Clock, recorder: Recorder | None) -> None:
        self.receiver = SerialReceiver(profile)
        self._clock = clock
        self._arrivals = Arrivals(clock, recorder)
        self._told: tuple[str, ...] = ()
        self._answers = 0

    @property
    def now(self) -> Reception:
        """What has come so far, without what is known at the end alone."""
        a = self._arrivals
        counted = Reception(a.events, a.edges, a.seconds, a.last_t_us, a.digest)
        return replace(counted, answers=self._answers, told=self._told)

    def take(self, data: bytes) -> None:
        """Hear bytes that have come just now."""
        now_ns = self._clock.now_ns()
        self.receiver.push(data)
        self._arrivals.add(self.receiver.take_events(), self.receiver.take_edges(), now_ns)
        told = self.receiver.take_reports()
        self._answers += len(told)
        self._told = (self._told + told)[-_MOST_TOLD:]

    def finish(self, *, gone: bool) -> Reception:
        """Return everything."""
        receiver = self.receiver
        return replace(
            self.now,
            faults=receiver.faults,
            counts=receiver.counts,
            jitter_us=self._arrivals.jitter(),
            housekeeping=receiver.housekeeping,
            gone=gone,
        )

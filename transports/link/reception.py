"""Reception of a computer from an instrument, over any transport of the packets.

`Arrivals` holds the counts of one listener: number, digest, delay and record of the received events.
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
    """Counts and record of the events that a listener has received.

    Attributes
    ----------
    events, edges
        Number received so far.
    last_t_us
        The camera's time of the newest event; None before the first.
    digest
        Digest of all events, see `digest_of`.
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
        """Add events (n,) EVENT and edges (m,) EDGE that arrived together at `t_ns`."""
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
        """Return the delay of each arrival relative to the fastest one, us: the camera's own clock is not known."""
        if not self._delays_us:
            return LatencySummary()
        above = np.array(self._delays_us) - min(self._delays_us)
        return LatencySummary(float(np.quantile(above, 0.5)), float(np.quantile(above, 0.99)), float(above.max()))


_MOST_ANSWER_TEXTS = 1024


@dataclass(frozen=True)
class Reception:
    """Events, counts and answers received so far.

    Attributes
    ----------
    seconds
        Wall time since the reception began.
    last_t_us
        The camera's time of the newest event; None before the first.
    digest
        Digest of all events, see `digest_of`.
    faults
        Number of faults that never occur on an intact link: damaged frames, gaps in the counts, wrong blocks.
    counts
        All counts by name; `events_dropped` is the camera's own number of dropped events.
    jitter_us
        Delay of each block relative to the fastest one: the camera's clock is not known.
    housekeeping
        The newest report.
    answers
        Number of answers to telecommands.
    answer_texts
        Texts of the newest answers, at most 1024.
    gone
        True when the other side disconnected.
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
    answer_texts: tuple[str, ...] = ()
    gone: bool = False


class Receiving:
    """State of one reception from an instrument; `receiver` decodes the data and wraps telecommands."""

    def __init__(self, profile: str, clock: Clock, recorder: Recorder | None) -> None:
        self.receiver = SerialReceiver(profile)
        self._clock = clock
        self._arrivals = Arrivals(clock, recorder)
        self._answer_texts: tuple[str, ...] = ()
        self._answers = 0

    @property
    def now(self) -> Reception:
        """Reception so far, without the values that are known only at the end."""
        a = self._arrivals
        counted = Reception(a.events, a.edges, a.seconds, a.last_t_us, a.digest)
        return replace(counted, answers=self._answers, answer_texts=self._answer_texts)

    def take(self, data: bytes) -> None:
        """Process bytes that have just arrived."""
        now_ns = self._clock.now_ns()
        self.receiver.push(data)
        self._arrivals.add(self.receiver.take_events(), self.receiver.take_edges(), now_ns)
        texts = self.receiver.take_reports()
        self._answers += len(texts)
        self._answer_texts = (self._answer_texts + texts)[-_MOST_ANSWER_TEXTS:]

    def finish(self, *, gone: bool) -> Reception:
        """Return the complete reception."""
        receiver = self.receiver
        return replace(
            self.now,
            faults=receiver.faults,
            counts=receiver.counts,
            jitter_us=self._arrivals.jitter(),
            housekeeping=receiver.housekeeping,
            gone=gone,
        )

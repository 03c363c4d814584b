"""Reception of the data of a link, for a listener on its other side: `receive` is the loop, `Reception` the result.

`Arrivals` holds the counts of one listener: number, digest, delay and record of the received events. `Receiving` is a
computer that receives from an instrument, over any transport of the packets.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from firmware_protocol.events import Edges, Events
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.receiver.instrument import SerialReceiver
from firmware_protocol.recordings.part import Part
from transports.link.deliveries import LatencySummary, digest_of
from transports.link.pacing import Clock
from transports.recording.record import Recorder


@dataclass(frozen=True)
class Reception:
    """Events and edges received so far.

    Attributes
    ----------
    seconds : wall time since the reception began.
    last_t_us : the camera's time of the newest event; None before the first.
    digest : digest of all events, see `digest_of`.
    gone : True when the other side disconnected, or the transport was lost.
    faults : number of faults that never occur on an intact link: damaged words or frames, gaps in counts, lost blocks.
    """

    events: int = 0
    edges: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    gone: bool = False
    faults: int = 0

    @property
    def is_early(self) -> bool:
        """True when the other side was lost before the end of its run."""
        return self.gone


_R = TypeVar("_R", bound=Reception)


def receive(
    now: Callable[[], _R],
    goes_on: Callable[[_R], bool],
    turn: Callable[[], None],
    *,
    stop: Callable[[], None] = lambda: None,
    lost: type[Exception] | tuple[type[Exception], ...] = (),
) -> bool:
    """Call `turn` while `goes_on`, called with the reception before each turn, returns True; then `stop`.

    Returns whether the other side was lost, which `turn` and `stop` report by raising `lost`.
    """
    try:
        while goes_on(now()):
            turn()
        stop()
    except lost:
        return True
    return False


_MOST_DELAYS = 1_000_000


class Arrivals:
    """Counts and record of the events that a listener has received.

    Attributes
    ----------
    events, edges : number received so far.
    last_t_us : the camera's time of the newest event; None before the first.
    digest : digest of all events, see `digest_of`.
    """

    def __init__(self, clock: Clock, recorder: Recorder | None = None) -> None:
        self._clock = clock
        self._recorder = recorder
        self._start_ns = clock.now_ns()
        self._delays_us = array("d")
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

    def reception(self, kind: type[_R], **values: Any) -> _R:
        """Return a reception of a kind with the counts so far, and further `values` of it."""
        return kind(self.events, self.edges, self.seconds, self.last_t_us, self.digest, **values)

    def jitter(self) -> LatencySummary:
        """Return the delay of each arrival relative to the fastest one, us: the camera's own clock is not known."""
        if not self._delays_us:
            return LatencySummary()
        above = np.array(self._delays_us) - min(self._delays_us)
        return LatencySummary(float(np.quantile(above, 0.5)), float(np.quantile(above, 0.99)), float(above.max()))


_MOST_ANSWER_TEXTS = 1024


@dataclass(frozen=True)
class CountedReception(Reception):
    """Events and counts received so far over a link of telemetry.

    Attributes
    ----------
    counts : all other counts by name.
    jitter_us : delay of each block or frame relative to the fastest one: the camera's clock is not known.
    """

    counts: Mapping[str, int] = field(default_factory=dict)
    jitter_us: LatencySummary = field(default_factory=LatencySummary)


@dataclass(frozen=True)
class InstrumentReception(CountedReception):
    """Events, counts and answers received so far from an instrument.

    `events_dropped` in `counts` is the camera's own number of dropped events.

    Attributes
    ----------
    housekeeping : the newest report.
    answers : number of answers to telecommands.
    answer_texts : texts of the newest answers, at most 1024.
    """

    housekeeping: Housekeeping | None = None
    answers: int = 0
    answer_texts: tuple[str, ...] = ()


class Receiving:
    """State of one reception from an instrument; `receiver` decodes the data and wraps telecommands."""

    def __init__(self, profile: str, clock: Clock, recorder: Recorder | None) -> None:
        self.receiver = SerialReceiver(profile)
        self._clock = clock
        self._arrivals = Arrivals(clock, recorder)
        self._answer_texts: tuple[str, ...] = ()
        self._answers = 0

    @property
    def now(self) -> InstrumentReception:
        """Reception so far, without the values that are known only at the end."""
        return self._arrivals.reception(InstrumentReception, answers=self._answers, answer_texts=self._answer_texts)

    def take(self, data: bytes) -> None:
        """Process bytes that have just arrived."""
        now_ns = self._clock.now_ns()
        self.receiver.push(data)
        self._arrivals.add(self.receiver.take_events(), self.receiver.take_edges(), now_ns)
        texts = self.receiver.take_reports()
        self._answers += len(texts)
        self._answer_texts = (self._answer_texts + texts)[-_MOST_ANSWER_TEXTS:]

    def finish(self, *, gone: bool) -> InstrumentReception:
        """Return the complete reception."""
        receiver = self.receiver
        return self._arrivals.reception(
            InstrumentReception,
            gone=gone,
            faults=receiver.faults,
            counts=receiver.counts,
            jitter_us=self._arrivals.jitter(),
            housekeeping=receiver.housekeeping,
            answers=self._answers,
            answer_texts=self._answer_texts,
        )

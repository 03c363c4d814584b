"""What a computer has received of an instrument, on whatever carries the packets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.receiver.serial import SerialReceiver
from transports.link.arrivals import Arrivals
from transports.link.latency import LatencySummary
from transports.link.pacing import Clock
from transports.recording.record import Recorder

__all__ = ["Receiving", "Reception"]

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

"""The [trigger] table of a rig: what is connected to the camera's external input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from firmware_protocol.edges import EdgeKind
from transports.link.edges import EdgeTiming
from transports.link.listed_edges import EdgeTrain

__all__ = ["Trigger", "TriggerEdges"]

_LATEST_MS = 1e10

Kind = Literal["pulse", "rising", "falling"]


@dataclass(frozen=True)
class TriggerEdges:
    """Edges at given times of the run.

    Attributes
    ----------
    at_ms
        Stream time of the first.
    kind
        As of the trigger.
    every_ms
        Above 0, it is repeated with this period.
    count
        How often it happens in all; 0: without end. Without a period: once.
    """

    at_ms: float
    kind: Kind = "pulse"
    every_ms: float = 0.0
    count: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.at_ms <= _LATEST_MS:
            raise ValueError(f"at_ms must be 0 to {_LATEST_MS:g}, got {self.at_ms}")
        if self.every_ms != 0 and not 0.01 <= self.every_ms <= 1e7:
            raise ValueError(f"every_ms must be 0 (once) or 0.01 to 1e7, got {self.every_ms}")
        if self.count < 0 or (self.count > 1 and not self.every_ms):
            raise ValueError(f"count must be 0 or more, and every_ms be given for more than one, got {self.count}")

    def train(self) -> EdgeTrain:
        """Return the edges as a link makes them."""
        count = (self.count or None) if self.every_ms else 1
        return EdgeTrain(EdgeKind[self.kind.upper()], round(self.at_ms * 1000), round(self.every_ms * 1000), count)


@dataclass(frozen=True)
class Trigger:
    """What is connected to the camera's external input.

    Attributes
    ----------
    source
        Name of the CAN link whose SYNC triggers.
    period_ms
        Instead: an edge each period of stream time, the first after one period.
    edges
        Instead: edges at given times, without latency and jitter.
    kind
        What happens at the input: "pulse" (it rises, and falls again after `pulse_us`), "rising" or "falling".
    channel
        Which input; a DAVIS346 has one, 0.
    latency_us
        From the bus to the input.
    jitter_us
        Standard deviation of the latency, normal and never below zero in all.
    pulse_us
        Length of a pulse.
    holdback_us
        With a source: how long after its time an event goes to the camera, so that an edge which is heard late still
        comes in order. Later ones are stamped at the earliest time possible, and counted.
    send_period_ms
        Above 0, the camera itself sends a mark on the bus each time its own clock has gone this far.
    """

    source: str = ""
    period_ms: float = 0.0
    edges: tuple[TriggerEdges, ...] = ()
    kind: Kind = "pulse"
    channel: int = 0
    latency_us: float = 0.0
    jitter_us: float = 0.0
    pulse_us: int = 100
    holdback_us: int = 2000
    send_period_ms: float = 0.0

    def __post_init__(self) -> None:
        if self.source and self.period_ms:
            raise ValueError("period_ms makes edges without a bus; leave it out, or leave out source")
        if self.edges and (self.source or self.period_ms):
            raise ValueError("edges come at given times; leave them out, or leave out source and period_ms")
        if not (self.source or self.period_ms or self.edges or self.send_period_ms):
            raise ValueError("a trigger needs source (the name of a CAN link), period_ms, edges or send_period_ms")
        for name in ("period_ms", "send_period_ms"):
            value = getattr(self, name)
            if value != 0 and not 0.01 <= value <= 1e7:
                raise ValueError(f"{name} must be 0 (none) or 0.01 to 1e7, got {value}")
        if not 0 <= self.channel <= 255:
            raise ValueError(f"channel must be 0 to 255, got {self.channel}")
        for name, most in (("latency_us", 1e7), ("jitter_us", 1e6), ("holdback_us", 1e6)):
            if not 0 <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be 0 to {most:g}, got {getattr(self, name)}")
        if not 1 <= self.pulse_us <= 1_000_000:
            raise ValueError(f"pulse_us must be 1 to 1000000, got {self.pulse_us}")

    def timing(self, seed: int) -> EdgeTiming:
        """Return what an edge of this trigger is."""
        return EdgeTiming(EdgeKind[self.kind.upper()], self.channel, self.latency_us, self.jitter_us, seed)

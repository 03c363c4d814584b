"""A rig's trigger: where edges on the camera's input come from, and how they get to each link and to the session.

    [trigger]  source = "can"      SYNC on that link's bus     -> EdgeSink -> a ring for each link (and the session's)
               period_ms = 10.0    no bus: every 10 ms         -> each link makes the same edges by itself

The rings are shared memory, made before the links' processes start and passed to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from firmware_protocol.device_clock import ClockSettings
from firmware_protocol.edges import EdgeKind
from transports.edges import EdgeRing, EdgeSink, EdgeSource, EdgeTiming, PeriodicEdges
from transports.feed import Timing
from transports.ring import EventRing

__all__ = ["Trigger", "TriggerPaths"]


@dataclass(frozen=True)
class Trigger:
    """What is connected to the camera's external input.

    Attributes
    ----------
    source
        Name of the CAN link whose SYNC triggers.
    period_ms
        Instead: an edge each period of stream time, the first after one period.
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
    kind: Literal["pulse", "rising", "falling"] = "pulse"
    channel: int = 0
    latency_us: float = 0.0
    jitter_us: float = 0.0
    pulse_us: int = 100
    holdback_us: int = 2000
    send_period_ms: float = 0.0

    def __post_init__(self) -> None:
        if self.source and self.period_ms:
            raise ValueError("period_ms makes edges without a bus; leave it out, or leave out source")
        if not (self.source or self.period_ms or self.send_period_ms):
            raise ValueError("a trigger needs source (the name of a CAN link), period_ms or send_period_ms")
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


class TriggerPaths:
    """The rings of one run's trigger.

    Parameters
    ----------
    links
        Names of the rig's links.
    lockstep_us
        Above 0, the trigger drives the run.
    """

    def __init__(self, trigger: Trigger | None, links: Sequence[str], seed: int, lockstep_us: int = 0) -> None:
        self._trigger = trigger
        self._seed = seed
        self._lockstep_us = lockstep_us
        has_bus = trigger is not None and bool(trigger.source)
        self._rings = {name: EdgeRing() for name in links} if has_bus else {}
        self._syncs = EdgeRing() if has_bus and lockstep_us else None

    def timing(self, link: str, clock: ClockSettings | None, truth: Path | None) -> Timing:
        """Return what the link `link` has to do with time and triggers."""
        trigger, is_source = self._trigger, self._is_source(link)
        return Timing(
            edges=self._edges(link),
            holdback_us=trigger.holdback_us if trigger is not None and trigger.source else 0,
            clock=clock,
            seed=self._seed,
            truth=truth if clock is not None else None,
            send_period_us=round(trigger.send_period_ms * 1000) if trigger is not None else 0,
            syncs=self._syncs if is_source else None,
        )

    def sink(self, link: str, run: EventRing) -> EdgeSink | None:
        """Return what the link `link`, fed from `run`, tells of its bus's SYNCs; None where nobody wants to know."""
        if self._trigger is None or not self._is_source(link):
            return None
        # The session's ring comes last: when it has an edge, every link has it too.
        rings = [*self._rings.values(), *([] if self._syncs is None else [self._syncs])]
        return EdgeSink(rings, run, self._trigger.timing(self._seed), self._lockstep_us)

    def _edges(self, link: str) -> EdgeSource | None:
        if self._trigger is None:
            return None
        if self._trigger.period_ms:
            return PeriodicEdges(round(self._trigger.period_ms * 1000), self._trigger.timing(self._seed))
        return self._rings.get(link)

    def _is_source(self, link: str) -> bool:
        return self._trigger is not None and self._trigger.source == link

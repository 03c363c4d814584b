"""A rig's trigger: where edges on the camera's input come from, and how they get to each link and to the session.

    [trigger]  source = "can"      SYNC on that link's bus     -> EdgeSink -> a ring for each link (and the session's)
               period_ms = 10.0    no bus: every 10 ms         -> each link makes the same edges by itself
               [[trigger.edges]]   no bus: at given times      -> the same

The rings are shared memory, made before the links' processes start and passed to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from emulator.rig.trigger_table import Trigger
from firmware_protocol.device_clock import ClockSettings
from transports.link.edges import EdgeRing, EdgeSink, EdgeSource, PeriodicEdges
from transports.link.feed import Timing
from transports.link.listed_edges import ListedEdges
from transports.link.ring import EventRing

__all__ = ["TriggerPaths"]


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
        if self._trigger.edges:
            return ListedEdges([edges.train() for edges in self._trigger.edges], self._trigger.channel)
        return self._rings.get(link)

    def _is_source(self, link: str) -> bool:
        return self._trigger is not None and self._trigger.source == link

"""Pacing of a run: real time, lockstep with a bus, or another drive.

A paced run computes each step one lead ahead of the moment its first event is due. When a step is ready after that
moment it is late, and counted. A run that is behind takes longer steps (twice as long each time, up to eight times):
the light is then sampled more coarsely, which costs accuracy in event times but keeps the run with the clock; when it
has caught up the steps shrink again. The summary reports this.

The lead that a step needed is the time from when its computing was to begin until it was ready. A lead above all of
them makes no step late; more than that only makes a closed loop slower, since light is drawn that far ahead.

In lockstep each SYNC on a bus lets the run go on by one period, for targets too slow for real time. A `Drive` does the
same for other sources of time, such as a simulation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Protocol

import numpy as np

from emulator.light import Light
from emulator.plan.step_control import StepSource
from firmware_protocol.events import Events
from transports.link.deliveries import LatencyHistogram, LatencySummary
from transports.link.edges import EdgeRing
from transports.link.pacing import Clock
from transports.link.rings import FOREVER_US

LONGEST_STRETCH = 8
_MEMORY = 0.9  # of the running mean of a length's load, a step


@dataclass
class Lateness:
    """Delays of a paced run behind real time.

    `computing_ns` is the time in which steps were computed, `processor_ns` the part of it in which the session's thread
    had a processor.
    """

    frames_late: int = 0
    worst_gap_us: float = 0.0
    steps_stretched: int = 0
    computing_ns: int = 0
    processor_ns: int = 0
    _leads: LatencyHistogram = field(default_factory=LatencyHistogram, repr=False, compare=False)

    def add(self, gap_ns: int, stretch: int, lead_ns: int = 0) -> None:
        """Count one step that was ready `gap_ns` after its first event was due (negative: in time).

        Its computing was to begin `lead_ns` before that.
        """
        self._leads.add(np.array([(gap_ns + lead_ns) / 1000]))
        self.steps_stretched += stretch > 1
        if gap_ns > 0:
            self.frames_late += 1
            self.worst_gap_us = max(self.worst_gap_us, gap_ns / 1000)

    @property
    def processor_share(self) -> float:
        """Share of the computing for which the session's thread had a processor: small beside other busy programs."""
        return self.processor_ns / self.computing_ns if self.computing_ns else 1.0

    @property
    def lead_needed_us(self) -> LatencySummary:
        """Lead that the steps needed, us."""
        return self._leads.summary()

    def as_json(self) -> dict[str, object]:
        """The `lateness` object of `evstim run --json`."""
        return {
            "frames_late": self.frames_late,
            "worst_gap_us": round(self.worst_gap_us, 1),
            "steps_stretched": self.steps_stretched,
            "processor_share": round(self.processor_share, 3),
            "lead_needed_us": asdict(self.lead_needed_us),
        }


class StepRule:
    """Length of the next step: as planned while the run keeps up, longer while it does not and longer is cheaper.

    Longer steps save light frames. They do not always save time: where many pixels change a lot within a step, each of
    them costs more. So the cost of a length for each second of stream is measured, and a dearer one is left again.
    """

    def __init__(self, steps: StepSource) -> None:
        self._steps = steps
        self._load: dict[int, float] = {}
        self.stretch = 1

    @property
    def step_ns(self) -> int:
        """Length of the next step, ns."""
        return self._steps.step_ns * self.stretch

    def follow(self, gap_ns: int, cost_ns: int) -> None:
        """Adapt to the last step: `gap_ns` late (negative: in time), `cost_ns` of computing."""
        load = cost_ns / max(self.step_ns, 1)
        self._load[self.stretch] = load + _MEMORY * (self._load.get(self.stretch, load) - load)
        if gap_ns > self._steps.step_ns:
            self.stretch = self._cheaper()
        elif gap_ns <= 0 and self.stretch > 1:
            self.stretch //= 2

    def _cheaper(self) -> int:
        """Return the neighbouring length with the least load; for one not tried yet half the load is assumed."""
        shorter, longer = max(self.stretch // 2, 1), min(2 * self.stretch, LONGEST_STRETCH)
        load = self._load[self.stretch]
        expected = {shorter: self._load.get(shorter, load), longer: self._load.get(longer, load / 2)}
        expected[self.stretch] = load
        return min(expected, key=lambda stretch: expected[stretch])


_POLL_NS = 200_000


class Lockstep:
    """Limit of a run by the SYNCs that a bus has carried, `period_ns` of stream time for each in the ring `syncs`."""

    def __init__(self, syncs: EdgeRing, period_ns: int, clock: Clock) -> None:
        self._syncs = syncs
        self._period_ns = period_ns
        self._clock = clock
        self.received = 0

    @property
    def limit_ns(self) -> int:
        """Stream time that the run may reach."""
        self.received += len(self._syncs.take(FOREVER_US))
        return self.received * self._period_ns

    def wait(self, t_ns: int, goes_on: Callable[[], bool]) -> int:
        """Wait until the run may go beyond `t_ns`, or `goes_on` returns False; return the time that it may reach."""
        while (limit_ns := self.limit_ns) <= t_ns and goes_on():
            self._clock.sleep_until(self._clock.now_ns() + _POLL_NS)
        return limit_ns


class Drive(Protocol):
    """Source of the stream time that a run may reach."""

    @property
    def limit_ns(self) -> int:
        """Stream time that the run may reach."""

    def wait(self, t_ns: int, goes_on: Callable[[], bool]) -> int:
        """Return the time that the run may reach: beyond `t_ns`, or not beyond it when it is to end.

        All events up to `t_ns` have been handed to the links when this is called.
        """


class SimulationDrive(Drive, Protocol):
    """A drive that gives the poses too, so nothing can be drawn before it has begun."""

    def begin(self, light: Callable[[], Light], goes_on: Callable[[], bool]) -> None:
        """Wait until the first light frame can be drawn, or `goes_on` returns False; `light` returns the last one."""

    def take(self, events: Events) -> None:
        """Note events that have been handed to the links."""

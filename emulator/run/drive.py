"""What lets a run go on where it is neither the machine's clock nor as fast as it can."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from emulator.light import Light
from firmware_protocol.events import Events

__all__ = ["Drive", "Simulation"]


class Drive(Protocol):
    """Tells how far in stream time a run may go."""

    @property
    def limit_ns(self) -> int:
        """Stream time that the run may reach."""

    def wait(self, t_ns: int, goes_on: Callable[[], bool]) -> int:
        """Return how far the run may go: beyond `t_ns`, or not beyond it when it is to end.

        All events up to `t_ns` have been handed to the links when this is called.
        """


class Simulation(Drive, Protocol):
    """A drive that gives the poses too, so nothing can be drawn before it has begun."""

    def begin(self, light: Callable[[], Light], goes_on: Callable[[], bool]) -> None:
        """Return when the first picture can be drawn, or `goes_on` says no; `light` gives the last picture."""

    def take(self, events: Events) -> None:
        """Take note of events that have been handed to the links."""

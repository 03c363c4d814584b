"""What a CAN bus is to a link, whoever carries it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

from firmware_protocol.can_frames.frame import Frame

__all__ = ["BusDown", "CanBus", "Heard"]


class BusDown(OSError):
    """A bus cannot be had, or is gone; the message says what to do."""


@dataclass(frozen=True)
class Heard:
    """A frame, and when it was on the bus (CLOCK_MONOTONIC, ns); `own` for an urgent one of ours that has left."""

    frame: Frame
    t_ns: int
    own: bool = False


class CanBus(ABC):
    """One bus. Its methods return at once, except `open`.

    Attributes
    ----------
    missed
        Frames that others were too slow to take, where that is known.
    """

    missed = 0

    @abstractmethod
    async def open(self) -> None:
        """Open it, again after it was lost; raises BusDown."""

    @abstractmethod
    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """Hand over a frame; False: there is no room now. Raises BusDown when the bus is gone.

        An urgent frame passes ordinary ones that wait on our side, where the bus can do that.
        """

    def flood(self, frame: Frame, t_ns: int) -> None:
        """Put a frame of a strange node on the bus, at `t_ns` (CLOCK_MONOTONIC) where that can be chosen."""
        self.send(frame)

    @abstractmethod
    def take(self) -> list[Heard]:
        """Return what was on the bus since the last call, but for our ordinary frames; raises BusDown."""

    def discard(self) -> None:
        """Forget our ordinary frames that were handed over and have not begun, where that can be done."""
        return

    @abstractmethod
    async def close(self) -> None:
        """Let go of it; may be called at any time."""

    @property
    @abstractmethod
    def address(self) -> str:
        """Where others find it."""

    @property
    def waiting(self) -> int:
        """Ordinary frames that were handed over and have not begun, where that is known."""
        return 0

    @property
    def counts(self) -> Mapping[str, int]:
        """What happened to those who joined the bus, by name, for the summary."""
        return {}

    @property
    def heard(self) -> bool:
        """False when it is certain that no other node is on the bus."""
        return True

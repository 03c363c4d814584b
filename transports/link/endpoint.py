"""The far side of a camera's plug: what a transport implements for a link, and what makes it in the link's process.

Attempts to open again what was lost: one at a time, a period apart, by a clock that is passed in.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from firmware_protocol.events import Edges
from transports.faults.kinds import Fault
from transports.faults.script import FaultRecord
from transports.link.deliveries import Deliveries
from transports.link.pacing import Clock
from transports.recording.summary import RecordingSummary

__all__ = ["Endpoint", "EndpointFactory", "LineUse", "LinkBroken", "Reopening"]


_Served = TypeVar("_Served", contravariant=True)  # an endpoint for any camera on USB serves a Davis346 too


@dataclass(frozen=True)
class LineUse:
    """How full a line was, from its first bit to now.

    Attributes
    ----------
    carried
        Bytes or frames that were sent.
    share
        Part of the line's time that sending took, 0 to 1.
    busiest
        The same over the busiest second.
    """

    carried: int = 0
    share: float = 0.0
    busiest: float = 0.0


class LinkBroken(Exception):
    """A link found that it does not do what it promises; the run cannot go on."""


class Endpoint(ABC):
    """The far side of a camera's plug: whatever asks it for bytes."""

    @abstractmethod
    async def start(self) -> None:
        """Open; raises OSError when the machine refuses."""

    def listen(self) -> None:
        """Take the orders of hosts that came by another process; the camera is fed next."""
        return

    @abstractmethod
    def pump(self) -> None:
        """The camera may have new data: hand over what is asked for."""

    def mark(self, edges: Edges) -> int:
        """Send the camera's own marks, (n > 0,) EDGE in the time its receivers see; return how many could be sent.

        USB sends none: a DAVIS346's leave by a connector of their own.
        """
        return 0

    def advance_faults(self, stream_us: int) -> None:
        """Begin and end the faults of the rig that are due at this stream time."""
        return

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for one that this link cannot have."""
        raise ValueError(f"{fault.kind!r} is no fault of this kind of link")

    @property
    def withholds(self) -> bool:
        """True while a fault keeps from the host what the camera has: stream time must not wait for the host then."""
        return False

    @property
    def faults(self) -> tuple[FaultRecord, ...]:
        """What each fault has done so far."""
        return ()

    @abstractmethod
    async def close(self) -> None:
        """Let go of the host and close."""

    @property
    @abstractmethod
    def state(self) -> str:
        """A few words for the live table."""

    @property
    def address(self) -> str | None:
        """Where a host finds the camera; None where there is no such place."""
        return None

    @property
    def use(self) -> LineUse | None:
        """How full the line is; None where it has no capacity of its own."""
        return None

    @property
    def trouble(self) -> str:
        """Why a file that it writes is not whole, for people; empty where it is, or where there is none."""
        return ""

    @property
    def recording(self) -> RecordingSummary | None:
        """What the file that it writes holds, once it is closed; None where it writes none."""
        return None

    @property
    def counts(self) -> Mapping[str, int]:
        """What else happened, by name, for the summary."""
        return {}


class EndpointFactory(ABC, Generic[_Served]):
    """Makes an endpoint inside the link process; itself passed to it by pickling."""

    @abstractmethod
    def build(self, device: _Served, deliveries: Deliveries) -> Endpoint:
        """Return the endpoint that serves `device` and tells `deliveries` of the events that have left."""

    def restarted(self, number: int) -> EndpointFactory[_Served]:
        """Return what makes the endpoint of the `number`-th restart of the link's process, after one that died."""
        return self

    def remove_remains(self) -> None:
        """Remove what a process of this link that was killed left on the machine; what a running one has stays."""
        return

    def traced(self, path: Path) -> EndpointFactory[_Served] | None:
        """Return the same with a trace of its cable in PATH.txt and PATH.pcap; None where there is no such cable."""
        return None


T = TypeVar("T")


class Reopening(Generic[T]):
    """Opens a port or a bus again, beside the link's ticks.

    Parameters
    ----------
    attempt
        Opens it and returns what was opened; an exception means that this attempt failed.
    period_ns
        From a loss, or from the end of an attempt that failed, to the next attempt.

    Attributes
    ----------
    why
        What the last attempt that failed said.
    """

    def __init__(self, clock: Clock, period_ns: int, attempt: Callable[[], Coroutine[Any, Any, T]]) -> None:
        self._clock = clock
        self._period_ns = period_ns
        self._attempt = attempt
        self._next_ns = 0
        self._running: asyncio.Task[T] | None = None
        self.why = ""

    def lost(self, why: str = "") -> None:
        """Say that it was lost just now."""
        self.why = why
        self._next_ns = self._clock.now_ns() + self._period_ns

    def poll(self) -> T | None:
        """Return what was opened since the last call, or None; starts an attempt when one is due."""
        if self._running is None:
            if self._clock.now_ns() >= self._next_ns:
                self._running = asyncio.get_running_loop().create_task(self._attempt())
            return None
        if not self._running.done():
            return None
        done, self._running = self._running, None
        failure = done.exception()
        if failure is None:
            return done.result()
        self.lost(str(failure))
        return None

    async def close(self) -> None:
        """Give up the attempt under way."""
        if self._running is not None:
            self._running.cancel()
            await asyncio.gather(self._running, return_exceptions=True)

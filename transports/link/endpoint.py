"""Interface of a link's transport: the endpoint, and its factory in the link's process.

`Reopening` opens a lost port or bus again: one attempt at a time, a period apart, by a clock that is passed in.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from firmware_protocol.events import Edges
from firmware_protocol.recordings.part import RecordingSummary
from transports.faults.script import FaultPlan, Faulty
from transports.link.deliveries import Deliveries
from transports.link.kind import Wiring
from transports.link.pacing import Clock

BUSY_NS = 500_000
"""Time from one tick of a link to the next while data move or a fault is active."""

HOSTED_NS = 1_000_000
"""Longest time without a tick while a host is present: it sees wraps, counters and timers of its camera advance."""

REST_NS = 4_000_000
"""Longest time without a tick while no host is present: the ring of events is emptied, and the port looked at."""

_Served = TypeVar("_Served", contravariant=True)  # an endpoint for any camera on USB serves a Davis346 too


@dataclass(frozen=True)
class LineUse:
    """Load of a line, from its first bit until now.

    Attributes
    ----------
    carried : number of bytes or frames that were sent.
    share : share of the line's time used for sending, 0 to 1.
    busiest : share in the busiest second.
    """

    carried: int = 0
    share: float = 0.0
    busiest: float = 0.0


class LinkBroken(Exception):
    """Error: a link does not fulfil its guarantees; the run cannot continue."""


@dataclass(frozen=True)
class EndpointReport:
    """Contribution of an endpoint to the report of its link.

    Attributes
    ----------
    address : address at which a host finds the camera; None if there is no address.
    attach_command
        Command that attaches a host to the camera that waits for one; empty if none waits, or none is known.
    use : load of the line; None if it has no limited capacity.
    counts : further counts by name, for the summary.
    trouble : reason for an incomplete output file, for people; empty if it is complete or there is none.
    recording : summary of the closed output file; None if there is none.
    """

    address: str | None = None
    attach_command: str = ""
    use: LineUse | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    trouble: str = ""
    recording: RecordingSummary | None = None


class Endpoint(ABC):
    """Host side of a camera's connector: the transport that reads the camera's bytes.

    `faulty`: path of its data through the faults of the link; by default this kind of link has none.
    """

    faulty: Faulty[Any] = Faulty(FaultPlan())

    @abstractmethod
    async def start(self) -> None:
        """Open the transport; raises OSError if the machine refuses."""

    def listen(self) -> None:
        """Process the hosts' requests that arrived through another process, before the camera is fed."""
        return

    @abstractmethod
    def pump(self) -> None:
        """Send the requested data; called when the camera may have new data."""

    def serve(self, attend: Callable[[], None]) -> None:
        """Receive the function that feeds the camera up to now; call it before a request from an event loop."""
        return

    @property
    def inputs(self) -> Sequence[int]:
        """Descriptors that become readable when a host's request has arrived, which the next tick then processes."""
        return ()

    @property
    def longest_sleep_ns(self) -> int:
        """Longest time from one `pump` to the next while no data are due and no request arrives.

        A link that sleeps long also needs `serve` or `inputs` for its requests.
        """
        return BUSY_NS

    def mark(self, edges: Edges) -> int:
        """Send the camera's own marks, (n > 0,) EDGE in the time its receivers see; return the number sent.

        USB sends none: those of a camera on USB leave by a separate connector.
        """
        return 0

    def advance_faults(self, stream_us: int) -> None:
        """Begin and end the faults of the rig that are due at this stream time."""
        return

    @abstractmethod
    async def close(self) -> None:
        """Disconnect the host and close."""

    @property
    @abstractmethod
    def state(self) -> str:
        """Short state for the live table."""

    def report(self) -> EndpointReport:
        """Return what a report of the link contains beside the state."""
        return EndpointReport()


class EndpointFactory(ABC, Generic[_Served]):
    """Factory of an endpoint inside the link process; passed to that process by pickling."""

    @abstractmethod
    def build(self, device: _Served, deliveries: Deliveries) -> Endpoint:
        """Return the endpoint that serves `device` and reports sent events to `deliveries`."""

    def restarted(self, number: int) -> EndpointFactory[_Served]:
        """Return the factory for the `number`-th restart of the link's process, after the earlier one died."""
        return self

    def remove_remains(self) -> None:
        """Remove the resources that a killed process of this link left on the machine; those of a running one stay."""
        return

    def traced(self, path: Path) -> EndpointFactory[_Served] | None:
        """Return the same factory with a trace of its cable in PATH.txt and PATH.pcap; None without such a cable."""
        return None


@dataclass(frozen=True)
class LinkFactory(EndpointFactory[Any]):
    """Factory of an endpoint, made by its class of the link's table, its wiring, the device and deliveries."""

    endpoint: Callable[[Any, Wiring, Any, Deliveries], Endpoint]
    link: Any
    wiring: Wiring = field(default_factory=Wiring)

    def build(self, device: Any, deliveries: Deliveries) -> Endpoint:
        """Return the endpoint; nothing is open yet."""
        return self.endpoint(self.link, self.wiring, device, deliveries)


T = TypeVar("T")


class Reopening(Generic[T]):
    """Repeated attempts to open a port or a bus again, in parallel with the link's ticks.

    Parameters
    ----------
    attempt : coroutine that opens it and returns the opened object; an exception means that this attempt failed.
    period_ns : time from a loss, or from the end of a failed attempt, to the next attempt.

    Attributes
    ----------
    why : message of the last failed attempt.
    """

    def __init__(self, clock: Clock, period_ns: int, attempt: Callable[[], Coroutine[Any, Any, T]]) -> None:
        self._clock = clock
        self._period_ns = period_ns
        self._attempt = attempt
        self._next_ns = 0
        self._running: asyncio.Task[T] | None = None
        self.why = ""

    def lost(self, reason: str = "") -> None:
        """Record that it was lost just now."""
        self.why = reason
        self._next_ns = self._clock.now_ns() + self._period_ns

    def poll(self) -> T | None:
        """Return the object opened since the last call, or None; start an attempt when one is due."""
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
        """Cancel the attempt in progress."""
        if self._running is not None:
            self._running.cancel()
            await asyncio.gather(self._running, return_exceptions=True)

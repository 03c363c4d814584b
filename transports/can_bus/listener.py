"""A computer on a CAN bus: hears a camera until told to stop, counts, and answers what has to be answered."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from firmware_protocol.receiver.can import CanReceiver
from transports.can_bus.bus import BusDown
from transports.can_bus.parameters import CanParameters
from transports.can_bus.python_can import PythonCanBus
from transports.link.digest import digest_of
from transports.link.latency import LatencySummary
from transports.link.pacing import Clock
from transports.link.record import Recorder

__all__ = ["CanReception", "listen_can", "peer_of"]

_LOOK_PERIOD_S = 0.1
_MOST_DELAYS = 1_000_000


@dataclass(frozen=True)
class CanReception:
    """What has come so far.

    Attributes
    ----------
    seconds
        Wall time since the bus was joined.
    last_t_us
        Time of the newest event; None before the first.
    digest
        Of all events, see `digest_of`.
    faults
        Things that a sound link never shows.
    counts
        Everything else by name.
    jitter_us
        How much later than the quickest frame each came, by the bus's stamps: the camera's own clock is not known.
    gone
        True when the bus went away.
    """

    events: int = 0
    edges: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    faults: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)
    jitter_us: LatencySummary = field(default_factory=LatencySummary)
    gone: bool = False


def peer_of(parameters: CanParameters) -> CanParameters:
    """Return how the other side joins the bus of a rig's link."""
    return replace(parameters, interface="socketcand") if parameters.interface == "served" else parameters


class _Listening:
    """One visit to the bus."""

    def __init__(self, parameters: CanParameters, clock: Clock, recorder: Recorder | None) -> None:
        self._receiver = CanReceiver(parameters.receiver)
        self._recorder = recorder
        self._clock = clock
        self._start_ns = clock.now_ns()
        self._delays_us: list[float] = []
        self.now = CanReception()

    def take(self, bus: PythonCanBus) -> None:
        """Hear all that has come; raises BusDown when the bus is gone."""
        for heard in bus.take():
            self._receiver.push(heard.frame, heard.t_ns)
            for reply in self._receiver.take_replies():
                bus.send(reply)
            self._keep(heard.t_ns)
        self.now = replace(self.now, seconds=(self._clock.now_ns() - self._start_ns) * 1e-9)

    def finish(self, *, gone: bool) -> CanReception:
        """Return everything."""
        receiver = self._receiver
        return replace(
            self.now,
            faults=receiver.faults,
            counts=receiver.counts,
            jitter_us=_jitter(self._delays_us),
            gone=gone,
        )

    def _keep(self, t_ns: int) -> None:
        events, edges = self._receiver.take_events(), self._receiver.take_edges()
        self.now = replace(self.now, edges=self.now.edges + len(edges))
        if self._recorder is not None and (len(events) or len(edges)):
            self._recorder.append(events, edges=edges)
        if not len(events):
            return
        if len(self._delays_us) < _MOST_DELAYS:
            self._delays_us.append(t_ns / 1000 - float(events["t"][-1]))
        now = self.now
        digest = digest_of(events, now.digest)
        self.now = replace(now, events=now.events + len(events), last_t_us=int(events["t"][-1]), digest=digest)


async def listen_can(
    parameters: CanParameters, goes_on: Callable[[CanReception], bool], clock: Clock, recorder: Recorder | None = None
) -> CanReception:
    """Join the bus of `parameters` and hear it while `goes_on` says so, which is asked whenever something has come.

    Raises BusDown when it cannot be joined; a bus that goes away later ends the visit.
    """
    bus = PythonCanBus(parameters, parameters.channel)
    await bus.open()
    listening = _Listening(parameters, clock, recorder)
    gone = False
    try:
        while goes_on(listening.now):
            listening.take(bus)
            await bus.wait(_LOOK_PERIOD_S)
    except BusDown:
        gone = True
    finally:
        await bus.close()
    return listening.finish(gone=gone)


def _jitter(delays_us: list[float]) -> LatencySummary:
    if not delays_us:
        return LatencySummary()
    above = np.array(delays_us) - min(delays_us)
    return LatencySummary(float(np.quantile(above, 0.5)), float(np.quantile(above, 0.99)), float(above.max()))

"""A computer on a CAN bus: hears a camera until told to stop, counts, and answers what has to be answered."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

from firmware_protocol.can_frames.canopen import NodeState
from firmware_protocol.receiver.can import CanReceiver
from transports.can_bus.bus import BusDown
from transports.can_bus.parameters import CanParameters
from transports.can_bus.python_can import PythonCanBus
from transports.link.arrivals import Arrivals
from transports.link.latency import LatencySummary
from transports.link.pacing import Clock
from transports.recording.record import Recorder

__all__ = ["CanReception", "listen_can", "peer_of"]

_LOOK_PERIOD_S = 0.1


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
    ended
        Whether the newest heartbeat said that the camera had stopped, as it does at the end of its run.
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
    ended: bool = False


def peer_of(parameters: CanParameters) -> CanParameters:
    """Return how the other side joins the bus of a rig's link."""
    return replace(parameters, interface="socketcand") if parameters.interface == "served" else parameters


class _Listening:
    """One visit to the bus."""

    def __init__(self, parameters: CanParameters, clock: Clock, recorder: Recorder | None) -> None:
        self._receiver = CanReceiver(parameters.receiver)
        self._arrivals = Arrivals(clock, recorder)
        self._heartbeat = parameters.identifiers.heartbeat
        self._ended = False

    @property
    def now(self) -> CanReception:
        """What has come so far, without what is known at the end alone."""
        a = self._arrivals
        return CanReception(a.events, a.edges, a.seconds, a.last_t_us, a.digest)

    def take(self, bus: PythonCanBus) -> None:
        """Hear all that has come; raises BusDown when the bus is gone."""
        for heard in bus.take():
            self._receiver.push(heard.frame, heard.t_ns)
            if heard.frame.identifier == self._heartbeat and not heard.frame.extended:
                self._ended = heard.frame.data == bytes([NodeState.STOPPED])
            for reply in self._receiver.take_replies():
                with suppress(BusDown):  # the next look says so, after all that was heard before
                    bus.send(reply)
            self._arrivals.add(self._receiver.take_events(), self._receiver.take_edges(), heard.t_ns)

    def finish(self, *, gone: bool) -> CanReception:
        """Return everything."""
        receiver, jitter = self._receiver, self._arrivals.jitter()
        known = replace(self.now, faults=receiver.faults, counts=receiver.counts, jitter_us=jitter)
        return replace(known, gone=gone, ended=self._ended)


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

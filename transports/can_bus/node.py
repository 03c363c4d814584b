"""Camera as a node of a CANopen-like network: heartbeat, NMT, SYNC, TIME, SCET, EMCY and bus selection.

`listen_can` is the other side: a computer on the bus that receives a camera's frames, counts them and sends the replies
that the protocol requires.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

from firmware_protocol.can_frames.canopen import (
    EMCY_NO_ERROR,
    EMCY_OVERRUN,
    BusSelector,
    Emergency,
    NmtCommand,
    NmtOrder,
    NodeState,
    ObjectError,
    TimeOfDay,
    next_sync,
    parse_heartbeat,
    parse_scet,
    parse_sync,
    scet,
)
from firmware_protocol.can_frames.frame import FollowUp, Frame
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.receiver.can import CanReceiver
from transports.can_bus.bus import BusDown, PythonCanBus
from transports.can_bus.kind import CanLink
from transports.link.deliveries import Deliveries
from transports.link.pacing import Clock
from transports.reception import Arrivals, CountedReception
from transports.recording.record import Recorder

TriggerCallback = Callable[[int, int], None]
"""Callback with the time of a trigger (CLOCK_MONOTONIC, ns) and its number."""

_MS = 1_000_000
_EMCY_PERIOD_NS = 1_000 * _MS  # at most one emergency a second; it is over after this time without a drop


class Node:
    """Node of the camera: frames sent by the clock, and reactions to received frames."""

    def __init__(
        self, parameters: CanLink, instrument: Instrument, deliveries: Deliveries, sink: TriggerCallback | None
    ) -> None:
        self.parameters = self._p = parameters
        self._ids = parameters.identifiers
        self.instrument = self._instrument = instrument
        self._deliveries = deliveries
        self._sink = sink
        self._next_ns: dict[str, int] = {}
        self._sync = 0
        self._last_sync: int | None = None
        self._follow_ups: list[Frame] = []
        self._dropped_reported = 0
        self._emergency = False
        self._booted = False
        self.selector: BusSelector | None = None
        self.counts: Counter[str] = Counter()

    @property
    def state(self) -> NodeState:
        """State in the heartbeat."""
        return NodeState.OPERATIONAL if self._instrument.streaming else NodeState.STOPPED

    @property
    def bus(self) -> int:
        """Index of the active bus: 0 for A, 1 for B."""
        return 0 if self.selector is None else self.selector.active

    def start(self, now_ns: int) -> None:
        """Start the node on the default bus."""
        self._booted = False
        if self._p.channel_b:
            self.selector = BusSelector(self._p.redundancy, now_ns)

    def due(self, now_ns: int) -> list[Frame]:
        """Return the node's own frames that are due now, the urgent ones first."""
        frames: list[Frame] = []
        if self._is_due("sync", self._p.sync_ms, now_ns):
            self._sync = next_sync(self._sync)
            frames.append(Frame(self._ids.sync, bytes([self._sync]) if self._p.sync_counter else b""))
        frames += self._follow_ups
        self._follow_ups.clear()
        if not self._booted:
            self._booted = True
            frames.append(Frame(self._ids.heartbeat, bytes([NodeState.BOOT])))
        elif self._is_due("heartbeat", self._p.heartbeat_ms, now_ns):
            frames.append(Frame(self._ids.heartbeat, bytes([self.state])))
        if self._is_due("time", self._p.time_ms, now_ns):
            frames.append(Frame(self._ids.scet, scet(self._instrument.own_us)))
        frames += self._emergencies(now_ns)
        return frames

    def farewell(self) -> list[Frame]:
        """Return the frames at the end of this node: the heartbeat of a stopped node, if it sends heartbeats."""
        return [Frame(self._ids.heartbeat, bytes([NodeState.STOPPED]))] if self._p.heartbeat_ms else []

    def receive(self, bus: int, frame: Frame, t_ns: int) -> None:
        """Process a frame that was on a bus at `t_ns`. On an inactive bus only the master's heartbeat counts."""
        if frame.error:
            self.counts["error frames"] += 1
            return
        if frame.extended:
            return
        with suppress(ObjectError):
            if frame.identifier == self._ids.master_heartbeat:
                self._heartbeat(bus, frame.data, t_ns)
            elif bus == self.bus:
                self._order(frame, t_ns)

    def has_left(self, frame: Frame, t_ns: int) -> None:
        """Record that our frame was on the bus at `t_ns`: a SYNC triggers the camera, its follow-up has `t_ns`."""
        if frame.identifier != self._ids.sync or frame.extended:
            return
        counter = frame.data[0] if frame.data else 0
        self.counts["SYNC sent"] += 1
        if self._sink is not None:
            self._sink(t_ns, counter or self.counts["SYNC sent"] & 0xFFFF)
        sent_ns = self._deliveries.device_ns(t_ns)
        if sent_ns is not None:
            self._follow_ups.append(Frame(self._ids.follow_up, bytes(FollowUp(counter, sent_ns))))

    def _heartbeat(self, bus: int, data: bytes, t_ns: int) -> None:
        parse_heartbeat(data)
        if self.selector is not None:
            self.selector.heartbeat(bus, t_ns)

    def _order(self, frame: Frame, t_ns: int) -> None:
        if frame.identifier == self._ids.sync:
            self._take_sync(parse_sync(frame.data), t_ns)
        elif frame.identifier == self._ids.nmt:
            self._obey(NmtOrder.parse(frame.data))
        elif frame.identifier == self._ids.scet and self._p.follow_time:
            self._set_time(parse_scet(frame.data), t_ns)
        elif frame.identifier == self._ids.time and self._p.follow_time:
            self._set_time(TimeOfDay.parse(frame.data).us, t_ns)

    def _take_sync(self, counter: int | None, t_ns: int) -> None:
        self.counts["SYNC"] += 1
        if counter is not None:
            if self._last_sync is not None and counter != next_sync(self._last_sync):
                self.counts["SYNC gaps"] += 1
            self._last_sync = counter
        if self._sink is not None:
            self._sink(t_ns, self.counts["SYNC"] & 0xFFFF if counter is None else counter)

    def _obey(self, order: NmtOrder) -> None:
        if order.node not in (0, self._p.node):
            return
        self.counts["NMT orders"] += 1
        if order.command is NmtCommand.START:
            self._instrument.start()
            return
        self._instrument.stop()
        if order.command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            self._booted = False

    def _set_time(self, master_us: int, t_ns: int) -> None:
        """Set the camera's time so that it was `master_us` when the frame was on the bus; count impossible times."""
        then_ns = self._deliveries.device_ns(t_ns)
        if then_ns is None:
            return
        try:
            self._instrument.set_time(master_us + self._instrument.now_us - then_ns // 1000)
        except ValueError:
            self.counts["times refused"] += 1

    def _emergencies(self, now_ns: int) -> list[Frame]:
        if not self._is_due("emergency", _EMCY_PERIOD_NS // _MS, now_ns):
            return []
        c = self._instrument.counters
        dropped = c.dropped_fifo + c.dropped_late + c.dropped_rate + c.lost_on_link
        goes_on = dropped > self._dropped_reported
        self._dropped_reported = dropped
        if goes_on or self._emergency:
            self._emergency = goes_on
            self.counts["EMCY"] += 1
            return [Frame(self._ids.emcy, bytes(Emergency(EMCY_OVERRUN if goes_on else EMCY_NO_ERROR, dropped)))]
        return []

    def _is_due(self, name: str, period_ms: int, now_ns: int) -> bool:
        """Return True if a periodic frame is due. Due times are absolute, so a late call delays no later frame."""
        if period_ms == 0:
            return False
        due_ns = self._next_ns.setdefault(name, now_ns)
        if now_ns < due_ns:
            return False
        period_ns = period_ms * _MS
        self._next_ns[name] = due_ns + period_ns * (1 + (now_ns - due_ns) // period_ns)
        return True


_LOOK_PERIOD_S = 0.1


@dataclass(frozen=True)
class CanReception(CountedReception):
    """Events and counts received so far from a bus; `jitter_us` is by the bus's time stamps.

    `ended`: True if the newest heartbeat reported a stopped camera, as it does at the end of its run.
    """

    ended: bool = False

    @property
    def is_early(self) -> bool:
        """True when the bus was lost before the camera reported its stop."""
        return self.gone and not self.ended


def peer_of(parameters: CanLink) -> CanLink:
    """Return the parameters with which the other side joins the bus of a rig's link."""
    return replace(parameters, interface="socketcand") if parameters.interface == "served" else parameters


class _Listener:
    """State of one reception from a bus."""

    def __init__(self, parameters: CanLink, clock: Clock, recorder: Recorder | None) -> None:
        self._receiver = CanReceiver(parameters.receiver)
        self._arrivals = Arrivals(clock, recorder)
        self._heartbeat = parameters.identifiers.heartbeat
        self._ended = False

    @property
    def now(self) -> CanReception:
        """Reception so far, without the values that are known only at the end."""
        return self._arrivals.reception(CanReception)

    def take(self, bus: PythonCanBus) -> None:
        """Process all received frames; raises BusDown when the bus is lost."""
        for received in bus.take():
            self._receiver.push(received.frame, received.t_ns)
            if received.frame.identifier == self._heartbeat and not received.frame.extended:
                self._ended = received.frame.data == bytes([NodeState.STOPPED])
            for reply in self._receiver.take_replies():
                with suppress(BusDown):  # the next `bus.take` raises it, after all frames received before
                    bus.send(reply)
            self._arrivals.add(self._receiver.take_events(), self._receiver.take_edges(), received.t_ns)

    def finish(self, *, gone: bool) -> CanReception:
        """Return the complete reception."""
        values = {
            "faults": self._receiver.faults,
            "counts": self._receiver.counts,
            "jitter_us": self._arrivals.jitter(),
        }
        return self._arrivals.reception(CanReception, gone=gone, ended=self._ended, **values)


async def listen_can(
    parameters: CanLink, goes_on: Callable[[CanReception], bool], clock: Clock, recorder: Recorder | None = None
) -> CanReception:
    """Join the bus of `parameters` and receive frames while `goes_on`, called after each arrival, returns True.

    Raises BusDown if the bus cannot be joined; the reception ends if the bus is lost later.
    """
    bus = PythonCanBus(parameters, parameters.channel)
    await bus.open()
    listening = _Listener(parameters, clock, recorder)
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

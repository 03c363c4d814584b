"""CAN endpoint of a link: one bus or two, a node, and the sources of the instrument's frames.

Every frame is sent by `_send`, and every received frame is processed by `_receive`.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from firmware_protocol.can_frames.frame import BusShare, Frame
from firmware_protocol.can_frames.raw_events import pack_marks
from firmware_protocol.events import Edges
from firmware_protocol.instrument.instrument import Instrument, Outgoing
from transports.can_bus.bus import BusDown, CanBus, PythonCanBus
from transports.can_bus.carriage import FrameSource, sources
from transports.can_bus.faulty_bus import BusFaults, FaultyBus
from transports.can_bus.kind import CanLink
from transports.can_bus.node import Node
from transports.can_bus.served import ServedBus
from transports.faults.bus import QueuedFrame, Tracker
from transports.link.deliveries import Deliveries
from transports.link.endpoint import BUSY_NS, HOSTED_NS, REST_NS, Endpoint, EndpointReport, LineUse, Reopening
from transports.link.kind import Wiring
from transports.link.pacing import Clock

_RETRY_NS = 1_000_000_000
_SECOND_NS = 1_000_000_000
_MAKE_UP_NS = 5_000_000  # bus time that a late tick may catch up
_NAMES = ("A", "B")
_MOST_ANSWERS = 1024  # limit of the urgent frames that wait while other nodes occupy the bus
_DRAIN_TURNS, _DRAIN_TURN_S = 1000, 0.001  # at the end, queued frames get one second to leave


@dataclass
class _Slot:
    """One of the buses and its state: `up` when it can be used."""

    bus: FaultyBus
    reopening: Reopening[bool]
    up: bool = False


class CanEndpoint(Endpoint):
    """Endpoint of an instrument on a CAN bus; `buses` stand in for those of the link's table."""

    faulty: BusFaults

    def __init__(
        self, link: CanLink, wiring: Wiring, device: Instrument, deliveries: Deliveries, buses: Sequence[CanBus] = ()
    ) -> None:
        p, clock = link, deliveries.clock
        self.faulty = faults = BusFaults(wiring.faults, p.rates, deliveries)
        if not buses and p.interface == "served":
            buses = [ServedBus(p, clock)]
        elif not buses:
            buses = [PythonCanBus(p, channel) for channel in (p.channel, p.channel_b) if channel]
        self._slots = [_slot(FaultyBus(bus, index, faults), clock) for index, bus in enumerate(buses)]
        self._instrument = device
        self._node = Node(p, device, deliveries, wiring.sink)
        self._sources = sources(device, deliveries, p)
        self._clock = clock
        self._share = BusShare(p.rates, p.share, _MAKE_UP_NS)
        self._urgent: deque[Frame] = deque()
        self._pending: tuple[FrameSource, QueuedFrame] | None = None  # the bus had no room for this frame
        self._use = _Use()
        self._counts: Counter[str] = Counter()
        self._active = 0
        self._listeners_present = True
        self._closed_ns: int | None = None
        self._marks = p.identifiers.marks

    async def start(self) -> None:
        """Open the buses; raises BusDown, with the remedy, if one cannot be opened."""
        for slot in self._slots:
            await slot.bus.open()
            slot.up = True
        self._node.start(self._clock.now_ns())

    def pump(self) -> None:
        """Process the received frames, then send the frames that are due."""
        for index, slot in enumerate(self._slots):
            self._listen(index, slot)
        now_ns = self._clock.now_ns()
        for slot in self._slots:
            slot.bus.babble(now_ns)
        if self._node.selector is not None:
            self._node.selector.poll(now_ns)
        if self._active != self._node.bus:  # the master has selected the other one
            self._drop()
            self._active = self._node.bus
        slot = self._slots[self._active]
        present = slot.up and slot.bus.has_listeners  # once: it changes with time
        self._set_listeners(present)
        if not present:
            return
        self._urgent += self._node.due(now_ns)
        try:
            self._send_urgent(slot, now_ns)
            self._send_ordinary(slot, now_ns)
        except BusDown as error:
            self._down(slot, error)
        self._settle()

    def serve(self, attend: Callable[[], None]) -> None:
        """Receive the function to call before a request is processed."""
        for slot in self._slots:
            slot.bus.serve(attend)

    @property
    def longest_sleep_ns(self) -> int:
        """Longest time until the next `pump`; without a listener and a second bus nothing has to happen in time.

        Listeners see the SYNCs of this node at most half a millisecond late.
        """
        if self._pending is not None or self._urgent or any(slot.bus.is_busy for slot in self._slots):
            return BUSY_NS
        if self._listeners_present and (self._instrument.waiting_items or self._node.parameters.sync_ms):
            return BUSY_NS
        return HOSTED_NS if self._listeners_present or len(self._slots) > 1 else REST_NS

    def advance_faults(self, stream_us: int) -> None:
        """Begin and end the faults of the rig that are due."""
        over, held = self.faulty.advance(stream_us)
        if not over:
            return
        slot = self._slots[self._active]
        try:
            slot.bus.put(held)
        except BusDown as error:
            self._down(slot, error)
        for tracker in self._trackers():
            tracker.damaged()

    def mark(self, edges: Edges) -> int:
        """Send the camera's own marks; return the number sent."""
        slot = self._slots[self._active]
        if not (slot.up and slot.bus.has_listeners):
            return 0
        self._urgent += [Frame(self._marks, data) for data in pack_marks(edges)]
        return len(edges)

    async def close(self) -> None:
        """Finish the frames that the bus has accepted, drop the rest, send the farewell and close the buses."""
        await self._drain()
        slot = self._slots[self._active]
        if slot.up and slot.bus.has_listeners:
            with suppress(BusDown):
                for frame in self._node.farewell():
                    self._send(slot, QueuedFrame(frame, exempt=True), self._clock.now_ns())
        await self._drain()
        self._closed_ns = self._clock.now_ns()
        self._drop()
        self._instrument.disconnected()
        for slot in self._slots:
            await slot.reopening.close()
            await slot.bus.close()
        for tracker in self._trackers():
            tracker.close()
        self.faulty.close()

    @property
    def state(self) -> str:
        """Active bus, and the state of the node there."""
        slot = self._slots[self._active]
        if not slot.up:
            return slot.reopening.why
        name = f", bus {_NAMES[self._active]}" if len(self._slots) > 1 else ""
        state = self._node.state.name.lower() if slot.bus.has_listeners else "no listener yet"
        return f"on {slot.bus.address}{name}, {state}"

    def report(self) -> EndpointReport:
        """Return the active bus, its load as far as this node saw it, and counts."""
        counts = self._counts + self._node.counts
        for source in self._sources:
            counts += Counter({f"{source.label} {name}": n for name, n in source.faults.items()})
        if self._node.selector is not None:
            counts["bus changes"] = self._node.selector.turns
        counts["frames missed by slow listeners"] += sum(slot.bus.missed for slot in self._slots)
        return EndpointReport(
            self._slots[self._active].bus.address,
            use=self._use.line(self._closed_ns or self._clock.now_ns()),
            counts=dict(sum((Counter(slot.bus.counts) for slot in self._slots), counts)),
        )

    def _listen(self, index: int, slot: _Slot) -> None:
        if not slot.up:
            slot.up = slot.reopening.poll() or False
            return
        try:
            for received in slot.bus.take():
                if received.is_ours:
                    self._node.has_left(received.frame, received.t_ns)
                else:
                    self._receive(index, received.frame, received.t_ns)
        except BusDown as error:
            self._down(slot, error)

    def _receive(self, index: int, frame: Frame, t_ns: int) -> None:
        """Process a frame of another node."""
        now_ns = self._clock.now_ns()
        self._node.receive(index, frame, t_ns)
        if index != self._active or frame.error:
            return
        self._use.add(self._share.spend(frame, now_ns), now_ns, ours=False)
        for source in self._sources:
            answer = source.receive(frame, now_ns)
            if answer is not None and len(self._urgent) < _MOST_ANSWERS:
                self._urgent.append(answer)
            elif answer is not None:
                self._counts["answers dropped, the bus had no room"] += 1

    def _send(self, slot: _Slot, queued: QueuedFrame, now_ns: int) -> bool:
        """Pass a frame to the bus; return False if it has no room. Raises BusDown."""
        if not slot.bus.post(queued):
            self._counts["bus had no room"] += 1
            return False
        self._use.add(self._share.spend(queued.frame, now_ns), now_ns)
        return True

    def _send_urgent(self, slot: _Slot, now_ns: int) -> None:
        waiting, self._urgent = self._urgent, deque()
        while waiting:
            if not self._send(slot, QueuedFrame(waiting[0], urgent=True), now_ns):
                self._urgent.append(waiting[0])  # the next frame may have its own transmit buffer
            waiting.popleft()

    def _send_ordinary(self, slot: _Slot, now_ns: int) -> None:
        while self._share.has_room(now_ns):
            if self._pending is None:
                self._pending = self._next(now_ns)
            if self._pending is None:
                return
            source, queued = self._pending
            if not self._send(slot, queued, now_ns):
                return
            self._pending = None
            self._follow(slot, source, source.left())

    def _follow(self, slot: _Slot, source: FrameSource, outgoing: Outgoing | None) -> None:
        """Count a message when all frames that the bus has accepted so far have begun, or can no longer begin."""
        if outgoing is not None:
            slot.bus.follow(partial(source.delivered, outgoing), partial(source.lost, outgoing))

    def _next(self, now_ns: int) -> tuple[FrameSource, QueuedFrame] | None:
        for source in self._sources:
            if source.between:
                self.faulty.look_at(source)
            frame, tracker = source.next_frame(now_ns), source.tracker
            if frame is not None:
                message = None if tracker is None else tracker.message(source.load)
                return source, QueuedFrame(frame, message=message, exempt=tracker is None)
        return None

    def _trackers(self) -> list[Tracker]:
        return [source.tracker for source in self._sources if source.tracker is not None]

    async def _drain(self) -> None:
        slot = self._slots[self._active]
        for _ in range(_DRAIN_TURNS):
            if not (slot.up and slot.bus.has_listeners and slot.bus.waiting):
                return
            await asyncio.sleep(_DRAIN_TURN_S)
            self._listen(self._active, slot)
            self._settle()

    def _settle(self) -> None:
        for slot in self._slots:
            slot.bus.settle()
        for tracker in self._trackers():
            tracker.settle()

    def _set_listeners(self, present: bool) -> None:
        if present == self._listeners_present:
            return
        self._listeners_present = present
        if present:
            self._instrument.connected()
        else:
            self._drop()
            self._instrument.disconnected()

    def _drop(self) -> None:
        slot = self._slots[self._active]
        for source in self._sources:
            self._follow(slot, source, source.cut())
        slot.bus.drop()
        self._pending = None
        self._urgent.clear()
        for source in self._sources:
            source.drop()

    def _down(self, slot: _Slot, error: BusDown) -> None:
        slot.up = False
        slot.reopening.lost(str(error))
        self._counts["bus lost"] += 1
        if slot is self._slots[self._active]:
            self._drop()
        else:
            slot.bus.drop()


def _slot(bus: FaultyBus, clock: Clock) -> _Slot:
    async def opened() -> bool:
        await bus.open()
        return True

    return _Slot(bus, Reopening(clock, _RETRY_NS, opened))


class _Use:
    """Load of the bus."""

    def __init__(self) -> None:
        self._frames = 0
        self._busy_ns = 0
        self._first_ns: int | None = None
        self._second = 0
        self._in_second_ns = 0
        self._busiest_ns = 0

    def add(self, duration_ns: int, now_ns: int, *, ours: bool = True) -> None:
        if self._first_ns is None:
            self._first_ns = now_ns
        self._frames += ours
        self._busy_ns += duration_ns
        if now_ns // _SECOND_NS != self._second:
            self._second, self._in_second_ns = now_ns // _SECOND_NS, 0
        self._in_second_ns += duration_ns
        self._busiest_ns = max(self._busiest_ns, self._in_second_ns)

    def line(self, now_ns: int) -> LineUse:
        if self._first_ns is None or now_ns <= self._first_ns:
            return LineUse()
        share = self._busy_ns / (now_ns - self._first_ns)
        return LineUse(self._frames, min(1.0, share), min(1.0, self._busiest_ns / _SECOND_NS))

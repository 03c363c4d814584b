"""Fault injection on a CAN link: a wrapper around each of its buses.

    endpoint --post--> stage --> stage --> [frames for which the bus had no room] --> bus [frames that have not begun]
    endpoint <--take---------------------- unless the bus is dead or off ----'
    endpoint <--settle-- callbacks, when a frame has begun or can no longer begin

While no fault is active, frames pass unchanged. Faults of the bus itself (off, dead, flooded) appear as its state, so
that the endpoint reacts as it does to a real bus.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from firmware_protocol.can_frames.frame import BitRates, Frame
from transports.can_bus.bus import BusDown, CanBus, TimedFrame
from transports.can_bus.carriage import FrameSource
from transports.faults.bus import Babbler, BusStage, Callbacks, FrameTracker, MessageTracker, QueuedFrame
from transports.faults.kinds import CAN_BUS, ItemStage
from transports.faults.script import FaultPlan, Faulty, pass_through
from transports.link.deliveries import Deliveries

_AHEAD_NS = 1_000_000  # frames of a babbling node are queued this long before their time


class BusFaults(Faulty[ItemStage[QueuedFrame]]):
    """Faults of one link, for all its buses."""

    carrier = CAN_BUS

    def __init__(self, plan: FaultPlan, rates: BitRates, deliveries: Deliveries) -> None:
        super().__init__(plan, rates)
        self._posted = 0
        self._callbacks = Callbacks(
            deliveries.add_items, lambda load: self._faults.lose(len(load.events), len(load.edges))
        )

    @property
    def strikes_frames(self) -> bool:
        """True while a fault may hit single frames."""
        return any(not isinstance(stage, BusStage) for stage in self._faults.stages)

    def advance(self, now_us: int) -> tuple[bool, list[QueuedFrame]]:
        """Advance stream time; return True if any fault has ended, and the frames that it had held."""
        over = self._faults.advance(now_us)
        return bool(over), [queued for stage in over for queued in stage.finish()]

    def look_at(self, source: FrameSource) -> None:
        """Set or remove the tracker of a source that is between two messages."""
        if source.tracker is None and self.strikes_frames:
            read = source.reader()
            source.tracker = FrameTracker(self._callbacks) if read is None else MessageTracker(self._callbacks, read)
        elif source.tracker is not None and source.tracker.in_step and not self.strikes_frames:
            source.tracker = None

    def changed(self, queued: QueuedFrame) -> list[QueuedFrame]:
        """Return the frames that go to the bus in place of `queued`."""
        passed = pass_through(self._faults, queued, self._posted)
        self._posted += 1
        return passed

    def is_off(self, bus: int) -> bool:
        """Return True if our controller has left this bus."""
        return any(stage.off for stage in self._of(bus))

    def is_dead(self, bus: int) -> bool:
        """Return True if this bus is cut."""
        return any(stage.dead for stage in self._of(bus))

    def babblers(self, bus: int) -> list[Babbler]:
        """Return the nodes that flood this bus."""
        return [stage for stage in self._of(bus) if isinstance(stage, Babbler)]

    def _of(self, bus: int) -> list[BusStage]:
        return [stage for stage in self._faults.stages if isinstance(stage, BusStage) and stage.bus == bus]


@dataclass(frozen=True)
class _Followed:
    """Callbacks that depend on the ordinary frames up to `number`."""

    number: int
    begun: Callable[[], None]
    gone: Callable[[], None]


class FaultyBus(CanBus):
    """CAN bus with fault injection; `index` is 0 for bus A, 1 for bus B."""

    def __init__(self, bus: CanBus, index: int, faults: BusFaults) -> None:
        self._bus = bus
        self._index = index
        self._faults = faults
        self._rest: deque[QueuedFrame] = deque()
        self._taken = 0  # ordinary frames that the bus accepted
        self._followed: deque[_Followed] = deque()
        self.missed = 0
        self._is_off = False  # off by a fault, while the bus itself is open

    async def open(self) -> None:
        """Open the bus; raises BusDown while a fault keeps the controller off."""
        self._check_off()
        if self._is_off:
            self._is_off = False
            self._bus.take()  # frames sent in the meantime were not received
            return
        await self._bus.open()

    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """Pass a frame to the bus; return False if there is no room now."""
        return self.post(QueuedFrame(frame, urgent))

    def post(self, queued: QueuedFrame) -> bool:
        """Send a frame through the faults; return False if there is no room now. Raises BusDown."""
        self._check_off()
        if not self._flush():
            return False
        if queued.exempt or (queued.message is None and not self._faults.strikes_frames):
            return self._hand_over(queued)
        self.put(self._faults.changed(queued))
        return True

    def put(self, queued_frames: list[QueuedFrame]) -> None:
        """Send these frames unchanged, as soon as there is room; raises BusDown when the bus is lost."""
        self._rest += queued_frames
        self._flush()

    def follow(self, begun: Callable[[], None], gone: Callable[[], None]) -> None:
        """Register callbacks for the frames accepted so far: `begun` when all have begun, `gone` if they never will."""
        self._followed.append(_Followed(self._taken, begun, gone))

    def settle(self) -> None:
        """Call the callbacks of frames that have begun."""
        begun = self._taken - self._bus.waiting
        while self._followed and self._followed[0].number <= begun:
            self._followed.popleft().begun()

    def drop(self) -> None:
        """Discard all frames that have not begun, because the bus is inactive or lost."""
        self.settle()
        self._bus.discard()
        while self._followed:
            self._followed.popleft().gone()
        while self._rest:
            message = self._rest.popleft().message
            if message is not None:
                message.gone()

    def take(self) -> list[TimedFrame]:
        """Return the frames since the last call."""
        self._check_off()
        self._flush()
        received = self._bus.take()
        self.missed = self._bus.missed
        return [] if self._faults.is_dead(self._index) else received

    def babble(self, now_ns: int) -> None:
        """Send the due frames of the nodes that flood this bus."""
        for babbler in self._faults.babblers(self._index):
            for t_ns in babbler.due(now_ns + _AHEAD_NS):
                self._bus.flood(babbler.frame, t_ns)

    async def close(self) -> None:
        """Close the bus."""
        self.drop()
        await self._bus.close()

    @property
    def address(self) -> str:
        """Address at which other nodes find the bus."""
        return self._bus.address

    @property
    def waiting(self) -> int:
        """Number of our ordinary frames that have not begun."""
        return self._bus.waiting + len(self._rest)

    @property
    def is_busy(self) -> bool:
        """True while frames are on the bus or wait for it."""
        return self._bus.is_busy or bool(self._rest)

    def serve(self, attend: Callable[[], None]) -> None:
        """Receive the function to call when another node has sent a frame."""
        self._bus.serve(attend)

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of clients of the bus by name."""
        return self._bus.counts

    @property
    def has_listeners(self) -> bool:
        """False when no other node is on the bus, or a fault has cut it."""
        return self._bus.has_listeners and not self._faults.is_dead(self._index)

    def _check_off(self) -> None:
        if self._faults.is_off(self._index):
            self._is_off = True
            raise BusDown(f"{self.address} is bus-off, by a fault of this rig; it comes back when that is over")

    def _flush(self) -> bool:
        """Send the waiting frames; return True if none is left."""
        while self._rest:
            if not self._hand_over(self._rest[0]):
                return False
            self._rest.popleft()
        return True

    def _hand_over(self, queued: QueuedFrame) -> bool:
        if not self._bus.send(queued.frame, urgent=queued.urgent):
            return False
        self._taken += not queued.urgent
        if queued.message is not None:
            self.follow(partial(queued.message.arrived, queued.frame), queued.message.gone)
            self.settle()
        return True

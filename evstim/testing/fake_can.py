"""A CAN bus in memory with the methods of python-can's Bus, and a camera as its other node.

    with FakeCanBus(CanParameters(carriage="raw")) as bus:
        bus.show(events)                   # EVENT array, stream time
        while (message := bus.recv(0.1)) is not None:
            decoder_under_test(message)

The camera is the real node: heartbeat, SYNC, NMT, ISO-TP and CFP as in a run. Its clock moves
with `show`, and with `recv` by the timeout at most: a test takes no longer than its computation.
"""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import replace
from types import TracebackType

import can

from evstim.testing.moments import moments
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.events import Events
from firmware_protocol.instrument.instrument import Instrument
from transports.can_bus.bus import CanBus, Heard
from transports.can_bus.carriage import sources
from transports.can_bus.endpoint import CanEndpoint
from transports.can_bus.faulty_bus import BusFaults
from transports.can_bus.node import Node
from transports.can_bus.parameters import CanParameters
from transports.can_bus.python_can import from_message, to_message
from transports.faults.script import FaultPlan
from transports.link.deliveries import Deliveries
from transports.link.pacing import FakeClock
from transports.link.ring import EventRing

__all__ = ["FakeCanBus"]

_TICK_NS = 100_000
_RING_EVENTS = 1 << 16


class _Wire(CanBus):
    """The camera's side: frames that it sends, with the time at which they left, and frames of the computer."""

    def __init__(self, clock: FakeClock) -> None:
        self._clock = clock
        self.from_camera: deque[tuple[int, Frame]] = deque()
        self.to_camera: deque[Heard] = deque()

    async def open(self) -> None:
        """See `CanBus.open`."""

    async def close(self) -> None:
        """See `CanBus.close`."""

    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """See `CanBus.send`."""
        now_ns = self._clock.now_ns()
        self.from_camera.append((now_ns, frame))
        if urgent:
            self.to_camera.append(Heard(frame, now_ns, own=True))
        return True

    def take(self) -> list[Heard]:
        """See `CanBus.take`."""
        heard = list(self.to_camera)
        self.to_camera.clear()
        return heard

    @property
    def address(self) -> str:
        """See `CanBus.address`."""
        return "memory"


class FakeCanBus:
    """The computer's side of the bus; a context manager.

    Parameters
    ----------
    parameters : of the camera's node, as a rig's [[links]] table of kind "can" has them.
    size : (width, height) of the camera's array, pixels.

    Attributes
    ----------
    instrument : the camera at the other side, with `counters`.
    """

    def __init__(self, parameters: CanParameters | None = None, size: tuple[int, int] = (346, 260)) -> None:
        p = replace(parameters or CanParameters(), interface="virtual")
        self.instrument = Instrument(size, p.instrument)
        self._clock = FakeClock()
        self._ring = EventRing(_RING_EVENTS)
        deliveries = Deliveries(self._ring, self._clock)
        self._wire = _Wire(self._clock)
        node = Node(p, self.instrument, deliveries, None)
        faults = BusFaults(FaultPlan(), p.rates, deliveries)
        carried = sources(self.instrument, deliveries, p)
        self._endpoint = CanEndpoint([self._wire], faults, node, carried, self._clock)
        self._loop = asyncio.new_event_loop()
        self._loop.run_until_complete(self._endpoint.start())
        self._t_us = 0

    def __enter__(self) -> FakeCanBus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.shutdown()

    def show(self, events: Events, until_us: int | None = None) -> None:
        """Give the camera events (n,) EVENT of stream time, sorted, and let time go on to `until_us` (their last)."""
        for part, now_us in moments(events, self._t_us, until_us):
            self._clock.advance((now_us - self._t_us) * 1000)
            self._t_us = now_us
            self.instrument.offer(part)
            self.instrument.advance(now_us)
            self._endpoint.pump()

    @property
    def in_waiting(self) -> int:
        """Frames that `recv` returns at once."""
        return len(self._wire.from_camera)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the camera's next frame, None where none comes within `timeout` seconds of the bus's own time."""
        end_ns = self._clock.now_ns() + round((timeout or 0.0) * 1e9)
        while not self._wire.from_camera:
            self._endpoint.pump()
            if self._wire.from_camera or self._clock.now_ns() >= end_ns:
                break
            self._clock.advance(_TICK_NS)
        if not self._wire.from_camera:
            return None
        t_ns, frame = self._wire.from_camera.popleft()
        message = to_message(frame)
        message.timestamp = t_ns * 1e-9
        return message

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a frame on the bus."""
        frame = from_message(msg)
        if frame is not None:
            self._wire.to_camera.append(Heard(frame, self._clock.now_ns()))
            self._endpoint.pump()

    def shutdown(self) -> None:
        """Leave the bus."""
        if not self._loop.is_closed():
            self._loop.run_until_complete(self._endpoint.close())
            self._loop.close()
            self._ring.close()

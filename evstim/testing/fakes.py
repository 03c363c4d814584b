"""Fakes in memory: a CAN bus with a camera as its other node, and a serial port with an instrument at its other side.

The CAN bus has the methods of python-can's Bus:

    with FakeCanBus(CanLink(node=34)) as bus:
        bus.show(events)                   # EVENT array, stream time
        while (message := bus.recv(0.1)) is not None:
            decoder_under_test(message)

The camera is the real node: heartbeat, SYNC, NMT, ISO-TP and CFP as in a run. Its clock moves with `show`, and with
`recv` by the timeout at most: a test takes no longer than its computation.

The serial port has the methods of pyserial's Serial:

    with FakeSerialPort("ccsds-cobs") as port:
        port.show(events)                  # EVENT array, stream time
        decoder_under_test(port.read(4096))

Telecommands that the program under test writes reach the instrument, and its answers come back. The line is as fast as
the program reads: a `read` returns the waiting bytes at once, whatever the timeout. `damage` changes bytes on the way.

Events are offered in moments of a millisecond: an instrument that receives a second of events at once finds most of
them too old.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import can
import numpy as np

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.events import Events
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.profile import Profile
from transports import Closing
from transports.can_bus.bus import CanBus, TimedFrame, from_message, to_message
from transports.can_bus.endpoint import CanEndpoint
from transports.can_bus.kind import CanLink
from transports.link.deliveries import Deliveries
from transports.link.kind import Wiring
from transports.link.pacing import FakeClock
from transports.link.rings import EventRing

_MOMENT_US = 1000


def moments(events: Events, from_us: int, until_us: int | None) -> Iterator[tuple[Events, int]]:
    """Yield (events of a moment, its end in us), a millisecond each while there are events, then up to `until_us`.

    `until_us` None means the time of the last event.
    """
    last_us = int(events["t"][-1]) if len(events) else from_us
    end_us = max(from_us, last_us, until_us or 0)
    cuts = np.flatnonzero(np.diff(events["t"] // _MOMENT_US)) + 1
    for part in np.split(events, cuts) if len(events) else ():
        yield part, int(part["t"][-1])
    yield events[:0], end_us


_TICK_NS = 100_000
_RING_EVENTS = 1 << 16


class _Wire(CanBus):
    """The camera's side: frames that it sends, with the time at which they left, and frames of the computer."""

    address = "memory"

    def __init__(self, clock: FakeClock) -> None:
        self._clock = clock
        self.from_camera: deque[tuple[int, Frame]] = deque()
        self.to_camera: deque[TimedFrame] = deque()

    async def open(self) -> None:
        """Do nothing: the bus is memory."""

    async def close(self) -> None:
        """Do nothing: the bus is memory."""

    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """Send a frame at once; an urgent one comes back as a bus confirms it."""
        now_ns = self._clock.now_ns()
        self.from_camera.append((now_ns, frame))
        if urgent:
            self.to_camera.append(TimedFrame(frame, now_ns, is_ours=True))
        return True

    def take(self) -> list[TimedFrame]:
        """Return the frames that have come since the last call."""
        heard = list(self.to_camera)
        self.to_camera.clear()
        return heard


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

    def __init__(self, parameters: CanLink | None = None, size: tuple[int, int] = (346, 260)) -> None:
        p = replace(parameters or CanLink(), interface="virtual")
        self.instrument = Instrument(size, p.instrument)
        self._clock = FakeClock()
        self._ring = EventRing(_RING_EVENTS)
        deliveries = Deliveries(self._ring, self._clock)
        self._wire = _Wire(self._clock)
        self._endpoint = CanEndpoint(p, Wiring(), self.instrument, deliveries, [self._wire])
        self._loop = asyncio.new_event_loop()
        self._loop.run_until_complete(self._endpoint.start())
        self._t_us = 0

    def __enter__(self) -> FakeCanBus:
        return self

    def __exit__(self, *_: object) -> None:
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
            self._wire.to_camera.append(TimedFrame(frame, self._clock.now_ns()))
            self._endpoint.pump()

    def shutdown(self) -> None:
        """Leave the bus."""
        if not self._loop.is_closed():
            self._loop.run_until_complete(self._endpoint.close())
            self._loop.close()
            self._ring.close()


class FakeSerialPort(Closing):
    """The computer's side of the line.

    Parameters
    ----------
    profile : packets and framing, as in a rig: "ccsds-cobs", "ccsds-slip", "ccsds-kiss", "csp-kiss" or "fprime".
    size : (width, height) of the camera's array, pixels.
    settings : of the instrument.

    Attributes
    ----------
    instrument : the camera at the other side, with `counters`.
    damage : function that changes the bytes on their way to the computer; by default they arrive as they were sent.
    timeout, is_open, name : as in pyserial.
    """

    def __init__(
        self,
        profile: str = "ccsds-cobs",
        size: tuple[int, int] = (346, 260),
        settings: InstrumentSettings | None = None,
    ) -> None:
        self.instrument = Instrument(size, settings)
        self.damage: Callable[[bytes], bytes] = bytes
        self.timeout: float | None = 0.0
        self.is_open = True
        self.name = f"memory://{profile}"
        self._profile = Profile(profile)
        self._commands = self._profile.command_unwrapper()
        self._line = bytearray()
        self._t_us = 0

    def show(self, events: Events, until_us: int | None = None) -> None:
        """Give the camera events (n,) EVENT of stream time, sorted, and let time go on to `until_us` (their last)."""
        for part, now_us in moments(events, self._t_us, until_us):
            self._t_us = now_us
            self.instrument.offer(part)
            self.instrument.advance(now_us)
            self._send()

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read."""
        self._check()
        return len(self._line)

    def read(self, size: int = 1) -> bytes:
        """Return at most `size` bytes, fewer where there are no more."""
        self._check()
        data = bytes(self._line[:size])
        del self._line[:size]
        return data

    def write(self, data: bytes) -> int:
        """Send telecommands to the camera; return how many bytes it took."""
        self._check()
        for command in self._commands.push(bytes(data)):
            self.instrument.command(command)
        self._send()
        return len(data)

    def flush(self) -> None:
        """Return when all has been written, which is at once."""
        self._check()

    def reset_input_buffer(self) -> None:
        """Discard the bytes that have arrived."""
        self._check()
        self._line.clear()

    def close(self) -> None:
        """Hang up: events that come from now on are counted as not running."""
        if self.is_open:
            self.is_open = False
            self.instrument.disconnected()

    def _send(self) -> None:
        """Send every message that waits in the instrument."""
        while (outgoing := self.instrument.next_message()) is not None:
            self._line += self.damage(self._profile.wrap(outgoing.message))
            self.instrument.sent(outgoing)

    def _check(self) -> None:
        if not self.is_open:
            raise OSError(f"{self.name} is closed")

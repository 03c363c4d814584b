"""Fault injection on a serial line, between the endpoint's output and its port:

    endpoint._write --> stage --> stage --> [bytes for which the port had no room] --> port
                                   |
                                   +--> ReferenceReceiver: the messages that an intact receiver gets

While no fault is active bytes pass unchanged and are not decoded. A byte that entered a stage counts as sent by the
camera. If the port has no room for it, it waits here, and later bytes are refused, as by a full port.

`ReferenceReceiver` decodes the damaged line as an intact receiver does, and so determines the messages that faults
destroyed. It receives only from the beginning of a fault until whole messages arrive again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from firmware_protocol.instrument.instrument import Outgoing
from firmware_protocol.packets.addresses import Message, Received
from firmware_protocol.packets.profile import Profile, Unwrapper
from transports.faults.kinds import SERIAL_LINE
from transports.faults.line import ByteStage
from transports.faults.script import FaultPlan, Faulty

_IN_STEP = 2  # consecutive messages: the beginning of the first one may have been damaged before


class ReferenceReceiver:
    """Decoder of the messages that survived, in order; `false`: number that arrived again, or without being sent."""

    def __init__(self) -> None:
        self._expected: deque[Outgoing] = deque()
        self._came: deque[Message] = deque()
        self._in_step = 0
        self.false = 0

    @property
    def in_step(self) -> bool:
        """True when no message is outstanding and messages arrive whole again."""
        return not self._expected and self._in_step >= _IN_STEP

    def came(self, received: Iterable[Received]) -> None:
        """Add the messages that an intact receiver decodes from the arrived bytes."""
        self._came += [packet.message for packet in received]

    def left(self, outgoing: Outgoing) -> None:
        """Add a message whose last byte has left, damaged or not."""
        self._expected.append(outgoing)

    def settle(self) -> tuple[list[Outgoing], list[Outgoing]]:
        """Return the messages that arrived whole since the last call, and those that are now known to be lost."""
        came: list[Outgoing] = []
        lost: list[Outgoing] = []
        while self._came:
            message = self._came.popleft()
            came_as = message.kind, message.payload
            alike = (n for n, sent in enumerate(self._expected) if (sent.message.kind, sent.message.payload) == came_as)
            place = next(alike, None)
            if place is None:
                self.false += 1
                continue
            self._in_step = self._in_step + 1 if place == 0 else 1
            lost += [self._expected.popleft() for _ in range(place)]
            came.append(self._expected.popleft())
        return came, lost

    def give_up(self) -> list[Outgoing]:
        """Return the outstanding messages, which can no longer arrive."""
        lost = list(self._expected)
        self._expected.clear()
        return lost

    def damaged(self) -> None:
        """Record that a fault was active until now."""
        self._in_step = 0


_Write = Callable[[bytes], int]


class FaultyLine(Faulty[ByteStage]):
    """Serial line with fault injection.

    Parameters
    ----------
    profile : packets and framing of the messages.
    bytes_per_s : the line's capacity.
    arrived : called with each message that an intact receiver gets.
    """

    carrier = SERIAL_LINE

    def __init__(self, plan: FaultPlan, profile: str, bytes_per_s: float, arrived: Callable[[Outgoing], None]) -> None:
        super().__init__(plan, bytes_per_s)
        self._profile = profile
        self._arrived = arrived
        self._reference: ReferenceReceiver | None = None
        self._unwrapper: Unwrapper | None = None
        self._rest = b""
        self._sent = 0
        self.false = 0

    @property
    def gone(self) -> bool:
        """True while a fault has removed the port."""
        return any(stage.gone for stage in self._faults.stages)

    def advance(self, now_us: int, begun: bytes) -> None:
        """Advance stream time; `begun` is the sent part of the current frame on the line."""
        for stage in self._faults.advance(now_us):
            self._arrive(stage.finish())
            if self._reference is not None:
                self._reference.damaged()
        if self._faults.stages and self._reference is None:
            self._reference, self._unwrapper = ReferenceReceiver(), Profile(self._profile).unwrapper()
            self._see(begun)

    def write(self, data: bytes, port: _Write) -> int:
        """Send bytes through the faults; return the number of accepted bytes."""
        if not self.flush(port) or any(stage.holds for stage in self._hold(data)):
            return 0
        if self._faults.stages:
            taken = len(data)
            self._arrive(self._changed(data))
            self.flush(port)
        else:
            taken = port(data)
            self._see(data[:taken])
        self._sent += taken
        return taken

    def flush(self, port: _Write) -> bool:
        """Pass the waiting bytes to the port; return True if it accepted all of them."""
        if self._rest:
            self._rest = self._rest[port(self._rest) :]
        return not self._rest

    def left(self, outgoing: Outgoing) -> None:
        """Record that the last byte of a message has left."""
        if self._reference is None:
            self._arrived(outgoing)
        else:
            self._reference.left(outgoing)

    def settle(self) -> None:
        """Determine the fates of the messages that have left."""
        if self._reference is None:
            return
        came, lost = self._reference.settle()
        self._lose(lost)
        for outgoing in came:
            self._arrived(outgoing)
        self.false += self._reference.false
        self._reference.false = 0
        if self._reference.in_step and not self._faults.stages:
            self._reference = None

    def drop(self) -> None:
        """Discard the messages in progress: the line or its receiver is lost."""
        self._rest = b""
        if self._reference is not None:
            self.settle()
        if self._reference is not None:
            self._lose(self._reference.give_up())
            self._reference = None

    def close(self) -> None:
        """End all faults; the messages in progress are lost."""
        self.drop()
        super().close()

    def _hold(self, data: bytes) -> list[ByteStage]:
        holding = [stage for stage in self._faults.stages if stage.holds]
        for stage in holding:
            before = stage.hits
            stage.change(data)
            if stage.hits != before:
                self._faults.applied(stage, [self._sent])
        return holding

    def _changed(self, data: bytes) -> bytes:
        for stage in self._faults.stages:
            before = stage.touched
            data = stage.change(data)
            if stage.touched != before or stage.places:
                self._faults.applied(stage, [self._sent + place for place in stage.places])
        return data

    def _arrive(self, data: bytes) -> None:
        self._rest += data
        self._see(data)

    def _see(self, data: bytes) -> None:
        if self._reference is not None and self._unwrapper is not None:
            self._reference.came(self._unwrapper.push(data))

    def _lose(self, lost: list[Outgoing]) -> None:
        for outgoing in lost:
            self._faults.lose(len(outgoing.events), len(outgoing.edges))

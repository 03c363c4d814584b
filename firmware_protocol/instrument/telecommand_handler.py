"""Execution of telecommands, with answers as in PUS service 1.

Answers wait for the line in a bounded queue of messages; the oldest are dropped first.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

from firmware_protocol.instrument.queue import OwnTime
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.housekeeping import Housekeeping, TimeReport
from firmware_protocol.packets.profile import ReceivedCommand
from firmware_protocol.packets.pus import Acknowledge
from firmware_protocol.packets.telecommands import (
    CommandRefused,
    Failure,
    FailureCode,
    Ping,
    RequestHousekeeping,
    RequestId,
    SetBias,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Stage,
    Start,
    Stop,
    Telecommand,
    Verification,
)

__all__ = ["Answers", "Commanded", "TelecommandHandler"]


_MOST_ANSWERS = 256


class Answers:
    """Queue of answers; if requests arrive faster than the line sends answers, the oldest answers are dropped."""

    def __init__(self, time: OwnTime) -> None:
        self._time = time
        self._waiting: deque[Message] = deque(maxlen=_MOST_ANSWERS)

    def put(self, kind: MessageKind, payload: bytes) -> None:
        """Queue an answer, dated with the camera's time now."""
        self._waiting.append(Message(kind, payload, self._time.own_us))

    def take(self) -> Message | None:
        """Return the oldest answer; None if none waits."""
        return self._waiting.popleft() if self._waiting else None

    def clear(self) -> None:
        """Drop all answers."""
        self._waiting.clear()


_MOST_EXECUTED = 256  # between two calls of take_executed, a millisecond apart at most


class Commanded(Protocol):
    """Device on which telecommands act; each method raises ValueError for a value that does not fit it."""

    def start(self) -> None:
        """Start the flow of events."""

    def stop(self) -> None:
        """Stop the flow of events, and drop those that wait."""

    def set_tick(self, tick_us: int) -> None:
        """Set the unit of time."""

    def set_region(self, x: int, y: int, width: int, height: int) -> None:
        """Send events of these pixels only."""

    def set_rate_limit(self, events_per_s: int) -> None:
        """Limit the rate; 0 for no limit."""

    def set_time(self, t_us: int) -> None:
        """Set the camera's own time."""

    def set_bias(self, bias: int, value: int) -> None:
        """Set a bias."""

    def report(self) -> Housekeeping:
        """Return the housekeeping report."""


class TelecommandHandler:
    """Executes telecommands one by one.

    Attributes
    ----------
    taken, refused, missing
        Numbers of telecommands so far.
    """

    def __init__(self, device: Commanded, answers: Answers, time: OwnTime) -> None:
        self._device = device
        self._answers = answers
        self._time = time
        self.taken = self.refused = self.missing = 0
        self._executed: deque[str] = deque(maxlen=_MOST_EXECUTED)

    def take_executed(self) -> tuple[str, ...]:
        """Return the telecommands that changed a setting since the last call, oldest first; of too many, the last."""
        executed = tuple(self._executed)
        self._executed.clear()
        return executed

    def handle(self, received: ReceivedCommand) -> None:
        """Execute a telecommand, and queue the answers."""
        self.missing += received.missing
        if received.command is None:
            self._refuse(received.request, Stage.ACCEPTANCE, received.failure)
            return
        self._verify(received, Stage.ACCEPTANCE, Acknowledge.ACCEPTANCE)
        try:
            self._execute(received.command)
        except ValueError as error:
            failure = CommandRefused(FailureCode.ILLEGAL_DATA, str(error)).failure
            self._refuse(received.request, Stage.COMPLETION, failure)
            return
        self.taken += 1
        if not isinstance(received.command, Ping | RequestHousekeeping):
            self._executed.append(repr(received.command))
        self._verify(received, Stage.COMPLETION, Acknowledge.COMPLETION)

    def _execute(self, command: Telecommand) -> None:
        """Execute it; raises ValueError if its values do not fit the device."""
        match command:
            case Start():
                self._device.start()
            case Stop():
                self._device.stop()
            case Ping():
                self._answers.put(MessageKind.PONG, b"")
            case RequestHousekeeping():
                self._answers.put(MessageKind.HOUSEKEEPING, self._device.report().encode())
            case SetTick(tick_us):
                self._device.set_tick(tick_us)
            case SetRegion(x, y, width, height):
                self._device.set_region(x, y, width, height)
            case SetRateLimit(events_per_s):
                self._device.set_rate_limit(events_per_s)
            case SetTime(t_us):
                self._device.set_time(t_us)
                self._answers.put(MessageKind.TIME, TimeReport(t_us, self._time.status).encode())
            case SetBias(bias, value):
                self._device.set_bias(bias, value)

    def _verify(self, received: ReceivedCommand, stage: Stage, wanted: Acknowledge) -> None:
        if received.acknowledge & wanted:
            self._answers.put(MessageKind.VERIFICATION, Verification(stage, received.request).encode())

    def _refuse(self, request: RequestId, stage: Stage, failure: Failure | None) -> None:
        self.refused += 1
        self._answers.put(MessageKind.VERIFICATION, Verification(stage, request, failure).encode())

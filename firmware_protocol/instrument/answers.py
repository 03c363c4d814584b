"""Answers that wait for the line: a bounded queue of messages, the oldest lost first."""

from __future__ import annotations

from collections import deque

from firmware_protocol.instrument.own_time import OwnTime
from firmware_protocol.packets.message import Message, MessageKind

__all__ = ["Answers"]

_MOST_ANSWERS = 256


class Answers:
    """Queues what a telecommand asked for; a computer that asks faster than the line answers loses the oldest ones."""

    def __init__(self, time: OwnTime) -> None:
        self._time = time
        self._waiting: deque[Message] = deque(maxlen=_MOST_ANSWERS)

    def put(self, kind: MessageKind, payload: bytes) -> None:
        """Queue an answer, with the camera's time now."""
        self._waiting.append(Message(kind, payload, self._time.own_us))

    def take(self) -> Message | None:
        """Return the oldest answer; None when none waits."""
        return self._waiting.popleft() if self._waiting else None

    def clear(self) -> None:
        """Drop all answers."""
        self._waiting.clear()

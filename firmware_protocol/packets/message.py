"""What an instrument says, whichever standard carries it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

__all__ = ["Message", "MessageKind", "Received"]


class MessageKind(Enum):
    """The kinds of messages, and what their payload is."""

    EVENTS = "events"
    """One event block (firmware_protocol.telemetry)."""
    EDGES = "edges"
    """One block of edges (firmware_protocol.telemetry)."""
    HOUSEKEEPING = "housekeeping"
    """`Housekeeping`."""
    VERIFICATION = "verification"
    """`Verification`."""
    TIME = "time"
    """`TimeReport`."""
    PONG = "pong"
    """Nothing."""


@dataclass(frozen=True)
class Message:
    """One message, with its time in microseconds since the start of the stream."""

    kind: MessageKind
    payload: bytes
    t_us: int


@dataclass(frozen=True)
class Received:
    """A message that came, and how many of its counter are missing before it."""

    message: Message
    missing: int = 0

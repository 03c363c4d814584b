"""What leaves an instrument."""

from __future__ import annotations

from dataclasses import dataclass, field

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.events import Events, empty_events
from firmware_protocol.packets.message import Message

__all__ = ["Outgoing"]


@dataclass(frozen=True)
class Outgoing:
    """A message, and what it carries as a receiver will see it.

    Attributes
    ----------
    message
        What to send, with the instrument's own time. Its payload is empty where the link packs the events itself.
    events, edges
        What it carries, in stream time: cut to the tick and in the order of the block.
    epoch_us
        Stream time at which the instrument's own time is zero; negative where that is before the stream began.
    dropped
        Events dropped between these and those that left before.
    """

    message: Message
    events: Events = field(default_factory=empty_events)
    edges: Edges = field(default_factory=empty_edges)
    epoch_us: int = 0
    dropped: int = 0

"""What a receiver says of a packet that it does not take."""

from __future__ import annotations

__all__ = ["PacketError"]


class PacketError(ValueError):
    """A packet is malformed or not for us. The message is the reason under which it is counted."""

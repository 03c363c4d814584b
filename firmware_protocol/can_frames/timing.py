"""The follow-up of a SYNC: what the sender's clock showed when that SYNC was really on the bus.

A SYNC has the highest priority and still waits for a frame that is being sent, up to 0.16 ms at 1 Mbit/s. Who sent it
measures when it left, and says so in a frame of its own:

    u8 counter of the SYNC it belongs to (0 where the bus counts none) | u56 ns of the sender's clock

Little-endian, 8 bytes; 2^56 ns are 2.2 years. A receiver that stamped the SYNC takes the pair (its stamp, this time).
"""

from __future__ import annotations

from dataclasses import dataclass

from firmware_protocol.can_frames.canopen import ObjectError

__all__ = ["FollowUp"]

_TIME_BYTES = 7


@dataclass(frozen=True)
class FollowUp:
    """One follow-up message.

    Attributes
    ----------
    counter
        Of the SYNC, 0 to 255.
    sent_ns
        Sender's clock when the SYNC left, ns, 0 to 2^56 - 1.
    """

    counter: int
    sent_ns: int

    def __post_init__(self) -> None:
        if not 0 <= self.counter <= 0xFF:
            raise ValueError(f"counter must be 0 to 255, got {self.counter}")
        if not 0 <= self.sent_ns < 1 << 8 * _TIME_BYTES:
            raise ValueError(f"sent_ns must be 0 to 2^56 - 1, got {self.sent_ns}")

    def __bytes__(self) -> bytes:
        return bytes([self.counter]) + self.sent_ns.to_bytes(_TIME_BYTES, "little")

    @classmethod
    def parse(cls, data: bytes) -> FollowUp:
        """Read a frame's data; raises ObjectError."""
        if len(data) != 1 + _TIME_BYTES:
            raise ObjectError(f"a follow-up has 8 bytes, not {len(data)}")
        return cls(data[0], int.from_bytes(data[1:], "little"))

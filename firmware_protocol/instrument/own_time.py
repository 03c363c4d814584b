"""The camera's own time: stream time plus an offset that SetTime, the bus or a synchronisation input changes."""

from __future__ import annotations

from firmware_protocol.packets.housekeeping import TimeStatus

__all__ = ["OwnTime"]

_LATEST_US = ((1 << 32) - 366 * 86_400) * 1_000_000


class OwnTime:
    """Stream time reached, and the camera's time beside it.

    Attributes
    ----------
    now_us
        Stream time.
    offset_us
        What the camera's time is ahead of it.
    status
        What the camera's time depends on.
    """

    def __init__(self) -> None:
        self.now_us = self.offset_us = 0
        self.status = TimeStatus.FREE_RUNNING

    @property
    def own_us(self) -> int:
        """The camera's own time; never negative."""
        return self.now_us + self.offset_us

    @property
    def epoch_us(self) -> int:
        """Stream time at which the camera's own time is zero; negative when it was set ahead."""
        return -self.offset_us

    def of(self, stream_us: int) -> int:
        """Return the camera's time at a stream time, which is taken modulo 2^64: a tick may begin before the stream."""
        return (stream_us + self.offset_us) % (1 << 64)

    def reach(self, now_us: int) -> None:
        """Let stream time pass; it never goes back."""
        self.now_us = max(self.now_us, now_us)

    def set(self, t_us: int) -> None:
        """Make the camera's time `t_us` now; raises ValueError when that is negative or too far in the future."""
        if not 0 <= t_us <= _LATEST_US:
            raise ValueError(f"time {t_us} us leaves no year before 32 bits of seconds are full")
        self.offset_us = t_us - self.now_us
        self.status = TimeStatus.SET

    def restart(self) -> None:
        """Make the camera's time zero now, unasked."""
        self.set(0)
        self.status = TimeStatus.FREE_RUNNING

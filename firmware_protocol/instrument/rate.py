"""What keeps a stream within a set rate: a token bucket in stream time, and a choice of pixels."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_protocol.events import EVENT, Events

__all__ = ["Selection", "TokenBucket"]

_RECORD = f"V{EVENT.itemsize}"  # numpy picks these as bytes, and structured records field by field


class TokenBucket:
    """Lets through `per_second` events on the average, at most `burst` at once; a rate of 0 lets everything through."""

    def __init__(self, per_second: float, burst: int, now_us: int = 0) -> None:
        self.per_second = per_second
        self._burst = burst
        self._tokens = float(burst)
        self._now_us = now_us

    def advance(self, now_us: int) -> None:
        """Let stream time pass."""
        gained = (now_us - self._now_us) * 1e-6 * self.per_second
        self._tokens = min(float(self._burst), self._tokens + gained)
        self._now_us = now_us

    def holds(self, count: int) -> bool:
        """Say whether `count` events may go now."""
        return self.per_second == 0 or count <= self._tokens

    def spend(self, count: int) -> None:
        """Let `count` events go."""
        if self.per_second:
            self._tokens -= count


@dataclass(frozen=True)
class Selection:
    """Which pixels are sent.

    Attributes
    ----------
    x, y, width, height
        The region of interest, pixels.
    keep_every
        Of the region, only columns and rows that are a multiple of this, counted from the array's corner.
    """

    x: int
    y: int
    width: int
    height: int
    keep_every: int = 1

    def within(self, size: tuple[int, int]) -> Selection:
        """Return this if it lies within an array of `size` = (width, height); raises ValueError otherwise."""
        if self.x + self.width > size[0] or self.y + self.height > size[1]:
            raise ValueError(
                f"region {[self.x, self.y, self.width, self.height]} reaches beyond the {size[0]}x{size[1]} pixels"
            )
        return self

    def of(self, events: Events) -> Events:
        """Return a copy of those events (n,) that are chosen."""
        x, y = events["x"], events["y"]
        chosen = (x >= self.x) & (x < self.x + self.width) & (y >= self.y) & (y < self.y + self.height)
        if self.keep_every > 1:
            chosen &= (x % self.keep_every == 0) & (y % self.keep_every == 0)
        chosen_events: Events = events.view(_RECORD)[chosen].view(EVENT)
        return chosen_events

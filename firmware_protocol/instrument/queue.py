"""Queue of events for a line narrower than the scene, rate limit, selection of pixels, and the camera's own time.

The queue is bounded in number and in age, and records its gaps:

    head                                                          tail
    [ before=0 | e e e e e ] [ before=120 | e e e ] [ before=0 | e ] ...        segments

`before` is the number of events dropped just before a segment's first. A block is taken from the head and never spans
a gap, so the count in its header belongs exactly to the place of the missing events.

A policy selects the events to drop when the queue is full: "drop_oldest" drops at the head, so the sent events are
recent and the gap is between two blocks; "drop_newest" drops at the tail until there is room for a block again.

The rate limit is a token bucket in stream time. The camera's own time is stream time plus an offset that SetTime, the
bus or a synchronisation input changes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from firmware_protocol.events import EVENT, Events, empty_events, join_events
from firmware_protocol.packets.housekeeping import TimeStatus


class Policy(StrEnum):
    """Selection of the events to drop when there are too many."""

    OLDEST = "drop_oldest"
    NEWEST = "drop_newest"


@dataclass(frozen=True)
class QueueBounds:
    """Limits of the queue.

    Attributes
    ----------
    events : most events that wait.
    age_us : longest that an event waits, us of stream time.
    block_events : events of a full block: "drop_newest" accepts events again once there is room for that many.
    """

    events: int
    age_us: int
    block_events: int
    policy: Policy


@dataclass(frozen=True)
class Dropped:
    """Numbers of events that a call dropped, by bound."""

    full: int = 0
    late: int = 0

    @property
    def total(self) -> int:
        """Sum of both."""
        return self.full + self.late


@dataclass
class _Segment:
    before: int
    events: Events


class EventQueue:
    """A bounded queue of events, sorted by time."""

    def __init__(self, bounds: QueueBounds) -> None:
        self.bounds = bounds
        self._segments: deque[_Segment] = deque()
        self._before = 0  # dropped at the head since the last block
        self._refused = 0  # dropped at the tail since the last accepted event
        self._refusing = False
        self.waiting = 0

    @property
    def room(self) -> int:
        """Events that fit now."""
        return max(0, self.bounds.events - self.waiting)

    @property
    def oldest_us(self) -> int | None:
        """Stream time of the event at the head; None if the queue is empty."""
        return int(self._segments[0].events["t"][0]) if self._segments else None

    @property
    def dropped_before(self) -> int:
        """Events dropped between the last block and the head; all dropped ones if the queue is empty."""
        return self._before if self._segments else self._before + self._refused

    def put(self, events: Events, now_us: int) -> Dropped:
        """Append events (n,), which the queue stores without a copy; return the numbers dropped."""
        if self.bounds.policy is Policy.NEWEST:
            return self._put_what_fits(events, now_us)
        self._append(events)
        return self.trim(now_us)

    def trim(self, now_us: int) -> Dropped:
        """Drop events at the head that are too old or too many, if the policy drops there."""
        if self.bounds.policy is not Policy.OLDEST:
            return Dropped()
        full = self._drop(self.waiting - self.bounds.events)
        return Dropped(full, self._drop(self._late(now_us)))

    def head(self, limit: int) -> Events:
        """Return up to `limit` events from the head, without a gap inside; they stay in the queue."""
        if not self._segments:
            return empty_events()
        first = self._segments.popleft()
        parts, have = [first.events], len(first.events)
        while have < limit and self._segments and not self._segments[0].before:
            parts.append(self._segments.popleft().events)
            have += len(parts[-1])
        first.events = join_events(parts)
        self._segments.appendleft(first)
        return first.events[:limit]

    def remove(self, count: int, reported: int) -> None:
        """Remove `count` events from the head for a block that reported `reported` dropped ones before them."""
        if not self._segments:
            self._before, self._refused = self.dropped_before, 0
        self._before -= reported
        self._leave(count)

    def clear(self) -> int:
        """Drop everything and return the number of events."""
        self._before, self._refused = self._before + self._refused, 0
        return self._drop(self.waiting)

    def _put_what_fits(self, events: Events, now_us: int) -> Dropped:
        late = self.oldest_us is not None and now_us - self.oldest_us > self.bounds.age_us
        if self._refusing and self.room >= min(self.bounds.block_events, self.bounds.events):
            self._refusing = False
        fitting = 0 if late or self._refusing else min(len(events), self.room)
        if not late and fitting < len(events):
            self._refusing = True
        self._append(events[:fitting])
        refused = len(events) - fitting
        self._refused += refused
        return Dropped(late=refused) if late else Dropped(full=refused)

    def _append(self, events: Events) -> None:
        if not len(events):
            return
        before, self._refused = self._refused, 0
        if not self._segments:
            self._before, before = self._before + before, 0
        self._segments.append(_Segment(before, events))
        self.waiting += len(events)

    def _late(self, now_us: int) -> int:
        """Events that have waited too long."""
        limit_us = now_us - self.bounds.age_us
        late = 0
        for segment in self._segments:
            if int(segment.events["t"][0]) >= limit_us:
                break
            late += int(np.searchsorted(segment.events["t"], max(limit_us, 0)))
        return late

    def _drop(self, count: int) -> int:
        count = max(0, count)
        self._before += count
        self._leave(count)
        return count

    def _leave(self, count: int) -> None:
        """Remove `count` events from the head; gaps that reach the head are reported with the next block."""
        self.waiting -= count
        while count:
            first = self._segments[0]
            gone = min(count, len(first.events))
            count -= gone
            first.events = first.events[gone:]
            if not len(first.events):
                self._segments.popleft()
                if self._segments:
                    self._before, self._segments[0].before = self._before + self._segments[0].before, 0


_RECORD = f"V{EVENT.itemsize}"  # numpy selects these as bytes, and structured records field by field


class TokenBucket:
    """Rate limit of `per_second` events on average, at most `burst` at once; a rate of 0 sets no limit."""

    def __init__(self, per_second: float, burst: int, now_us: int = 0) -> None:
        self.per_second = per_second
        self._burst = burst
        self._tokens = float(burst)
        self._now_us = now_us

    def advance(self, now_us: int) -> None:
        """Advance stream time."""
        gained = (now_us - self._now_us) * 1e-6 * self.per_second
        self._tokens = min(float(self._burst), self._tokens + gained)
        self._now_us = now_us

    def holds(self, count: int) -> bool:
        """Return true if `count` events may leave now."""
        return self.per_second == 0 or count <= self._tokens

    def spend(self, count: int) -> None:
        """Count `count` events as leaving."""
        if self.per_second:
            self._tokens -= count


@dataclass(frozen=True)
class Selection:
    """Selection of the pixels to send.

    Attributes
    ----------
    x, y, width, height : the region of interest, pixels.
    keep_every
        Of the region, only columns and rows that are a multiple of this, counted from the array's corner, are sent.
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
        """Return a copy of the selected ones of events (n,)."""
        x, y = events["x"], events["y"]
        chosen = (x >= self.x) & (x < self.x + self.width) & (y >= self.y) & (y < self.y + self.height)
        if self.keep_every > 1:
            chosen &= (x % self.keep_every == 0) & (y % self.keep_every == 0)
        return events.view(_RECORD)[chosen].view(EVENT)


_LATEST_US = ((1 << 32) - 366 * 86_400) * 1_000_000


class OwnTime:
    """Stream time reached, and the camera's own time.

    Attributes
    ----------
    now_us : stream time.
    offset_us : the camera's time minus stream time.
    status : source of the camera's time.
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
        """Stream time at which the camera's own time is zero; negative if it was set ahead."""
        return -self.offset_us

    def of(self, stream_us: int) -> int:
        """Return the camera's time at a stream time, which is taken modulo 2^64: a tick may begin before the stream."""
        return (stream_us + self.offset_us) % (1 << 64)

    def reach(self, now_us: int) -> None:
        """Set stream time; it never goes back."""
        self.now_us = max(self.now_us, now_us)

    def set(self, t_us: int) -> None:
        """Set the camera's time to `t_us` now; raises ValueError if that is negative or too far in the future."""
        if not 0 <= t_us <= _LATEST_US:
            raise ValueError(f"time {t_us} us leaves no year before 32 bits of seconds are full")
        self.offset_us = t_us - self.now_us
        self.status = TimeStatus.SET

    def restart(self) -> None:
        """Set the camera's time to zero now, without a command."""
        self.set(0)
        self.status = TimeStatus.FREE_RUNNING

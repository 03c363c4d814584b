"""Sender and receiver of a stream of raw frames: the sender adds epoch frames, the receiver counts losses.

`raw_events` describes the frames, classic and FD; both use the same epoch frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.raw_events import (
    TICKS_US,
    Epoch,
    RawError,
    pack_clock,
    pack_events,
    pack_fd_events,
    unpack_clock,
    unpack_events,
    unpack_fd_events,
    unwrapped,
)
from firmware_protocol.events import Events, empty_events

_HALF_SPAN_TICKS = 1 << 15
_CLOCK_PERIOD_US = 1_000_000


@dataclass(frozen=True)
class RawSettings:
    """Settings of raw frames.

    Attributes
    ----------
    events, epoch : 11-bit identifiers of events frames and epoch frames.
    tick_us : 1, 10, 100 or 1000.
    epoch_us : Longest time between two epoch frames. Half the span of a frame's 16 bits covers the epoch frames that
        may be lost in a row before time is ambiguous: three of 10 ms at a tick of 1 us.
    fd : CAN FD frames, with the faster bit rate for their data.
    clock : 11-bit identifier of clock frames; None for none, if no receiver starts later and the time is never set.
    """

    events: int
    epoch: int
    tick_us: int = 1
    epoch_us: int = 10_000
    fd: bool = False
    clock: int | None = None

    def __post_init__(self) -> None:
        if self.tick_us not in TICKS_US:
            raise ValueError(f"tick_us must be one of {TICKS_US}, got {self.tick_us}")
        if not 0 < self.epoch_us <= _HALF_SPAN_TICKS * self.tick_us // 2:
            raise ValueError(
                f"epoch_us must be 1 to {_HALF_SPAN_TICKS * self.tick_us // 2}, a quarter of the span of a frame's "
                f"time, got {self.epoch_us}"
            )


@dataclass(frozen=True)
class Packed:
    """A frame to send, and its events (none in an epoch frame)."""

    frame: Frame
    events: Events = field(default_factory=empty_events)


class RawSender:
    """Encoder of events into raw frames, with epoch frames where they are needed."""

    def __init__(self, settings: RawSettings) -> None:
        self._settings = settings
        self._seq = 0
        self._time_sent_us: int | None = None
        self._epoch_sent_us = 0
        self._clock_sent_us: int | None = None
        self._sent = 0
        self._dropped = 0
        self._dropped_sent = 0

    def pack(self, events: Events, dropped: int = 0) -> list[Packed]:
        """Return the frames for events (n,), sorted; they precede earlier ones only if time was set back.

        `dropped` counts the events lost before this encoder, since the start. Raises RawError for pixels beyond 511.
        """
        self._dropped = dropped
        frames: list[Packed] = []
        for part in self._parts(events):
            frames += self._frames_of(part)
        return frames

    def epoch(self, now_us: int, dropped: int) -> list[Packed]:
        """Return the epoch frame that is due at `now_us` if no earlier event waits, and its clock frame."""
        if self._time_sent_us is not None and abs(now_us - self._epoch_sent_us) < self._settings.epoch_us:
            return []
        self._dropped = dropped
        return self._epoch(now_us)

    def time_frames(self, t_us: int) -> list[Packed]:
        """Return the frames that must precede a frame with the low 32 bits of `t_us`, for the upper bits."""
        return [] if self._settings.clock is None or self._has_clock_near(t_us) else self._epoch(t_us)

    def forget(self) -> None:
        """Send the time again before the next frame, because frames that were made have not left."""
        self._time_sent_us = self._clock_sent_us = None

    def set_tick(self, tick_us: int) -> None:
        """Count time in another unit from the next frame on; that frame is an epoch frame with the new unit."""
        quarter_us = _HALF_SPAN_TICKS * tick_us // 2
        self._settings = replace(self._settings, tick_us=tick_us, epoch_us=min(self._settings.epoch_us, quarter_us))
        self._time_sent_us = None

    def _parts(self, events: Events) -> list[Events]:
        """Split the events where an epoch frame has to precede them."""
        times = events["t"].tolist()
        jump_us, period_us = (_HALF_SPAN_TICKS - 1) * self._settings.tick_us, self._settings.epoch_us
        cuts = [
            at
            for at, (before, t) in enumerate(pairwise(times), 1)
            if t - before >= jump_us or (t - times[0]) // period_us > (before - times[0]) // period_us
        ]
        return [events[a:b] for a, b in pairwise([0, *cuts, len(events)]) if b > a]

    def _frames_of(self, events: Events) -> list[Packed]:
        first_us = int(events["t"][0])
        frames: list[Packed] = []
        if (
            self._time_sent_us is None
            or abs(first_us - self._time_sent_us) >= (_HALF_SPAN_TICKS - 1) * self._settings.tick_us
            or abs(first_us - self._epoch_sent_us) >= self._settings.epoch_us
        ):
            frames += self._epoch(first_us)
        frames += self._packed_fd(events) if self._settings.fd else self._packed(events)
        self._time_sent_us = int(events["t"][-1])
        self._sent += len(events)
        return frames

    def _packed(self, events: Events) -> list[Packed]:
        data, first = pack_events(events, self._settings.tick_us, self._seq)
        self._seq = (self._seq + len(data)) & 7
        bounds = pairwise([*first.tolist(), len(events)])
        return [
            Packed(Frame(self._settings.events, raw), events[a:b]) for raw, (a, b) in zip(data, bounds, strict=True)
        ]

    def _packed_fd(self, events: Events) -> list[Packed]:
        s = self._settings
        packed = pack_fd_events(events, s.tick_us, self._seq, self._dropped - self._dropped_sent)
        self._dropped_sent = self._dropped
        self._seq = (self._seq + len(packed)) & 0xFF
        frames, at = [], 0
        for raw, n in packed:
            frames.append(Packed(Frame(s.events, raw, fd=True, brs=True), events[at : at + n]))
            at += n
        return frames

    def _epoch(self, t_us: int) -> list[Packed]:
        self._time_sent_us = self._epoch_sent_us = t_us
        tick_us = self._settings.tick_us
        epoch = Frame(self._settings.epoch, bytes(Epoch(t_us // tick_us, tick_us, self._sent, self._dropped)))
        return [*self._clock(t_us), Packed(epoch)]

    def _has_clock_near(self, t_us: int) -> bool:
        """Return true if the last clock frame is near enough to `t_us`."""
        return self._clock_sent_us is not None and abs(t_us - self._clock_sent_us) < _CLOCK_PERIOD_US

    def _clock(self, t_us: int) -> list[Packed]:
        """Return the clock frame that an epoch frame needs before it, if any."""
        if self._settings.clock is None or self._has_clock_near(t_us):
            return []
        self._clock_sent_us = t_us
        return [Packed(Frame(self._settings.clock, pack_clock(t_us)))]


@dataclass(frozen=True)
class RawCounters:
    """Counts of a receiver of raw frames.

    Attributes
    ----------
    events : events received.
    lost : Events sent and not received, by the counts in the epoch frames; below 0 while later frames came before
        earlier ones.
    dropped : events dropped before they were sent, by the epoch frames.
    gaps : number of frames whose `seq` was not the next.
    repeated : frames that came twice in a row; used once.
    before_epoch : events frames before any epoch frame, which therefore have no time; they are in no other count.
    before_clock : events frames before any clock frame: their times are known modulo 2^30 ticks.
    malformed : frames that no sender makes.
    """

    events: int = 0
    lost: int = 0
    dropped: int = 0
    gaps: int = 0
    repeated: int = 0
    before_epoch: int = 0
    before_clock: int = 0
    malformed: int = 0


class RawReceiver:
    """Decoder of raw frames into events, with a count of losses. The epoch frames contain the tick."""

    def __init__(self, events: int, epoch: int, clock: int | None = None) -> None:
        self._events_id = events
        self._epoch_id = epoch
        self._clock_id = clock
        self._clocked = clock is None
        self._tick_us = 1
        self.now_us: int | None = None  # time of the last frame that had one
        self._epoch: Epoch | None = None
        self._since_epoch = 0
        self._last: tuple[int, bytes] | None = None
        self.counters = RawCounters()

    def push(self, frame: Frame) -> Events:
        """Return the events of a frame, shape (n,); none of a frame of another kind."""
        if frame.error or frame.extended:
            return empty_events()
        try:
            if frame.identifier == self._epoch_id:
                self._take_epoch(Epoch.parse(frame.data))
            elif frame.identifier == self._clock_id:
                self.now_us, self._clocked = unpack_clock(frame.data), True
            elif frame.identifier == self._events_id:
                return self._take_events(frame)
        except RawError:
            self._count(malformed=1)
        return empty_events()

    def _take_epoch(self, epoch: Epoch) -> None:
        expected_ticks = epoch.ticks if self.now_us is None else self.now_us // epoch.tick_us
        before, self._epoch = self._epoch, epoch
        self._tick_us = epoch.tick_us
        self.now_us = unwrapped(epoch.ticks, 30, expected_ticks) * epoch.tick_us
        if before is not None:
            sent = (epoch.sent - before.sent + 0x8000 & 0xFFFF) - 0x8000  # below 0 where a later frame came before
            self._count(lost=sent - self._since_epoch, dropped=(epoch.dropped - before.dropped) & 0xFFFF)
        self._since_epoch = 0

    def _take_events(self, frame: Frame) -> Events:
        if self._epoch is None or self.now_us is None:
            self._count(before_epoch=1)
            return empty_events()
        unpack = unpack_fd_events if frame.fd else unpack_events
        unpacked = unpack(frame.data, self._tick_us, self.now_us)
        if self._last == (unpacked.seq, frame.data):
            self._count(repeated=1)
            return empty_events()
        span = 256 if frame.fd else 8
        if self._last is not None and unpacked.seq != (self._last[0] + 1) % span:
            self._count(gaps=1)
        self._last = unpacked.seq, frame.data
        if len(unpacked.events):
            self.now_us = int(unpacked.events["t"][-1])
        self._since_epoch += len(unpacked.events)
        self._count(events=len(unpacked.events), before_clock=int(not self._clocked))
        return unpacked.events

    def _count(self, **increments: int) -> None:
        c = self.counters
        self.counters = replace(c, **{name: getattr(c, name) + n for name, n in increments.items()})

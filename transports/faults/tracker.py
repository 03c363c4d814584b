"""Trackers of an instrument's messages on a CAN bus with faults: by frame, or assembled from frames.

A tracker follows one frame source. It begins and ends between two messages; without a tracker, each message that left
counts as arrived.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.events import Edges, Events, empty_edges, empty_events
from firmware_protocol.instrument.instrument import Outgoing
from firmware_protocol.packets.addresses import Received
from transports.faults.bus import QueuedMessage
from transports.faults.faulty_line import ReferenceReceiver


@dataclass(frozen=True)
class Load:
    """Data of one frame, in stream time."""

    events: Events
    edges: Edges
    epoch_us: int

    @classmethod
    def of(cls, outgoing: Outgoing) -> Load:
        """Return the data of a whole message."""
        return cls(outgoing.events, outgoing.edges, outgoing.epoch_us)

    @classmethod
    def nothing(cls) -> Load:
        """Return the empty load, for a frame that the link itself makes."""
        return cls(empty_events(), empty_edges(), 0)


@dataclass(frozen=True)
class Callbacks:
    """Functions that receive the data that arrived, and the data that never will."""

    arrived: Callable[[Load], None]
    lost: Callable[[Load], None]


class Tracker(ABC):
    """Tracker of the frames of one source."""

    @abstractmethod
    def message(self, load: Load) -> QueuedMessage | None:
        """Return the callbacks for the next frame, which contains `load` if frames stand alone."""

    @abstractmethod
    def left(self, outgoing: Outgoing) -> None:
        """Record that all of a message has left the camera."""

    @abstractmethod
    def dropped(self) -> None:
        """Record that the camera has aborted the message in progress, and counts it as lost itself."""

    @property
    @abstractmethod
    def in_step(self) -> bool:
        """True when no message is outstanding."""

    def settle(self) -> None:
        """Determine the fates of the messages that have left."""
        return

    def damaged(self) -> None:
        """Record that a fault was active until now."""
        return

    def close(self) -> None:
        """Close the tracker: outstanding messages can no longer arrive."""
        return


class _Single:
    """Frame that stands alone: its fate is reported when its message has left."""

    def __init__(self, load: Load, callbacks: Callbacks) -> None:
        self._load = load
        self._callbacks: Callbacks | None = callbacks
        self._fate: Callable[[Load], None] | None = None
        self._settled = False

    def arrived(self, frame: Frame) -> None:
        if self._callbacks is not None:
            self._decide(self._callbacks.arrived)

    def gone(self) -> None:
        if self._callbacks is not None:
            self._decide(self._callbacks.lost)

    def spoilt(self) -> None:
        self.gone()

    def settle(self) -> None:
        self._settled = True
        if self._fate is not None:
            self._fate(self._load)

    def cancel(self) -> None:
        self._callbacks = None

    def _decide(self, fate: Callable[[Load], None]) -> None:
        self._callbacks = None  # the first fate counts, also for a frame that arrives twice
        self._fate = fate
        if self._settled:
            fate(self._load)


class FrameTracker(Tracker):
    """Tracker of frames that stand alone."""

    def __init__(self, callbacks: Callbacks) -> None:
        self._callbacks = callbacks
        self._under_way: list[_Single] = []

    def message(self, load: Load) -> QueuedMessage | None:
        """See `Tracker.message`."""
        if not len(load.events) and not len(load.edges):
            return None
        self._under_way.append(_Single(load, self._callbacks))
        return self._under_way[-1]

    def left(self, outgoing: Outgoing) -> None:
        """See `Tracker.left`."""
        for single in self._under_way:
            single.settle()
        self._under_way.clear()

    def dropped(self) -> None:
        """See `Tracker.dropped`."""
        for single in self._under_way:
            single.cancel()
        self._under_way.clear()

    @property
    def in_step(self) -> bool:
        """See `Tracker.in_step`."""
        return not self._under_way


class MessageTracker(Tracker):
    """Tracker of messages in several frames; `read` decodes messages from frames, as the receiver does."""

    def __init__(self, callbacks: Callbacks, read: Callable[[Frame], Iterable[Received]]) -> None:
        self._callbacks = callbacks
        self._read = read
        self._reference = ReferenceReceiver()

    def message(self, load: Load) -> QueuedMessage:
        """See `Tracker.message`."""
        return self

    def arrived(self, frame: Frame) -> None:
        """See `QueuedMessage.arrived`."""
        self._reference.came(self._read(frame))

    def gone(self) -> None:
        """See `QueuedMessage.gone`."""
        self._reference.damaged()

    def spoilt(self) -> QueuedMessage:
        """See `QueuedMessage.spoilt`."""
        self._reference.damaged()
        return self

    def left(self, outgoing: Outgoing) -> None:
        """See `Tracker.left`."""
        self._reference.left(outgoing)

    def dropped(self) -> None:
        """See `Tracker.dropped`."""
        return

    @property
    def in_step(self) -> bool:
        """See `Tracker.in_step`."""
        return self._reference.in_step

    def settle(self) -> None:
        """See `Tracker.settle`."""
        came, lost = self._reference.settle()
        for outgoing in lost:
            self._callbacks.lost(Load.of(outgoing))
        for outgoing in came:
            self._callbacks.arrived(Load.of(outgoing))

    def damaged(self) -> None:
        """See `Tracker.damaged`."""
        self._reference.damaged()

    def close(self) -> None:
        """See `Tracker.close`."""
        self.settle()
        for outgoing in self._reference.give_up():
            self._callbacks.lost(Load.of(outgoing))

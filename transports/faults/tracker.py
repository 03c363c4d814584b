"""Trackers of an instrument's messages on a CAN bus with faults: frame by frame, or put together from frames.

A tracker goes with one frame source. It begins and ends between two messages; while there is none, each message that
left counts as arrived.
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
from transports.faults.line import ReferenceReceiver

__all__ = ["Callbacks", "FrameTracker", "Load", "MessageTracker", "Tracker"]


@dataclass(frozen=True)
class Load:
    """What one frame carries by itself, in stream time."""

    events: Events
    edges: Edges
    epoch_us: int

    @classmethod
    def of(cls, outgoing: Outgoing) -> Load:
        """Return what a whole message carries."""
        return cls(outgoing.events, outgoing.edges, outgoing.epoch_us)

    @classmethod
    def nothing(cls) -> Load:
        """Return what a frame carries that is of the link's own making."""
        return cls(empty_events(), empty_edges(), 0)


@dataclass(frozen=True)
class Callbacks:
    """Who is told of what has arrived, and of what never will."""

    arrived: Callable[[Load], None]
    lost: Callable[[Load], None]


class Tracker(ABC):
    """Follows the frames of one source."""

    @abstractmethod
    def message(self, load: Load) -> QueuedMessage | None:
        """Return what depends on the next frame, which carries `load` where frames stand alone."""

    @abstractmethod
    def left(self, outgoing: Outgoing) -> None:
        """All of a message has left the camera."""

    @abstractmethod
    def dropped(self) -> None:
        """The camera has given up the message under way, and counts it as lost itself."""

    @property
    @abstractmethod
    def in_step(self) -> bool:
        """True when nothing is outstanding."""

    def settle(self) -> None:
        """Find out what came of what has left."""
        return

    def damaged(self) -> None:
        """A fault has been at work until now."""
        return

    def close(self) -> None:
        """Nothing more will come of what is outstanding."""
        return


class _Single:
    """A frame that stands alone: what is told of it waits until its message has left."""

    def __init__(self, load: Load, tell: Callbacks) -> None:
        self._load = load
        self._tell: Callbacks | None = tell
        self._fate: Callable[[Load], None] | None = None
        self._settled = False

    def arrived(self, frame: Frame) -> None:
        if self._tell is not None:
            self._decide(self._tell.arrived)

    def gone(self) -> None:
        if self._tell is not None:
            self._decide(self._tell.lost)

    def spoilt(self) -> None:
        self.gone()

    def settle(self) -> None:
        self._settled = True
        if self._fate is not None:
            self._fate(self._load)

    def cancel(self) -> None:
        self._tell = None

    def _decide(self, fate: Callable[[Load], None]) -> None:
        self._tell = None  # the first fate counts, also of a frame that comes twice
        self._fate = fate
        if self._settled:
            fate(self._load)


class FrameTracker(Tracker):
    """Of frames that stand alone."""

    def __init__(self, tell: Callbacks) -> None:
        self._tell = tell
        self._under_way: list[_Single] = []

    def message(self, load: Load) -> QueuedMessage | None:
        """See `Tracker.message`."""
        if not len(load.events) and not len(load.edges):
            return None
        self._under_way.append(_Single(load, self._tell))
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
    """Of messages cut into frames; `read` makes messages of frames, as at the other side."""

    def __init__(self, tell: Callbacks, read: Callable[[Frame], Iterable[Received]]) -> None:
        self._tell = tell
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
            self._tell.lost(Load.of(outgoing))
        for outgoing in came:
            self._tell.arrived(Load.of(outgoing))

    def damaged(self) -> None:
        """See `Tracker.damaged`."""
        self._reference.damaged()

    def close(self) -> None:
        """See `Tracker.close`."""
        self.settle()
        for outgoing in self._reference.give_up():
            self._tell.lost(Load.of(outgoing))

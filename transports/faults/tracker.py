"""What becomes of an instrument's messages on a CAN bus with faults: frame by frame, or put together from frames.

A watch goes with one frame source. It begins and ends between two messages; while there is none, what a source says has
left counts as arrived.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.events import Events, empty_events
from firmware_protocol.instrument.outgoing import Outgoing
from firmware_protocol.packets.message import Received
from transports.faults.bus import Cargo
from transports.faults.reference_receiver import Witness

__all__ = ["FrameWatch", "Load", "MessageWatch", "Tell", "Watch"]


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
class Tell:
    """Who is told of what has arrived, and of what never will."""

    arrived: Callable[[Load], None]
    lost: Callable[[Load], None]


class Watch(ABC):
    """Follows the frames of one source."""

    @abstractmethod
    def cargo(self, load: Load) -> Cargo | None:
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

    def __init__(self, load: Load, tell: Tell) -> None:
        self._load = load
        self._tell: Tell | None = tell
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


class FrameWatch(Watch):
    """Of frames that stand alone."""

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._under_way: list[_Single] = []

    def cargo(self, load: Load) -> Cargo | None:
        """See `Watch.cargo`."""
        if not len(load.events) and not len(load.edges):
            return None
        self._under_way.append(_Single(load, self._tell))
        return self._under_way[-1]

    def left(self, outgoing: Outgoing) -> None:
        """See `Watch.left`."""
        for single in self._under_way:
            single.settle()
        self._under_way.clear()

    def dropped(self) -> None:
        """See `Watch.dropped`."""
        for single in self._under_way:
            single.cancel()
        self._under_way.clear()

    @property
    def in_step(self) -> bool:
        """See `Watch.in_step`."""
        return not self._under_way


class MessageWatch(Watch):
    """Of messages cut into frames; `read` makes messages of frames, as at the other side."""

    def __init__(self, tell: Tell, read: Callable[[Frame], Iterable[Received]]) -> None:
        self._tell = tell
        self._read = read
        self._witness = Witness()

    def cargo(self, load: Load) -> Cargo:
        """See `Watch.cargo`."""
        return self

    def arrived(self, frame: Frame) -> None:
        """See `Cargo.arrived`."""
        self._witness.came(self._read(frame))

    def gone(self) -> None:
        """See `Cargo.gone`."""
        self._witness.damaged()

    def spoilt(self) -> Cargo:
        """See `Cargo.spoilt`."""
        self._witness.damaged()
        return self

    def left(self, outgoing: Outgoing) -> None:
        """See `Watch.left`."""
        self._witness.left(outgoing)

    def dropped(self) -> None:
        """See `Watch.dropped`."""
        return

    @property
    def in_step(self) -> bool:
        """See `Watch.in_step`."""
        return self._witness.in_step

    def settle(self) -> None:
        """See `Watch.settle`."""
        came, lost = self._witness.settle()
        for outgoing in lost:
            self._tell.lost(Load.of(outgoing))
        for outgoing in came:
            self._tell.arrived(Load.of(outgoing))

    def damaged(self) -> None:
        """See `Watch.damaged`."""
        self._witness.damaged()

    def close(self) -> None:
        """See `Watch.close`."""
        self.settle()
        for outgoing in self._witness.give_up():
            self._tell.lost(Load.of(outgoing))

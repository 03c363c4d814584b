"""Faults of a CAN bus: their tables in a rig, and their effects on the frames of a node and on the bus. Sans-I/O.

See `kinds` for the attributes that all faults have.

A `Tracker` finds the messages of an instrument that survive, by frame or assembled from frames. It follows one frame
source, and begins and ends between two messages; without a tracker, each message that left counts as arrived.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Protocol

import numpy as np
from msgspec import Meta

from firmware_protocol.can_frames.frame import BitRates, Frame, frame_bits
from firmware_protocol.device.items import Items
from firmware_protocol.instrument.instrument import Outgoing
from firmware_protocol.packets.addresses import Received
from transports.faults.faulty_line import ReferenceReceiver
from transports.faults.kinds import CAN_BUS, Delay, HitFault, HitStage, ItemStage, LastingFault, Repetition, Stage

_PROTOCOL_ERROR = 0x88  # CAN_ERR_PROT | CAN_ERR_BUSERROR of linux/can/error.h
_BUSES = {"A": 0, "B": 1}


class QueuedMessage(Protocol):
    """Callbacks that depend on the arrival of a frame."""

    def arrived(self, frame: Frame) -> None:
        """Record that another node has received the frame."""

    def gone(self) -> None:
        """Record that no other node will receive the frame."""

    def spoilt(self) -> QueuedMessage | None:
        """Record that the frame's data are wrong; return the callbacks that now depend on its arrival."""


@dataclass(frozen=True)
class QueuedFrame:
    """Frame in the queue to the bus; `exempt` from faults if its message was in progress when they began."""

    frame: Frame
    urgent: bool = False
    message: QueuedMessage | None = None
    exempt: bool = False


class _HitFrames(HitStage[QueuedFrame]):
    """Fault of single frames; the generator of the places is separate, so that further draws do not move them."""

    def __init__(self, fault: HitFault, random: np.random.Generator, carrier: BitRates) -> None:
        super().__init__(fault, random.spawn(1)[0], carrier)


class _Lost(_HitFrames):
    def change(self, item: QueuedFrame) -> list[QueuedFrame]:
        if not self.is_hit():
            return [item]
        if item.message is not None:
            item.message.gone()
        return []


@dataclass(frozen=True)
class LostFrames(HitFault, carriers=(CAN_BUS,), effect=_Lost):
    """Frames that no node receives: a bus repeats damaged frames, but a gateway or a full receiver loses frames."""


class _Repeated(_HitFrames, Repetition[QueuedFrame]):
    pass


@dataclass(frozen=True)
class RepeatedFrames(HitFault, carriers=(CAN_BUS,), effect=_Repeated):
    """Frames that arrive twice, as when the last bit of a good frame is disturbed and the sender repeats it."""


class _Overtaken(Delay[QueuedFrame]):
    def change(self, item: QueuedFrame) -> list[QueuedFrame]:
        if item.urgent:
            return [item]  # urgent frames are sent separately
        overtakes = bool(self._held)
        passed = super().change(item)
        self.touched += overtakes and bool(passed)
        return passed


@dataclass(frozen=True)
class ReorderedFrames(HitFault, carriers=(CAN_BUS,)):
    """Frames that later frames overtake, as in a controller with several transmit buffers, or a gateway.

    Attributes
    ----------
    behind : number of frames that overtake it.
    """

    behind: Annotated[int, Meta(ge=1, le=1000)] = 1

    def stage(self, random: np.random.Generator, carrier: BitRates) -> Stage:
        """Return the delay of frames until `behind` others have passed."""
        return _Overtaken(self, random, self.behind)


class _Changed(_HitFrames):
    def __init__(self, fault: HitFault, random: np.random.Generator, carrier: BitRates) -> None:
        super().__init__(fault, random, carrier)
        self._bits = random.spawn(1)[0]

    def change(self, item: QueuedFrame) -> list[QueuedFrame]:
        if not self.is_hit() or not item.frame.data:
            return [item]
        data = bytearray(item.frame.data)
        bit = int(self._bits.integers(8 * len(data)))
        data[bit >> 3] ^= 1 << (bit & 7)
        message = None if item.message is None else item.message.spoilt()
        return [replace(item, frame=replace(item.frame, data=bytes(data)), message=message)]


@dataclass(frozen=True)
class ChangedFrames(HitFault, carriers=(CAN_BUS,), effect=_Changed):
    """One inverted bit in a frame's data. The CRC of a real bus would detect it; the memory of a gateway does not."""


class _Destroyed(_HitFrames):
    def change(self, item: QueuedFrame) -> list[QueuedFrame]:
        error = QueuedFrame(Frame(_PROTOCOL_ERROR, bytes(8), error=True), item.urgent)
        return [error, item] if self.is_hit() else [item]


@dataclass(frozen=True)
class ErrorFrames(HitFault, carriers=(CAN_BUS,), effect=_Destroyed):
    """Frames that are destroyed on the bus: an error frame, then the frame again. Only time is lost."""


@dataclass(frozen=True)
class _OfBus(LastingFault):
    """Fault of one bus of a link.

    Attributes
    ----------
    bus : "A" or, if the link has a redundant bus, "B".
    """

    bus: Literal["A", "B"] = "A"


class BusStage(ItemStage[QueuedFrame]):
    """One active fault of a bus itself; frames pass it unchanged.

    Attributes
    ----------
    bus : the bus that is off, dead or flooded.
    off, dead : state of that bus.
    """

    def __init__(self, fault: _OfBus, random: np.random.Generator, carrier: BitRates) -> None:
        super().__init__(fault, random, carrier)
        self.bus = _BUSES[fault.bus]
        self.off, self.dead = isinstance(fault, BusOff), isinstance(fault, DeadBus)
        self.hits = int(self.off or self.dead)


@dataclass(frozen=True)
class BusOff(_OfBus, carriers=(CAN_BUS,), effect=BusStage):
    """The camera's controller has counted too many errors and left the bus; it returns at the end of the fault."""


@dataclass(frozen=True)
class DeadBus(_OfBus, carriers=(CAN_BUS,), effect=BusStage):
    """The bus is cut at the camera: it receives no frames, and no node receives its frames."""


class Babbler(BusStage):
    """Node that floods the bus; `due` returns the times of its frames."""

    def __init__(self, fault: BabblingIdiot, random: np.random.Generator, carrier: BitRates) -> None:
        super().__init__(fault, random, carrier)
        self.frame = Frame(fault.identifier, bytes(8))
        self._period_ns = round(carrier.duration_ns(frame_bits(self.frame)) / fault.load)
        self._next_ns: int | None = None

    def due(self, until_ns: int) -> list[int]:
        """Return the times of its frames since the last call and until `until_ns`, ns."""
        if self._next_ns is None:
            self._next_ns = until_ns
        times = list(range(self._next_ns, until_ns, self._period_ns))
        self._next_ns += len(times) * self._period_ns
        self.hits = 1
        self.touched += len(times)
        return times


@dataclass(frozen=True)
class BabblingIdiot(_OfBus, carriers=(CAN_BUS,), effect=Babbler):
    """A node that floods the bus.

    Attributes
    ----------
    identifier : identifier of its frames, 11 bits: a lower one delays other nodes more.
    load : share of the bus's time that it requests.
    """

    identifier: Annotated[int, Meta(ge=0, le=2047)] = 0
    load: Annotated[float, Meta(gt=0, le=1)] = 1.0


@dataclass(frozen=True)
class Callbacks:
    """Functions that receive the data that arrived, and the data that never will."""

    arrived: Callable[[Items], None]
    lost: Callable[[Items], None]


class Tracker(ABC):
    """Tracker of the frames of one source."""

    @abstractmethod
    def message(self, load: Items) -> QueuedMessage | None:
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

    def __init__(self, load: Items, callbacks: Callbacks) -> None:
        self._load = load
        self._callbacks: Callbacks | None = callbacks
        self._fate: Callable[[Items], None] | None = None
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

    def _decide(self, fate: Callable[[Items], None]) -> None:
        self._callbacks = None  # the first fate counts, also for a frame that arrives twice
        self._fate = fate
        if self._settled:
            fate(self._load)


class FrameTracker(Tracker):
    """Tracker of frames that stand alone."""

    def __init__(self, callbacks: Callbacks) -> None:
        self._callbacks = callbacks
        self._under_way: list[_Single] = []

    def message(self, load: Items) -> QueuedMessage | None:
        """Return the callbacks of a frame with data; None for one without."""
        if not len(load.events) and not len(load.edges):
            return None
        self._under_way.append(_Single(load, self._callbacks))
        return self._under_way[-1]

    def left(self, outgoing: Outgoing) -> None:
        """Report the fates of the message's frames, now that all of them have left."""
        for single in self._under_way:
            single.settle()
        self._under_way.clear()

    def dropped(self) -> None:
        """Report no fate for the frames of the message in progress."""
        for single in self._under_way:
            single.cancel()
        self._under_way.clear()

    @property
    def in_step(self) -> bool:
        """True when no frame's fate is open."""
        return not self._under_way


class MessageTracker(Tracker):
    """Tracker of messages in several frames; `read` decodes messages from frames, as the receiver does."""

    def __init__(self, callbacks: Callbacks, read: Callable[[Frame], Iterable[Received]]) -> None:
        self._callbacks = callbacks
        self._read = read
        self._reference = ReferenceReceiver()

    def message(self, load: Items) -> QueuedMessage:
        """Return this tracker: the fate of a message depends on all its frames."""
        return self

    def arrived(self, frame: Frame) -> None:
        """Decode a frame as the receiver does."""
        self._reference.came(self._read(frame))

    def gone(self) -> None:
        """Record that a frame will not arrive."""
        self._reference.damaged()

    def spoilt(self) -> QueuedMessage:
        """Record that a frame's data are wrong; it is decoded all the same."""
        self._reference.damaged()
        return self

    def left(self, outgoing: Outgoing) -> None:
        """Expect a message whose last frame has left."""
        self._reference.left(outgoing)

    def dropped(self) -> None:
        """Do nothing: an aborted message is not expected."""
        return

    @property
    def in_step(self) -> bool:
        """True when no message is outstanding and messages arrive whole again."""
        return self._reference.in_step

    def settle(self) -> None:
        """Report the messages that arrived whole, and those that are now known to be lost."""
        came, lost = self._reference.settle()
        for outgoing in lost:
            self._callbacks.lost(outgoing)
        for outgoing in came:
            self._callbacks.arrived(outgoing)

    def damaged(self) -> None:
        """Record that a fault was active until now."""
        self._reference.damaged()

    def close(self) -> None:
        """Report outstanding messages as lost."""
        self.settle()
        for outgoing in self._reference.give_up():
            self._callbacks.lost(outgoing)

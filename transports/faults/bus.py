"""Faults of a CAN bus: their tables in a rig, and their effects on the frames of a node and on the bus. Sans-I/O.

See `kinds` for the attributes that all faults have.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Protocol

import numpy as np

from firmware_protocol.can_frames.bus_time import BitRates, frame_bits
from firmware_protocol.can_frames.frame import Frame
from transports.faults.kinds import Fault, HitFault, LastingFault, Places

__all__ = [
    "CAN_FAULTS",
    "Babbler",
    "BabblingIdiot",
    "BusOff",
    "ChangedFrames",
    "DeadBus",
    "ErrorFrames",
    "FrameStage",
    "LostFrames",
    "QueuedFrame",
    "QueuedMessage",
    "ReorderedFrames",
    "RepeatedFrames",
    "frame_stage",
]


@dataclass(frozen=True)
class LostFrames(HitFault):
    """Frames that no node receives: a bus repeats damaged frames, but a gateway or a full receiver loses frames."""

    kind: ClassVar[str] = "lost_frames"


@dataclass(frozen=True)
class RepeatedFrames(HitFault):
    """Frames that arrive twice, as when the last bit of a good frame is disturbed and the sender repeats it."""

    kind: ClassVar[str] = "repeated_frames"


@dataclass(frozen=True)
class ReorderedFrames(HitFault):
    """Frames that later frames overtake, as in a controller with several transmit buffers, or a gateway.

    Attributes
    ----------
    behind
        Number of frames that overtake it.
    """

    kind: ClassVar[str] = "reordered_frames"
    behind: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.behind <= 1000:
            raise ValueError(f"behind must be 1 to 1000 frames, got {self.behind}")


@dataclass(frozen=True)
class ChangedFrames(HitFault):
    """One inverted bit in a frame's data. The CRC of a real bus would detect it; the memory of a gateway does not."""

    kind: ClassVar[str] = "changed_frames"


@dataclass(frozen=True)
class ErrorFrames(HitFault):
    """Frames that are destroyed on the bus: an error frame, then the frame again. Only time is lost."""

    kind: ClassVar[str] = "error_frames"


@dataclass(frozen=True)
class _OfBus(LastingFault):
    """Fault of one bus of a link.

    Attributes
    ----------
    bus
        "A" or, if the link has a redundant bus, "B".
    """

    bus: Literal["A", "B"] = "A"


@dataclass(frozen=True)
class BusOff(_OfBus):
    """The camera's controller has counted too many errors and left the bus; it returns at the end of the fault."""

    kind: ClassVar[str] = "bus_off"


@dataclass(frozen=True)
class DeadBus(_OfBus):
    """The bus is cut at the camera: it receives no frames, and no node receives its frames."""

    kind: ClassVar[str] = "dead_bus"


@dataclass(frozen=True)
class BabblingIdiot(_OfBus):
    """A node that floods the bus.

    Attributes
    ----------
    identifier
        Identifier of its frames, 11 bits: a lower one delays other nodes more.
    load
        Share of the bus's time that it requests.
    """

    kind: ClassVar[str] = "babbling_idiot"
    identifier: int = 0
    load: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.identifier < 1 << 11:
            raise ValueError(f"identifier must be 0 to 2047, got {self.identifier}")
        if not 0 < self.load <= 1:
            raise ValueError(f"load must be above 0 and at most 1, got {self.load}")


CAN_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each
    for each in (
        *(LostFrames, RepeatedFrames, ReorderedFrames, ChangedFrames, ErrorFrames),
        *(BusOff, DeadBus, BabblingIdiot),
    )
}
"""Faults of a CAN bus, by kind."""


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


class FrameStage:
    """One active fault; the base class passes frames unchanged.

    Attributes
    ----------
    hits
        Number of times that it was applied.
    touched
        Number of frames that it changed, removed, inserted or held.
    over
        True when it has no further effect.
    bus
        The bus that is off, dead or flooded; None for faults of frames.
    off, dead
        State of that bus.
    """

    bus: int | None = None
    off = dead = False

    def __init__(self) -> None:
        self.hits = self.touched = 0
        self.over = False

    def change(self, queued: QueuedFrame) -> list[QueuedFrame]:
        """Return the frames that go to the bus in place of `queued`."""
        return [queued]

    def finish(self) -> list[QueuedFrame]:
        """Return the frames that go to the bus at the end of the fault."""
        return []


class _Hitting(FrameStage):
    """Fault that is applied to each frame that is hit."""

    def __init__(self, fault: HitFault, random: np.random.Generator) -> None:
        super().__init__()
        where, self._random = random.spawn(2)
        self._where = Places(fault, where)

    def change(self, queued: QueuedFrame) -> list[QueuedFrame]:
        if not self._where.within(1):
            return [queued]
        self.hits += 1
        self.touched += 1
        self.over = self._where.over
        return self._hit(queued)

    def _hit(self, queued: QueuedFrame) -> list[QueuedFrame]:
        return [queued, queued]


class _Lost(_Hitting):
    def _hit(self, queued: QueuedFrame) -> list[QueuedFrame]:
        if queued.message is not None:
            queued.message.gone()
        return []


class _Changed(_Hitting):
    def _hit(self, queued: QueuedFrame) -> list[QueuedFrame]:
        data = bytearray(queued.frame.data)
        if not data:
            return [queued]
        bit = int(self._random.integers(8 * len(data)))
        data[bit >> 3] ^= 1 << (bit & 7)
        message = None if queued.message is None else queued.message.spoilt()
        return [replace(queued, frame=replace(queued.frame, data=bytes(data)), message=message)]


class _Destroyed(_Hitting):
    def _hit(self, queued: QueuedFrame) -> list[QueuedFrame]:
        return [QueuedFrame(Frame(_PROTOCOL_ERROR, bytes(8), error=True), queued.urgent), queued]


class _Overtaken(FrameStage):
    def __init__(self, fault: ReorderedFrames, random: np.random.Generator) -> None:
        super().__init__()
        self._where = Places(fault, random)
        self._behind = fault.behind
        self._held: deque[tuple[QueuedFrame, int]] = deque()  # each with the number of frames that still overtake it

    def change(self, queued: QueuedFrame) -> list[QueuedFrame]:
        if queued.urgent:
            return [queued]  # urgent frames are sent separately
        if self._where.within(1):
            self.hits += 1
            self.touched += 1
            self._held.append((queued, self._behind))
            return []
        self.touched += bool(self._held)
        self._held = deque((held, left - 1) for held, left in self._held)
        out = [queued]
        while self._held and self._held[0][1] <= 0:
            out.append(self._held.popleft()[0])
        self.over = self._where.over and not self._held
        return out

    def finish(self) -> list[QueuedFrame]:
        return [held for held, _ in self._held]


class _Bus(FrameStage):
    def __init__(self, fault: BusOff | DeadBus) -> None:
        super().__init__()
        self.bus = _BUSES[fault.bus]
        self.off, self.dead = isinstance(fault, BusOff), isinstance(fault, DeadBus)
        self.hits = 1


class Babbler(FrameStage):
    """Node that floods the bus; `due` returns the times of its frames."""

    def __init__(self, fault: BabblingIdiot, rates: BitRates) -> None:
        super().__init__()
        self.bus = _BUSES[fault.bus]
        self.frame = Frame(fault.identifier, bytes(8))
        self._period_ns = round(rates.duration_ns(frame_bits(self.frame)) / fault.load)
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


def frame_stage(fault: Fault, random: np.random.Generator, rates: BitRates) -> FrameStage:
    """Return the stage of a fault on a bus of these bit rates.

    Raises ValueError for a fault that a bus does not have.
    """
    match fault:
        case LostFrames():
            return _Lost(fault, random)
        case RepeatedFrames():
            return _Hitting(fault, random)
        case ReorderedFrames():
            return _Overtaken(fault, random)
        case ChangedFrames():
            return _Changed(fault, random)
        case ErrorFrames():
            return _Destroyed(fault, random)
        case BusOff() | DeadBus():
            return _Bus(fault)
        case BabblingIdiot():
            return Babbler(fault, rates)
    raise ValueError(f"{fault.kind!r} is no fault of a CAN bus")

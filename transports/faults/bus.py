"""Faults of a CAN bus: their tables in a rig, and their effects on the frames of a node and on the bus. Sans-I/O.

See `kinds` for the attributes that all faults have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Protocol

import numpy as np

from firmware_protocol.can_frames.frame import BitRates, Frame, frame_bits
from transports.faults.items import Delay, HitStage, ItemStage, Repetition
from transports.faults.kinds import CAN_BUS, HitFault, LastingFault, Stage

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
class LostFrames(HitFault):
    """Frames that no node receives: a bus repeats damaged frames, but a gateway or a full receiver loses frames."""

    kind: ClassVar[str] = "lost_frames"
    carriers = (CAN_BUS,)
    effect: ClassVar[type[Stage]] = _Lost


class _Repeated(_HitFrames, Repetition[QueuedFrame]):
    pass


@dataclass(frozen=True)
class RepeatedFrames(HitFault):
    """Frames that arrive twice, as when the last bit of a good frame is disturbed and the sender repeats it."""

    kind: ClassVar[str] = "repeated_frames"
    carriers = (CAN_BUS,)
    effect: ClassVar[type[Stage]] = _Repeated


class _Overtaken(Delay[QueuedFrame]):
    def change(self, item: QueuedFrame) -> list[QueuedFrame]:
        if item.urgent:
            return [item]  # urgent frames are sent separately
        overtakes = bool(self._held)
        passed = super().change(item)
        self.touched += overtakes and bool(passed)
        return passed


@dataclass(frozen=True)
class ReorderedFrames(HitFault):
    """Frames that later frames overtake, as in a controller with several transmit buffers, or a gateway.

    Attributes
    ----------
    behind
        Number of frames that overtake it.
    """

    kind: ClassVar[str] = "reordered_frames"
    carriers = (CAN_BUS,)
    behind: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.behind <= 1000:
            raise ValueError(f"behind must be 1 to 1000 frames, got {self.behind}")

    def stage(self, random: np.random.Generator, carrier: BitRates) -> Stage:
        """See `Fault.stage`."""
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
class ChangedFrames(HitFault):
    """One inverted bit in a frame's data. The CRC of a real bus would detect it; the memory of a gateway does not."""

    kind: ClassVar[str] = "changed_frames"
    carriers = (CAN_BUS,)
    effect: ClassVar[type[Stage]] = _Changed


class _Destroyed(_HitFrames):
    def change(self, item: QueuedFrame) -> list[QueuedFrame]:
        error = QueuedFrame(Frame(_PROTOCOL_ERROR, bytes(8), error=True), item.urgent)
        return [error, item] if self.is_hit() else [item]


@dataclass(frozen=True)
class ErrorFrames(HitFault):
    """Frames that are destroyed on the bus: an error frame, then the frame again. Only time is lost."""

    kind: ClassVar[str] = "error_frames"
    carriers = (CAN_BUS,)
    effect: ClassVar[type[Stage]] = _Destroyed


@dataclass(frozen=True)
class _OfBus(LastingFault):
    """Fault of one bus of a link.

    Attributes
    ----------
    bus
        "A" or, if the link has a redundant bus, "B".
    """

    bus: Literal["A", "B"] = "A"


class BusStage(ItemStage[QueuedFrame]):
    """One active fault of a bus itself; frames pass it unchanged.

    Attributes
    ----------
    bus
        The bus that is off, dead or flooded.
    off, dead
        State of that bus.
    """

    off = dead = False

    def __init__(self, fault: _OfBus, random: np.random.Generator, carrier: BitRates) -> None:
        super().__init__(fault, random, carrier)
        self.bus = _BUSES[fault.bus]
        self.hits = int(self.off or self.dead)


class _Off(BusStage):
    off = True


class _Dead(BusStage):
    dead = True


@dataclass(frozen=True)
class BusOff(_OfBus):
    """The camera's controller has counted too many errors and left the bus; it returns at the end of the fault."""

    kind: ClassVar[str] = "bus_off"
    carriers = (CAN_BUS,)
    effect: ClassVar[type[Stage]] = _Off


@dataclass(frozen=True)
class DeadBus(_OfBus):
    """The bus is cut at the camera: it receives no frames, and no node receives its frames."""

    kind: ClassVar[str] = "dead_bus"
    carriers = (CAN_BUS,)
    effect: ClassVar[type[Stage]] = _Dead


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
    carriers = (CAN_BUS,)
    effect: ClassVar[type[Stage]] = Babbler
    identifier: int = 0
    load: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.identifier < 1 << 11:
            raise ValueError(f"identifier must be 0 to 2047, got {self.identifier}")
        if not 0 < self.load <= 1:
            raise ValueError(f"load must be above 0 and at most 1, got {self.load}")

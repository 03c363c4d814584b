"""The faults of a CAN bus, as a rig writes them; see `kinds`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from transports.faults.kinds import Fault, HitFault, LastingFault

__all__ = [
    "CAN_FAULTS",
    "BabblingIdiot",
    "BusOff",
    "ChangedFrames",
    "DeadBus",
    "ErrorFrames",
    "LostFrames",
    "ReorderedFrames",
    "RepeatedFrames",
]


@dataclass(frozen=True)
class LostFrames(HitFault):
    """Frames that no other node takes: a bus repeats what it damages, but a gateway or a full receiver loses frames."""

    kind: ClassVar[str] = "lost_frames"


@dataclass(frozen=True)
class RepeatedFrames(HitFault):
    """Frames that come twice, as when the last bit of a good frame is disturbed and the sender repeats it."""

    kind: ClassVar[str] = "repeated_frames"


@dataclass(frozen=True)
class ReorderedFrames(HitFault):
    """Frames that others overtake, as in a controller with several transmit buffers, or a gateway.

    Attributes
    ----------
    behind
        How many frames overtake it.
    """

    kind: ClassVar[str] = "reordered_frames"
    behind: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.behind <= 1000:
            raise ValueError(f"behind must be 1 to 1000 frames, got {self.behind}")


@dataclass(frozen=True)
class ChangedFrames(HitFault):
    """One bit of a frame's data turned over. The CRC of a real bus would not let that pass; a gateway's memory does."""

    kind: ClassVar[str] = "changed_frames"


@dataclass(frozen=True)
class ErrorFrames(HitFault):
    """Frames that are destroyed on the bus: an error frame, and the frame again. Only time is lost."""

    kind: ClassVar[str] = "error_frames"


@dataclass(frozen=True)
class _OfBus(LastingFault):
    """Of one bus of a link.

    Attributes
    ----------
    bus
        "A" or, where the link has a redundant bus, "B".
    """

    bus: Literal["A", "B"] = "A"


@dataclass(frozen=True)
class BusOff(_OfBus):
    """The camera's controller has seen too many errors and left the bus; it comes back when this is over."""

    kind: ClassVar[str] = "bus_off"


@dataclass(frozen=True)
class DeadBus(_OfBus):
    """The bus is cut at the camera: it hears nobody, and nobody hears it."""

    kind: ClassVar[str] = "dead_bus"


@dataclass(frozen=True)
class BabblingIdiot(_OfBus):
    """A node that floods the bus.

    Attributes
    ----------
    identifier
        Of its frames, 11 bits: the lower, the more others have to wait.
    load
        Share of the bus's time that it asks for.
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

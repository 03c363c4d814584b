"""The faults that a link can be given, as a rig writes them: a table with a `kind`, one frozen dataclass each.

A fault begins at `at_s` of stream time and lasts `for_s`. Those that hit single bits, bytes or frames hit each with a
chance of `rate` and are over after `count` hits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

__all__ = [
    "CAN_FAULTS",
    "SERIAL_FAULTS",
    "USB_FAULTS",
    "BabblingIdiot",
    "BitFlips",
    "Burst",
    "BusOff",
    "ChangedFrames",
    "DeadBus",
    "ErrorFrames",
    "Fault",
    "HitFault",
    "InsertedBytes",
    "LastingFault",
    "LostBytes",
    "LostFrames",
    "Overrun",
    "ReorderedFrames",
    "RepeatedFrames",
    "ShortTransfers",
    "Stall",
    "StuckLine",
    "Unplugged",
    "UsbSilence",
    "UsbStall",
    "UsbUnplugged",
    "WrongBaud",
]

_LONGEST_S = 3.2e7  # a year, as a run


@dataclass(frozen=True)
class Fault:
    """What all faults have in common.

    Attributes
    ----------
    link
        Name of the link; "" where only one link can have this fault.
    at_s
        Stream time at which it begins.
    for_s
        How long it lasts, in stream time; 0: until it has hit `count` times.
    """

    kind: ClassVar[str] = ""
    link: str = ""
    at_s: float = 0.0
    for_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("at_s", "for_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0 <= value <= _LONGEST_S):
                raise ValueError(f"{name} must be 0 to 3.2e7 (a year), got {value}")


@dataclass(frozen=True)
class HitFault(Fault):
    """Hits single bits, bytes or frames.

    Attributes
    ----------
    rate
        Chance for each, above 0 to 1. With the defaults the next one is hit, once.
    count
        Over after so many hits; 0: no limit, then for_s says when it ends.
    """

    rate: float = 1.0
    count: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.rate <= 1:
            raise ValueError(f"rate must be above 0 and at most 1, got {self.rate}")
        if self.count < 0:
            raise ValueError(f"count must be 0 (no limit) or more, got {self.count}")
        if not self.count and not self.for_s:
            raise ValueError("for_s is 0 and so is count: say when it is over")


@dataclass(frozen=True)
class LastingFault(Fault):
    """Is there for a while."""

    for_s: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.for_s:
            raise ValueError("for_s must be above 0: this fault lasts for a while")


@dataclass(frozen=True)
class BitFlips(HitFault):
    """Single bits turned over: noise on the line. `rate` is the bit error rate."""

    kind: ClassVar[str] = "bit_flips"


@dataclass(frozen=True)
class InsertedBytes(HitFault):
    """Bytes that nobody sent, random ones, before those that are hit."""

    kind: ClassVar[str] = "inserted_bytes"


@dataclass(frozen=True)
class LostBytes(HitFault):
    """Single bytes that never arrive."""

    kind: ClassVar[str] = "lost_bytes"


@dataclass(frozen=True)
class Burst(HitFault):
    """A burst of noise: a run of bytes replaced by random ones.

    Attributes
    ----------
    length
        Bytes of one burst.
    """

    kind: ClassVar[str] = "burst"
    length: int = 32

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.length <= 1_000_000:
            raise ValueError(f"length must be 1 to 1000000 bytes, got {self.length}")


@dataclass(frozen=True)
class Overrun(HitFault):
    """The receiver comes too late to empty its FIFO: it keeps what fits and loses what comes until then.

    Attributes
    ----------
    late_us
        From the byte that is hit until the receiver looks again.
    fifo_bytes
        What it keeps meanwhile: 16 in a 16550, 1 in a UART without a FIFO.
    """

    kind: ClassVar[str] = "overrun"
    late_us: float = 1000.0
    fifo_bytes: int = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.late_us <= 1e7:
            raise ValueError(f"late_us must be above 0 and at most 1e7, got {self.late_us}")
        if not 1 <= self.fifo_bytes <= 65_536:
            raise ValueError(f"fifo_bytes must be 1 to 65536, got {self.fifo_bytes}")


@dataclass(frozen=True)
class StuckLine(LastingFault):
    """The line does not move: what is sent meanwhile is lost.

    Attributes
    ----------
    level
        "low": a break, of which a UART makes one zero byte; "high": a broken wire, on which nothing comes.
    """

    kind: ClassVar[str] = "stuck_line"
    level: Literal["low", "high"] = "low"


@dataclass(frozen=True)
class WrongBaud(LastingFault):
    """The receiver samples the line at another baud rate: garbage, computed from the bits.

    Attributes
    ----------
    ratio
        Baud rate of the receiver over that of the sender.
    """

    kind: ClassVar[str] = "wrong_baud"
    ratio: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.1 <= self.ratio <= 10:
            raise ValueError(f"ratio must be 0.1 to 10, got {self.ratio}")


@dataclass(frozen=True)
class Stall(LastingFault):
    """The receiver holds the sender (XOFF, RTS, a full buffer): nothing leaves, and the camera's queue fills."""

    kind: ClassVar[str] = "stall"


@dataclass(frozen=True)
class Unplugged(LastingFault):
    """The port goes away and comes back, as an adapter does that is pulled out; it is found within half a second."""

    kind: ClassVar[str] = "unplugged"


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


@dataclass(frozen=True)
class UsbSilence(LastingFault):
    """The endpoint has nothing to say (NAK): the host's transfers wait, and the camera's FIFO fills.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint; 2 bears a DAVIS346's data.
    """

    kind: ClassVar[str] = "usb_silence"
    endpoint: int = 2


@dataclass(frozen=True)
class UsbStall(Fault):
    """The endpoint halts (STALL) until the host clears the halt: libcaer takes that for an unplugged camera.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint.
    count
        How often: it halts again when the host has cleared it.
    """

    kind: ClassVar[str] = "usb_stall"
    endpoint: int = 2
    count: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.count < 1:
            raise ValueError(f"count must be 1 or more, got {self.count}")


@dataclass(frozen=True)
class ShortTransfers(LastingFault):
    """Transfers end early, with a short packet: a host must not count on full buffers.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint.
    most_bytes
        Of one transfer.
    """

    kind: ClassVar[str] = "short_transfers"
    endpoint: int = 2
    most_bytes: int = 34

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.most_bytes < 2 or self.most_bytes % 2:
            raise ValueError(f"most_bytes must be even, a DAVIS346 sends words of two bytes, got {self.most_bytes}")


@dataclass(frozen=True)
class UsbUnplugged(LastingFault):
    """The camera is pulled out and plugged in again: its host loses it, and finds it without power until then."""

    kind: ClassVar[str] = "usb_unplugged"


USB_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each for each in (UsbSilence, UsbStall, ShortTransfers, UsbUnplugged)
}
"""Faults of a camera on USB/IP, by kind."""

CAN_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each
    for each in (
        *(LostFrames, RepeatedFrames, ReorderedFrames, ChangedFrames, ErrorFrames),
        *(BusOff, DeadBus, BabblingIdiot),
    )
}
"""Faults of a CAN bus, by kind."""

SERIAL_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each
    for each in (BitFlips, InsertedBytes, LostBytes, Burst, Overrun, StuckLine, WrongBaud, Stall, Unplugged)
}
"""Faults of a serial line, by kind."""

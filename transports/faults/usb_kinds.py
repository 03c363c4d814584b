"""The faults of a camera on USB/IP, as a rig writes them; see `kinds`, and `davis_kinds` for those of a DAVIS346."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from transports.faults.davis_kinds import DAVIS_FAULTS
from transports.faults.kinds import Fault, HitFault, LastingFault

__all__ = [
    "USB_FAULTS",
    "ControlStall",
    "EmptyTransfers",
    "FifoOverflow",
    "OddBytes",
    "ShortTransfers",
    "SlowControl",
    "UsbSilence",
    "UsbStall",
    "UsbUnplugged",
]

_UNICODE_MOST = 126  # characters of a string descriptor


@dataclass(frozen=True)
class UsbSilence(LastingFault):
    """The endpoint has nothing to say (NAK): the host's transfers wait, and the camera's FIFO fills.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint; 2 bears a DAVIS346's data, 1 an EVK4's.
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
class EmptyTransfers(HitFault):
    """Transfers of no byte, where there would have been data or silence: a host must ask again.

    `rate` is the chance of each transfer that the host asks for.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint.
    """

    kind: ClassVar[str] = "empty_transfers"
    endpoint: int = 2


@dataclass(frozen=True)
class OddBytes(HitFault):
    """Transfers of an odd length, while the camera sends words of two bytes. `rate` is the chance of each transfer.

    Attributes
    ----------
    change
        "missing": the last byte never comes, and its word is lost; "extra": a byte that nobody sent follows.
    """

    kind: ClassVar[str] = "odd_bytes"
    change: Literal["missing", "extra"] = "missing"


@dataclass(frozen=True)
class FifoOverflow(LastingFault):
    """The endpoint is silent until the camera's FIFO was full and has dropped events, for `for_s` at most.

    Attributes
    ----------
    events
        So many are dropped, or more.
    """

    kind: ClassVar[str] = "fifo_overflow"
    for_s: float = 10.0
    events: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.events < 1:
            raise ValueError(f"events must be 1 or more, got {self.events}")


@dataclass(frozen=True)
class ControlStall(Fault):
    """Vendor requests are refused (STALL).

    Attributes
    ----------
    request
        bRequest of those that are; -1: any vendor request. A DAVIS346 has 191 (0xBF) for registers.
    count
        How many.
    """

    kind: ClassVar[str] = "control_stall"
    request: int = -1
    count: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not -1 <= self.request <= 0xFF:
            raise ValueError(f"request must be -1 (any) to 255, got {self.request}")
        if self.count < 1:
            raise ValueError(f"count must be 1 or more, got {self.count}")


@dataclass(frozen=True)
class SlowControl(LastingFault):
    """Vendor requests are answered late: neuromorphic_drivers gives up after a second, libcaer never.

    Attributes
    ----------
    delay_ms
        From each request to its answer, in stream time.
    """

    kind: ClassVar[str] = "slow_control"
    for_s: float = 5.0
    delay_ms: float = 200.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.delay_ms <= 1e6:
            raise ValueError(f"delay_ms must be above 0 and at most 1e6, got {self.delay_ms}")


@dataclass(frozen=True)
class UsbUnplugged(LastingFault):
    """The camera is pulled out and plugged in again: its host loses it, and finds it without power until then.

    Attributes
    ----------
    serial
        Serial number with which it returns, as if another were plugged in; empty: its own.
    """

    kind: ClassVar[str] = "usb_unplugged"
    serial: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.serial) > _UNICODE_MOST or not (self.serial + "0").isprintable() or not self.serial.isascii():
            raise ValueError(f"serial must be at most {_UNICODE_MOST} printable ASCII characters, got {self.serial!r}")


_OF_ANY_CAMERA = (
    UsbSilence, UsbStall, ShortTransfers, EmptyTransfers, OddBytes, FifoOverflow, ControlStall, SlowControl,
    UsbUnplugged,
)  # fmt: skip

USB_FAULTS: Mapping[str, type[Fault]] = {**{each.kind: each for each in _OF_ANY_CAMERA}, **DAVIS_FAULTS}
"""Faults of a camera on USB/IP, by kind."""

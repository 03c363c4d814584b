"""The faults of a camera on USB/IP, as a rig writes them; see `kinds`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from transports.faults.kinds import Fault, LastingFault

__all__ = [
    "USB_FAULTS",
    "ShortTransfers",
    "UsbSilence",
    "UsbStall",
    "UsbUnplugged",
]


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
class UsbUnplugged(LastingFault):
    """The camera is pulled out and plugged in again: its host loses it, and finds it without power until then."""

    kind: ClassVar[str] = "usb_unplugged"


USB_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each for each in (UsbSilence, UsbStall, ShortTransfers, UsbUnplugged)
}
"""Faults of a camera on USB/IP, by kind."""

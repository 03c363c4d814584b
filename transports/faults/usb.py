"""Faults of a camera on USB: their tables in a rig, and their effects. Sans-I/O.

    host <-- control: refused, late, false answers --+
    host <-- read: halted, silent, short, empty -----+-- FaultyDevice <-- device
    host <-- read: changed words --------------------+

A fault acts on the device's endpoints, on its control requests, on its presence, or on the words of its data; the last
ones are in `words`. Wrong versions, register flips and all faults of words but odd bytes hit nothing on other cameras
than a DAVIS346. See `kinds` for the attributes that all faults have.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta

from firmware_protocol.usb.device import NotReady, SetupPacket, Stall
from transports.faults.kinds import USB_LINK, Count, Fault, HitFault, LastingFault, Length, Places, Stage

_SAME = -1
_Octet = Annotated[int, Meta(ge=-1, le=0xFF)]
_Version = Annotated[int, Meta(ge=_SAME, le=0xFFFFFFFF)]
_UNICODE_MOST = 126  # characters of a string descriptor


@dataclass
class UsbStage(Stage):
    """One active fault of one IN endpoint, or of the whole device when it is `gone`.

    Attributes
    ----------
    fault : the fault as requested.
    endpoint : number of the IN endpoint; that of the data if the camera's FIFO is to overflow.
    empty : indices of the transfers that arrive empty.
    overflow : number of events that the camera is to drop.
    """

    fault: Fault
    endpoint: int = 0
    silent: bool = False
    stalls: int = 0
    most_bytes: int = 0
    gone: bool = False
    empty: Places | None = None
    overflow: int = 0
    hits: int = 0
    touched: int = 0
    over: bool = False


class ControlStage(Stage, ABC):
    """One active fault of vendor requests."""

    @abstractmethod
    def check(self, setup: SetupPacket, now_us: int) -> None:
        """Raise Stall for a vendor request that is to be refused, NotReady for one that is answered later."""


@dataclass(frozen=True)
class UsbSilence(LastingFault, carriers=(USB_LINK,)):
    """The endpoint sends no data (NAK): the host's transfers wait, and the camera's FIFO fills.

    Attributes
    ----------
    endpoint : number of the IN endpoint; 2 carries a DAVIS346's data, 1 an EVK4's.
    """

    endpoint: int = 2

    def stage(self, random: np.random.Generator, carrier: Callable[[], int]) -> Stage:
        """Return a silent endpoint."""
        return UsbStage(self, self.endpoint, silent=True)


@dataclass(frozen=True)
class UsbStall(Fault, carriers=(USB_LINK,)):
    """The endpoint halts (STALL) until the host clears the halt: libcaer treats this as an unplugged camera.

    Attributes
    ----------
    endpoint : number of the IN endpoint.
    count : number of halts: it halts again when the host has cleared a halt.
    """

    endpoint: int = 2
    count: Count = 1

    def stage(self, random: np.random.Generator, carrier: Callable[[], int]) -> Stage:
        """Return an endpoint that halts `count` times."""
        return UsbStage(self, self.endpoint, stalls=self.count)


@dataclass(frozen=True)
class ShortTransfers(LastingFault, carriers=(USB_LINK,)):
    """Transfers end early, with a short packet: a host must not rely on full buffers.

    Attributes
    ----------
    endpoint : number of the IN endpoint.
    most_bytes : largest size of a transfer.
    """

    endpoint: int = 2
    most_bytes: int = 34

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.most_bytes < 2 or self.most_bytes % 2:
            raise ValueError(f"most_bytes must be even, a DAVIS346 sends words of two bytes, got {self.most_bytes}")

    def stage(self, random: np.random.Generator, carrier: Callable[[], int]) -> Stage:
        """Return an endpoint whose transfers end early."""
        return UsbStage(self, self.endpoint, most_bytes=self.most_bytes)


@dataclass(frozen=True)
class EmptyTransfers(HitFault, carriers=(USB_LINK,)):
    """Transfers without data, in place of data or silence: a host must request again.

    `rate` is the probability of each transfer that the host requests.

    Attributes
    ----------
    endpoint : number of the IN endpoint.
    """

    endpoint: int = 2

    def stage(self, random: np.random.Generator, carrier: Callable[[], int]) -> Stage:
        """Return an endpoint with empty transfers at places drawn by `random`."""
        return UsbStage(self, self.endpoint, empty=Places(self, random))


@dataclass(frozen=True)
class FifoOverflow(LastingFault, carriers=(USB_LINK,)):
    """The endpoint is silent until the camera's FIFO was full and has dropped events, for `for_s` at most.

    Attributes
    ----------
    events : lowest number of dropped events at which it ends.
    """

    for_s: Length = 10.0
    events: Count = 1

    def stage(self, random: np.random.Generator, carrier: Callable[[], int]) -> Stage:
        """Return a silent endpoint; `carrier` returns the number of events dropped from a full FIFO so far."""
        return UsbStage(self, silent=True, overflow=carrier() + self.events)


@dataclass(frozen=True)
class UsbUnplugged(LastingFault, carriers=(USB_LINK,)):
    """The camera is unplugged and plugged in again: its host loses it, and finds it without power until then.

    Attributes
    ----------
    serial : serial number with which it returns, as if another camera were plugged in; empty: its own.
    """

    disconnects: ClassVar[bool] = True
    serial: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.serial) > _UNICODE_MOST or not (self.serial + "0").isprintable() or not self.serial.isascii():
            raise ValueError(f"serial must be at most {_UNICODE_MOST} printable ASCII characters, got {self.serial!r}")

    def stage(self, random: np.random.Generator, carrier: Callable[[], int]) -> Stage:
        """Return the absence of the device."""
        return UsbStage(self, gone=True, hits=1)


@dataclass(frozen=True)
class WrongVersion(Fault, carriers=(USB_LINK,)):
    """The camera reports versions that its host may not support; -1 leaves a version unchanged.

    Attributes
    ----------
    firmware : low byte of bcdDevice: drivers require 6.
    logic_version, logic_patch : drivers require 18, and at least 1.
    chip : chip identifier: 5 is a DAVIS346B.
    """

    firmware: _Octet = _SAME
    logic_version: _Version = _SAME
    logic_patch: _Version = _SAME
    chip: _Version = _SAME

    def stage(self, random: np.random.Generator, carrier: Callable[[], int]) -> Stage:
        """Return false versions, which the device's answers contain from now on."""
        return UsbStage(self, hits=1)


@dataclass(frozen=True)
class RegisterFlip(Fault, carriers=(USB_LINK,)):
    """One inverted bit of a register, as by radiation; until the host writes the register, or until power-on.

    Attributes
    ----------
    module, parameter : address of the register; see the list of registers.
    bit : 0 to 31.
    """

    module: Annotated[int, Meta(ge=0, le=0xFFFF)] = 1
    parameter: Annotated[int, Meta(ge=0, le=0xFFFF)] = 3
    bit: Annotated[int, Meta(ge=0, le=31)] = 0

    def stage(self, random: np.random.Generator, carrier: Callable[[], int]) -> Stage:
        """Return the flip of one bit, which is done when the fault begins."""
        return UsbStage(self)


class _Refusal(ControlStage):
    def check(self, setup: SetupPacket, now_us: int) -> None:
        if self.over or self._fault.request not in (-1, setup.request):
            return
        self.hits += 1
        self.over = self.hits == self._fault.count
        raise Stall(f"{setup} is refused, by a fault")


@dataclass(frozen=True)
class ControlStall(Fault, carriers=(USB_LINK,), effect=_Refusal):
    """Vendor requests are refused (STALL).

    Attributes
    ----------
    request : bRequest of the refused requests; -1: any vendor request. A DAVIS346 has 191 (0xBF) for registers.
    count : number of refused requests.
    """

    request: _Octet = -1
    count: Count = 1


class _Slowness(ControlStage):
    def __init__(self, fault: SlowControl, random: np.random.Generator, carrier: Any) -> None:
        super().__init__(fault, random, carrier)
        self._pending: SetupPacket | None = None
        self._due_us = 0

    def check(self, setup: SetupPacket, now_us: int) -> None:
        if setup is not self._pending:  # equal bytes after a time-out are another request
            self._pending, self._due_us = setup, now_us + round(self._fault.delay_ms * 1000)
            self.hits += 1
        if now_us < self._due_us:
            raise NotReady
        self._pending = None


@dataclass(frozen=True)
class SlowControl(LastingFault, carriers=(USB_LINK,), effect=_Slowness):
    """Vendor requests are answered late: neuromorphic_drivers gives up after a second, libcaer never.

    Attributes
    ----------
    delay_ms : time from each request to its answer, in stream time.
    """

    for_s: Length = 5.0
    delay_ms: Annotated[float, Meta(gt=0, le=1e6)] = 200.0

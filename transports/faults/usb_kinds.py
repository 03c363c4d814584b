"""Faults of a camera on USB/IP or GigE Vision, as a rig writes them; see `kinds` for the common attributes.

The faults of a DAVIS346's own electronics come first: versions, registers, clock and word stream. The faults of any
camera on USB follow, then those of a GigE Vision camera, which has the faults of datagrams too.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from transports.faults.kinds import Fault, HitFault, LastingFault

__all__ = [
    "DAVIS_FAULTS",
    "USB_FAULTS",
    "ControlStall",
    "EmptyTransfers",
    "FifoOverflow",
    "IpChange",
    "LinkDown",
    "LostHeartbeat",
    "MissedWraps",
    "OddBytes",
    "RefusedResends",
    "RegisterFlip",
    "RepeatedEvents",
    "ShortTransfers",
    "SlowControl",
    "StaleData",
    "TimeAhead",
    "TimeBack",
    "TimeFrozen",
    "UsbSilence",
    "UsbStall",
    "UsbUnplugged",
    "WrongVersion",
]


_SAME = -1
_WRAP_US = 32_768


@dataclass(frozen=True)
class WrongVersion(Fault):
    """The camera reports versions that its host may not support; -1 leaves a version unchanged.

    Attributes
    ----------
    firmware
        Low byte of bcdDevice: drivers require 6.
    logic_version, logic_patch
        Drivers require 18, and at least 1.
    chip
        Chip identifier: 5 is a DAVIS346B.
    """

    kind: ClassVar[str] = "wrong_version"
    firmware: int = _SAME
    logic_version: int = _SAME
    logic_patch: int = _SAME
    chip: int = _SAME

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _SAME <= self.firmware <= 0xFF:
            raise ValueError(f"firmware must be -1 (the same) to 255, got {self.firmware}")
        for name in ("logic_version", "logic_patch", "chip"):
            if not _SAME <= getattr(self, name) <= 0xFFFFFFFF:
                raise ValueError(f"{name} must be -1 (the same) or 32 bits, got {getattr(self, name)}")


@dataclass(frozen=True)
class RegisterFlip(Fault):
    """One inverted bit of a register, as by radiation; until the host writes the register, or until power-on.

    Attributes
    ----------
    module, parameter
        Address of the register; see the list of registers.
    bit
        0 to 31.
    """

    kind: ClassVar[str] = "register_flip"
    module: int = 1
    parameter: int = 3
    bit: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.bit <= 31:
            raise ValueError(f"bit must be 0 to 31, got {self.bit}")
        for name in ("module", "parameter"):
            if not 0 <= getattr(self, name) <= 0xFFFF:
                raise ValueError(f"{name} must be 0 to 65535, got {getattr(self, name)}")


@dataclass(frozen=True)
class StaleData(Fault):
    """Words of an earlier session arrive first when the host starts the data endpoint the next time.

    Attributes
    ----------
    events
        Number of events in them, each with its own time and row.
    """

    kind: ClassVar[str] = "stale_data"
    events: int = 100

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.events <= 1000:
            raise ValueError(f"events must be 1 to 1000, got {self.events}")


@dataclass(frozen=True)
class TimeBack(LastingFault):
    """Timestamps that are too low for a time, but never below the last wrap.

    Attributes
    ----------
    by_us
        Error of the timestamps.
    """

    kind: ClassVar[str] = "time_back"
    by_us: int = 1000

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.by_us < _WRAP_US:
            raise ValueError(f"by_us must be 1 to {_WRAP_US - 1}, got {self.by_us}")


@dataclass(frozen=True)
class TimeAhead(Fault):
    """Additional wraps: the host's clock is ahead from then on, until a timestamp reset.

    Attributes
    ----------
    wraps
        Number of wraps, of 32.768 ms each.
    """

    kind: ClassVar[str] = "time_ahead"
    wraps: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.wraps <= 100:
            raise ValueError(f"wraps must be 1 to 100, got {self.wraps}")


@dataclass(frozen=True)
class TimeFrozen(LastingFault):
    """No timestamps and no wraps for a time: all events have the last time; then all wraps arrive at once."""

    kind: ClassVar[str] = "time_frozen"


@dataclass(frozen=True)
class MissedWraps(HitFault):
    """Wraps that never arrive: the host's clock is behind from then on, 32.768 ms each, until a timestamp reset.

    `rate` is the probability of each wrap.
    """

    kind: ClassVar[str] = "missed_wraps"


@dataclass(frozen=True)
class RepeatedEvents(HitFault):
    """Events that arrive twice, one after the other. `rate` is the probability of each event."""

    kind: ClassVar[str] = "repeated_events"


DAVIS_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each
    for each in (
        WrongVersion, RegisterFlip, StaleData, TimeBack, TimeAhead, TimeFrozen, MissedWraps, RepeatedEvents,
    )
}  # fmt: skip
"""Faults of a DAVIS346, by kind; on other USB cameras they hit nothing."""


_UNICODE_MOST = 126  # characters of a string descriptor


@dataclass(frozen=True)
class UsbSilence(LastingFault):
    """The endpoint sends no data (NAK): the host's transfers wait, and the camera's FIFO fills.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint; 2 carries a DAVIS346's data, 1 an EVK4's.
    """

    kind: ClassVar[str] = "usb_silence"
    endpoint: int = 2


@dataclass(frozen=True)
class UsbStall(Fault):
    """The endpoint halts (STALL) until the host clears the halt: libcaer treats this as an unplugged camera.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint.
    count
        Number of halts: it halts again when the host has cleared a halt.
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
    """Transfers end early, with a short packet: a host must not rely on full buffers.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint.
    most_bytes
        Largest size of a transfer.
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
    """Transfers without data, in place of data or silence: a host must request again.

    `rate` is the probability of each transfer that the host requests.

    Attributes
    ----------
    endpoint
        Number of the IN endpoint.
    """

    kind: ClassVar[str] = "empty_transfers"
    endpoint: int = 2


@dataclass(frozen=True)
class OddBytes(HitFault):
    """Transfers of an odd length, while the camera sends words of two bytes.

    `rate` is the probability of each transfer.

    Attributes
    ----------
    change
        "missing": the last byte never arrives, and its word is lost; "extra": a byte that the camera did not
        send follows.
    """

    kind: ClassVar[str] = "odd_bytes"
    change: Literal["missing", "extra"] = "missing"


@dataclass(frozen=True)
class FifoOverflow(LastingFault):
    """The endpoint is silent until the camera's FIFO was full and has dropped events, for `for_s` at most.

    Attributes
    ----------
    events
        Lowest number of dropped events at which it ends.
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
        bRequest of the refused requests; -1: any vendor request. A DAVIS346 has 191 (0xBF) for registers.
    count
        Number of refused requests.
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
        Time from each request to its answer, in stream time.
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
    """The camera is unplugged and plugged in again: its host loses it, and finds it without power until then.

    Attributes
    ----------
    serial
        Serial number with which it returns, as if another camera were plugged in; empty: its own.
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


@dataclass(frozen=True)
class RefusedResends(HitFault):
    """Packets that a host requests again and that the camera no longer holds, like one with a small memory."""

    kind: ClassVar[str] = "refused_resends"


@dataclass(frozen=True)
class LostHeartbeat(Fault):
    """The camera takes control away from its host, as when the host's heartbeat did not arrive in time."""

    kind: ClassVar[str] = "lost_heartbeat"


@dataclass(frozen=True)
class LinkDown(LastingFault):
    """The cable is unplugged and plugged in again: no data pass in either direction in between."""

    kind: ClassVar[str] = "link_down"


@dataclass(frozen=True)
class IpChange(LastingFault):
    """The camera leaves its IP address and returns with another one, as after a new DHCP lease or a FORCEIP.

    Attributes
    ----------
    for_s
        Time without an address.
    address
        IPv4 address that it has afterwards, to the end of the run; one of this machine's, on loopback any 127.x.y.z.
    """

    kind: ClassVar[str] = "ip_change"
    for_s: float = 0.5
    address: str = "127.0.0.254"

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            good = not ipaddress.IPv4Address(self.address).is_unspecified
        except ValueError:
            good = False
        if not good:
            raise ValueError(f"address must be an IPv4 address that the camera has afterwards, got {self.address!r}")

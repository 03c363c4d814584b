"""The faults of a DAVIS346's own electronics, as a rig writes them: versions, registers, clock and word stream."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from transports.faults.kinds import Fault, HitFault, LastingFault

__all__ = [
    "DAVIS_FAULTS",
    "MissedWraps",
    "RegisterFlip",
    "RepeatedEvents",
    "StaleData",
    "TimeAhead",
    "TimeBack",
    "TimeFrozen",
    "WrongVersion",
]

_SAME = -1
_WRAP_US = 32_768


@dataclass(frozen=True)
class WrongVersion(Fault):
    """The camera tells of versions that its host may not know; -1 leaves one as it is.

    Attributes
    ----------
    firmware
        Low byte of bcdDevice: drivers want 6.
    logic_version, logic_patch
        Drivers want 18, and 1 at least.
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
    """One bit of a register turns over, as radiation does it; until the host writes the register, or power-on.

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
    """Words of an earlier session come first when the host starts the data endpoint the next time.

    Attributes
    ----------
    events
        How many events they tell of, each with its own time and row.
    """

    kind: ClassVar[str] = "stale_data"
    events: int = 100

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.events <= 1000:
            raise ValueError(f"events must be 1 to 1000, got {self.events}")


@dataclass(frozen=True)
class TimeBack(LastingFault):
    """Timestamps are too low while it lasts, but never below the last wrap.

    Attributes
    ----------
    by_us
        How much.
    """

    kind: ClassVar[str] = "time_back"
    by_us: int = 1000

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.by_us < _WRAP_US:
            raise ValueError(f"by_us must be 1 to {_WRAP_US - 1}, got {self.by_us}")


@dataclass(frozen=True)
class TimeAhead(Fault):
    """Wraps too many: the host's clock is ahead from then on, until a timestamp reset.

    Attributes
    ----------
    wraps
        How many, of 32.768 ms each.
    """

    kind: ClassVar[str] = "time_ahead"
    wraps: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.wraps <= 100:
            raise ValueError(f"wraps must be 1 to 100, got {self.wraps}")


@dataclass(frozen=True)
class TimeFrozen(LastingFault):
    """No timestamps and no wraps while it lasts: all events have the last time; then the wraps come at once."""

    kind: ClassVar[str] = "time_frozen"


@dataclass(frozen=True)
class MissedWraps(HitFault):
    """Wraps that never come: the host's clock is behind from then on, 32.768 ms each, until a timestamp reset.

    `rate` is the chance of each wrap.
    """

    kind: ClassVar[str] = "missed_wraps"


@dataclass(frozen=True)
class RepeatedEvents(HitFault):
    """Events that come twice, one after the other. `rate` is the chance of each event."""

    kind: ClassVar[str] = "repeated_events"


DAVIS_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each
    for each in (
        WrongVersion, RegisterFlip, StaleData, TimeBack, TimeAhead, TimeFrozen, MissedWraps, RepeatedEvents,
    )
}  # fmt: skip
"""Faults of a DAVIS346, by kind; other cameras on USB let them hit nothing."""

"""The faults that a link can be given, as a rig writes them: a table with a `kind`, one frozen dataclass each.

Here are what all have in common and those of a serial line; `can_kinds` and `usb_kinds` have the others.

A fault begins at `at_s` of stream time and lasts `for_s`. Those that hit single bits, bytes or frames hit each with a
chance of `rate` and are over after `count` hits.

Where a fault hits: places in a stream of bits, bytes or frames that do not depend on how it is cut.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

__all__ = [
    "SERIAL_FAULTS",
    "BitFlips",
    "Burst",
    "Fault",
    "HitFault",
    "InsertedBytes",
    "LastingFault",
    "LostBytes",
    "Overrun",
    "Places",
    "Stall",
    "StuckLine",
    "Unplugged",
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


SERIAL_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each
    for each in (BitFlips, InsertedBytes, LostBytes, Burst, Overrun, StuckLine, WrongBaud, Stall, Unplugged)
}
"""Faults of a serial line, by kind."""


_GAPS_AT_ONCE = 256


class Places:
    """Draws the places at which a fault hits, one after the other, from the gaps between them."""

    def __init__(self, fault: HitFault, random: np.random.Generator) -> None:
        self._rate = fault.rate
        self._left = fault.count or None
        self._random = random
        self._gaps: list[int] = []
        self._next = self._gap() - 1

    @property
    def over(self) -> bool:
        """True when all hits have been made."""
        return self._left == 0

    def within(self, n: int) -> list[int]:
        """Return which of the next `n` units are hit, and go on behind them."""
        found = []
        while self._next < n and self._left != 0:
            found.append(self._next)
            self._next += self._gap()
            if self._left is not None:
                self._left -= 1
        self._next -= n
        return found

    def first(self, n: int) -> int | None:
        """Return the first of the next `n` units that is hit, and go on behind it; None, and behind all, if none is."""
        if self._next >= n or self._left == 0:
            self._next -= n
            return None
        place, self._next = self._next, self._gap() - 1
        if self._left is not None:
            self._left -= 1
        return place

    def _gap(self) -> int:
        if not self._gaps:
            self._gaps = self._random.geometric(self._rate, _GAPS_AT_ONCE).tolist()
        return self._gaps.pop()

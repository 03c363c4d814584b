"""Faults of links as a rig writes them: a table with a `kind`, one frozen dataclass each.

This module has the common attributes, the faults of a serial line, and `Places`. Faults of a CAN bus are in `bus`,
those of datagrams in `datagrams`, those of USB and GigE Vision in `usb_kinds`.

A fault begins at `at_s` of stream time and lasts `for_s`. Faults of single bits, bytes or frames hit each one with
probability `rate` and end after `count` hits.

`Places` draws the places of the hits in a stream of bits, bytes or frames; they do not depend on how it is divided.
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


_LONGEST_S = 3.2e7  # a year, the longest run


@dataclass(frozen=True)
class Fault:
    """Common attributes of all faults.

    Attributes
    ----------
    link
        Name of the link; "" if only one link can have this fault.
    at_s
        Stream time at which it begins.
    for_s
        Its duration, in stream time; 0: until it has hit `count` times.
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
    """Fault of single bits, bytes or frames.

    Attributes
    ----------
    rate
        Probability for each, above 0 to 1. With the defaults the next one is hit, once.
    count
        The fault ends after this number of hits; 0: no limit, then for_s sets its end.
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
            raise ValueError("for_s is 0 and so is count: set one of them")


@dataclass(frozen=True)
class LastingFault(Fault):
    """Fault with a duration."""

    for_s: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.for_s:
            raise ValueError("for_s must be above 0: this fault lasts for a while")


@dataclass(frozen=True)
class BitFlips(HitFault):
    """Single inverted bits: noise on the line. `rate` is the bit error rate."""

    kind: ClassVar[str] = "bit_flips"


@dataclass(frozen=True)
class InsertedBytes(HitFault):
    """Random bytes that the camera did not send, inserted before the bytes that are hit."""

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
    """The receiver empties its FIFO too late: it keeps the bytes that fit, and loses the others until then.

    Attributes
    ----------
    late_us
        Time from the byte that is hit until the receiver reads again.
    fifo_bytes
        Number of bytes that it keeps until then: 16 in a 16550, 1 in a UART without a FIFO.
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
    """The line stays at one level: bytes sent in this time are lost.

    Attributes
    ----------
    level
        "low": a break, from which a UART makes one zero byte; "high": a broken wire, on which nothing arrives.
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
    """The receiver stops the sender (XOFF, RTS, a full buffer): no byte leaves, and the camera's queue fills."""

    kind: ClassVar[str] = "stall"


@dataclass(frozen=True)
class Unplugged(LastingFault):
    """The port disappears and returns, like an adapter that is unplugged; it is found again within half a second."""

    kind: ClassVar[str] = "unplugged"


SERIAL_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each
    for each in (BitFlips, InsertedBytes, LostBytes, Burst, Overrun, StuckLine, WrongBaud, Stall, Unplugged)
}
"""Faults of a serial line, by kind."""


_GAPS_AT_ONCE = 256


class Places:
    """Generator of the places at which a fault hits, in order, from the gaps between them."""

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
        """Return the indices of the next `n` units that are hit, and advance behind these units."""
        found = []
        while self._next < n and self._left != 0:
            found.append(self._next)
            self._next += self._gap()
            if self._left is not None:
                self._left -= 1
        self._next -= n
        return found

    def first(self, n: int) -> int | None:
        """Return the first of the next `n` units that is hit, and advance behind it.

        None, and behind all, if none is.
        """
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

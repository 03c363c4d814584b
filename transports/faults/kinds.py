"""Base classes of faults, which a rig writes as tables with a `kind`.

A fault is one frozen dataclass: its attributes are the keys of the table, and `effect` is the class of its effect on
its carrier, a `Stage`. A fault whose effect needs other parameters overrides `stage`. The modules `line`, `bus`,
`datagrams`, `words` and `usb` contain the faults of each carrier, `transports.gige.packet_faults` those of GigE Vision.

A fault begins at `at_s` of stream time and lasts `for_s`. Faults of single bits, bytes or frames hit each one with
probability `rate` and end after `count` hits.

`Places` draws the places of the hits in a stream of bits, bytes or frames; they do not depend on how it is divided.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

_LONGEST_S = 3.2e7  # a year, the longest run


class Stage:
    """Effect of one active fault; each carrier has its kinds of stages.

    Parameters
    ----------
    fault
        The fault, whose attributes are the parameters of the effect.
    random
        Generator that draws the hits.
    carrier
        Property of the carrier on which the effect depends, if there is one.

    Attributes
    ----------
    hits
        Number of times that it was applied.
    touched
        Number of bytes, words, frames or datagrams that it changed, removed, inserted or held.
    over
        True when it has no further effect.
    """

    def __init__(self, fault: Any, random: np.random.Generator, carrier: Any = None) -> None:
        self.hits = self.touched = 0
        self.over = False

    def count(self, hits: int, touched: int) -> None:
        """Count hits, and what they touched."""
        self.hits += hits
        self.touched += touched


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
    effect: ClassVar[type[Stage]] = Stage
    disconnects: ClassVar[bool] = False  # True: the host loses the camera, and must open it again
    link: str = ""
    at_s: float = 0.0
    for_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("at_s", "for_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0 <= value <= _LONGEST_S):
                raise ValueError(f"{name} must be 0 to 3.2e7 (a year), got {value}")

    def stage(self, random: np.random.Generator, carrier: Any) -> Stage:
        """Return its effect on a carrier, with hits drawn by `random`; see `Stage`."""
        return self.effect(self, random, carrier)


@dataclass(frozen=True)
class HitFault(Fault):
    """Fault of single bits, bytes or frames.

    Attributes
    ----------
    rate
        Probability for each, above 0 to 1; by default the next one is hit, once.
    count
        Number of hits after which it ends; 0: no limit, then `for_s` sets its end.
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

"""Where a fault hits: places in a stream of bits, bytes or frames that do not depend on how it is cut."""

from __future__ import annotations

import numpy as np

from transports.faults.kinds import HitFault

__all__ = ["Places"]

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

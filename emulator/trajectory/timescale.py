"""Scene time from stream time, by an exact factor that makes slow motion fast.

Itokawa turns once in half a day, and from Hayabusa's home position a pixel of motion takes a quarter of a minute. A
factor of 100 shows the same in minutes; events then come 100 times as fast as they would, which a summary should
never hide.
"""

from __future__ import annotations

from fractions import Fraction

__all__ = ["Timescale"]


class Timescale:
    """Scene time = start + factor * stream time; `factor` is taken as the decimal that a person wrote."""

    def __init__(self, factor: float = 1.0, start_s: float = 0.0) -> None:
        self._factor = Fraction(repr(float(factor)))
        self._start_ns = round(Fraction(repr(float(start_s))) * 10**9)

    @property
    def factor(self) -> float:
        """Scene time per unit of stream time."""
        return float(self._factor)

    def scene_ns(self, t_ns: int) -> int:
        """Return the scene's time at stream time `t_ns`, ns, rounded down."""
        return self._start_ns + int(t_ns) * self._factor.numerator // self._factor.denominator

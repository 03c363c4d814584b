"""Phase of periodic motion, exact for as long as the stream lasts.

A phase computed from seconds in floating point gets coarser as turns pile up; here the whole turns are taken off in
integers before anything is rounded, so that the phase after a month is as good as in the first second.
"""

from __future__ import annotations

from fractions import Fraction

__all__ = ["Cycle"]

_NS_PER_S = 1_000_000_000


class Cycle:
    """Turns made since time zero at a constant rate.

    Parameters
    ----------
    rate_hz
        Turns per second, of either sign; 0 stands still. A `Fraction` is taken exactly.
    start_turns
        Phase at time zero.

    Attributes
    ----------
    rate_hz
        Turns per second, exactly.
    """

    def __init__(self, rate_hz: Fraction | float, start_turns: Fraction | float = 0.0) -> None:
        rate, start = _as_written(rate_hz), _as_written(start_turns)
        self._turn = rate.denominator * start.denominator * _NS_PER_S
        self._per_ns = rate.numerator * start.denominator
        self._start = start.numerator * rate.denominator * _NS_PER_S
        self.rate_hz = rate

    def turns(self, t_ns: int) -> float:
        """Return the fraction of a turn reached at `t_ns`, 0 <= turns <= 1, correctly rounded."""
        return ((self._start + int(t_ns) * self._per_ns) % self._turn) / self._turn


def _as_written(number: Fraction | float) -> Fraction:
    """Read a float as the decimal that a person wrote: 0.1 is one tenth, so a period of 0.1 s is exactly 1e8 ns."""
    return number if isinstance(number, Fraction) else Fraction(repr(float(number)))

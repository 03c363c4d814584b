"""Which events leave the sensor: those in the ranges of rows and columns, and no more than the rate control lets by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events
from firmware_protocol.gige.evs_registers import (
    COLUMNS,
    INVERTED,
    MOST_RANGES,
    PERIOD_US,
    ROWS,
    Erc,
    RangeRegisters,
    evs_rules,
)
from firmware_protocol.gige.memory import Rule

__all__ = ["RateControl", "Selected", "Selection"]

_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Selected:
    """Events (n,) EVENT that pass, and how many others did not, by the reason."""

    events: Events
    outside: int
    beyond_rate: int


class Selection:
    """What hosts write to the registers of ranges and of the rate control, at work."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._bounds = evs_rules(size)
        self._rows, self._columns = _Ranges(size[1]), _Ranges(size[0])
        self._inverted = False
        self._rate = RateControl()

    def rules(self) -> dict[int, Rule]:
        """Return what writes to these registers do, by address."""
        doing = self._doing(ROWS, self._rows) | self._doing(COLUMNS, self._columns)
        doing |= {
            INVERTED: self._invert,
            Erc.ON: self._rate.turn,
            Erc.PERIOD_US: self._rate.set_period_us,
            Erc.EVENTS: self._rate.set_most,
        }
        return {address: _followed(self._bounds[address], do) for address, do in doing.items()}

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return what passes of events (n,) EVENT, sorted, of a camera whose clock was zero at `epoch_us`."""
        wanted = events
        if self._rows.on or self._columns.on:
            crossing = self._rows.mask[events["y"]] & self._columns.mask[events["x"]]
            wanted = events[~crossing if self._inverted else crossing]
        let_by = wanted[self._rate.passing(wanted, epoch_us)] if self._rate.on else wanted
        return Selected(let_by, len(events) - len(wanted), len(wanted) - len(let_by))

    def _invert(self, value: int) -> None:
        self._inverted = bool(value)

    @staticmethod
    def _doing(registers: RangeRegisters, ranges: _Ranges) -> dict[int, Callable[[int], None]]:
        return {
            registers.on: ranges.turn,
            registers.selector: ranges.select,
            registers.size: ranges.resize,
            registers.offset: ranges.move,
            registers.count: ranges.use,
        }


class _Ranges:
    """Ranges of rows, or of columns, that a host writes one by one: selector, then size and offset.

    Attributes
    ----------
    mask
        Which rows or columns lie in a range, (pixels,) bool; all of them while the ranges are off.
    """

    def __init__(self, pixels: int) -> None:
        self._sizes = np.zeros(MOST_RANGES, np.int64)
        self._offsets = np.zeros(MOST_RANGES, np.int64)
        self._selected = self._used = 0
        self.on = False
        self.mask: _Mask = np.ones(pixels, np.bool_)

    def turn(self, on: int) -> None:
        """Switch the ranges on or off."""
        self.on = bool(on)
        self._draw()

    def select(self, number: int) -> None:
        """Say which range is written next."""
        self._selected = number

    def resize(self, size: int) -> None:
        """Set the size of the selected range."""
        self._sizes[self._selected] = size
        self._draw()

    def move(self, offset: int) -> None:
        """Set where the selected range begins."""
        self._offsets[self._selected] = offset
        self._draw()

    def use(self, count: int) -> None:
        """Say how many ranges, from the first on, are used."""
        self._used = count
        self._draw()

    def _draw(self) -> None:
        self.mask[:] = not self.on
        for size, offset in zip(self._sizes[: self._used], self._offsets[: self._used], strict=True):
            self.mask[offset : offset + size] = True


class RateControl:
    """Lets so many events by in each period of the device's clock, and no more."""

    def __init__(self) -> None:
        self._period_us, self._most = PERIOD_US, 0
        self._period, self._seen = -1, 0
        self.on = False

    def turn(self, on: int) -> None:
        """Switch it on or off."""
        self.on = bool(on)

    def set_period_us(self, period_us: int) -> None:
        """Set the length of a period."""
        self._period_us = period_us

    def set_most(self, events: int) -> None:
        """Set how many events a period lets by."""
        self._most = events

    def passing(self, events: Events, epoch_us: int) -> _Mask:
        """Return which events (n,) EVENT, sorted, are let by, (n,) bool: the first ones of each period."""
        if not len(events):
            return np.zeros(0, np.bool_)
        periods = (events["t"].astype(np.int64) - epoch_us) // self._period_us
        ranks = np.arange(len(periods)) - np.searchsorted(periods, periods)
        if periods[0] == self._period:
            ranks[periods == self._period] += self._seen
        self._period, self._seen = int(periods[-1]), int(ranks[-1]) + 1
        return ranks < self._most


def _followed(bounds: Rule, do: Callable[[int], None]) -> Rule:
    """Return a rule that does something with a value that is within bounds."""

    def rule(value: int) -> int:
        done = bounds(value)
        do(done)
        return done

    return rule

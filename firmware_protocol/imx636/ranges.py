"""Selection of the events that leave a Triton2: ranges of rows and columns, and rate control, as a host writes them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events
from firmware_protocol.gige.registers import Rule
from firmware_protocol.imx636.selection import RateControl, Selected
from firmware_protocol.imx636.triton2_memory import evs_rules
from firmware_protocol.imx636.triton2_registers import (
    COLUMNS,
    INVERTED,
    MOST_RANGES,
    PERIOD_US,
    ROWS,
    Erc,
    RangeRegisters,
)

__all__ = ["RangeSelection"]


_Mask = npt.NDArray[np.bool_]


class RangeSelection:
    """Registers of ranges and of the rate control, applied to events."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._bounds = evs_rules(size)
        self._rows, self._columns = _Ranges(size[1]), _Ranges(size[0])
        self._inverted = False
        self._rate = RateControl(PERIOD_US)

    def rules(self) -> dict[int, Rule]:
        """Return the rules for writes to these registers, by address."""
        doing = self._doing(ROWS, self._rows) | self._doing(COLUMNS, self._columns)
        doing |= {
            INVERTED: self._invert,
            Erc.ON: self._rate.turn,
            Erc.PERIOD_US: self._rate.set_period_us,
            Erc.EVENTS: self._rate.set_most,
        }
        return {address: _followed(self._bounds[address], do) for address, do in doing.items()}

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the camera's clock was zero at `epoch_us`."""
        wanted = events
        if self._rows.on or self._columns.on:
            crossing = self._rows.mask[events["y"]] & self._columns.mask[events["x"]]
            wanted = events[~crossing if self._inverted else crossing]
        return self._rate.selected(events, wanted, epoch_us)

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
        Mask of the rows or columns in a range, (pixels,) bool; true for all while the ranges are off.
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
        """Select the range that is written next."""
        self._selected = number

    def resize(self, size: int) -> None:
        """Set the size of the selected range."""
        self._sizes[self._selected] = size
        self._draw()

    def move(self, offset: int) -> None:
        """Set the start of the selected range."""
        self._offsets[self._selected] = offset
        self._draw()

    def use(self, count: int) -> None:
        """Set the number of ranges, from the first on, that are used."""
        self._used = count
        self._draw()

    def _draw(self) -> None:
        self.mask[:] = not self.on
        for size, offset in zip(self._sizes[: self._used], self._offsets[: self._used], strict=True):
            self.mask[offset : offset + size] = True


def _followed(bounds: Rule, do: Callable[[int], None]) -> Rule:
    """Return a rule that calls `do` with a value that is within bounds."""

    def rule(value: int) -> int:
        done = bounds(value)
        do(done)
        return done

    return rule

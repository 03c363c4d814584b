"""Selection of the events that leave the sensor: masks, and rate control.

Row and column masks take effect together when bit 5 of the array control is written; masked pixels at once.

Event rate control: the first events of each period of the sensor's clock leave it, the others do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events
from firmware_protocol.imx636.registers import PIXEL_MASKS, SIZE, Address, Registers

__all__ = ["RateControl", "Selected", "Selection"]


_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Selected:
    """Events (n,) EVENT that pass, and the numbers of the others, by reason."""

    events: Events
    outside: int
    beyond_rate: int


class RateControl:
    """Limit of the events in each period of the device's clock."""

    def __init__(self, period_us: int) -> None:
        self._period_us, self._most = period_us, 0
        self._period, self._seen = -1, 0
        self.on = False

    def turn(self, on: int) -> None:
        """Switch it on or off."""
        self.on = bool(on)

    def set_period_us(self, period_us: int) -> None:
        """Set the length of a period."""
        self._period_us = period_us

    def set_most(self, events: int) -> None:
        """Set the number of events that pass in a period."""
        self._most = events

    def selected(self, events: Events, wanted: Events, epoch_us: int) -> Selected:
        """Return the part that passes of the `wanted` ones of `events`, both sorted; the clock was 0 at `epoch_us`."""
        passing = wanted[self._passing(wanted, epoch_us)] if self.on else wanted
        return Selected(passing, len(events) - len(wanted), len(wanted) - len(passing))

    def _passing(self, events: Events, epoch_us: int) -> _Mask:
        """Return a mask of the events (n,) EVENT, sorted, that pass, (n,) bool: the first ones of each period."""
        if not len(events):
            return np.zeros(0, np.bool_)
        periods = (events["t"].astype(np.int64) - epoch_us) // self._period_us
        ranks = np.arange(len(periods)) - np.searchsorted(periods, periods)
        if periods[0] == self._period:
            ranks[periods == self._period] += self._seen
        self._period, self._seen = int(periods[-1]), int(ranks[-1]) + 1
        return ranks < self._most


_MASKS_ON, _TAKE_OVER, _KEEP_INSIDE = 1 << 1, 1 << 5, 1 << 6
_RATE = (Address.RATE_STATE, Address.RATE_PERIOD, Address.RATE_EVENTS, Address.RATE_ON, Address.RATE_DROPS)


class Selection:
    """The masks and the rate control of a register file, applied to events."""

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self.reset()

    def reset(self) -> None:
        """Return to the power-on state."""
        self._columns, self._rows = (np.zeros(pixels, np.bool_) for pixels in SIZE)
        self._pixels = np.zeros(0, np.int64)
        self._rate = RateControl(self._registers[Address.RATE_PERIOD])
        self._hides = False

    def written(self, address: int) -> None:
        """Apply the effect of a register that was just written."""
        if address == Address.RESET:
            self.reset()
        elif address == Address.ARRAY:
            self._take_over()
        elif Address.PIXELS <= address < Address.PIXELS + 4 * PIXEL_MASKS:
            words = self._registers.words(Address.PIXELS, PIXEL_MASKS)
            words = words[words >> 31 == 1].astype(np.int64)
            self._pixels = _numbers(words & 0x7FF, words >> 16 & 0x3FF)
        elif address in _RATE:
            self._set_rate()

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the sensor's clock was zero at `epoch_us`."""
        wanted = events[~self._hidden(events)] if self._hides or len(self._pixels) else events
        return self._rate.selected(events, wanted, epoch_us)

    def _hidden(self, events: Events) -> _Mask:
        hidden = np.zeros(len(events), np.bool_)
        if self._hides:
            rows, columns = self._rows[events["y"]], self._columns[events["x"]]
            inside = self._registers[Address.ARRAY] & _KEEP_INSIDE
            hidden = rows | columns if inside else rows & columns
        if len(self._pixels):
            hidden |= np.isin(_numbers(events["x"].astype(np.int64), events["y"].astype(np.int64)), self._pixels)
        return hidden

    def _take_over(self) -> None:
        control = self._registers[Address.ARRAY]
        if control & _TAKE_OVER:
            self._columns = self._mask(Address.COLUMNS, SIZE[0])
            self._rows = self._mask(Address.ROWS, SIZE[1])
        self._hides = bool(control & _MASKS_ON) and bool(self._columns.any() or self._rows.any())

    def _mask(self, address: int, pixels: int) -> _Mask:
        words = self._registers.words(address, -(-pixels // 32)).astype("<u4")
        return np.unpackbits(words.view(np.uint8), count=pixels, bitorder="little").astype(np.bool_)

    def _set_rate(self) -> None:
        state, period_us, events, on, drops = (self._registers[address] for address in _RATE)
        self._rate.set_period_us(max(1, period_us & 0x3FF))
        self._rate.set_most(events & 0x3F_FFFF)
        self._rate.turn(state & 3 == 1 and on & 1 and drops & 1)


def _numbers(x: npt.NDArray[np.int64], y: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return y * SIZE[0] + x

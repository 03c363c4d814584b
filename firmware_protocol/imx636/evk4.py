"""USB device model of a Prophesee EVK4 HD (IMX636) and its siblings: see `imx636.boards` for these.

The USB side, with its endpoints, is `prophesee.usb`.

Run gate: events leave while the array runs (register 0004 bit 10), the output is enabled (9028 bit 1 is 0) and time
runs (9008 bit 0). Words are EVT3, or EVT2.1 if the host sets it (7000 bit 1).

Biases act on the sensor through `sensor_factors`; see `prophesee.biases`.

Row and column masks take effect together when bit 5 of the array control is written; masked pixels at once. The event
rate control is that of `prophesee.selection`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events
from firmware_protocol.imx636.boards import BOARDS, BoardModel
from firmware_protocol.imx636.registers import PIXEL_MASKS, SIZE, Address, Chip, Registers, Surroundings
from firmware_protocol.prophesee.selection import Mask, RateControl, Selected, unpacked
from firmware_protocol.prophesee.usb import TreuzellCamera, TreuzellSettings

_MASKS_ON, _TAKE_OVER, _KEEP_INSIDE = 1 << 1, 1 << 5, 1 << 6
_RATE = (Address.RATE_STATE, Address.RATE_PERIOD, Address.RATE_EVENTS, Address.RATE_ON, Address.RATE_DROPS)


@dataclass(frozen=True)
class Evk4Settings(TreuzellSettings):
    """Settings of a camera.

    Attributes
    ----------
    surroundings
        Readings of the sensor's own instruments.
    board
        The board: its identity and its sensor.
    """

    surroundings: Surroundings = field(default_factory=Surroundings)
    board: BoardModel = BOARDS["evk4"]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor, pixels."""
        return SIZE

    @property
    def identity_of_board(self) -> BoardModel:
        """Identity of the board."""
        return self.board

    @property
    def chip_names(self) -> Chip:
        """Names of the sensor."""
        return self.board.chip


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

    def _hidden(self, events: Events) -> Mask:
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

    def _mask(self, address: int, pixels: int) -> Mask:
        return unpacked(self._registers.words(address, -(-pixels // 32)), pixels)

    def _set_rate(self) -> None:
        state, period_us, events, on, drops = (self._registers[address] for address in _RATE)
        self._rate.set_period_us(max(1, period_us & 0x3FF))
        self._rate.set_most(events & 0x3F_FFFF)
        self._rate.turn(state & 3 == 1 and on & 1 and drops & 1)


def _numbers(x: npt.NDArray[np.int64], y: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return y * SIZE[0] + x


class Evk4(TreuzellCamera):
    """The camera; see `prophesee.usb.TreuzellCamera`."""

    def __init__(self, settings: Evk4Settings | None = None) -> None:
        settings = settings or Evk4Settings()
        registers = Registers(settings.surroundings, settings.biases, settings.board.chip)
        super().__init__(settings, registers, Selection(registers))

"""Selection of the events that leave a GenX320, in the order of its pipeline:

    latches -> masks of 32 pixels -> crop -> noise filter -> anti-flicker filter -> rate control

Latches, one for each pixel, are written by windows (0034, at once for all pixels), or for the rows that 3000 selects
when bit 5 of the array control rises; they count while its bit 1 is 1. The crop may move the origin: events leave with
columns and rows that count from its corner. Rate control is that of `prophesee.selection`.

The order of the filters is that of the sensor's status register (0084). The filter of trails has no effect here.
"""

from __future__ import annotations

import numpy as np

from firmware_protocol.events import Events, copy_events
from firmware_protocol.genx320.filters import FlickerFilter, NoiseFilter
from firmware_protocol.genx320.registers import MASKS, SIZE, WINDOWS, Address, Registers
from firmware_protocol.prophesee.selection import Mask, RateControl, Selected, unpacked

_WIDTH, _HEIGHT = SIZE
_LATCHES_ON, _TAKE_OVER = 1 << 1, 1 << 5
_RUN, _OUTSIDE = 3, 1 << 2
_CROP_ON, _CROP_DROPS, _NEW_ORIGIN = 1 << 0, 1 << 2, 1 << 4
_COORDINATE = 0x1FF
_RATE = (Address.RATE, Address.RATE_DROPS, Address.RATE_PERIOD, Address.RATE_EVENTS)


class Selection:
    """The part of the events that a register file selects."""

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self.reset()

    def reset(self) -> None:
        """Return to the power-on state."""
        self._latched, self._masked = (np.zeros((_HEIGHT, _WIDTH), np.bool_) for _ in range(2))
        self._hidden = self._latched
        self._array = self._registers[Address.ARRAY]
        self._hides = False
        self._rate = RateControl(self._registers[Address.RATE_PERIOD])
        self._noise = NoiseFilter(self._registers)
        self._flicker = FlickerFilter(self._registers)

    def written(self, address: int) -> None:
        """Apply the effect of a register that was just written."""
        if address == Address.RESET:
            if self._registers[Address.RESET] & 1:
                self.reset()
        elif address == Address.ARRAY:
            self._control_array()
        elif address == Address.WINDOW_CONTROL:
            self._set_windows()
        elif Address.MASKS <= address < Address.MASKS + 8 * MASKS:
            self._set_masks()
        elif address in _RATE:
            self._set_rate()
        elif Address.NOISE <= address <= Address.NOISE_HIGH_ON:
            self._noise.configure()
        elif Address.FLICKER <= address <= Address.FLICKER_READY:
            self._flicker.configure()

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the sensor's clock was zero at `epoch_us`."""
        wanted = events
        if self._hides:
            wanted = wanted[~self._hidden[wanted["y"], wanted["x"]]]
        if self._registers[Address.CROP] & _CROP_ON:
            wanted = self._cropped(wanted)
        wanted = self._flicker.passed(self._noise.passed(wanted, epoch_us))
        return self._rate.selected(events, wanted, epoch_us)

    def _control_array(self) -> None:
        before, self._array = self._array, self._registers[Address.ARRAY]
        if self._array & ~before & _TAKE_OVER:
            rows, columns = (unpacked(self._registers.words(at, 10), 320) for at in (Address.ROWS, Address.COLUMNS))
            self._latched[rows] = columns
        self._combine()

    def _set_windows(self) -> None:
        control = self._registers[Address.WINDOW_CONTROL]
        if control & _RUN != _RUN:
            return
        inside = np.zeros((_HEIGHT, _WIDTH), np.bool_)
        for i in range(min(control >> 3 & 0x1F, WINDOWS)):
            columns, rows = (_span(word) for word in self._registers.words(Address.WINDOWS + 8 * i, 2).tolist())
            inside[rows, columns] = True
        self._latched[:] = inside if control & _OUTSIDE else ~inside
        self._combine()

    def _set_masks(self) -> None:
        self._masked[:] = False
        words = self._registers.words(Address.MASKS, 2 * MASKS).reshape(-1, 2)
        for control, pixels in words.tolist():
            group, row = control & 0xF, control >> 4 & _COORDINATE
            if control >> 31 and group < _WIDTH // 32 and row < _HEIGHT:
                self._masked[row, 32 * group : 32 * group + 32] |= unpacked(np.array([pixels], np.uint32), 32)
        self._combine()

    def _combine(self) -> None:
        self._hidden = self._masked | self._latched if self._array & _LATCHES_ON else self._masked
        self._hides = bool(self._hidden.any())

    def _cropped(self, events: Events) -> Events:
        control, start, end = self._registers.words(Address.CROP, 3).tolist()
        first_x, first_y, last_x, last_y = (word >> shift & _COORDINATE for word in (start, end) for shift in (0, 16))
        x, y = events["x"], events["y"]
        inside: Mask = (x >= first_x) & (x <= last_x) & (y >= first_y) & (y <= last_y)
        if not control & _CROP_DROPS:
            return events
        cropped = copy_events(events[inside])
        if control & _NEW_ORIGIN:
            cropped["x"] -= np.uint16(first_x)
            cropped["y"] -= np.uint16(first_y)
        return cropped

    def _set_rate(self) -> None:
        control, drops, period_us, events = (self._registers[address] for address in _RATE)
        self._rate.set_period_us(max(1, period_us & 0x3FF))
        self._rate.set_most(events & 0x1F_FFFF)
        self._rate.turn(control & 5 == 1 and drops & 4)


def _span(word: int) -> slice:
    """Return the columns or rows of a window."""
    return slice(word & _COORDINATE, word >> 16 & _COORDINATE)

"""Selection of the events that leave a GenX320, in the order of its pipeline:

    latches -> masks of 32 pixels -> crop -> noise filter -> anti-flicker filter -> rate control

Latches, one for each pixel, are written by windows (0034, at once for all pixels), or for the rows that 3000 selects
when bit 5 of the array control rises; they count while its bit 1 is 1. The crop may move the origin: events leave with
columns and rows that count from its corner. Rate control is that of `prophesee.camera`.

The order of the filters is that of the sensor's status register (0084). The filter of trails has no effect here. The
other two act as far as their registers determine them.

Noise filter (E000 bit 0 on, 2 bypass): events leave while their rate is neither too low nor too high.

    E008            period, us, bits 10..0
    E00C, E010      below the first, in events a period, it drops all events; above the second, no more
    E018, E014      above the first it drops all events; below the second, no more

Anti-flicker filter (C000 bit 0 on, 2 bypass): events of pixels that flicker do not leave it.

    C008            bits 2..0 low count, 5..3 high count, 6 drops the others instead, 7 drops none
    C00C            shortest period in bits 7..0, longest in 15..8, in 128 us

Inferred: the noise filter decides at the end of a period about the next one. A period of flicker lasts from the first
ON event after an OFF event of a pixel to the next such event; each that is between the bounds raises the pixel's count
by one, up to 7, each other lowers it by one; a pixel flickers from the high count on, until its count is at or below
the low one. The duty cycle (C00C bits 19..16) has no effect.

Sources: registers and drivers of OpenEB 5.1.1 (genx320_nfl_driver.cpp, antiflicker_filter.cpp, and the description of
the thresholds in i_event_rate_activity_filter_module.h).
"""

from __future__ import annotations

import numpy as np

from firmware_protocol.events import Events, Int64s, copy_events
from firmware_protocol.genx320.registers import MASKS, SIZE, WINDOWS, Address, Registers
from firmware_protocol.prophesee.camera import Mask, NoiseFilter, RateBand, RateControl, Selected, unpacked

_WIDTH, _HEIGHT = SIZE
_LATCHES_ON, _TAKE_OVER = 1 << 1, 1 << 5
_RUN, _OUTSIDE = 3, 1 << 2
_CROP_ON = 1 << 0
_CROP_DROPS = 1 << 2
_NEW_ORIGIN = 1 << 4
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
        self._noise = NoiseFilter()
        self._set_noise()
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
            self._set_noise()
        elif Address.FLICKER <= address <= Address.FLICKER_READY:
            self._flicker.configure()

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the sensor's clock was zero at `epoch_us`."""
        selected = events
        if self._hides:
            selected = selected[~self._hidden[selected["y"], selected["x"]]]
        if self._registers[Address.CROP] & _CROP_ON:
            selected = self._cropped(selected)
        selected = self._flicker.passed(self._noise.passed(selected, epoch_us))
        return self._rate.selected(events, selected, epoch_us)

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
            columns, rows = self._registers.words(Address.WINDOWS + 8 * i, 2).tolist()
            first_column, last_column = columns & _COORDINATE, columns >> 16 & _COORDINATE
            first_row, last_row = rows & _COORDINATE, rows >> 16 & _COORDINATE
            inside[first_row:last_row, first_column:last_column] = True
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
        self._rate.period_us, self._rate.most = max(1, period_us & 0x3FF), events & 0x1F_FFFF
        self._rate.on = bool(control & 5 == 1 and drops & 4)

    def _set_noise(self) -> None:
        control, period_us = (self._registers[at] for at in (Address.NOISE, Address.NOISE_PERIOD))
        bounds = self._registers.words(Address.NOISE_LOW_ON, 4).tolist()
        low_on, low_off, high_off, high_on = (bound & _RATE_BITS for bound in bounds)
        band = RateBand(max(1, period_us & 0x7FF), low_on, low_off, high_off, high_on)
        self._noise.configure(band if control & _ON_BITS == _ON else None)


_ON_BITS, _ON = 5, 1  # of a pipeline control: bit 0 on, bit 2 bypass
_RATE_BITS = 0x1F_FFFF

_PIXELS = SIZE[0] * SIZE[1]
_MOST_COUNT = 7
_LONG_AGO_US = -(1 << 62)


class FlickerFilter:
    """Filter of the events of pixels that flicker."""

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._on = False
        self.configure()

    def configure(self) -> None:
        """Apply the registers; the filter's memory is empty after it was switched on."""
        had, self._on = self._on, self._registers[Address.FLICKER] & _ON_BITS == _ON
        if not self._on:
            return
        parameters, periods = self._registers.words(Address.FLICKER_PARAMETERS, 2).tolist()
        self._low, self._high = parameters & 7, parameters >> 3 & 7
        self._inverted, self._drops = bool(parameters & 1 << 6), not parameters & 1 << 7
        self._shortest_us, self._longest_us = 128 * (periods & 0xFF), 128 * (periods >> 8 & 0xFF) + 127
        if not had:
            self._was_on = np.ones(_PIXELS, np.bool_)
            self._rise_us = np.full(_PIXELS, _LONG_AGO_US, np.int64)
            self._count = np.zeros(_PIXELS, np.int64)
            self._flickers = np.zeros(_PIXELS, np.bool_)

    def passed(self, events: Events) -> Events:
        """Return the part that passes of events (n,) EVENT, sorted by time."""
        if not self._on or not len(events):
            return events
        pixels = events["y"].astype(np.int64) * SIZE[0] + events["x"]
        order = np.argsort(pixels, kind="stable")
        flickers = np.empty(len(events), np.bool_)
        flickers[order] = self._flickering(pixels[order], events["t"].astype(np.int64)[order], events["on"][order])
        return events[flickers == self._inverted] if self._drops else events

    def _flickering(self, pixels: Int64s, t_us: Int64s, on: Mask) -> Mask:
        """Return whether the pixel of each event flickers then, (n,) bool; events are sorted by pixel, then by time."""
        places = np.arange(len(pixels))
        is_first = np.concatenate([[True], pixels[1:] != pixels[:-1]])
        was_on = np.where(is_first, self._was_on[pixels], np.concatenate([[False], on[:-1]]))
        is_last = np.concatenate([is_first[1:], [True]])
        self._was_on[pixels[is_last]] = on[is_last]
        before, rises = self._flickers[pixels], on & ~was_on
        after = before.copy()
        after[rises] = self._count_periods(pixels[rises], t_us[rises])
        first = np.maximum.accumulate(np.where(is_first, places, 0))
        rise = np.maximum.accumulate(np.where(rises, places, -1))
        return np.where(rise >= first, after[rise], before)

    def _count_periods(self, pixels: Int64s, t_us: Int64s) -> Mask:
        """Return whether the pixel of each rise flickers after it; the first rises of all pixels go together."""
        flickers = np.empty(len(pixels), np.bool_)
        is_first = np.concatenate([[True], pixels[1:] != pixels[:-1]]) if len(pixels) else flickers
        places = np.arange(len(pixels))
        rank = places - np.maximum.accumulate(np.where(is_first, places, 0))
        for k in range(int(rank.max(initial=-1)) + 1):
            now = rank == k
            flickers[now] = self._count_once(pixels[now], t_us[now])
        return flickers

    def _count_once(self, pixels: Int64s, t_us: Int64s) -> Mask:
        period_us = t_us - self._rise_us[pixels]
        fits = (period_us >= self._shortest_us) & (period_us <= self._longest_us)
        count = np.clip(self._count[pixels] + np.where(fits, 1, -1), 0, _MOST_COUNT)
        flickers: Mask = (count >= self._high) | (self._flickers[pixels] & (count > self._low))
        self._rise_us[pixels] = t_us
        self._count[pixels] = count
        self._flickers[pixels] = flickers
        return flickers

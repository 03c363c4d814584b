"""Selection of events by the sensor chip of a DVXplorer.

    events -> polarity -> crop -> area blocking -> sub-sampling -> flatten -> encoder

    crop            3300 bit 0: off   3305-06, 3307-08 first and last column   3301, 3303 first and last group of rows
                    3302, 3304 rows of those two groups: bit i is row 8 g + i
    area blocking   20 words, one for each 32 columns; bit i: the pixels of rows 32 i to 32 i + 31 send events
    sub-sampling    code    0    1          2         3          4         7
                    sends   all  every 2nd  2 of 4    every 4th  4 of 8    every 8th

The chip's frame is the user's with both axes mirrored, as the orientation register reports. This is observed for the
crop (traffic of dv-processing and libcaer) and inferred for the other two. Inferred as well: the phase of sub-sampling,
that the codes 2 and 4 are bands, and that flattened events are ON. Codes 5 and 6 are patterns that are not public: here
they send all pixels. Binning has no effect.

Filtered events are counted as not selected.
"""

from __future__ import annotations

import numpy as np

from firmware_protocol.device.fates import Counts
from firmware_protocol.dvxplorer.registers import AREA_WORDS, SIZE, Chip, chip_of
from firmware_protocol.dvxplorer.words import ROWS_OF_GROUP
from firmware_protocol.events import Events, Mask
from firmware_protocol.fx3.registers import RegisterFile

_FLATTEN = 1 << 6
_ON_ONLY = 1 << 5
_OFF_ONLY = 1 << 4
_NO_AREA, _NO_SUBSAMPLING = 1 << 1, 1 << 2
_BLOCK = 32
_KEPT_OF = {1: (1, 2), 2: (2, 4), 3: (1, 4), 4: (4, 8), 7: (1, 8)}
_CROP_NAMES = 9


def polarity_format(mode: int) -> int:
    """Return the bits of the format register of a polarity mode: 0 both, 1 all are ON, 2 ON only, 3 OFF only."""
    return (0, _FLATTEN, _ON_ONLY, _OFF_ONLY)[mode]


class ChipFilters:
    """The selection of one chip, which counts in the camera's `fates`."""

    def __init__(self, fates: Counts) -> None:
        self._fates = fates
        self._columns, self._rows = (np.ones(pixels, np.bool_) for pixels in SIZE)
        self._blocks: Mask | None = None
        self._format = 0
        self._filtered = 0
        self._all_pixels = True
        self._selected_by: tuple[int, ...] = ()

    def power_on(self) -> None:
        """Do nothing: the selection has no memory."""

    def follow(self, registers: RegisterFile, now_us: int) -> None:
        """Apply registers that were written at `now_us`."""
        chip = chip_of(registers)
        self._format = chip(Chip.FORMAT)
        addresses = (Chip.DIGITAL, Chip.SUBSAMPLING, *range(Chip.CROP_OFF, Chip.CROP_OFF + _CROP_NAMES))
        values = tuple(map(chip, (*addresses, *range(Chip.AREA, Chip.AREA + 2 * AREA_WORDS))))
        if values == self._selected_by:
            return
        self._selected_by = values
        digital, ratio, *crop = values[: 2 + _CROP_NAMES]
        columns, rows = _cropped(crop)
        if not digital & _NO_SUBSAMPLING:
            columns, rows = columns & sampled(ratio & 7, SIZE[0]), rows & sampled(ratio >> 3 & 7, SIZE[1])
        self._columns, self._rows = columns[::-1].copy(), rows[::-1].copy()
        blocks = None if digital & _NO_AREA else _blocks(values[2 + _CROP_NAMES :])
        self._blocks = None if blocks is None or blocks.all() else blocks
        self._all_pixels = bool(columns.all() and rows.all()) and self._blocks is None

    def passed(self, events: Events, registers: RegisterFile) -> Events:
        """Return the part of `events`, (n,) EVENT, that passes; `events` may be changed. `take` counts the others."""
        self._filtered = 0
        if self._all_pixels and not self._format & (_FLATTEN | _ON_ONLY | _OFF_ONLY):
            return events
        good = np.ones(len(events), np.bool_)
        if self._format & _ON_ONLY:
            good &= events["on"]
        if self._format & _OFF_ONLY:
            good &= ~events["on"]
        inside = (events["x"] < SIZE[0]) & (events["y"] < SIZE[1])  # others are refused later, not filtered
        x, y = events["x"][inside], events["y"][inside]
        good[inside] &= self._columns[x] & self._rows[y]
        if self._blocks is not None:
            good[inside] &= self._blocks[x, y]
        passing = events if good.all() else events[good]
        if self._format & _FLATTEN:
            passing["on"] = True
        self._filtered = len(events) - len(passing)
        return passing

    def take(self) -> None:
        """Count the events that did not pass in the last call of `passed`."""
        self._fates.not_selected += self._filtered


def _cropped(crop: list[int]) -> tuple[Mask, Mask]:
    """Return masks of the columns and of the rows of the chip's frame that the nine crop registers select."""
    is_off, first_group, first_rows, last_group, last_rows, *x = crop
    columns, rows = np.zeros(SIZE[0], np.bool_), np.zeros((SIZE[1] // ROWS_OF_GROUP, ROWS_OF_GROUP), np.bool_)
    if is_off & 1:
        return ~columns, ~rows.ravel()
    columns[x[0] << 8 | x[1] : (x[2] << 8 | x[3]) + 1] = True
    rows[first_group : last_group + 1] = True
    for group, bits in ((first_group, first_rows), (last_group, last_rows)):
        if group < len(rows):
            rows[group] &= np.unpackbits(np.uint8(bits), bitorder="little").astype(np.bool_)
    return columns, rows.ravel()


def sampled(code: int, pixels: int) -> Mask:
    """Return a mask of the pixels of a line that a code of sub-sampling sends."""
    kept, period = _KEPT_OF.get(code, (1, 1))
    return np.arange(pixels) % period < kept


def _blocks(values: tuple[int, ...]) -> Mask:
    """Return a mask of the pixels (x, y) in the user's frame that area blocking lets send, (width, height)."""
    words = np.array(values[::2]) << 8 | np.array(values[1::2])
    bits = words[:, None] >> np.arange(SIZE[1] // _BLOCK) & 1
    of_chip = np.repeat(np.repeat(bits.astype(np.bool_), _BLOCK, axis=0), _BLOCK, axis=1)
    return np.ascontiguousarray(of_chip[::-1, ::-1])

"""The filters of background activity and refractory period, which use the time since the last event nearby.

Both share one memory. It holds a stamp of 18 bits for each cell of 4 x 4 pixels, all 0 at power-on:

    clock                ticks of 250 us since one of the two was switched on; it wraps after 65.5 s
    each event           reads the clock and writes it into its own cell, whether it passes or not
    age of a cell        the clock minus the stamp that was there before, modulo 2^18
    refractory           drops an event whose own cell is younger than register 34; it is tested first
    background activity  drops an event if neither its own cell nor one that its pixel touches has an age of at most
                         register 32

    +---------+     o  touches no other cell
    | c e e c |     e  touches one, beyond its side
    | e o o e |     c  touches three, beyond its corner
    | e o o e |
    | c e e c |     beyond the border of the array there is none
    +---------+

So the filters work on cells: an event in the same cell supports another, or follows it too soon, whatever its pixel
and its polarity. All events pass during the first register 32 ticks after power-on, because stamps and clock start
at 0. A stamp that is 65.5 s old looks new, because the clock has wrapped.

The filters work the same in both layouts: a swap of rows and columns only swaps the sides of a cell. The memory does
not depend on which events passed, so the result does not depend on how events are divided into batches.

Source: DVSBAFilterStateMachine of the published logic (DAVIS FX3), the version with one memory. Its parameter
BA_FILTER_SUBSAMPLE is a number of address bits, 2 by default; the value in the shipped logic is not published.

The loop over events is a compiled kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_protocol.compiled import entry_of, kernel
from firmware_protocol.events import Bytes, Events, Int32s, Mask, UInt16s, empty_events
from firmware_protocol.fx3.registers import Module, RegisterFile

CELL_BITS = 2
STAMP_MASK = (1 << 18) - 1
PASSES = 0
ISOLATED = 1
TOO_SOON = 2

_LAST = (1 << CELL_BITS) - 1

_Int = np.signedinteger[Any]


@entry_of(__name__)
def find_fates(ticks: Int32s, x: UInt16s, y: UInt16s, limits: tuple[int, int], stamps: Int32s, fates: Bytes) -> None:
    """Write the fate of each event into `fates` (n,), and the tick of each into its cell of `stamps`.

    Parameters
    ----------
    ticks, x, y : (n,) the clock at each event, 0 to STAMP_MASK, and its pixel.
    limits : the least age of its own cell and the greatest age of a cell that supports an event, ticks.
    stamps : (rows, columns) of cells.
    """
    rows, columns = stamps.shape
    shortest, longest = limits
    for i in range(len(ticks)):
        now = ticks[i]
        row = np.int64(y[i]) >> CELL_BITS
        column = np.int64(x[i]) >> CELL_BITS
        if row >= rows or column >= columns:
            fates[i] = PASSES
            continue
        age = now - stamps[row, column] & STAMP_MASK
        if age < shortest:
            fates[i] = TOO_SOON
        elif age <= longest:
            fates[i] = PASSES
        else:
            row_beside, column_beside = row + _side(y[i]), column + _side(x[i])
            supported = (
                _supports(stamps, row, column_beside, now, longest)
                or _supports(stamps, row_beside, column, now, longest)
                or _supports(stamps, row_beside, column_beside, now, longest)
            )
            fates[i] = PASSES if supported else ISOLATED
        stamps[row, column] = now  # after its neighbours are read: a missing neighbour is replaced by the cell itself


@kernel
def _side(place: np.uint16) -> int:
    """Return -1 or 1 for a pixel at the low or high side of its cell, else 0."""
    within = np.int64(place) & _LAST
    return 1 if within == _LAST else -1 if within == 0 else 0


@kernel
def _supports(stamps: Int32s, row: _Int, column: _Int, now: _Int, longest: int) -> bool:
    """Return true if a cell supports an event."""
    rows, columns = stamps.shape
    is_inside = 0 <= row < rows and 0 <= column < columns
    return bool(is_inside and (now - stamps[row, column] & STAMP_MASK) <= longest)


_TICK_US = 250


@dataclass(frozen=True)
class ActivityLimits:
    """Limits that the registers set, in ticks.

    Attributes
    ----------
    shortest : the least age of its own cell that lets an event pass; 0: any.
    longest : the greatest age of a cell that supports an event; STAMP_MASK: any.
    """

    shortest: int
    longest: int

    @classmethod
    def of(cls, registers: RegisterFile) -> ActivityLimits | None:
        """Return the limits in the registers; None: both filters are off."""
        isolated, age, refractory, pause = (registers.read(Module.DVS, address) for address in (31, 32, 33, 34))
        if not isolated and not refractory:
            return None
        return cls(pause if refractory else 0, age if isolated else STAMP_MASK)


@dataclass(frozen=True)
class ActivityResult:
    """Result for a batch: mask of passing events, counts of isolated and early ones, memory (cells) after them."""

    passes: Mask
    isolated: int
    too_soon: int
    stamps: Int32s


class ActivityFilter:
    """Both filters of a camera of `size` (width, height); compiles the kernel at once, so that no event waits."""

    def __init__(self, size: tuple[int, int]) -> None:
        width, height = size
        self._stamps = np.zeros((_cells(height), _cells(width)), np.int32)
        self._since_us = 0
        self._on = False
        self._result_for(empty_events(), ActivityLimits(0, STAMP_MASK))

    def power_on(self) -> None:
        """Empty the memory."""
        self._stamps = np.zeros_like(self._stamps)
        self._on = False

    def follow(self, registers: RegisterFile, now_us: int) -> None:
        """Start the clock if the registers have switched a filter on at `now_us`."""
        on = ActivityLimits.of(registers) is not None
        if on and not self._on:
            self._since_us = now_us
        self._on = on

    def result_for(self, events: Events, registers: RegisterFile) -> ActivityResult | None:
        """Return the fate of events, (n,) EVENT in stream time; `take` applies it.

        None: both filters are off. Events outside the array pass and leave no stamp: the encoder refuses them.
        """
        limits = ActivityLimits.of(registers)
        return None if limits is None else self._result_for(events, limits)

    def take(self, activity: ActivityResult) -> None:
        """Store the stamps of the events that passed."""
        self._stamps = activity.stamps

    def _result_for(self, events: Events, limits: ActivityLimits) -> ActivityResult:
        ticks = (events["t"].astype(np.int64) - self._since_us) // _TICK_US & STAMP_MASK
        x, y = np.ascontiguousarray(events["x"]), np.ascontiguousarray(events["y"])
        stamps, fates = self._stamps.copy(), np.empty(len(events), np.uint8)
        find_fates(ticks.astype(np.int32), x, y, (limits.shortest, limits.longest), stamps, fates)
        isolated, too_soon = np.count_nonzero(fates == ISOLATED), np.count_nonzero(fates == TOO_SOON)
        return ActivityResult(fates == PASSES, int(isolated), int(too_soon), stamps)


def _cells(pixels: int) -> int:
    return (pixels - 1 >> CELL_BITS) + 1

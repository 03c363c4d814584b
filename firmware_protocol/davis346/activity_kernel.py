"""The loop over events of the activity filter, compiled; the rules: see `activity_filter`."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import entry_of, kernel

__all__ = ["CELL_BITS", "ISOLATED", "PASSES", "STAMP_MASK", "TOO_SOON", "find_fates"]

CELL_BITS = 2
STAMP_MASK = (1 << 18) - 1
PASSES, ISOLATED, TOO_SOON = 0, 1, 2

_LAST = (1 << CELL_BITS) - 1

_Int = np.signedinteger[Any]
_Int32s = npt.NDArray[np.int32]
_UInt16s = npt.NDArray[np.uint16]


@entry_of(__name__)
def find_fates(
    ticks: _Int32s, x: _UInt16s, y: _UInt16s, limits: tuple[int, int], stamps: _Int32s, fates: npt.NDArray[np.uint8]
) -> None:
    """Write what becomes of each event into `fates` (n,), and the tick of each into its cell of `stamps`.

    Parameters
    ----------
    ticks, x, y
        (n,) the clock at each event, 0 to STAMP_MASK, and its pixel.
    limits
        The least age of its own cell and the greatest age of a cell that supports an event, ticks.
    stamps
        (rows, columns) of cells.
    """
    rows, columns = stamps.shape
    shortest, longest = limits
    for i in range(len(ticks)):
        now, row, column = ticks[i], np.int64(y[i]) >> CELL_BITS, np.int64(x[i]) >> CELL_BITS
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
            heard = (
                _is_heard(stamps, row, column_beside, now, longest)
                or _is_heard(stamps, row_beside, column, now, longest)
                or _is_heard(stamps, row_beside, column_beside, now, longest)
            )
            fates[i] = PASSES if heard else ISOLATED
        stamps[row, column] = now  # not before its neighbours were asked: where there is none, it is its own


@kernel
def _side(place: np.uint16) -> int:
    """Return -1 or 1 for a pixel at the low or high side of its cell, else 0."""
    within = np.int64(place) & _LAST
    return 1 if within == _LAST else -1 if within == 0 else 0


@kernel
def _is_heard(stamps: _Int32s, row: _Int, column: _Int, now: _Int, longest: int) -> bool:
    """Say whether a cell supports an event."""
    rows, columns = stamps.shape
    is_inside = 0 <= row < rows and 0 <= column < columns
    return bool(is_inside and (now - stamps[row, column] & STAMP_MASK) <= longest)

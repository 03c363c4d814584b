"""The changed region of a frame, as the blocks and parts of blocks that lie in it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.numerics.compiled import kernel
from emulator.sensor.pixels.state import BLOCK, PART, PARTS

__all__ = ["Touched", "block_is_touched", "part_is_touched", "touch"]

_BLOCK, _PART = np.int64(BLOCK), np.int64(PART)  # as literals, they would be compiled for one by one
_Bytes = npt.NDArray[np.uint8]


class Touched(NamedTuple):
    """The part of a light frame of `width` columns that may have changed; last row and column not included.

    `units`, (blocks * (1 + PARTS),), gives it instead, with 1 where a block or part may have changed, blocks first. It
    is empty where it is not used. One array for both, because each costs time in every call.
    """

    first_row: int
    last_row: int
    first_column: int
    last_column: int
    width: int
    units: _Bytes


@kernel
def _meets_rectangle(first: int, n: int | np.int64, touched: Touched) -> bool:
    """Return whether the n pixels from `first` on may meet the rectangle."""
    if (first + n <= touched.first_row * touched.width) | (first >= touched.last_row * touched.width):
        return False
    if touched.width < n:
        return True
    column = first % touched.width
    return bool((column + n > touched.width) | ((column < touched.last_column) & (column + n > touched.first_column)))


@kernel
def block_is_touched(first: int, touched: Touched) -> bool:
    """Return whether the block that begins at pixel `first` has pixels in the touched part."""
    if touched.units.size:
        return bool(touched.units[first // BLOCK])
    return bool(_meets_rectangle(first, _BLOCK, touched))


@kernel
def part_is_touched(first: int, touched: Touched) -> bool:
    """Return whether the part that begins at pixel `first` has pixels in the touched part."""
    if touched.units.size:
        return bool(touched.units[touched.units.size // (1 + PARTS) + first // PART])
    return bool(_meets_rectangle(first, _PART, touched))


@cached_entry
def touch(boxes: npt.NDArray[np.int64], width: int, units: _Bytes) -> None:
    """Write to `units`, see `Touched`, 1 where a block or part has pixels in one of the boxes of a `Region`, else 0."""
    units[:] = 0
    blocks = units.size // (1 + PARTS)
    for k in range(boxes.shape[0]):
        if boxes[k, 2] < boxes[k, 3]:
            for row in range(boxes[k, 0], boxes[k, 1]):
                begin, end = row * width + boxes[k, 2], row * width + boxes[k, 3]
                for part in range(begin // PART, (end - 1) // PART + 1):
                    units[blocks + part] = units[part // PARTS] = 1

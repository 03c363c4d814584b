"""Packed events of one step, one number each, so that sorting the numbers sorts the events."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import kernel, kernel_that_allocates

__all__ = ["MOST_EVENTS", "Keys", "pack", "reserve"]

Keys = npt.NDArray[np.uint64]

MOST_EVENTS = 64
"""Most events of a pixel in a step; further crossings are counted as lost in the pixel."""


@kernel
def pack(dt_ns: int, pixel: int, on: int, pixel_bits: int) -> np.uint64:
    """Pack an event so that sorting the numbers sorts by (time, pixel): [dt_ns | pixel | on]."""
    return (np.uint64(dt_ns) << np.uint64(pixel_bits + 1)) | (np.uint64(pixel) << np.uint64(1)) | np.uint64(on)


@kernel_that_allocates
def reserve(keys: Keys, needed: int) -> Keys:
    """Return `keys`, or a longer copy if it holds fewer than `needed`."""
    if needed <= keys.size:
        return keys
    longer = np.empty(max(2 * keys.size, needed), np.uint64)
    for k in range(keys.size):  # a slice would take seconds to compile
        longer[k] = keys[k]
    return longer

"""Packed events of one step, one number each, so that sorting the numbers sorts the events; and lost ones, counted.

A pixel without a refractory period may cross any number of thresholds in a step, as under light with parasitic leak.
Beyond MOST_EVENTS they are not found one by one: on a monotone curve their number is the way over the threshold.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import kernel, kernel_that_allocates

__all__ = ["MOST_EVENTS", "MOST_LOST", "Keys", "levels_passed", "pack", "reserve"]

Keys = npt.NDArray[np.uint64]

MOST_EVENTS = 64
"""Most events of a pixel in a step; further crossings are counted as lost in the pixel."""

MOST_LOST = 1 << 32
"""Most lost crossings of a pixel that are counted for a monotone part of its curve; a count that no int64 holds."""


@kernel
def levels_passed(level: float, end: float, threshold: float) -> tuple[int, float]:
    """Return how many thresholds lie between a level and the end of a monotone curve, and what is left of the way.

    The rest is below a threshold; 0 where the numbers are too large to have one.
    """
    way, step = np.float64(end) - np.float64(level), np.float64(threshold)
    passed = np.floor(abs(way) / step)
    rest = abs(way) - passed * step
    if not (rest >= 0) & (rest < step):
        rest = 0.0
    count = MOST_LOST if passed >= MOST_LOST else int(passed)
    return count, rest if way > 0 else -rest


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

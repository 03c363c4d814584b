"""Faults of an array's pixels: dead ones, and a leak that changes while the array runs.

The reference is stored with leak times the time since the epoch added (see `array`). When the leak changes, the
reference moves by the change of leak times that time, and the level that the comparator sees stays where it was.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from emulator.sensor.pixels.state import BLOCK, FIELDS, Field, PixelState

__all__ = ["DEAD_THRESHOLD", "ArrayFaults", "PixelFaults"]

DEAD_THRESHOLD = 1e6
"""Thresholds of a dead pixel, ln units: no light has a million e-folds, and float32 does arithmetic with it."""

_Int64s = npt.NDArray[np.int64]
_Floats = npt.NDArray[np.float64]


class PixelFaults(Protocol):
    """Access to pixels that can be dead, and whose leak can change while they run."""

    def kill(self, pixel: _Int64s) -> None:
        """Make pixels, (n,), dead; before they are reset."""

    def leak_hz(self) -> _Floats:
        """Return the leak rate of all pixels, (pixels,), without the parasitic leak."""

    def set_leak(self, leak_hz: _Floats) -> None:
        """Set the leak rate of all pixels, (pixels,), from now on."""


class _HasState(Protocol):
    """An array with its state; the state may be replaced by another one."""

    state: PixelState

    def wake(self) -> None:
        """Look at all pixels again in the next step."""


class ArrayFaults:
    """The faults of a `PixelArray` of some number of pixels; see `PixelFaults`."""

    def __init__(self, array: _HasState, pixels: int) -> None:
        self._array = array
        self._all = np.arange(pixels)

    def kill(self, pixel: _Int64s) -> None:
        """Make pixels, (n,), dead; before the array is reset.

        A dead pixel leaks in units of its threshold, so the parasitic leak still fires it; the caller must discard its
        crossings.
        """
        flat = self._array.state.fields.reshape(-1)
        flat[_at(pixel, Field.ON)] = flat[_at(pixel, Field.OFF)] = DEAD_THRESHOLD
        flat[_at(pixel, Field.LEAK)] = 0
        self._array.wake()

    def leak_hz(self) -> _Floats:
        """Return the leak rate of all pixels, (pixels,), without the parasitic leak."""
        flat, pixel = self._array.state.fields.reshape(-1), self._all
        return np.asarray(flat[_at(pixel, Field.LEAK)] / flat[_at(pixel, Field.ON)].astype(np.float64))

    def set_leak(self, leak_hz: _Floats) -> None:
        """Set the leak rate of all pixels, (pixels,), from the array's time on."""
        state, pixel = self._array.state, self._all
        flat = state.fields.reshape(-1)
        leak = (leak_hz * flat[_at(pixel, Field.ON)]).astype(np.float32)
        since_epoch_s = np.float32((state.t_ns - state.epoch_ns) * 1e-9)
        flat[_at(pixel, Field.REFERENCE)] += (leak - flat[_at(pixel, Field.LEAK)]) * since_epoch_s
        flat[_at(pixel, Field.LEAK)] = leak
        self._array.wake()


def _at(pixel: _Int64s, which: Field) -> _Int64s:
    """Return the indices of a field of some pixels in the flat state."""
    return np.asarray((pixel // BLOCK) * (FIELDS * BLOCK) + int(which) * BLOCK + pixel % BLOCK)

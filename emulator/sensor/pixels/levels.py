"""How far the comparators of some pixels are from their references, and firing a pixel from outside.

level = signal + leak - reference, ln units: an ON event where it reaches the ON threshold
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.pixels.state import BLOCK, Field, Pixels, PixelState, slot
from emulator.sensor.presets import SensorParameters

__all__ = ["Levels"]

_Int64s = npt.NDArray[np.int64]
_Float32s = npt.NDArray[np.float32]

_U, _V, _, _, _REF, _ON, _, _LEAK, _W, _P = (int(f) * BLOCK for f in Field)


@cached_entry
def _levels(pixels: Pixels, which: _Int64s, since_epoch_s: float, parasitic: float, second: bool) -> _Float32s:
    out = np.empty(which.size, np.float32)
    for k in range(which.size):
        at = slot(which[k])
        compared = pixels.fields[at + (_W if second else _V)] + pixels.fields[at + _LEAK] * since_epoch_s
        if parasitic > 0:
            light = np.exp(pixels.fields[at + _U])
            compared += pixels.fields[at + _P] + parasitic * pixels.fields[at + _ON] * light * since_epoch_s
        out[k] = compared - pixels.fields[at + _REF]
    return out


@cached_entry
def _thresholds(pixels: Pixels, which: _Int64s, row: int) -> _Float32s:
    out = np.empty(which.size, np.float32)
    for k in range(which.size):
        out[k] = pixels.fields[slot(which[k]) + row]
    return out


@cached_entry
def _fire(pixels: Pixels, which: _Int64s) -> None:
    for k in range(which.size):
        at = slot(which[k])
        pixels.fields[at + _REF] += pixels.fields[at + _ON]


class _Array(Protocol):
    """A `PixelArray`."""

    parameters: SensorParameters
    state: PixelState

    def wake(self) -> None:
        """Look at all pixels again in the next step."""


class Levels:
    """The levels of an array's pixels at its present time."""

    def __init__(self, array: _Array) -> None:
        self._array = array

    @property
    def _pixels(self) -> Pixels:
        state = self._array.state
        return Pixels(state.fields.reshape(-1), state.refractory_until_ns)

    def of(self, pixel: _Int64s) -> _Float32s:
        """Return the levels of pixels (n,); NaN in the refractory period."""
        state, p = self._array.state, self._array.parameters
        since_epoch_s = (state.t_ns - state.epoch_ns) * 1e-9
        second = p.source_follower_hz > 0
        levels: _Float32s = _levels(self._pixels, pixel, since_epoch_s, float(p.parasitic_hz_at_reference), second)
        return levels

    def thresholds(self, pixel: _Int64s) -> tuple[_Float32s, _Float32s]:
        """Return the ON and OFF thresholds of pixels (n,)."""
        on, off = (_thresholds(self._pixels, pixel, int(which) * BLOCK) for which in (Field.ON, Field.OFF))
        return on, off

    def fire(self, pixel: _Int64s) -> None:
        """Move the references of pixels (n,), each named once, by an ON event."""
        if len(pixel):
            _fire(self._pixels, pixel)
            self._array.wake()

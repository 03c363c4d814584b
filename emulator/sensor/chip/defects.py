"""Pixels that are not as they should be: hot ones, whose leak has its own rate, and dead ones, which nothing reaches.

Both are drawn by key from a share, or named by the rig. A dose of radiation makes more pixels hot: each has a dose at
which it turns, drawn from an exponential law, so that a pixel once hot stays hot, and a higher share or dose only adds.

A pixel's leak can change while it runs: the reference is stored with leak times the time since the epoch added (see
`pixels`), so it moves by the change of leak times that time, and the level that the comparator sees stays where it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.keyed import Purpose, normal, uniform
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import BLOCK, FIELDS, Field
from emulator.sensor.presets import SensorParameters

__all__ = ["DEAD_THRESHOLD", "ArrayFaults", "Defects", "Faults", "draw_defects"]

DEAD_THRESHOLD = 1e6
"""Thresholds of a dead pixel, ln units: no light has a million e-folds, and float32 does arithmetic with it."""

_DAY_NS = 86_400 * 10**9
_NEVER_NS = (1 << 63) - 1

_Int64s = npt.NDArray[np.int64]
_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Defects:
    """The defects of an array.

    Attributes
    ----------
    dead : (n,) int64, pixels.
    hot : (m,) int64, pixels that are hot at some time, none of them dead; in the order in which they turn.
    hot_hz : (m,) float64, their rates.
    hot_from_ns : (m,) int64, stream time from which on each is hot; below 0 for those that always were.
    """

    dead: _Int64s
    hot: _Int64s
    hot_hz: _Floats
    hot_from_ns: _Int64s


def _turning_ns(p: SensorParameters, seed: int, pixel: _Int64s) -> _Int64s:
    """Return when each pixel turns hot: -1 if it always was, _NEVER_NS if it does not."""
    turns = np.full(pixel.size, _NEVER_NS, np.int64)
    radiation = p.radiation
    if radiation.hot_share_per_krad and (radiation.dose_krad or radiation.dose_krad_per_day):
        dose_krad = -np.log(uniform(seed, Purpose.DOSE, pixel)) / radiation.hot_share_per_krad
        if radiation.dose_krad_per_day:
            days = (dose_krad - radiation.dose_krad) / radiation.dose_krad_per_day
            soon = days * _DAY_NS < _NEVER_NS / 2
            turns[soon] = np.ceil(days[soon] * _DAY_NS).astype(np.int64)
        turns[dose_krad <= radiation.dose_krad] = -1
    hot = uniform(seed, Purpose.HOT, pixel) < p.defects.hot_share
    hot[_places(p, p.defects.hot_pixels)] = True
    turns[hot] = -1
    return turns


def _places(p: SensorParameters, places: tuple[tuple[int, int], ...]) -> _Int64s:
    return np.array([y * p.width + x for x, y in places], np.int64)


def draw_defects(p: SensorParameters, seed: int) -> Defects:
    """Return the defects that `seed` means for a sensor."""
    pixel = np.arange(p.width * p.height)
    dead = uniform(seed, Purpose.DEAD, pixel) < p.defects.dead_share
    dead[_places(p, p.defects.dead_pixels)] = True
    turns = _turning_ns(p, seed, pixel)
    hot = np.flatnonzero((turns < _NEVER_NS) & ~dead)
    hot = hot[np.argsort(turns[hot], kind="stable")]
    hot_hz = p.defects.hot_hz * np.exp(p.defects.hot_spread * normal(seed, Purpose.HOT_RATE, hot))
    return Defects(np.flatnonzero(dead), hot, hot_hz, turns[hot])


class Faults(Protocol):
    """Pixels that can be dead, and whose leak can be changed while they run."""

    def kill(self, pixel: _Int64s) -> None:
        """Make pixels, (n,), dead; before they are reset."""

    def leak_hz(self) -> _Floats:
        """Return the leak rate of all pixels, (pixels,), without that of light."""

    def let_leak(self, leak_hz: _Floats) -> None:
        """Let all pixels leak at `leak_hz`, (pixels,), from now on."""


class ArrayFaults:
    """The faults of a `PixelArray`; see `Faults`."""

    def __init__(self, array: PixelArray) -> None:
        self._array = array
        self._all = np.arange(array.parameters.width * array.parameters.height)

    def kill(self, pixel: _Int64s) -> None:
        """Make pixels, (n,), dead; before the array is reset.

        Not quite: a pixel leaks in units of its threshold, so what light leaks still fires it. Its crossings are to be
        thrown away.
        """
        flat = self._array.state.fields.reshape(-1)
        flat[_at(pixel, Field.ON)] = flat[_at(pixel, Field.OFF)] = DEAD_THRESHOLD
        flat[_at(pixel, Field.LEAK)] = 0

    def leak_hz(self) -> _Floats:
        """Return the leak rate of all pixels, (pixels,), without that of light."""
        flat, pixel = self._array.state.fields.reshape(-1), self._all
        return np.asarray(flat[_at(pixel, Field.LEAK)] / flat[_at(pixel, Field.ON)].astype(np.float64))

    def let_leak(self, leak_hz: _Floats) -> None:
        """Let all pixels leak at `leak_hz`, (pixels,), from the array's time on."""
        state, pixel = self._array.state, self._all
        flat = state.fields.reshape(-1)
        leak = (leak_hz * flat[_at(pixel, Field.ON)]).astype(np.float32)
        since_epoch_s = np.float32((state.t_ns - state.epoch_ns) * 1e-9)
        flat[_at(pixel, Field.REFERENCE)] += (leak - flat[_at(pixel, Field.LEAK)]) * since_epoch_s
        flat[_at(pixel, Field.LEAK)] = leak


def _at(pixel: _Int64s, which: Field) -> _Int64s:
    """Return where a field of pixels is in the flat state."""
    return np.asarray((pixel // BLOCK) * (FIELDS * BLOCK) + int(which) * BLOCK + pixel % BLOCK)

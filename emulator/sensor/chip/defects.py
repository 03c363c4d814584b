"""Defective pixels: hot ones, whose leak has its own rate, and dead ones, which no light fires.

Both are drawn by key from a share, or listed in the rig. A dose of radiation makes more pixels hot: each has a dose at
which it turns, drawn from an exponential law, so a hot pixel stays hot, and a higher share or dose only adds pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.keyed import Purpose, normal, uniform
from emulator.sensor.presets import SensorParameters

__all__ = ["Defects", "draw_defects"]

_DAY_NS = 86_400 * 10**9
_NEVER_NS = (1 << 63) - 1

_Int64s = npt.NDArray[np.int64]
_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Defects:
    """The defects of an array.

    Attributes
    ----------
    dead : (n,) int64
        Dead pixels.
    hot : (m,) int64
        Pixels that are hot at some time, none of them dead; in the order in which they turn hot.
    hot_hz : (m,) float64
        Rates of the hot pixels.
    hot_from_ns : (m,) int64
        Stream time from which each is hot; below 0 for those that always are.
    """

    dead: _Int64s
    hot: _Int64s
    hot_hz: _Floats
    hot_from_ns: _Int64s


def _turning_ns(p: SensorParameters, seed: int, pixel: _Int64s) -> _Int64s:
    """Return when each pixel turns hot: -1 if it always is, _NEVER_NS if it never is."""
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
    """Return the defects of a sensor for a seed."""
    pixel = np.arange(p.width * p.height)
    dead = uniform(seed, Purpose.DEAD, pixel) < p.defects.dead_share
    dead[_places(p, p.defects.dead_pixels)] = True
    turns = _turning_ns(p, seed, pixel)
    hot = np.flatnonzero((turns < _NEVER_NS) & ~dead)
    hot = hot[np.argsort(turns[hot], kind="stable")]
    hot_hz = p.defects.hot_hz * np.exp(p.defects.hot_spread * normal(seed, Purpose.HOT_RATE, hot))
    return Defects(np.flatnonzero(dead), hot, hot_hz, turns[hot])

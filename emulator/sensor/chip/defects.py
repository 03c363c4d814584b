"""Defective pixels, leak that changes while the array runs, and the effect of the chip's temperature.

Defects are hot pixels, whose leak has its own rate, and dead ones, which no light fires. Both are drawn by key from a
share, or listed in the rig. A dose of radiation makes more pixels hot: each has a dose at which it turns, drawn from an
exponential law, so a hot pixel stays hot, and a higher share or dose only adds pixels.

Leak changes when a dose turns pixels hot, and by jitter. The leak of a pixel is constant over each stretch of 2^33 ns
(8.6 s, the epochs of `array`): the pixel's usual leak times 1 + share times a keyed normal number, never below 0. It
changes at fixed stream times, which `Sensor` makes the ends of steps, so the result does not depend on the steps.

Temperature: leak and dark current double every so many kelvin.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from emulator.sensor.numerics.keyed import Purpose, normal, normals, root_of, streams, uniform
from emulator.sensor.parameters import REFERENCE_CELSIUS
from emulator.sensor.pixels.method import PixelMethod
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Floats, Int64s

_DAY_NS = 86_400 * 10**9
NEVER_NS = (1 << 63) - 1


@dataclass(frozen=True, slots=True)
class Defects:
    """The defects of an array.

    Attributes
    ----------
    dead : dead pixels, (n,) int64.
    hot : pixels that are hot at some time, (m,) int64, none of them dead; in the order in which they turn hot.
    hot_hz : rates of the hot pixels, (m,) float64.
    hot_from_ns : stream time from which each is hot, (m,) int64; below 0 for those that always are.
    """

    dead: Int64s
    hot: Int64s
    hot_hz: Floats
    hot_from_ns: Int64s


def _turning_ns(p: SensorParameters, seed: int, pixel: Int64s) -> Int64s:
    """Return the time at which each pixel turns hot: -1 if it always is, NEVER_NS if it never is."""
    turns = np.full(pixel.size, NEVER_NS, np.int64)
    radiation = p.radiation
    if radiation.hot_share_per_krad and (radiation.dose_krad or radiation.dose_krad_per_day):
        dose_krad = -np.log(uniform(seed, Purpose.DOSE, pixel)) / radiation.hot_share_per_krad
        if radiation.dose_krad_per_day:
            days = (dose_krad - radiation.dose_krad) / radiation.dose_krad_per_day
            soon = days * _DAY_NS < NEVER_NS / 2
            turns[soon] = np.ceil(days[soon] * _DAY_NS).astype(np.int64)
        turns[dose_krad <= radiation.dose_krad] = -1
    hot = uniform(seed, Purpose.HOT, pixel) < p.defects.hot_share
    hot[_places(p, p.defects.hot_pixels)] = True
    turns[hot] = -1
    return turns


def _places(p: SensorParameters, places: tuple[tuple[int, int], ...]) -> Int64s:
    return np.array([y * p.width + x for x, y in places], np.int64)


def draw_defects(p: SensorParameters, seed: int) -> Defects:
    """Return the defects of a sensor for a seed."""
    pixel = np.arange(p.width * p.height)
    dead = uniform(seed, Purpose.DEAD, pixel) < p.defects.dead_share
    dead[_places(p, p.defects.dead_pixels)] = True
    turns = _turning_ns(p, seed, pixel)
    hot = np.flatnonzero((turns < NEVER_NS) & ~dead)
    hot = hot[np.argsort(turns[hot], kind="stable")]
    hot_hz = p.defects.hot_hz * np.exp(p.defects.hot_spread * normal(seed, Purpose.HOT_RATE, hot))
    return Defects(np.flatnonzero(dead), hot, hot_hz, turns[hot])


_STRETCH_BITS = 33


class Leaks:
    """The changing leak of an array.

    Parameters
    ----------
    pixels : pixels that have faults; their present leak is the usual one.
    seed : keys the jitter.
    share : relative standard deviation of a pixel's leak between stretches.
    defects : pixels that are or turn hot.

    Attributes
    ----------
    next_ns : time of the next change; NEVER_NS if there is none.
    """

    def __init__(self, pixels: PixelMethod, seed: int, share: float, defects: Defects) -> None:
        self._pixels = pixels
        self._share = share
        self._defects = defects
        self._usual_hz = pixels.leak_hz()
        self._streams = streams(root_of(seed, Purpose.LEAK_JITTER), self._usual_hz.size) if share else None
        self.next_ns = NEVER_NS

    def follow(self, t_ns: int) -> None:
        """Set the leak that is valid from `t_ns`, the array's time, until `next_ns`."""
        d, hz = self._defects, self._usual_hz.copy()
        turned = int(np.searchsorted(d.hot_from_ns, t_ns, side="right"))
        hz[d.hot[:turned]] = d.hot_hz[:turned]
        next_ns = int(d.hot_from_ns[turned]) if turned < d.hot.size else NEVER_NS
        if self._streams is not None:
            stretch = t_ns >> _STRETCH_BITS
            hz *= np.maximum(1 + self._share * normals(self._streams, stretch), 0)
            next_ns = min(next_ns, (stretch + 1) << _STRETCH_BITS)
        self._pixels.set_leak(hz)
        self.next_ns = next_ns


def at_temperature(p: SensorParameters) -> SensorParameters:
    """Return the sensor's parameters at `temperature.celsius`, from those at the reference temperature.

    Hot pixels leak through a junction too, so their rate follows the leak's. The least corner frequency is that of the
    dark current, which it follows up to the greatest. Raises ValueError if a leak, of hot pixels where there are any,
    or the dark current would be outside its bounds.
    """
    t, d = p.temperature, p.defects
    may_be_hot = d.hot_share or d.hot_pixels or p.radiation.dose_krad or p.radiation.dose_krad_per_day
    hot_hz = d.hot_hz * (t.leak_factor if may_be_hot else 1)
    try:
        return dataclasses.replace(
            p,
            leak_hz=p.leak_hz * t.leak_factor,
            defects=dataclasses.replace(d, hot_hz=hot_hz),
            dark_current_relative=p.dark_current_relative * t.dark_factor,
            corner_min_hz=min(p.corner_min_hz * t.dark_factor, p.corner_max_hz),
            temperature=dataclasses.replace(t, celsius=REFERENCE_CELSIUS),
        )
    except ValueError as error:
        raise ValueError(f"temperature.celsius = {t.celsius:g}: {error}") from error

"""The common part of other simulators' rules: the sensor's pixels, the log of the light, and crossings in order.

A rule treats each frame as its simulator does, with this sensor's physics in this sensor's units: photocurrent
i = max(E, 0) + i_dark, u = ln i, thresholds and leak drawn as `PixelArray` draws them. Unreadable light (NaN, infinite)
silences a pixel for that step and is counted; its filter starts again from the next readable light. At most 64
crossings of a pixel in a step are listed, the others are counted. Arithmetic is float64 in numpy: these rules reproduce
what their authors publish, and need not be fast.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.light import PixelLight
from emulator.sensor.pixels.array import Crossings
from emulator.sensor.pixels.faults import PixelFaults
from emulator.sensor.pixels.mismatch import draw
from emulator.sensor.presets import SensorParameters

__all__ = ["MOST_EVENTS", "Fired", "Frame", "Rule", "each"]

MOST_EVENTS = 64
"""Crossings of one pixel in one step that are listed."""

_Float64s = npt.NDArray[np.float64]
_Int64s = npt.NDArray[np.int64]
_Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Frame:
    """One step of a rule.

    Attributes
    ----------
    t0_ns, h_ns : int
        Start and length of the step.
    u0, u1 : (pixels,) float64
        Log light before and after; NaN where unreadable.
    readable : (pixels,) bool
        Whether both are readable.
    """

    t0_ns: int
    h_ns: int
    u0: _Float64s
    u1: _Float64s
    readable: _Bools

    @property
    def h_s(self) -> float:
        """Length, s."""
        return self.h_ns * 1e-9


@dataclass(frozen=True, slots=True)
class Fired:
    """Crossings, (n,) each: pixel, when as a share of the step in [0, 1], and polarity; and how many more are lost."""

    pixel: _Int64s
    share: _Float64s
    on: _Bools
    lost: int = 0


def each(counts: _Int64s) -> tuple[_Int64s, _Int64s]:
    """Return (pixel, k) of each event, (n,): counts[p] times p, k going from 0 to counts[p] - 1."""
    active = np.flatnonzero(counts)
    many = counts[active]
    k = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
    return np.repeat(active, many), k


class Rule(ABC):
    """An array of pixels under the rule of another simulator, with the interface of `PixelArray`.

    Parameters
    ----------
    parameters : SensorParameters
        The sensor.
    seed : int
        Keys the pixels, which are those of a `PixelArray` with that seed.

    Attributes
    ----------
    lost_in_pixel : int
        Crossings since `reset` beyond 64 of a pixel and step.
    quiet_nan : int
        Pixel-steps since `reset` whose light was unreadable.
    """

    renderer: str | None = None
    undersampled_share: float | None = None

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        self.parameters, self.seed = parameters, seed
        self.lost_in_pixel = self.quiet_nan = 0
        self._drawn = draw(parameters, seed)
        pixels = self._drawn.on.size
        self._u, self._v, self._r = (np.zeros(pixels) for _ in range(3))
        self._refractory_until_ns = np.zeros(pixels, np.int64)
        self._t_ns = 0

    def reset(self, light: npt.NDArray[np.float32], t_ns: int, rate: npt.NDArray[np.float32] | None = None) -> None:
        """Start at `t_ns` at rest on `light`, (height, width) float32, and with counters at zero."""
        self._t_ns = int(t_ns)
        self._u = self._log(self._flat(light))
        self._v = self._u.copy()
        self._r = self._u - self._drawn.on * self._drawn.phase
        self._refractory_until_ns[:] = self._t_ns
        self.lost_in_pixel = self.quiet_nan = 0

    def step(
        self,
        light: npt.NDArray[np.float32],
        t_ns: int,
        rate: npt.NDArray[np.float32] | None = None,
        at: PixelLight | None = None,
    ) -> Crossings:
        """Move from the last frame to this one.

        Parameters
        ----------
        light : (height, width) float32
            Relative to the reference level; values below 0 count as 0.
        t_ns : int
            Stream time of that frame. If it equals the last time, the step is empty.
        rate, at : optional
            Time derivative, and light in between; no other simulator uses them.

        Raises
        ------
        ValueError
            Time goes back, or the frame does not have the sensor's size.
        """
        flat, t0_ns, t_ns = self._flat(light), self._t_ns, int(t_ns)
        if t_ns < t0_ns:
            raise ValueError(f"t_ns = {t_ns}: before the last step's {t0_ns}; time does not go back")
        if t_ns == t0_ns:
            return self._crossings(Fired(np.empty(0, np.int64), np.empty(0), np.empty(0, np.bool_)), t0_ns, 0)
        u1 = self._log(flat)
        unreadable, restarts = np.isnan(u1), np.isnan(self._u)
        self.quiet_nan += int(unreadable.sum())
        restarted = restarts & ~unreadable
        self._v[restarted] = u1[restarted]
        self._r[restarted & np.isnan(self._r)] = u1[restarted & np.isnan(self._r)]
        fired = self._fire(Frame(t0_ns, t_ns - t0_ns, self._u, u1, ~(unreadable | restarts)))
        self._u, self._t_ns = u1, t_ns
        return self._crossings(fired, t0_ns, t_ns - t0_ns)

    @property
    def settled_ns(self) -> int:
        """Stream time up to which all crossings have been returned."""
        return self._t_ns

    def faults(self) -> PixelFaults | None:
        """Return None: the rules of other simulators have no defects and no changing leak."""
        return None

    @abstractmethod
    def _fire(self, frame: Frame) -> Fired:
        """Return what fires in a step, in any order, and move the state; pixels that are not `readable` stay silent."""

    def _crossings(self, fired: Fired, t0_ns: int, h_ns: int) -> Crossings:
        """Sort by time and pixel, and drop the crossings of a pixel beyond the cap."""
        dt_ns = np.minimum((fired.share * h_ns).astype(np.int64), h_ns)
        order = np.lexsort((dt_ns, fired.pixel))
        pixel = fired.pixel[order]
        starts = np.searchsorted(pixel, pixel)
        listed = order[np.arange(order.size) - starts < MOST_EVENTS]
        listed = listed[np.lexsort((fired.pixel[listed], dt_ns[listed]))]
        lost = order.size - listed.size + fired.lost
        self.lost_in_pixel += lost
        return Crossings(t0_ns + dt_ns[listed], fired.pixel[listed].astype(np.uint32), fired.on[listed], lost)

    def _rate(self, u1: _Float64s) -> _Float64s:
        """Return the filter's rate under log light u1, rad/s."""
        p = self.parameters
        hz = np.clip(p.corner_hz_at_reference * np.exp(u1), p.corner_min_hz, p.corner_max_hz)
        return 2 * math.pi * (np.full_like(u1, math.inf) if math.isinf(p.corner_hz_at_reference) else hz)

    def _refractory_ns(self) -> int:
        return round(self.parameters.refractory_us * 1000)

    def _log(self, flat: npt.NDArray[np.float32]) -> _Float64s:
        current = np.maximum(flat.astype(np.float64), 0) + self.parameters.dark_current_relative
        current[~np.isfinite(current)] = np.nan
        return np.asarray(np.log(current))

    def _flat(self, light: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        size = (self.parameters.height, self.parameters.width)
        if light.shape != size or light.dtype != np.float32:
            raise ValueError(f"light is {light.shape} {light.dtype}: must be {size} float32")
        return light.reshape(-1)

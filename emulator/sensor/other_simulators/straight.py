"""A straight line in log light, no filter and no leak: Sikorski's rule and ESIM's.

Both interpolate the log of each pixel's light linearly between frames, and fire where the line meets the next level.
The differences:

                         Sikorski                        ESIM
    a level met exactly  fires                           must lie above (ON) or below (OFF) where the line starts: a
    at the line's start                                  signal that turned at a level never meets it again
    small changes        are used                        below 1e-6 are ignored
    thresholds           each pixel's own                ESIM draws them again for each pixel and frame; here only with
                                                         `redraw`, because pixels then die

In both, crossings within the refractory period of the last event ("latency") are lost, and the reference moves on.

Sources: Sikorski, Izzo and Meoni, CVPRW 2021, as told by the PANGU paper ("linear interpolation ... taking latency into
account"); Rebecq, Gehrig and Scaramuzza, CoRL 2018, event_simulator.cpp of rpg_esim at commit 4cf0b89.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.keyed import Purpose, normal
from emulator.sensor.other_simulators.rule import Fired, Frame, Rule
from emulator.sensor.presets import SensorParameters

__all__ = ["Esim", "Sikorski"]

_Float64s = npt.NDArray[np.float64]
_Int64s = npt.NDArray[np.int64]
_Bools = npt.NDArray[np.bool_]

_TOLERANCE = 1e-6  # ESIM's, ln units
_LEAST_THRESHOLD = 0.01  # ESIM's, ln units
_NEVER_NS = -(1 << 62)


class Sikorski(Rule):
    """Sikorski's rule: a straight line in log light; every level that it meets fires."""

    def reset(self, light: npt.NDArray[np.float32], t_ns: int, rate: npt.NDArray[np.float32] | None = None) -> None:
        """See `Rule`."""
        super().reset(light, t_ns, rate)
        self._refractory_until_ns[:] = _NEVER_NS

    def _thresholds(self, on: _Bools) -> _Float64s:
        return np.where(on, self._drawn.on, self._drawn.off)

    def _moves(self, u0: _Float64s, u1: _Float64s) -> _Bools:
        return np.asarray(u0 != u1)

    def _meets(self, level: _Float64s, u0: _Float64s, u1: _Float64s) -> _Bools:
        """Return whether each line meets its level; a level behind its start, as after unreadable light, counts."""
        return np.where(u1 > u0, level <= u1, level >= u1)

    def _fire(self, frame: Frame) -> Fired:
        """Proceed level by level, with the lines that met the last one."""
        up = frame.u1 > frame.u0
        theta = np.where(up, 1, -1) * self._thresholds(up)
        pixel = np.flatnonzero(frame.readable & self._moves(frame.u0, frame.u1))
        met, shares = [pixel[:0]], [np.empty(0)]
        while pixel.size:
            level, u0, u1 = self._r[pixel] + theta[pixel], frame.u0[pixel], frame.u1[pixel]
            meets = self._meets(level, u0, u1)
            pixel, level, u0, u1 = pixel[meets], level[meets], u0[meets], u1[meets]
            self._r[pixel] = level
            share = np.clip((level - u0) / (u1 - u0), 0, 1)
            passes = self._pass(pixel, frame.t0_ns + (share * frame.h_ns).astype(np.int64))
            met.append(pixel[passes])
            shares.append(share[passes])
        fired = np.concatenate(met)
        return Fired(fired, np.concatenate(shares), up[fired])

    def _pass(self, pixel: _Int64s, t_ns: _Int64s) -> _Bools:
        """Return which crossings lie outside the refractory period, and begin new ones."""
        passes = t_ns >= self._refractory_until_ns[pixel]
        self._refractory_until_ns[pixel[passes]] = t_ns[passes] + self._refractory_ns()
        return passes


class Esim(Sikorski):
    """ESIM's rule: a straight line in log light, with ESIM's comparisons.

    Parameters
    ----------
    parameters, seed
        See `Rule`.
    redraw : bool
        Whether every pixel's thresholds are drawn again in each step, with the sensor's mismatch.
    """

    def __init__(self, parameters: SensorParameters, seed: int, redraw: bool = False) -> None:
        super().__init__(parameters, seed)
        self._redraw = redraw
        self._steps = 0

    def _thresholds(self, on: _Bools) -> _Float64s:
        if not self._redraw:
            return super()._thresholds(on)
        self._steps += 1
        p = self.parameters
        spread = p.mismatch * normal(self.seed, Purpose.THRESHOLD_REDRAWN, np.arange(on.size), self._steps)
        return np.maximum(np.where(on, p.threshold_on, p.threshold_off) * (1 + spread), _LEAST_THRESHOLD)

    def _moves(self, u0: _Float64s, u1: _Float64s) -> _Bools:
        return np.abs(u1 - u0) > _TOLERANCE

    def _meets(self, level: _Float64s, u0: _Float64s, u1: _Float64s) -> _Bools:
        return np.where(u1 > u0, (level > u0) & (level <= u1), (level < u0) & (level >= u1))

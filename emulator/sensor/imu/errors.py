"""Errors of an IMU's elements: bias, its random walk, and white noise, before any filter.

    error of sample k = bias + walk of the first k periods + noise / sqrt(2 period) * normal(k)

A one-sided noise density n makes white samples of variance n^2 / (2 period); behind a filter of noise bandwidth B the
variance is n^2 B, and the Allan deviation of the unfiltered samples is n / sqrt(2 tau). All draws are keyed by (seed,
purpose, axis, sample), so a sample does not depend on when, or in what batches, it is asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.keyed import Purpose, normal

__all__ = ["AXES", "ElementErrors", "Errors"]

AXES = 6
_BLOCK = 1 << 14

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Errors:
    """Sizes of the errors, (6,) each: three of the accelerometer, m/s2, then three of the gyroscope, rad/s.

    Attributes
    ----------
    density : one-sided noise density, a root of hertz.
    walk : of the bias, a root of second.
    bias : at the start; where NaN, it is drawn with `spread`.
    """

    density: Floats
    walk: Floats
    bias: Floats
    spread: Floats


class ElementErrors:
    """The errors of one unit, sample by sample, `period_s` apart."""

    def __init__(self, errors: Errors, period_s: float, seed: int) -> None:
        self._errors, self._seed = errors, seed
        self._deviation = errors.density / np.sqrt(2 * period_s)
        self._step = errors.walk * np.sqrt(period_s)
        drawn = errors.spread * normal(seed, Purpose.IMU_BIAS, np.arange(AXES))
        self.bias = np.where(np.isnan(errors.bias), drawn, errors.bias)
        self._walked = 0, np.zeros(AXES)  # number of steps, and their sum

    def at(self, first: int, count: int) -> Floats:
        """Return the errors of samples `first` to `first + count - 1`, (count, 6)."""
        index = np.arange(first, first + count)[:, None]
        white = self._deviation * normal(self._seed, Purpose.IMU_NOISE, np.arange(AXES), index)
        return np.asarray(self.bias + self._walk(first, count) + white)

    def _walk(self, first: int, count: int) -> Floats:
        """Return the walks after `first`, `first + 1`, ... steps, (count, 6)."""
        if not self._step.any() or not count:
            return np.zeros((count, AXES))
        known, total = self._walked if self._walked[0] <= first else (0, np.zeros(AXES))
        while known < first:
            upto = min(first, known + _BLOCK)
            total = self._summed(total, known, upto)[-1]
            known = upto
        walks = self._summed(total, first, first + count - 1)
        self._walked = first + count - 1, walks[-1]
        return walks

    def _summed(self, total: Floats, first: int, last: int) -> Floats:
        """Return the sums after `first` to `last` steps, the first being `total`; one by one: no batch shows."""
        return np.cumsum(np.concatenate([total[None], self._steps(first, last)]), axis=0)

    def _steps(self, first: int, last: int) -> Floats:
        index = np.arange(first, last)[:, None]
        return np.asarray(self._step * normal(self._seed, Purpose.IMU_WALK, np.arange(AXES), index))

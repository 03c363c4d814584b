"""Steps as long as the picture allows: error control from quantities that are there already.

Between two pictures log light is a straight line, or a cubic through values and slopes. What that misses in time is
estimated from a sample of pixels, weighted by the events each is about to have (its change of log light D):

    line       e = dt (2/3) |a1 - a0| / (8 |D|)              a0, a1 slopes at the step's ends, times dt
    Hermite    e = dt (16/30) |d - d before| / (32 |D|)      d = D - (a0 + a1)/2, zero for a parabola

(|u''| dt^2 = |a1 - a0| and |u''''| dt^4 = 12 |d - d before|; the factors turn the worst point of a step into the mean.)
The 95th percentile over the events of the last steps, not over pixels, is held at the tolerance: a pixel at an extremum
that emits nothing, or one glint, does not set the pace of all. The next step is

    dt * clamp(0.9 (wanted / e)^(1/p), 1/2, 2)       p = 2 (line), 4 (Hermite)

and never more than moves the picture by half a pixel (a quarter for the line), where that is known.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from emulator.scene.base import Light

__all__ = ["ControlledSteps", "FixedSteps", "Limits", "Sampled", "StepSource", "error_us", "sample"]

Floats = npt.NDArray[np.float64]

_SAMPLE_PIXELS = 4096
_SAFETY = 0.9
# The estimate sees how pictures are joined, not how the filter follows: in dim light, or where bright points cross a
# dark sky, that adds up to half as much again, which the straight line's own safety covers already.
_SHARE_OF_THE_FILTER = {2: 1.0, 4: 1.5}
_QUANTILE = 0.95
_WINDOW_STEPS = 16  # a picture that turns everywhere at once, such as a flicker, is judged over its turns too


class StepSource(Protocol):
    """Says how long the next step is, having seen the last picture."""

    @property
    def step_ns(self) -> int:
        """Length of the next step, ns."""
        ...

    def observe(self, light: Light, rate: Light | None, t_ns: int) -> None:
        """Take note of a picture and its time derivative (None: not known) at `t_ns`."""
        ...


class FixedSteps:
    """Every step has the same length."""

    def __init__(self, step_ns: int) -> None:
        if step_ns < 1:
            raise ValueError(f"a step lasts at least 1 ns, got {step_ns}")
        self.step_ns = step_ns

    def observe(self, light: Light, rate: Light | None, t_ns: int) -> None:
        """A picture changes nothing."""


@dataclass(frozen=True)
class Sampled:
    """Log photocurrent u and its slope (per second; None where not known) at some pixels, (n,) float64, at `t_ns`."""

    u: Floats
    slope: Floats | None
    t_ns: int


@dataclass(frozen=True)
class Limits:
    """What steps are held to.

    Attributes
    ----------
    tolerance_us
        Wanted 95th percentile of timestamp errors.
    shortest_ns, longest_ns
        Bounds on a step.
    motion_bound_px_s
        How fast the picture may move; infinite where not known, which binds nothing.
    """

    tolerance_us: float
    shortest_ns: int = 50_000
    longest_ns: int = 20_000_000
    motion_bound_px_s: float = float("inf")

    def longest_step_ns(self, has_slopes: bool) -> float:
        """Return the bound from the picture's motion and the absolute one, ns."""
        if not 0 < self.motion_bound_px_s < float("inf"):
            return self.longest_ns
        pixels = 0.5 if has_slopes else 0.25
        return min(self.longest_ns, pixels / self.motion_bound_px_s * 1e9)


def sample(light: Light, rate: Light | None, dark: float, t_ns: int) -> Sampled:
    """Take some 4096 pixels, evenly spread, of a picture and its derivative."""
    flat = light.reshape(-1)
    every = max(1, flat.size // _SAMPLE_PIXELS) | 1  # odd, so that it does not lie on columns
    current = np.maximum(flat[::every].astype(np.float64), 0.0) + dark
    slope = None if rate is None else rate.reshape(-1)[::every] / current
    return Sampled(np.log(current), slope, t_ns)


def error_us(before: Sampled, middle: Sampled, after: Sampled) -> tuple[Floats, Floats]:
    """Estimate the timestamp error in the step from `middle` to `after`.

    Returns
    -------
    Error (n,), us, of each pixel's events, and the pixels' weights (n,): |D|, which goes as their number of events.
    """
    dt = (after.t_ns - middle.t_ns) * 1e-9
    change = after.u - middle.u
    weight = np.abs(change)
    if after.slope is None or middle.slope is None or before.slope is None:
        scale = dt / max((middle.t_ns - before.t_ns) * 1e-9, 1e-12)
        bend = np.abs(change - (middle.u - before.u) * scale) * 2 / 3 / 8
    else:
        bend = np.abs(_defect(middle, after) - _defect(before, middle)) * 16 / 30 / 32
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(weight > 0, bend / weight * dt * 1e6, 0.0)
    return np.nan_to_num(error, posinf=0.0), np.nan_to_num(weight)


def weighted_quantile(values: Floats, weights: Floats, share: float) -> float:
    """Return the value below which `share` of the weight lies; 0 where there is no weight."""
    total = float(weights.sum())
    if total <= 0:
        return 0.0
    order = np.argsort(values)
    reached = np.searchsorted(np.cumsum(weights[order]), share * total)
    return float(values[order][min(int(reached), len(values) - 1)])


def _defect(first: Sampled, second: Sampled) -> Floats:
    """How far the trapezium rule on the slopes misses the change: zero for anything that a parabola fits."""
    if first.slope is None or second.slope is None:
        raise ValueError("a defect needs slopes at both ends")
    dt = (second.t_ns - first.t_ns) * 1e-9
    return np.asarray(second.u - first.u - (first.slope + second.slope) * dt / 2)


class ControlledSteps:
    """Steps under error control.

    Parameters
    ----------
    limits
        What the steps are held to.
    dark
        Photocurrent in the dark, relative: the floor under the logarithm.
    first_ns
        Length of the first steps, before anything is known.
    """

    def __init__(self, limits: Limits, dark: float, first_ns: int) -> None:
        self._limits = limits
        self._dark = dark
        self._step_ns = float(np.clip(first_ns, limits.shortest_ns, limits.longest_ns))
        self._seen: list[Sampled] = []
        self._recent: deque[tuple[Floats, Floats]] = deque(maxlen=_WINDOW_STEPS)

    @property
    def step_ns(self) -> int:
        """Length of the next step, ns, in whole microseconds."""
        return max(1000, round(self._step_ns / 1000) * 1000)

    def observe(self, light: Light, rate: Light | None, t_ns: int) -> None:
        """Take note of a picture, and adapt once there are three."""
        self._seen = [*self._seen[-2:], sample(light, rate, self._dark, t_ns)]
        if len(self._seen) == 3:
            self._adapt(*self._seen)

    def _adapt(self, before: Sampled, middle: Sampled, after: Sampled) -> None:
        has_slopes = after.slope is not None
        order = 4 if has_slopes else 2
        last_ns = after.t_ns - middle.t_ns
        error, weight = error_us(before, middle, after)
        self._recent.append((error / last_ns**order, weight))
        bends, weights = (np.concatenate(column) for column in zip(*self._recent, strict=True))
        bend = weighted_quantile(bends, weights, _QUANTILE)
        wish_us = self._limits.tolerance_us / _SHARE_OF_THE_FILTER[order]
        factor = 2.0 if bend <= 0 else _SAFETY * (wish_us / bend) ** (1 / order) / last_ns
        wanted = last_ns * float(np.clip(factor, 0.5, 2.0))
        self._step_ns = float(np.clip(wanted, self._limits.shortest_ns, self._limits.longest_step_ns(has_slopes)))

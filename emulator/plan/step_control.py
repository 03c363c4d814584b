"""Steps as long as the picture allows: error control from quantities that are there already.

Between two pictures log light is a straight line, or a cubic through values and slopes. What that misses in time is
estimated from a sample of pixels, weighted by the events each is about to have (its change of log light D):

    line       e = dt (2/3) |a1 - a0| / (8 |D|)              a0, a1 slopes at the step's ends, times dt
    Hermite    e = dt (16/30) |d - d before| / (32 |D|)      d = D - (a0 + a1)/2, zero for a parabola

(|u''| dt^2 = |a1 - a0| and |u''''| dt^4 = 12 |d - d before|; the factors turn the worst point of a step into the mean.)
The 95th percentile over the events of the last steps, not over pixels, is held at the tolerance: a pixel at an extremum
that emits nothing, or one glint, does not set the pace of all. Where the light turns, the same error in log light
decides whether a level is met at all. Per event that happens wrongly with the probability

    slips      sum over the pixels that turn of |bend| / sum over all of |D|         bend: the worst point of the step

which is held at a share of the tolerated wrong sequences. Both are foretold for steps from half to twice as long as
the last, e and bend going with dt^p, p = 2 (line), 4 (Hermite), and the longest that does is taken; never more than
moves the picture by half a pixel (a quarter for the line), where that is known.

Where the light of single pixels is to be had, suspect ones (see `sensor.trust`) are solved in halves: that takes
2^-4 off their error for each halving, and bounds the step by another rule: as many lights asked for as a picture has
pixels cost what a picture does, so that beyond that a shorter step for all is the better choice.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from emulator.light import Light
from emulator.sensor.pixels.interpolation import HALVED
from emulator.sensor.pixels.refinement import LEVELS

__all__ = ["ControlledSteps", "FixedSteps", "Halves", "Limits", "Sampled", "StepSource", "error_us", "sample", "slips"]

Floats = npt.NDArray[np.float64]

_SAMPLE_PIXELS = 4096
_CONTROL_PIXELS = 512  # the same figures, to a few percent, and every step pays for them
_LINE, _HERMITE = 2, 4
_MEAN_OF_BEND = {_LINE: 2 / 3, _HERMITE: 16 / 30}  # over the step, against its worst point
# The estimate sees how pictures are joined, not how the filter follows: in dim light, or where bright points cross a
# dark sky, that adds up to half as much again, which the straight line's own safety covers already.
_SAFETY = {_LINE: 0.9**2, _HERMITE: 0.9**4 / 1.5}
_RELIEF = np.array([*(0.5 ** (_HERMITE * k) for k in range(LEVELS)), 1.0])  # by how often a pixel is halved
_ASKED = np.array([2.0**k - 1 for k in range(LEVELS + 1)])
_MOST_ASKED = 1.0  # lights of single pixels, in pictures
_QUANTILE = 0.95
_EVENTS_OF_A_SEQUENCE = 300  # of a pixel, that are to be right together
_LONGER, _SHORTER = (1.1, 1.3, 1.6, 2.0), (0.9, 0.75, 0.6, 0.5)
_WINDOW_STEPS = 32  # a picture that turns everywhere at once, such as a flicker, is judged over its turns too


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
    wrong_share
        Tolerated share of sequences of 300 events that are not right; 1 binds nothing.
    """

    tolerance_us: float
    shortest_ns: int = 50_000
    longest_ns: int = 20_000_000
    motion_bound_px_s: float = float("inf")
    wrong_share: float = 0.01

    @property
    def slips(self) -> float:
        """Return the foretold slips, an event, that are tolerated: half of what may come."""
        return 0.5 * self.wrong_share / _EVENTS_OF_A_SEQUENCE if self.wrong_share < 1 else float("inf")

    def longest_step_ns(self, has_slopes: bool) -> float:
        """Return the bound from the picture's motion and the absolute one, ns."""
        if not 0 < self.motion_bound_px_s < float("inf"):
            return self.longest_ns
        pixels = 0.5 if has_slopes else 0.25
        return min(self.longest_ns, pixels / self.motion_bound_px_s * 1e9)


def sample(light: Light, rate: Light | None, dark: float, t_ns: int, pixels: int = _SAMPLE_PIXELS) -> Sampled:
    """Take some of the pixels, evenly spread, of a picture and its derivative."""
    flat = light.reshape(-1)
    every = max(1, flat.size // pixels) | 1  # odd, so that it does not lie on columns
    current = np.maximum(flat[::every].astype(np.float64), 0.0) + dark
    slope = None if rate is None else rate.reshape(-1)[::every] / current
    return Sampled(np.log(current), slope, t_ns)


def error_us(before: Sampled, middle: Sampled, after: Sampled) -> tuple[Floats, Floats]:
    """Estimate the timestamp error in the step from `middle` to `after`.

    Returns
    -------
    Error (n,), us, of each pixel's events, and the pixels' weights (n,): |D|, which goes as their number of events.
    """
    seen = _look(before, middle, after)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(seen.change > 0, seen.bend / seen.change, 0.0)
    return np.nan_to_num(share, posinf=0.0) * _MEAN_OF_BEND[seen.order] * seen.dt_us, seen.change


def slips(before: Sampled, middle: Sampled, after: Sampled) -> tuple[float, float]:
    """Return what the step from `middle` to `after` may miss where light turns, and its |D|, summed over pixels.

    Their ratio goes with dt^p; see above.
    """
    seen = _look(before, middle, after)
    return float(seen.bend[seen.turns].sum()), float(seen.change.sum())


@dataclass(frozen=True)
class Halves:
    """What makes a step suspect, where suspects are halved: the threshold, ln units, at most 3 times."""

    threshold: float

    def of(self, defect: Floats, turn: Floats) -> tuple[Floats, Floats]:
        """Return what is left of each pixel's bend, as a factor, and how many lights it asks for.

        A halving takes a defect to an eighth, what the light turns by to a quarter, and the bend to a sixteenth, where
        pictures are close enough for that: one halving is kept in reserve, and who would need it is not relieved.
        """
        unseen = float(HALVED) * self.threshold
        levels = np.zeros(defect.shape, np.intp)
        for k in range(LEVELS):
            levels += (defect > unseen * 8.0**k) | (turn > unseen * 4.0**k)
        return np.take(_RELIEF, levels), np.take(_ASKED, levels)


@dataclass(frozen=True)
class _Seen:
    """What a step did to the sampled pixels, (n,) each; or what several did, (steps, n), and (steps, 1) for `dt_us`.

    Attributes
    ----------
    change
        |D|.
    bend
        By how much log light may be missed at the worst point of the step, ln units.
    defect, turn
        |d|, and where the light turns by how much it does, else 0.
    turns
        Whether it turns.
    dt_us
        Length of the step.
    order
        By which power of it the bend goes.
    """

    change: Floats
    bend: Floats
    defect: Floats
    turn: Floats
    turns: npt.NDArray[np.bool_]
    dt_us: Any
    order: int


def _look(before: Sampled, middle: Sampled, after: Sampled) -> _Seen:
    """Return what the step from `middle` to `after` did."""
    dt = (after.t_ns - middle.t_ns) * 1e-9
    change, last = np.nan_to_num(after.u - middle.u), np.nan_to_num(middle.u - before.u)
    if after.slope is None or middle.slope is None or before.slope is None:
        last *= dt / max((middle.t_ns - before.t_ns) * 1e-9, 1e-12)
        none = np.zeros(change.shape)
        return _Seen(np.abs(change), np.abs(change - last) / 8, none, none, change * last < 0, dt * 1e6, _LINE)
    a0, a1 = np.nan_to_num(middle.slope * dt), np.nan_to_num(after.slope * dt)
    defect, turns = np.nan_to_num(_defect(middle, after)), a0 * a1 < 0
    bend = np.abs(np.nan_to_num(defect - _defect(before, middle))) / 32
    return _Seen(
        np.abs(change), bend, np.abs(defect), np.where(turns, np.abs(a0 - a1) / 8, 0.0), turns, dt * 1e6, _HERMITE
    )


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


def _together(steps: Sequence[_Seen]) -> _Seen:
    """Return what several steps of one order did as one."""
    return _Seen(
        np.stack([seen.change for seen in steps]),
        np.stack([seen.bend for seen in steps]),
        np.stack([seen.defect for seen in steps]),
        np.stack([seen.turn for seen in steps]),
        np.stack([seen.turns for seen in steps]),
        np.array([[seen.dt_us] for seen in steps]),
        steps[-1].order,
    )


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
    halves
        How suspects are halved; None where they are not.
    """

    def __init__(self, limits: Limits, dark: float, first_ns: int, halves: Halves | None = None) -> None:
        self._limits = limits
        self._dark = dark
        self._halves = halves
        self._step_ns = float(np.clip(first_ns, limits.shortest_ns, limits.longest_ns))
        self._pictures: list[Sampled] = []
        self._recent: deque[_Seen] = deque(maxlen=_WINDOW_STEPS)

    @property
    def step_ns(self) -> int:
        """Length of the next step, ns, in whole microseconds."""
        return max(1000, round(self._step_ns / 1000) * 1000)

    def observe(self, light: Light, rate: Light | None, t_ns: int) -> None:
        """Take note of a picture, and adapt once there are three."""
        self._pictures = [*self._pictures[-2:], sample(light, rate, self._dark, t_ns, _CONTROL_PIXELS)]
        if len(self._pictures) == 3:
            self._recent.append(_look(*self._pictures))
            last_ns, has_slopes, seen = self._recent[-1].dt_us * 1000, rate is not None, _together(self._recent)
            longest_ns = self._limits.longest_step_ns(has_slopes)
            wanted = self._longest(seen, last_ns, longest_ns)
            self._step_ns = float(np.clip(wanted, self._limits.shortest_ns, longest_ns))

    def _longest(self, seen: _Seen, last_ns: float, longest_ns: float) -> float:
        """Return the longest step of half to twice the last that keeps the limits, ns; the shortest if none does."""
        if not self._keeps(seen, last_ns):
            shorter = (factor * last_ns for factor in _SHORTER)
            return next((step_ns for step_ns in shorter if self._keeps(seen, step_ns)), _SHORTER[-1] * last_ns)
        longer = (min(factor * last_ns, longest_ns) for factor in _LONGER)
        return max([last_ns, *takewhile(lambda step_ns: self._keeps(seen, step_ns), longer)])

    def _keeps(self, seen: _Seen, step_ns: float) -> bool:
        """Tell whether steps of that length would have kept the limits over the steps seen."""
        limits, factor = self._limits, step_ns / (seen.dt_us * 1000)
        bend, events = seen.bend * factor**seen.order, seen.change * factor
        if self._halves is not None and seen.order == _HERMITE:
            relief, asked = self._halves.of(seen.defect * factor**3, seen.turn * factor**2)
            bend *= relief
            if asked.mean() > _MOST_ASKED:
                return False
        held = limits.tolerance_us * _SAFETY[seen.order] / (_MEAN_OF_BEND[seen.order] * seen.dt_us)
        late, missed = events[bend > held * seen.change].sum(), (bend * factor)[seen.turns].sum()
        return bool((late <= (1 - _QUANTILE) * events.sum()) & (missed <= limits.slips * events.sum()))

"""Step control: steps as long as the frames allow, from quantities that are computed already.

Between two frames log light is interpolated by a straight line, or by a cubic through values and slopes. The timestamp
error of this is estimated from a sample of pixels, weighted by the events that each is about to have (its change of log
light D):

    line       e = dt (2/3) |a1 - a0| / (8 |D|)              a0, a1 slopes at the step's ends, times dt
    Hermite    e = dt (16/30) |d - d before| / (32 |D|)      d = D - (a0 + a1)/2, zero for a parabola

(|u''| dt^2 = |a1 - a0| and |u''''| dt^4 = 12 |d - d before|; the factors turn the worst point of a step into the mean.)
The 95th percentile over the events of the last steps, not over pixels, is kept below the tolerance, so a pixel at an
extremum without events, or one glint, does not determine the step of all pixels. Where the light turns, the same error
in log light decides whether a level is met at all. The probability that an event is wrong for this reason is

    slips      sum over the pixels that turn of |bend| / sum over all of |D|         bend: the worst point of the step

which is kept below half of the tolerated share of wrong events. Both are predicted for steps from half to twice as long
as the last, e and bend in proportion to dt^p, p = 2 (line), 4 (Hermite), and the longest permitted step is taken. The
motion of the image sets no limit: values and slopes of exact light show more of an edge than where it is, and steps of
at most half a pixel were 2 to 15 times as dear as fixed ones with the same wrong events (docs/accuracy.md).

Where the scene can give the light of single pixels, undersampled steps are refined (see `refinement`). A refinement
divides the error by 2^4, and limits the step by another rule: a number of single lights equal to the pixels of a frame
costs as much as a frame, so beyond that number a shorter step for all pixels is better.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, Protocol

import numpy as np

from emulator.light import LightFrame
from emulator.sensor.pixels.curve import REFINED_UNSEEN_SHARE
from emulator.sensor.pixels.refinement import LEVELS
from firmware_protocol.events import Floats, Mask

_SAMPLE_PIXELS = 4096
_CONTROL_PIXELS = 512  # the same estimates, to a few percent, at a cost in every step
_LINE, _HERMITE = 2, 4
_MEAN_OF_BEND = {_LINE: 2 / 3, _HERMITE: 16 / 30}  # over the step, against its worst point
# The estimate covers the interpolation, not the filter: in dim light, or where bright points cross a dark sky, the
# filter adds up to half of the error again, which the safety factor of the straight line covers already.
_SAFETY = {_LINE: 0.9**2, _HERMITE: 0.9**4 / 1.5}
_RELIEF = np.array([*(0.5 ** (_HERMITE * k) for k in range(LEVELS)), 1.0])  # by the number of refinements of a pixel
_ASKED = np.array([2.0**k - 1 for k in range(LEVELS + 1)])
_MOST_LIGHTS = 1.0  # lights of single pixels, as a number of frames
_QUANTILE = 0.95
_LONGER, _SHORTER = (1.1, 1.3, 1.6, 2.0), (0.9, 0.75, 0.6, 0.5)
_WINDOW_STEPS = 32  # long enough that light which turns everywhere at once, such as a flicker, is judged with its turns


class StepSource(Protocol):
    """Source of the next step's length, which observes each frame."""

    @property
    def step_ns(self) -> int:
        """Length of the next step, ns."""

    def observe(self, frame: LightFrame) -> None:
        """Observe a frame."""


class FixedSteps:
    """Steps of one fixed length."""

    def __init__(self, step_ns: int) -> None:
        if step_ns < 1:
            raise ValueError(f"a step lasts at least 1 ns, got {step_ns}")
        self.step_ns = step_ns

    def observe(self, frame: LightFrame) -> None:
        """Ignore the frame."""


@dataclass(frozen=True)
class Sampled:
    """Log photocurrent u and its slope (per second; None where not known) at some pixels, (n,) float64, at `t_ns`."""

    u: Floats
    slope: Floats | None
    t_ns: int


@dataclass(frozen=True)
class Limits:
    """Limits that controlled steps keep.

    Attributes
    ----------
    tolerance_us : wanted 95th percentile of timestamp errors.
    shortest_ns, longest_ns : bounds on a step.
    wrong_share : tolerated share of wrong events; 1 sets no limit.
    """

    tolerance_us: float
    shortest_ns: int = 50_000
    longest_ns: int = 100_000_000
    wrong_share: float = 0.01

    @property
    def slips(self) -> float:
        """Return the tolerated number of predicted slips per event: half of the actual limit."""
        return 0.5 * self.wrong_share if self.wrong_share < 1 else float("inf")


def sample(frame: LightFrame, dark: float, pixels: int = _SAMPLE_PIXELS) -> Sampled:
    """Return a sample of evenly spread pixels of a frame."""
    flat = frame.light.reshape(-1)
    every = max(1, flat.size // pixels) | 1  # odd, so that it does not lie on columns
    current = np.maximum(flat[::every].astype(np.float64), 0.0) + dark
    slope = None if frame.rate is None else frame.rate.reshape(-1)[::every] / current
    return Sampled(np.log(current), slope, frame.t_ns)


def error_us(before: Sampled, middle: Sampled, after: Sampled) -> tuple[Floats, Floats]:
    """Estimate the timestamp error in the step from `middle` to `after`.

    It is (n,), us, of each pixel's events, beside the pixels' weights (n,): |D|, which goes as their number of events.
    """
    seen = _look(before, middle, after)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(seen.change > 0, seen.bend / seen.change, 0.0)
    return np.nan_to_num(share, posinf=0.0) * _MEAN_OF_BEND[seen.order] * seen.dt_us, seen.change


def slips(before: Sampled, middle: Sampled, after: Sampled) -> tuple[float, float]:
    """Return the possible slips of the step from `middle` to `after`, and its |D|, summed over pixels.

    Their ratio is proportional to dt^p; see the module docstring.
    """
    seen = _look(before, middle, after)
    return float(seen.bend[seen.turns].sum()), float(seen.change.sum())


@dataclass(frozen=True)
class RefinementModel:
    """Model of the refinement of undersampled steps, for a threshold in ln units."""

    threshold: float

    def of(self, defect: Floats, turn: Floats) -> tuple[Floats, Floats]:
        """Return the remaining share of each pixel's bend after refinement, and the number of lights that it needs.

        A refinement divides a defect by 8, a turn by 4 and the bend by 16, where frames are close enough for this
        order. The last refinement is kept in reserve: pixels that would need it get no reduction.
        """
        unseen = float(REFINED_UNSEEN_SHARE) * self.threshold
        levels = np.zeros(defect.shape, np.intp)
        for k in range(LEVELS):
            levels += (defect > unseen * 8.0**k) | (turn > unseen * 4.0**k)
        return np.take(_RELIEF, levels), np.take(_ASKED, levels)


@dataclass(frozen=True)
class _Seen:
    """Changes of the sampled pixels in a step, (n,) each; or in several, (steps, n), with (steps, 1) for `dt_us`.

    Attributes
    ----------
    change : |D|.
    bend : error of log light at the worst point of the step, ln units.
    defect, turn : |d|; and the size of the turn where the light turns, else 0.
    turns : whether the light turns.
    dt_us : length of the step.
    order : power of `dt_us` to which the bend is proportional.
    """

    change: Floats
    bend: Floats
    defect: Floats
    turn: Floats
    turns: Mask
    dt_us: Any
    order: int


def _look(before: Sampled, middle: Sampled, after: Sampled) -> _Seen:
    """Return the changes in the step from `middle` to `after`."""
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
    """Return the error of the trapezium rule on the slopes: zero where a parabola fits."""
    if first.slope is None or second.slope is None:
        raise ValueError("a defect needs slopes at both ends")
    dt = (second.t_ns - first.t_ns) * 1e-9
    return np.asarray(second.u - first.u - (first.slope + second.slope) * dt / 2)


def _together(steps: Sequence[_Seen]) -> _Seen:
    """Return several steps of one order as one."""
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
    limits : limits of the steps.
    dark : photocurrent in the dark, relative, which is added before the logarithm.
    first_ns : length of the first steps, before three frames are known.
    refinement : model of the refinement; None where undersampled steps are not refined.
    """

    def __init__(self, limits: Limits, dark: float, first_ns: int, refinement: RefinementModel | None = None) -> None:
        self._limits = limits
        self._dark = dark
        self._refinement = refinement
        self._step_ns = float(np.clip(first_ns, limits.shortest_ns, limits.longest_ns))
        self._frames: list[Sampled] = []
        self._recent: deque[_Seen] = deque(maxlen=_WINDOW_STEPS)

    @property
    def step_ns(self) -> int:
        """Length of the next step, ns, in whole microseconds."""
        return max(1000, round(self._step_ns / 1000) * 1000)

    def observe(self, frame: LightFrame) -> None:
        """Observe a frame, and adapt the step once there are three."""
        self._frames = [*self._frames[-2:], sample(frame, self._dark, _CONTROL_PIXELS)]
        if len(self._frames) == 3:
            self._recent.append(_look(*self._frames))
            last_ns = self._recent[-1].dt_us * 1000
            step_ns = self._longest(_together(self._recent), last_ns)
            self._step_ns = float(np.clip(step_ns, self._limits.shortest_ns, self._limits.longest_ns))

    def _longest(self, seen: _Seen, last_ns: float) -> float:
        """Return the longest step of half to twice the last that meets the limits, ns; the shortest if none does."""
        if not self._meets_limits(seen, last_ns):
            shorter = (factor * last_ns for factor in _SHORTER)
            return next((step_ns for step_ns in shorter if self._meets_limits(seen, step_ns)), _SHORTER[-1] * last_ns)
        longer = (min(factor * last_ns, self._limits.longest_ns) for factor in _LONGER)
        return max([last_ns, *takewhile(lambda step_ns: self._meets_limits(seen, step_ns), longer)])

    def _meets_limits(self, seen: _Seen, step_ns: float) -> bool:
        """Return whether steps of that length would have met the limits over the last steps."""
        limits, factor = self._limits, step_ns / (seen.dt_us * 1000)
        bend, events = seen.bend * factor**seen.order, seen.change * factor
        if self._refinement is not None and seen.order == _HERMITE:
            relief, lights = self._refinement.of(seen.defect * factor**3, seen.turn * factor**2)
            bend *= relief
            if lights.mean() > _MOST_LIGHTS:
                return False
        allowed = limits.tolerance_us * _SAFETY[seen.order] / (_MEAN_OF_BEND[seen.order] * seen.dt_us)
        late, missed = events[bend > allowed * seen.change].sum(), (bend * factor)[seen.turns].sum()
        return bool((late <= (1 - _QUANTILE) * events.sum()) & (missed <= limits.slips * events.sum()))

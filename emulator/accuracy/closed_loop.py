"""Controlled steps against the truth: the frames they use, and the timestamp error for a wanted error.

The step rule is that of a run (`emulator.plan.step_control`), and gets nothing but frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from emulator.accuracy.cases import Swept
from emulator.accuracy.harness import SEED, Case, pixel_light, truth
from emulator.accuracy.light import Float64s
from emulator.accuracy.metrics import Scores, compare
from emulator.accuracy.stream import Stream
from emulator.plan.step_control import ControlledSteps, Limits, RefinementModel
from emulator.sensor.pixels.array import Crossings, PixelArray

__all__ = ["WISHES_US", "Controlled", "control", "controlled"]

WISHES_US = (1.0, 10.0, 100.0)
"""Wanted 95th percentiles of timestamp errors, us."""

_FIRST_NS = 1_000_000


@dataclass(frozen=True)
class Controlled:
    """One wish on one case.

    Attributes
    ----------
    wish_us
        Wanted 95th percentile of timestamp errors, us.
    with_rate
        Whether the light's derivative was given.
    refined
        Whether the light of single pixels between the frames was given.
    frames_per_s
        Frames used for a second of stream.
    asked_per_s
        Lights of single pixels asked for in a second of stream, as a number of frames.
    """

    case: str
    wish_us: float
    with_rate: bool
    refined: bool
    frames_per_s: float
    asked_per_s: float
    scores: Scores


def controlled(cases: Sequence[Swept], wishes_us: Sequence[float] = WISHES_US) -> Iterator[Controlled]:
    """Run every wish on every case: with light in between, with derivatives alone, and with neither."""
    for swept in cases:
        for wish_us in wishes_us:
            for with_rate, refined in ((True, True), (True, False), (False, False)):
                yield control(swept.case, Limits(wish_us), with_rate=with_rate, refined=refined)


def control(case: Case, limits: Limits, *, with_rate: bool, refined: bool = False) -> Controlled:
    """Run one case in controlled steps, to the end of its last whole step, and score it up to there."""
    array = PixelArray(case.parameters, SEED)
    at, threshold = (pixel_light(case) if refined else None), case.parameters.threshold_on
    refinement = RefinementModel(threshold) if refined else None
    steps = ControlledSteps(limits, case.parameters.dark_current_relative, _FIRST_NS, refinement)
    end_ns, t_ns, frames = round(case.duration_s * 1e9), 0, 0
    found: list[Crossings] = []
    light, rate = _frame(case, 0)
    array.reset(light, 0)
    steps.observe(light, rate if with_rate else None, 0)
    while t_ns < end_ns:
        t_ns = min(t_ns + steps.step_ns, end_ns)
        light, rate = _frame(case, t_ns)
        crossings = array.step(light, t_ns, rate, at) if with_rate else array.step(light, t_ns)
        found.append(Crossings(crossings.t_ns.copy(), crossings.pixel.copy(), crossings.on.copy()))
        steps.observe(light, rate if with_rate else None, t_ns)
        frames += 1
    t, pixel, on = (np.concatenate([getattr(c, name) for c in found]) for name in ("t_ns", "pixel", "on"))
    stream = Stream.of(t * 1e-3, pixel, on, case.scene.pixels)
    asked = array.refined / case.scene.pixels
    spent = frames / case.duration_s, asked / case.duration_s
    return Controlled(case.name, limits.tolerance_us, with_rate, refined, *spent, compare(stream, truth(case)))


def _frame(case: Case, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
    t_s: Float64s = np.array([t_ns * 1e-9])
    return case.scene.value(t_s).astype(np.float32), case.scene.rate(t_s).astype(np.float32)

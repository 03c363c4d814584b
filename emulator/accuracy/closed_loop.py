"""What controlled steps make of a wish: frames spent, and the error that came out, against the truth.

The step rule is the product's own (`emulator.plan.step_control`), told nothing but pictures, as in a run.
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
from emulator.plan.step_control import ControlledSteps, Halves, Limits
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
        What was asked for, 95 %.
    with_rate
        Whether the light's derivative was given.
    halved
        Whether light of single pixels between the pictures was given.
    frames_per_s
        Pictures spent for a second of stream.
    asked_per_s
        Lights of single pixels asked for in a second of stream, in pictures.
    """

    case: str
    wish_us: float
    with_rate: bool
    halved: bool
    frames_per_s: float
    asked_per_s: float
    scores: Scores


def controlled(cases: Sequence[Swept], wishes_us: Sequence[float] = WISHES_US) -> Iterator[Controlled]:
    """Run every wish on every case: with light in between, with derivatives alone, and with neither."""
    for swept in cases:
        for wish_us in wishes_us:
            for with_rate, halved in ((True, True), (True, False), (False, False)):
                yield control(swept.case, Limits(wish_us), with_rate=with_rate, halved=halved)


def control(case: Case, limits: Limits, *, with_rate: bool, halved: bool = False) -> Controlled:
    """Run one case in controlled steps, to the end of its last whole step, and score it up to there."""
    array = PixelArray(case.parameters, SEED)
    at, threshold = (pixel_light(case) if halved else None), case.parameters.threshold_on
    halves = Halves(threshold) if halved else None
    steps = ControlledSteps(limits, case.parameters.dark_current_relative, _FIRST_NS, halves)
    end_ns, t_ns, frames = round(case.duration_s * 1e9), 0, 0
    found: list[Crossings] = []
    light, rate = _picture(case, 0)
    array.reset(light, 0)
    steps.observe(light, rate if with_rate else None, 0)
    while t_ns < end_ns:
        t_ns = min(t_ns + steps.step_ns, end_ns)
        light, rate = _picture(case, t_ns)
        crossings = array.step(light, t_ns, rate, at) if with_rate else array.step(light, t_ns)
        found.append(Crossings(crossings.t_ns.copy(), crossings.pixel.copy(), crossings.on.copy()))
        steps.observe(light, rate if with_rate else None, t_ns)
        frames += 1
    t, pixel, on = (np.concatenate([getattr(c, name) for c in found]) for name in ("t_ns", "pixel", "on"))
    stream = Stream.of(t * 1e-3, pixel, on, case.scene.pixels)
    asked = array.halved / case.scene.pixels
    spent = frames / case.duration_s, asked / case.duration_s
    return Controlled(case.name, limits.tolerance_us, with_rate, halved, *spent, compare(stream, truth(case)))


def _picture(case: Case, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
    t_s: Float64s = np.array([t_ns * 1e-9])
    return case.scene.value(t_s).astype(np.float32), case.scene.rate(t_s).astype(np.float32)

"""Sweeps of accuracy: methods over scenes and steps, effects of the sensor, and controlled steps.

`sweep` measures speed against accuracy: every method over every scene in every step, one point a setting.

`cells_against_line` gives the map "hermite against line": right sequences and wrong events over blur and speed, with
sharp edges. Steps are 5 ms, with 60 pixels and the sensor of the chart. A cell is better, equal or worse by the
difference of the two methods.

`effect_rows` gives the cost and the effect on the events of each effect of the sensor, switched on alone. The ideal
sensor has equal thresholds, no leak, no low-pass, no refractory period, no noise and no fault. Each effect is added to
it, with the parameters of the case's sensor or, where that has it switched off, with those of the table; the events
that leave the sensor are compared with those of the ideal one under the same light: the count, the share of pixels
whose sequence stays, and the shift of their events. The time is that of a whole step of the sensor on 346 x 260 pixels,
read-out included.

`controlled` runs controlled steps against the truth: the frames they use, and the timestamp error for a wanted error.
The step rule is that of a run (`emulator.plan.step_control`), and gets nothing but frames.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from emulator.light import LightFrame
from emulator.plan.step_control import ControlledSteps, Limits, RefinementModel
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.crossings import Crossings
from emulator.sensor.presets import ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor
from laboratory.accuracy.harness import PLAIN, SEED, Case, Method, Swept, pixel_light, score, step_cost_us, truth
from laboratory.accuracy.scenes import ShadedEdge, ThinLine, TurningBody
from laboratory.accuracy.scores import Scores, Stream, compare

_LEAST_ORDER = 0.5  # below it, an error does not count as falling with the step


@dataclass(frozen=True)
class Point:
    """One setting: a method on a scene in a step.

    Attributes
    ----------
    case, method : names.
    step_ms : time between two frames.
    frames_per_s : frames rendered for a second of stream.
    us_per_frame : pixel work of a step, 346 x 260, one thread.
    us_per_stream_ms : pixel work of a millisecond of stream.
    scores : against the truth.
    """

    case: str
    method: str
    step_ms: float
    frames_per_s: float
    us_per_frame: float
    us_per_stream_ms: float
    scores: Scores

    def row(self) -> dict[str, float | str]:
        """Return it as one flat row."""
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "scores"}
        return own | dataclasses.asdict(self.scores)


def settings(cases: Sequence[Swept], methods: Sequence[Method]) -> int:
    """Return how many points a sweep has."""
    return sum(len(swept.fitting(methods)) * len(swept.steps_ms) for swept in cases)


def sweep(cases: Sequence[Swept], methods: Sequence[Method]) -> Iterator[Point]:
    """Yield the points one by one."""
    for swept in cases:
        for method in swept.fitting(methods):
            for step_ms in swept.steps_ms:
                scores = score(method, swept.case, step_ms * 1e-3)
                cost_us = step_cost_us(method, swept.case, step_ms * 1e-3)
                yield Point(swept.case.name, method.name, step_ms, 1e3 / step_ms, cost_us, cost_us / step_ms, scores)


@dataclass(frozen=True)
class Need:
    """Frames per second that a method needs for an error.

    Attributes
    ----------
    frames_per_s : infinite where no step gives the error.
    kind : "between" two points of the sweep; "beyond" its shortest step, by the order of its three shortest ones; "at
        most" that of its longest step, which is short enough; "never": the error does not fall with the step.
    """

    frames_per_s: float
    kind: Literal["between", "beyond", "at most", "never"]

    def __str__(self) -> str:
        if self.kind == "never":
            return self.kind
        mark = {"between": "", "beyond": "about ", "at most": "at most "}[self.kind]
        return f"{mark}{float(f'{self.frames_per_s:.2g}'):,.0f}".replace(",", " ")


def frames_needed(points: Sequence[Point], case: str, method: str, t95_us: float, right: float = 0.9) -> Need:
    """Return the frames per second from which on a method keeps a 95 % error and `right` of the sequences."""
    row = sorted((p for p in points if (p.case, p.method) == (case, method)), key=lambda p: p.frames_per_s)
    first = len(row)
    while first and row[first - 1].scores.right >= right and row[first - 1].scores.t95_us <= t95_us:
        first -= 1
    if first == 0:
        return Need(row[0].frames_per_s, "at most")
    if first == len(row):
        return _beyond(row, t95_us)
    worse, better = row[first - 1], row[first]
    if not worse.scores.right >= right or math.isnan(worse.scores.t95_us) or better.scores.t95_us == 0:
        return Need(better.frames_per_s, "between")
    order = _order(worse, better)
    return Need(better.frames_per_s * (better.scores.t95_us / t95_us) ** (1 / order), "between")


def _order(coarse: Point, fine: Point) -> float:
    """Return the power of the step by which the error falls."""
    fall = coarse.scores.t95_us / fine.scores.t95_us
    return math.log(fall) / math.log(fine.frames_per_s / coarse.frames_per_s) if fall > 0 else math.nan


def _beyond(row: Sequence[Point], t95_us: float) -> Need:
    """Extrapolate from the three shortest steps, if the error falls with the step."""
    if len(row) < 2:
        return Need(math.inf, "never")
    order = _order(row[-3:][0], row[-1])
    if not order >= _LEAST_ORDER:
        return Need(math.inf, "never")
    needed = row[-1].frames_per_s * (row[-1].scores.t95_us / t95_us) ** (1 / order)
    return Need(max(needed, row[-1].frames_per_s), "beyond")


STEP_S = 5e-3
BLURS_PX = 0.3, 0.6, 1.0, 3.0
SPEEDS_PX = 0.25, 0.5, 1.0, 2.0, 4.0
"""A step."""

_PROFILES: tuple[Literal["blurred", "kinked"], ...] = "blurred", "kinked"
SCENES = {
    f"{name}, {profile}": (make, profile)
    for name, make in (("edge", ShadedEdge), ("thin line", ThinLine), ("body", TurningBody))
    for profile in _PROFILES
}
QUICK_SCENES = ("edge, kinked",)


@dataclass(frozen=True)
class Difference:
    """A scene at one blur, px, and speed, px a step: shares of right sequences and of wrong events of both."""

    scene: str
    blur_px: float
    speed_px: float
    right_line: float
    right_hermite: float
    wrong_line: float
    wrong_hermite: float


def cells_against_line(scenes: Sequence[str], ways: Sequence[Method]) -> Iterator[Difference]:
    """Yield every scene at every blur and speed."""
    line, hermite = (next(way for way in ways if way.name == name) for name in ("line", "hermite"))
    for name in scenes:
        make, profile = SCENES[name]
        for blur in BLURS_PX:
            for speed in SPEEDS_PX:
                scene = make(profile=profile, blur_px=blur, speed_px_s=speed / STEP_S)
                steps = -(-scene.duration_s // STEP_S)
                case = Case(name, scene, PLAIN, steps * STEP_S, fine_s=5e-5)
                a, b = score(line, case, STEP_S), score(hermite, case, STEP_S)
                yield Difference(name, blur, speed, a.right, b.right, a.wrong_events, b.wrong_events)


def reading_against_line(cells: Sequence[Difference]) -> list[str]:
    """Return the findings of the map, in sentences."""
    worse = [c for c in cells if c.right_hermite < c.right_line - 0.02 or c.wrong_hermite > c.wrong_line + 0.002]
    better = sum(c.right_hermite > c.right_line + 0.02 for c in cells)
    lines = [
        f"hermite against line, {len(cells)} cells: better by more than 2 points in {better}; fewer right sequences by "
        f"more than 2 points, or more wrong events by more than 0.2 %, in {len(worse)}."
    ]
    lines += [
        f"Worse: {c.scene}, {c.blur_px:g} px, {c.speed_px:g} px a step: {c.right_hermite:.1%} right and "
        f"{c.wrong_hermite:.1%} wrong, line {c.right_line:.1%} and {c.wrong_line:.1%}."
        for c in worse
    ]
    return lines


_IDEAL: dict[str, Any] = {
    "mismatch": 0.0,
    "leak_hz": 0.0,
    "parasitic_hz_at_reference": 0.0,
    "corner_hz_at_reference": math.inf,
    "source_follower_hz": 0.0,
    "refractory_us": 0.0,
    "readout": ReadoutParameters(event_ns=1.0, row_ns=0),
}


@dataclass(frozen=True)
class Effect:
    """An effect, and the fields that switch it on.

    Attributes
    ----------
    own : fields that are copied from the case's sensor.
    table : of the sensor, in which `instead` is set.
    instead : fields and their values where the case's sensor has the effect switched off.
    """

    name: str
    own: tuple[str, ...] = ()
    table: str = ""
    instead: tuple[tuple[str, Any], ...] = ()


EFFECTS = (
    Effect("none: the ideal sensor"),
    Effect("threshold mismatch", ("mismatch",), instead=(("mismatch", 0.03),)),
    Effect("junction leak", ("leak_hz", "leak_spread"), instead=(("leak_hz", 0.1),)),
    Effect("parasitic leak", instead=(("parasitic_hz_at_reference", 0.1),)),
    Effect("low-pass, following the light", ("corner_hz_at_reference", "corner_min_hz", "corner_max_hz")),
    Effect("second pole", instead=(("source_follower_hz", 300.0),)),
    Effect("refractory period", instead=(("refractory_us", 100.0),)),
    Effect("noise", table="noise", instead=(("rms", 0.05), ("corner_hz", 300.0))),
    Effect("noise, reference", table="noise", instead=(("rms", 0.05), ("corner_hz", 300.0), ("grade", "grid"))),
    Effect("event-time jitter", table="jitter", instead=(("latency_us", 100.0), ("deviation_us", 30.0))),
    Effect("hot pixels", table="defects", instead=(("hot_share", 0.05),)),
    Effect("dead pixels", table="defects", instead=(("dead_share", 0.05),)),
    Effect("photo-response non-uniformity", table="imager", instead=(("prnu", 0.02),)),
    Effect("photon shot noise", table="imager", instead=(("photon_shot_noise", True),)),
    Effect("particles, 1000 a cm2 and s", table="radiation", instead=(("hits_per_cm2_s", 1000.0),)),
    Effect("read-out of 80 ns an event", table="readout", instead=(("event_ns", 80.0), ("row_ns", 80))),
)
"""All effects, in the order of the table."""

QUICK_EFFECTS = tuple(effect for effect in EFFECTS if ("grade", "grid") not in effect.instead)
"""The effects whose step takes less than a second."""


@dataclass(frozen=True)
class EffectRow:
    """An effect alone: its setting, the time of a step with it (us, 346 x 260), and the change of the events."""

    name: str
    setting: str
    us_per_frame: float
    scores: Scores


def _changes(effect: Effect, own: SensorParameters) -> dict[str, Any]:
    """Return the fields that switch an effect on."""
    if effect.table:
        return {effect.table: dataclasses.replace(getattr(own, effect.table), **dict(effect.instead))}
    own_values = {name: getattr(own, name) for name in effect.own}
    return own_values | {name: value for name, value in effect.instead if not own_values.get(name)}


def _setting_text(effect: Effect, changes: dict[str, Any]) -> str:
    shown = dict(effect.instead) if effect.table else changes
    return ", ".join(f"{k} = {v:g}" if isinstance(v, float) else f"{k} = {v}" for k, v in shown.items())


def _run(case: Case, parameters: SensorParameters, step_s: float) -> Stream:
    """Return the events of a sensor of one row under the light of a case."""
    sensor, h_ns = Sensor(parameters, SEED), round(step_s * 1e9)
    t_s = np.arange(round(case.duration_s / step_s) + 1) * step_s
    light, rate = (one.astype(np.float32)[:, None, :] for one in case.scene.light_and_rate(t_s))
    sensor.reset(LightFrame(0, light[0]))
    parts = [sensor.expose(LightFrame(k * h_ns, light[k], rate[k])) for k in range(1, t_s.size)]
    return Stream.from_events(np.concatenate([*parts, sensor.finish()]), parameters.width, parameters.height)


class _Whole(Sensor):
    """A whole sensor, timed as pixels are."""

    step = Sensor.expose


def effect_rows(case: Case, step_s: float, effects: Sequence[Effect] = EFFECTS) -> Iterator[EffectRow]:
    """Yield each effect's row on a case."""
    ideal = dataclasses.replace(case.parameters, **_IDEAL)
    plain, whole = _run(case, ideal, step_s), Method("sensor", _Whole, rate=True)  # type: ignore[arg-type]
    for effect in effects:
        changes = _changes(effect, case.parameters)
        alone = dataclasses.replace(ideal, **changes)
        scores = compare(_run(case, alone, step_s), plain)
        cost_us = step_cost_us(whole, dataclasses.replace(case, parameters=alone), step_s)
        yield EffectRow(effect.name, _setting_text(effect, changes), cost_us, scores)


WISHES_US = (1.0, 10.0, 100.0)  # wanted 95th percentiles of timestamp errors


@dataclass(frozen=True)
class Controlled:
    """One wish on one case.

    Attributes
    ----------
    wish_us : wanted 95th percentile of timestamp errors, us.
    with_rate : True: the light's derivative was given.
    refined : True: the light of single pixels between the frames was given.
    frames_per_s : frames used for a second of stream.
    pixel_frames_per_s : requested lights of single pixels in a second of stream, as a number of frames.
    """

    case: str
    wish_us: float
    with_rate: bool
    refined: bool
    frames_per_s: float
    pixel_frames_per_s: float
    scores: Scores


def controlled(cases: Sequence[Swept], wishes_us: Sequence[float] = WISHES_US) -> Iterator[Controlled]:
    """Run every wish on every case: with light in between, with derivatives alone, and with neither."""
    for swept in cases:
        for wish_us in wishes_us:
            for rate, refined in ((True, True), (True, False), (False, False)):
                yield control(swept.case, wish_us, with_rate=rate, refined=refined)


def control(case: Case, wish_us: float, *, with_rate: bool, refined: bool = False) -> Controlled:
    """Run one case in controlled steps, to the end of its last whole step, and score it up to there."""
    # One of a hundred sequences of 300 events; what comes into a still picture is met by steps of 20 ms at most.
    limits = Limits(wish_us, longest_ns=20_000_000, wrong_share=0.01 / 300)
    array = PixelArray(case.parameters, SEED)
    at, threshold = (pixel_light(case.scene) if refined else None), case.parameters.threshold_on
    refinement = RefinementModel(threshold) if refined else None
    steps = ControlledSteps(limits, case.parameters.dark_current_relative, 1_000_000, refinement)
    end_ns = round(case.duration_s * 1e9)
    t_ns = 0
    frames = 0
    found: list[Crossings] = []
    light, rate = _frame(case, 0)
    array.reset(LightFrame(0, light))
    steps.observe(LightFrame(0, light, rate if with_rate else None))
    while t_ns < end_ns:
        t_ns = min(t_ns + steps.step_ns, end_ns)
        light, rate = _frame(case, t_ns)
        frame = LightFrame(t_ns, light, rate, at) if with_rate else LightFrame(t_ns, light)
        crossings = array.step(frame)
        found.append(Crossings(crossings.t_ns.copy(), crossings.pixel.copy(), crossings.on.copy()))
        steps.observe(frame)
        frames += 1
    t, pixel, on = (np.concatenate([getattr(c, name) for c in found]) for name in ("t_ns", "pixel", "on"))
    stream = Stream.of(t * 1e-3, pixel, on, case.scene.pixels)
    refined_frames = array.refined / case.scene.pixels
    spent = frames / case.duration_s, refined_frames / case.duration_s
    return Controlled(case.name, wish_us, with_rate, refined, *spent, compare(stream, truth(case)))


def _frame(case: Case, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
    light, rate = case.scene.light_and_rate(t_ns * 1e-9)
    return light.astype(np.float32), rate.astype(np.float32)

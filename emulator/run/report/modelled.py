"""Effects and parts that a run modelled, and those that it left out, from the plan of the run.

The plan is made from the light frames of the run's own scene, as `evstim plan` does. Frames of another program, or of
a simulation that drives the run, are not drawn for it: then the plan has its effects without their costs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

from emulator.light import Scene
from emulator.plan.costs import EFFECTS
from emulator.plan.plan import Decision, Plan, make_plan
from emulator.plan.scene_probe import Probe
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig
from emulator.rig.remarks import remarks
from emulator.run.assembly import is_drawn_here, plan_of

_LENSES = {
    "none": "not modelled: the scene gives the light on the sensor",
    "applied": "modelled: radiance seen through the lens, with its point spread and distortion",
    "own": "modelled by the scene itself",
}
_METHODS = {"hermite": "a cubic from value and derivative in log light", "line": "a straight line in log light"}
_STILL = Probe(0.0, 0.0, 0.0, 0.0, 1e-3, 0.0, math.nan, math.nan, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Effect:
    """An effect of the sensor or the lens.

    Attributes
    ----------
    state : "modelled"; "left out", by the plan; or "off", by the rig or its camera's model.
    why : reason for the state.
    time_error_us, wrong_share : error that leaving it out would make, or makes; None where none is known.
    """

    effect: str
    state: Literal["modelled", "left out", "off"]
    why: str
    time_error_us: float | None = None
    wrong_share: float | None = None


@dataclass(frozen=True)
class Part:
    """A part of the camera or of its world, with how it is modelled, or "not modelled" and the reason."""

    part: str
    how: str


@dataclass(frozen=True)
class Modelled:
    """Parts and effects that a run modelled, and those that it left out.

    Attributes
    ----------
    tolerance_us, tolerated_wrong_share : errors below which the plan leaves effects out; None: it leaves none out.
    steps : length of the steps and the expected error of event times.
    probed : True where costs come from light frames of the scene.
    notes : remarks on the rig and its scene.
    """

    parts: Sequence[Part]
    effects: Sequence[Effect] = ()
    tolerance_us: float | None = None
    tolerated_wrong_share: float | None = None
    steps: str = ""
    probed: bool = False
    notes: Sequence[str] = field(default_factory=tuple)


def modelled(rig: Rig, scene: Scene | None, *, is_driven: bool = False) -> Modelled:
    """Return what a run models; `is_driven`: a simulation moves the scene. Without a scene there are no costs.

    A scene that cannot be probed raises SceneError, as the run would.
    """
    notes = (*remarks(rig), *(scene.notes if scene is not None else ()))
    if SCENES[rig.scene.kind].events:
        return Modelled((Part("events", "played from a recording: no light and no pixel is modelled"),), notes=notes)
    probed = scene is not None and not is_driven and is_drawn_here(rig)
    plan = plan_of(rig, scene) if scene is not None and probed else make_plan(rig, _STILL)
    tolerance = None if plan.pinned else plan.tolerance
    return Modelled(
        tuple(_parts(rig)),
        tuple(_effects(plan, probed=probed)),
        None if tolerance is None else tolerance.eps_us,
        None if tolerance is None else tolerance.wrong_share,
        _steps(plan, probed=probed),
        probed,
        notes,
    )


def _effects(plan: Plan, *, probed: bool) -> Iterator[Effect]:
    """Yield the effects of the plan, then those that are switched off."""
    for decision in plan.decisions:
        yield _effect(decision, plan, probed=probed)
    named = {decision.effect for decision in plan.decisions}
    sensor = plan.rig.camera.sensor
    for name in EFFECTS:
        if name in named:
            continue
        if name == "large signals" and sensor.photoreceptor == "large_signal":
            yield Effect(name, "modelled", "part of the photoreceptor's law")
        else:
            yield Effect(name, "off", "switched off, or without effect, in the rig or its camera's model")


def _effect(decision: Decision, plan: Plan, *, probed: bool) -> Effect:
    if not decision.choice:
        state, reason = ("modelled", "no choice") if decision.kept else ("left out", "not in the chosen grade")
    elif plan.pinned:
        state, reason = "modelled", "the rig has no tolerance"
    elif decision.kept:
        state, reason = "modelled", "beyond the tolerance without it"
    else:
        state, reason = "left out", "below the tolerance"
    costs = (_finite(decision.cost_us), _finite(decision.cost_share)) if probed else (None, None)
    return Effect(
        decision.effect, "modelled" if state == "modelled" else "left out", f"{reason}: {decision.bound}", *costs
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _steps(plan: Plan, *, probed: bool) -> str:
    steps = plan.steps
    text = f"{'controlled, about' if steps.controlled else 'fixed,'} {steps.step_us:.0f} us ({steps.bound})"
    return f"{text}; expected error of event times {steps.error_us:.3g} us (95 %)" if probed else text


def _parts(rig: Rig) -> Iterator[Part]:
    camera, run = rig.camera, rig.run
    yield Part("light", f"scene of kind {rig.scene.kind!r}")
    yield Part("lens", _LENSES[SCENES[rig.scene.kind].lens])
    yield Part("light between two frames", _METHODS[run.method])
    readout = camera.sensor.readout
    has_delay = bool(readout.event_ns or readout.row_ns or readout.scan_us)
    yield Part("read-out", _switched("", has_delay, "events leave their pixels without delay"))
    yield Part("camera", f"device model {camera.model!r}, {camera.size[0]} x {camera.size[1]} pixels")
    yield Part("frames of active pixels", _switched("", camera.frames is not None, "no [camera.frames] table"))
    yield Part("inertial unit", _switched("", camera.imu is not None, "no [camera.imu] table"))
    clock = "the camera's own clock, with its errors"
    yield Part("clock", _switched(clock, camera.clock is not None, "the camera shows stream time"))
    yield Part("external input", _switched("", rig.trigger is not None, "no [trigger] table"))
    second = _switched("on the same clock", rig.second_camera is not None, "no [second_camera] table")
    yield Part("second camera", second)
    links = ", ".join(f"{link.name} ({link.kind})" for link in rig.links)
    yield Part("links", f"modelled: {links}" if links else "not modelled: the rig has none")


def _switched(how: str, on: bool, why_not: str) -> str:
    """Return how a part is modelled, or why it is not."""
    return (f"modelled: {how}" if how else "modelled") if on else f"not modelled: {why_not}"

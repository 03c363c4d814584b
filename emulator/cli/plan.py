"""`evstim plan RIG`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

from emulator.cli.checks import failures, prepared
from emulator.cli.output import GOOD, Json, RigName, aligned, print_result
from emulator.plan.plan import Decision, Plan, line_loads
from emulator.rig.kinds import CAMERA_MODELS, SCENES
from emulator.rig.loading import Rig, load_rig
from emulator.rig.quality import described
from emulator.run.assembly import build_scene, plan_of
from emulator.run.kernels import parts_of
from emulator.run.trial import INSTANTS, Trial, runs_alone, trial
from emulator.run.tuning import Ladder
from emulator.scene.between import OFTEN, SELDOM

_METHODS = {
    "hermite": "cubic in log light from value and derivative, low-pass solved in warped time",
    "line": "straight line in log light, low-pass solved exactly for it",
}


def plan(rig: RigName, /, *, json: Json = False) -> int:
    """Show the plan of a run: steps, each effect with the bound that decided it, and the speed measured."""
    with failures():
        loaded = load_rig(rig)
        if SCENES[loaded.scene.kind].events:
            kind = loaded.scene.kind
            reason = (
                f"{loaded.name}: a {kind} plays events that exist already: there is no light and no sensor to plan for"
            )
            print_result(json, {"rig": loaded.name, "plan": None, "why": reason}, [reason])
            return GOOD
        prepared(parts_of(loaded))
        with build_scene(loaded) as scene:
            planned = plan_of(loaded, scene)
            speed = trial(loaded, scene, planned, INSTANTS)
            is_between = scene.refines
        rung = _rung(loaded)
    as_json = {**_as_json(planned), "light_between_drawings": is_between, "speed": speed.as_json(), "rung": rung}
    print_result(json, as_json, _lines(planned, speed, is_between, rung))
    return GOOD


def _as_json(planned: Plan) -> dict[str, object]:
    decisions = [{k: v for k, v in dataclasses.asdict(d).items() if k != "changes"} for d in planned.decisions]
    return {
        "rig": planned.rig.name,
        "pinned": planned.pinned,
        "tolerance": planned.tolerance,
        "probe": _finite(dataclasses.asdict(planned.probe)),
        "steps": planned.steps,
        "lines": line_loads(planned.rig, planned.probe.events_per_s),
        "effects": [_finite({**d, "kept": d["kept"] or (planned.pinned and d["choice"])}) for d in decisions],
    }


def _rung(rig: Rig) -> dict[str, Any] | None:
    """Return the rung of a rig, with its wrong events where it runs alone; None for none."""
    if rig.run.quality < 0:
        return None
    with Ladder(rig) if runs_alone(rig) else nullcontext() as ladder:
        wrong_share = None if ladder is None else ladder.wrong_share(rig)
    return {**described(rig.run.quality, rig), "wrong_share": wrong_share}


def _finite(table: dict[str, object]) -> dict[str, object]:
    """Return the table with null for infinity and NaN, which JSON does not have."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in table.items()}


def _lines(planned: Plan, speed: Trial, is_between: bool, rung: dict[str, Any] | None) -> Iterator[str]:
    """Yield the plan for people; `is_between`: light is moved between drawings."""
    p = planned.probe
    steps, sensor = planned.steps, planned.rig.camera.sensor
    yield f"{planned.rig.name}: {planned.rig.title}\n"
    yield (
        f"scene    {p.active_share:.0%} of {sensor.width}x{sensor.height} pixels active, contrast rate "
        f"{p.contrast_rate:.3g} /s, light {p.least_current:.2g} to {p.largest_current:.2g} of the reference, about "
        f"{p.events_per_s * 1e-6:.3g} Mev/s expected"
    )
    yield f"chip     {_chip(planned)}"
    method = planned.rig.run.method
    yield f"method   {method}: {_METHODS[method]}"
    motion = f", {p.motion_px_s * steps.step_us * 1e-6:.2g} px of motion" if math.isfinite(p.motion_px_s) else ""
    yield (
        f"steps    {'controlled, about' if steps.controlled else 'fixed,'} {steps.step_us:.0f} us{motion}: "
        f"{steps.bound}; timestamp error {_us(steps.error_us)} (95 %); a straight line would need "
        f"{steps.line_step_us:.0f} us for that"
    )
    if is_between:
        every_us = planned.rig.run.drawing_us
        every = f"every {every_us} us" if every_us else f"every {OFTEN} steps, or {SELDOM} where the image moves fast"
        yield f"drawing  {every}; in between light follows the motion of the surfaces (run.drawing_us)"
    if rung is not None:
        keys = " and ".join(f"{key} = {value!r}" for key, value in rung["keys"].items()) or "no key of this scene"
        wrong = (
            "" if rung["wrong_share"] is None else f"; {rung['wrong_share']:.2%} of the events of the light wrong here"
        )
        yield f"quality  {rung['quality']}: {keys}; leaves out {rung['left_out'] or 'nothing'}{wrong}"
    for load in line_loads(planned.rig, p.events_per_s):
        yield f"line     {load.line}"
    yield f"speed    {speed.line}\n"
    yield from _effects(planned)
    if planned.pinned:
        yield "\nThis rig has no run.tolerance_us, so no effect is dropped."


def _chip(planned: Plan) -> str:
    """Return the light of the active pixels in units: on the chip, and as a pixel's current."""
    lens, chip = planned.rig.camera.lens, CAMERA_MODELS[planned.rig.camera.model].chip
    bounds = planned.probe.least_current, planned.probe.largest_current
    if not all(map(math.isfinite, bounds)):
        return "the light of no pixel changes"
    lux = [light * lens.reference_lux for light in bounds]
    current_a = [chip.photocurrent_a(lens.chip_irradiance_w_m2(light)) for light in bounds]
    return (
        f"{lux[0]:.2g} to {lux[1]:.2g} lx on the active pixels, dark current included, where the reference is "
        f"{lens.reference_lux:g} lx; {current_a[0] * 1e12:.2g} to {current_a[1] * 1e12:.2g} pA a pixel"
    )


def _effects(planned: Plan) -> list[str]:
    """Return the effects as aligned lines."""
    eps, share = _us(planned.tolerance.eps_us), f"{planned.tolerance.wrong_share:g}"
    rows = [("effect", "verdict", f"time error (< {eps})", f"wrong events (< {share})", "bound")]
    rows += [_row(decision, planned) for decision in planned.decisions]
    return aligned(rows)


def _row(decision: Decision, planned: Plan) -> tuple[str, str, str, str, str]:
    worth = "matters" if decision.kept else "hardly matters"
    verdict = f"kept: no tolerance, {worth}" if planned.pinned else ("kept" if decision.kept else "dropped")
    if not decision.choice:
        verdict = "kept: no choice" if decision.kept else "left out: not in the grade"
    time = "-" if decision.cost_us is None else _us(decision.cost_us)
    share = "-" if decision.cost_share is None else f"{decision.cost_share:.2g}"
    return decision.effect, verdict, time, share, decision.bound


def _us(value: float) -> str:
    if not math.isfinite(value):
        return "no bound"
    return f"{value:.3g} us" if value < 1000 else f"{value / 1000:.3g} ms"

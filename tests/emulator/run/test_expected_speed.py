"""Expected speed of a rig, and the settings that would make it real time."""

import dataclasses

import pytest

from emulator.plan.plan import make_plan
from emulator.rig.loading import load_rig
from emulator.run import expected_speed as module
from emulator.run.assembly import build_scene
from emulator.run.expected_speed import StepCost, expected_speed
from tests.emulator.plan.test_decide import SCENE

PIXELS = 346 * 260


def plan_of(name="checkerboard", **run):
    rig = load_rig(name)
    run = {"step_us": 1000, **run}
    return make_plan(dataclasses.replace(rig, run=dataclasses.replace(rig.run, **run)), SCENE)


def cost(step_s, fixed_s=0.0, a_step=0.0, a_pixel_s=0.0, pixels=PIXELS):
    return StepCost(step_s, fixed_s + a_pixel_s * pixels, a_step * step_s)


def probed(monkeypatch, made, cost_of):
    """Return the expected speed where a step costs what a function of the rig and the step, ns, returns."""
    monkeypatch.setattr(module.HostedLinks, "cost", lambda links, rig, sensor, scene, step_ns: cost_of(rig, step_ns))
    monkeypatch.setattr(module, "available_threads", lambda: 2)
    with build_scene(made.rig) as scene:
        return expected_speed(dataclasses.replace(made.rig, links=()), scene, made)


def expected(monkeypatch, made, fixed_s, a_pixel_s):
    """Return the speed for a fixed cost a step, and one a pixel, halved without a bound on the threads."""

    def cost_of(rig, step_ns):
        threads = 1 if rig.run.threads == 1 else 2
        width, height = rig.camera.size
        return StepCost(step_ns * 1e-9, fixed_s / threads, a_pixel_s * width * height / threads)

    return probed(monkeypatch, made, cost_of)


def test_a_slow_rig_has_the_remedies_that_its_costs_support(monkeypatch):
    speed = expected(monkeypatch, plan_of(threads=1), 5e-4, 1e-8)  # 1.4 ms a step of 1 ms; 0.7 with two threads
    assert speed.cost.factor == pytest.approx(0.714, rel=0.01)
    threads, step, size = speed.remedies
    assert threads == "run.threads = 0"
    assert step.startswith("run.step_us = 1600")
    assert "px of motion" in step
    assert size == "a camera of 230x172 pixels"
    assert "run.threads = 0, or run.step_us" in speed.line


def test_a_probe_makes_steps_of_the_rig(monkeypatch):
    monkeypatch.setattr(module, "_PROBE_S", 0.05)
    made = plan_of()
    with build_scene(made.rig) as scene:
        speed = expected_speed(made.rig, scene, made)
    assert speed.cost.step_s == pytest.approx(1e-3)
    assert speed.cost.drawing_s > 0
    assert speed.cost.pixels_s > 0
    assert speed.cost.links_s > 0
    assert speed.as_json()["times_real_time"] == speed.cost.factor

"""Expected speed of a rig, and the settings that would make it real time."""

import dataclasses
from types import SimpleNamespace

import pytest

from emulator.plan.plan import make_plan
from emulator.rig.loading import load_rig
from emulator.run import expected_speed as module
from emulator.run.assembly import build_scene
from emulator.run.expected_speed import ExpectedSpeed, StepCost, expected_speed, longer_step_us, smaller_size
from emulator.run.link_process import LinkProcess
from tests.emulator.plan.test_decide import SCENE

PIXELS = 346 * 260


def plan_of(name="checkerboard", **run):
    rig = load_rig(name)
    run = {"step_us": 1000, **run}
    return make_plan(dataclasses.replace(rig, run=dataclasses.replace(rig.run, **run)), SCENE)


def cost(step_s, fixed_s=0.0, a_step=0.0, a_pixel_s=0.0, pixels=PIXELS):
    return StepCost(step_s, fixed_s + a_pixel_s * pixels, a_step * step_s)


@pytest.mark.parametrize(
    ("fixed_s", "a_step", "step_us"),
    [(9e-3, 0.0, 10_000), (9e-3, 0.45, 20_000), (1.8e-3, 0.0, 2000), (1e-3, 0.9, None), (5.0, 0.0, None)],
)
def test_the_least_step_in_real_time_follows_from_two_costs(fixed_s, a_step, step_us):
    costs = (cost(step_s, fixed_s, a_step) for step_s in (1e-3, 4e-3))
    assert longer_step_us(*costs) == (None if step_us is None else pytest.approx(step_us, rel=0.1))


def test_a_named_step_is_in_real_time():
    for fixed_s in (1.234e-3, 7.77e-3, 0.0499):
        step_us = longer_step_us(cost(1e-3, fixed_s, 0.3), cost(4e-3, fixed_s, 0.3))
        assert cost(step_us * 1e-6, fixed_s, 0.3).factor > 1.05


@pytest.mark.parametrize(("a_pixel_s", "fixed_s"), [(2e-8, 0.0), (1.2e-8, 2e-4), (3e-7, 0.0)])
def test_a_named_size_is_in_real_time_and_hardly_smaller_than_needed(a_pixel_s, fixed_s):
    whole = cost(1e-3, fixed_s, a_pixel_s=a_pixel_s)
    width, height = smaller_size(whole, cost(1e-3, fixed_s, a_pixel_s=a_pixel_s, pixels=PIXELS // 4), (346, 260))
    found = cost(1e-3, fixed_s, a_pixel_s=a_pixel_s, pixels=width * height)
    assert 1.05 < found.factor < 1.25
    assert width / height == pytest.approx(346 / 260, rel=0.05)


def test_no_size_helps_where_pixels_cost_nothing():
    assert smaller_size(cost(1e-3, 5e-3), cost(1e-3, 5e-3), (346, 260)) is None
    assert smaller_size(cost(1e-3, 5e-3, a_pixel_s=1e-9), cost(1e-3, 5e-3, pixels=PIXELS // 4), (346, 260)) is None


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


def test_a_fast_rig_needs_no_remedy(monkeypatch):
    speed = expected(monkeypatch, plan_of(), 1e-4, 1e-9)
    assert speed.remedies == ()
    assert "would" not in speed.line
    assert "times real time expected" in speed.line


def test_a_slow_rig_has_the_remedies_that_its_costs_support(monkeypatch):
    speed = expected(monkeypatch, plan_of(threads=1), 5e-4, 1e-8)  # 1.4 ms a step of 1 ms; 0.7 with two threads
    assert speed.cost.factor == pytest.approx(0.714, rel=0.01)
    threads, step, size = speed.remedies
    assert threads == "run.threads = 0"
    assert step.startswith("run.step_us = 1600")
    assert "px of motion" in step
    assert size == "a camera of 230x172 pixels"
    assert "run.threads = 0, or run.step_us" in speed.line


def test_costs_that_nothing_lowers_have_no_remedy(monkeypatch):
    speed = probed(monkeypatch, plan_of(), lambda rig, step_ns: StepCost(step_ns * 1e-9, 0.0, 3e-9 * step_ns))
    assert speed.remedies == ()
    assert "neither longer steps nor fewer pixels" in speed.line


def test_controlled_steps_are_named_by_their_tolerance(monkeypatch):
    made = plan_of(tolerance_us=100.0)
    speed = expected(monkeypatch, made, 4 * made.steps.step_us * 1e-6, 0.0)
    assert any("run.tolerance_us" in one for one in speed.remedies)


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


def test_the_line_has_the_shares():
    line = ExpectedSpeed(StepCost(0.04, 0.06, 0.015, 0.005), ("run.step_us = 90000",)).line
    assert "0.5 times real time" in line
    assert "drawing 75%, pixels 19%, links 6%" in line
    assert line.endswith("; run.step_us = 90000 would make it real time")


def test_a_link_that_takes_long_is_part_of_a_step(monkeypatch):
    """A link settles 5 ms after each step, but a second after the first events, which let it load kernels."""
    now_s, waits = 0.0, 0

    def settle(link, until_us, goes_on):
        nonlocal now_s, waits
        waits += until_us > 0
        now_s += 1.0 if waits == 1 else 5e-3

    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now_s))
    monkeypatch.setattr(module.LinkProcess, "wait_settled", settle)
    made = plan_of()
    with build_scene(made.rig) as scene:
        cost = expected_speed(made.rig, scene, made).cost
    assert cost.links_s == pytest.approx(5e-3)
    assert cost.total_s == pytest.approx(5e-3)


def test_steps_of_both_cameras_are_made_and_all_their_events_are_delivered(monkeypatch):
    """The links are those of the rig, and take all events at times that go on where the stream jumps."""
    monkeypatch.setattr(module, "_PROBE_S", 0.02)
    monkeypatch.setattr(module, "_BETWEEN_S", 0.0)
    rig, reports = load_rig("stars-stereo"), {}

    def stop(link, drain_s, stopped=LinkProcess.stop):
        reports[link.name] = stopped(link, 10.0)

    monkeypatch.setattr(LinkProcess, "stop", stop)
    with build_scene(rig) as scene, module.hosted_links(rig) as links:
        cost = links.cost(rig, rig.camera.sensor, scene, 1_000_000)
    assert cost.total_s > 0
    assert set(reports) == {link.name for link in rig.links}
    for report in reports.values():
        assert report.delivered > 0
        assert report.dropped == report.dropped_in_device == 0

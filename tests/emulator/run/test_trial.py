"""The trial of a rig before its run: its cost of a step, and that the run's events do not depend on it."""

import dataclasses

import numpy as np
import pytest

from emulator.cli.app import _main
from emulator.light import SceneEnded
from emulator.rig.loading import load_rig, parse_rig
from emulator.run import trial as module
from emulator.run.assembly import build_scene, build_session, plan_of, schedule
from emulator.run.trial import Trial, runs_alone, trial
from emulator.sensor.parameters import NoiseParameters
from transports.link.pacing import MonotonicClock

BOARD = (
    '[scene]\nkind = "checkerboard"\nspeed_px_s = 20.0\n[camera.sensor]\nwidth = 64\nheight = 48\n'
    "[run]\nstep_us = 2000\nseconds = 0.02\nmax_late_ms = 0\n"
)
LIVE = '[scene]\nkind = "bodies"\n[[scene.bodies]]\nshape = "eros022540"\n[scene.bodies.path]\nkind = "live"\n'


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(module, "_LONG_S", 0.05)


def small(name="eros", **run):
    rig = load_rig(name)
    sensor = dataclasses.replace(rig.camera.sensor, width=64, height=48, noise=NoiseParameters(rms=0.05))
    run = dataclasses.replace(rig.run, pace="free", **run)
    return dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor), run=run, links=())


def events_of(rig, *, tried):
    with build_scene(rig) as scene:
        if tried:
            trial(rig, scene)
        taken = []
        build_session(rig, scene, [], MonotonicClock()).run(schedule(rig), on_events=taken.append)
        return np.concatenate(taken), scene.counts


def test_the_events_of_a_run_do_not_depend_on_a_trial_before_it():
    rig = small(seconds=1.6)
    (without, counts), (after, counts_after) = (events_of(rig, tried=tried) for tried in (False, True))
    assert len(without) > 100
    assert np.array_equal(without, after)
    assert counts == counts_after


@pytest.mark.parametrize("instants", [1, 4])
def test_a_trial_makes_steps_of_the_rig(instants):
    rig = small("checkerboard")
    with build_scene(rig) as scene:
        tried = trial(rig, scene, instants=instants)
        planned = plan_of(dataclasses.replace(rig, run=dataclasses.replace(rig.run, tolerance_us=200.0)), scene)
        assert trial(rig, scene, planned).step_s == pytest.approx(planned.steps.step_us * 1e-6, abs=1e-9)
    assert tried.step_s == rig.run.step_us * 1e-6
    assert min(tried.drawing_s, tried.pixels_s) > 0
    assert tried.factor == pytest.approx(tried.step_s / (tried.drawing_s + tried.pixels_s))


def test_a_trial_ends_with_its_scene(monkeypatch):
    rig = small("checkerboard")
    with build_scene(rig) as scene:
        draw = scene.light_and_rate

        def ends(t_ns, *arrays):
            if t_ns > 2 * rig.run.step_us * 1000:
                raise SceneEnded("no more light")
            draw(t_ns, *arrays)

        monkeypatch.setattr(scene, "light_and_rate", ends)
        assert trial(rig, scene).step_s == rig.run.step_us * 1e-6
        monkeypatch.setattr(scene, "light_and_rate", lambda t_ns, *_: ends(t_ns + 10**12, *_))
        with pytest.raises(SceneEnded):
            trial(rig, scene)


def test_poses_and_light_from_outside_are_not_tried():
    assert runs_alone(load_rig("eros"))
    assert not runs_alone(parse_rig(LIVE, "live.toml", "live"))


@pytest.mark.parametrize(
    ("factor", "pace", "is_first"), [(0.25, "realtime", True), (1.5, "realtime", False), (0.25, "free", False)]
)
def test_the_first_line_of_a_run_is_that_it_is_too_slow_here(factor, pace, is_first, tmp_path, monkeypatch, capsys):
    path = tmp_path / "my board.toml"
    path.write_text(BOARD)
    monkeypatch.setattr(module, "trial", lambda *_: Trial(1.0, 0.5 / factor, 0.5 / factor))
    assert _main(["run", str(path), "--pace", pace]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    slow = first.startswith("my board does NOT run in real time on this machine: 0.25 times real time")
    assert slow is is_first
    assert f"`evstim tune '{path}'`" in first or not is_first

"""A rig in step with a program: the same bits in every way, states that come back, and what is refused."""

import dataclasses
import itertools
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from multiprocessing.context import SpawnContext

import numpy as np
import pytest

import evstim
from emulator.run.assembly import _gravity_of
from emulator.run.simulation import LONGEST_US, _driven
from evstim import Pose, Simulation

ORIGIN, AS_THE_WORLD = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])

RIG = """
[scene]
kind = "bodies"
camera = {kind = "keyframes", keyframes = [
    {t_s = 0.0, position_m = [0.0, 0.0, -4.0]}, {t_s = 10.0, position_m = [1.0, 0.0, -3.0]},
]}
[scene.sun]
direction = [-1.0, -1.0, -1.0]
[[scene.bodies]]
name = "ball"
shape = "globe"
path = {kind = "spin", pole = [0.0, 1.0, 0.0], spin_deg_s = 40.0}
[[scene.bodies]]
name = "moon"
shape = "globe"
units_m = 0.3
path = {kind = "fixed", position_m = [1.4, 0.4, -0.5]}
[camera]
sensor = {width = 64, height = 48}
imu = {}
frames = {}
[camera.lens]
field_of_view_deg = 40.0
[run]
step_us = 4000
seed = 3
"""


def rig_of(text=RIG, preset="davis346", threads=1):
    rig = evstim.parse_rig(text, "a.toml", "a")
    sensor = dataclasses.replace(evstim.PRESETS[preset], width=64, height=48)
    camera, run = dataclasses.replace(rig.camera, sensor=sensor), dataclasses.replace(rig.run, threads=threads)
    return dataclasses.replace(rig, camera=camera, run=run)


def at(k):
    """A camera that goes round a corner."""
    return Pose(np.array([0.05 * k, 0.02 * k * k, -4.0 + 0.1 * k]), AS_THE_WORLD)


def flown(sim, steps=range(5), us=10_000):
    return [
        sim.step(us, camera=at(k), bodies={"ball": Pose(np.array([0.0, 0.01 * k, 0.0]), AS_THE_WORLD)}) for k in steps
    ]


def assert_same(first, second):
    for a, b in itertools.zip_longest(first, second):
        assert a.t_us == b.t_us
        for name in ("events", "light", "imu"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert [frame.t_us for frame in a.frames] == [frame.t_us for frame in b.frames]
        for frame, other in zip(a.frames, b.frames, strict=True):
            np.testing.assert_array_equal(frame.pixels, other.pixels)


@pytest.fixture(scope="module", params=["davis346", "imx636", "dvxplorer_micro"])
def flight(request):
    """The output of a flight, and its rig."""
    rig = rig_of(preset=request.param)
    with Simulation(rig) as sim:
        steps = flown(sim)
    assert sim.result.ledger.balanced
    assert sim.result.good
    assert sum(len(step.events) for step in steps) > 200
    assert [step.t_us for step in steps] == [10_000, 20_000, 30_000, 40_000, 50_000]
    assert sum(len(step.imu) for step in steps) == 50
    assert sum(len(step.frames) for step in steps) == 2
    return rig, steps


@pytest.mark.sampled
@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_changes_no_bit(flight, threads):
    rig, steps = flight
    with Simulation(dataclasses.replace(rig, run=dataclasses.replace(rig.run, threads=threads))) as sim:
        assert_same(flown(sim), steps)


def test_a_state_comes_back_to_the_bit_as_often_as_it_is_restored(flight):
    rig, steps = flight
    with Simulation(rig) as sim:
        first = flown(sim, range(1))  # a frame is being read
        state = sim.save()
        for _ in range(2):
            away = Pose(np.array([0.3, 0.3, -2.5]), AS_THE_WORLD)
            assert len(sim.step(23_456, camera=away, bodies={"ball": away}).events)
            sim.step(1)
            sim.restore(state)
            assert sim.t_us == 10_000
            np.testing.assert_array_equal(sim.light, first[-1].light)
        assert_same(first + flown(sim, range(1, 5)), steps)
    assert sim.result.ledger.balanced


@pytest.mark.sampled
def test_links_change_no_bit_and_deliver_the_same_events(flight, tmp_path):
    rig, steps = flight
    rig = dataclasses.replace(rig, links=(evstim.FileLink(path=str(tmp_path / "events.raw")),))
    with Simulation(rig, links=True) as sim:
        linked = flown(sim)
        assert list(sim.addresses) == ["file"]
        with pytest.raises(RuntimeError, match="saved and restored"):
            sim.save()
    for step, other in zip(linked, steps, strict=True):
        np.testing.assert_array_equal(step.events, other.events)
        np.testing.assert_array_equal(step.light, other.light)
    read = evstim.read_events(tmp_path / "events.raw")
    sent = np.concatenate([step.events for step in linked])
    assert sim.result.ledger.links[0].delivered == len(read) >= len(sent)
    assert sorted(read[: len(sent)].tolist()) == sorted(sent.tolist())


def rolled_out(content):
    """Return the events that follow a pickled state, for another process."""
    with Simulation(rig_of(threads=2)) as sim:
        sim.restore(pickle.loads(content))
        return np.concatenate([step.events for step in flown(sim, range(1, 5))])


@pytest.mark.sampled
def test_a_state_can_be_pickled_for_rollouts_in_other_processes(flight):
    """Threads change no event, so a state goes to a simulation with another number of them."""
    rig = rig_of()
    with Simulation(rig) as sim:
        flown(sim, range(1))
        content = pickle.dumps(sim.save())
        followed = np.concatenate([step.events for step in flown(sim, range(1, 5))])
    assert len(followed) > 200
    with SpawnContext().Pool(2) as pool:  # not `get_context`: what `forked_links` gives has another environment
        for events in pool.map(rolled_out, [content] * 2):
            np.testing.assert_array_equal(events, followed)


def other_sensor(rig, **changed):
    sensor = dataclasses.replace(rig.camera.sensor, **changed)
    return dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor))


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (lambda rig: (rig, {"seed": 4}), "rig.run.seed is 3, here 4"),
        (lambda rig: (other_sensor(rig, width=63), {}), "rig.camera.sensor.width is 64, here 63"),
        (lambda rig: (other_sensor(rig, threshold_on=0.5), {}), "rig.camera.sensor.threshold_on is .*, here 0.5"),
        (lambda rig: (rig, {"bodies": ["moon"]}), r"bodies is \('ball',\), here \('ball', 'moon'\)"),
        (lambda rig: (evstim.load_rig("loopback"), {}), "rig.name is 'a', here 'loopback'"),
    ],
)
def test_a_state_of_another_simulation_is_refused_with_what_differs(other, why):
    with Simulation(rig_of()) as sim:
        sim.step(4_000)
        state = sim.save()
    rig, options = other(rig_of())
    with Simulation(rig, **options) as sim:
        with pytest.raises(ValueError, match=f"the state is of another simulation: .*{why}"):
            sim.restore(state)
        assert sim.t_us == 0
        sim.step(4_000)


def test_a_state_of_another_version_is_refused(monkeypatch):
    with Simulation(rig_of()) as sim:
        state = sim.save()
        old = dataclasses.replace(state, evstim="0.0.1")
        with pytest.raises(ValueError, match=r"evstim is '0.0.1', here"):
            sim.restore(old)


def test_a_pose_is_that_of_the_moment_it_was_given():
    """The program moves its own array after each step, as the manual's loop does."""

    def events(kept):
        place = np.array([0.0, 0.0, -4.0])
        with Simulation(rig_of()) as sim:
            parts, states = [], []
            for _ in range(5):
                parts.append(sim.step(10_000, camera=Pose(kept(place), AS_THE_WORLD)).events)
                place[0] += 0.05
                states.append(sim.save())
            sim.restore(states[0])
            return np.concatenate([*parts, sim.step(10_000).events])

    np.testing.assert_array_equal(events(lambda place: place), events(np.copy))


def test_output_of_a_step_stays_as_it_was():
    with Simulation(rig_of()) as sim:
        steps = [sim.step(10_000, camera=at(k), truth=True) for k in range(3)]
        assert not any(np.array_equal(a.light, b.light) for a, b in itertools.pairwise(steps))
        light, depth = (array.copy() for array in (steps[0].light, steps[0].truth.depth))
        sim.step(10_000, camera=at(9), truth=True)
        np.testing.assert_array_equal(steps[0].light, light)
        np.testing.assert_array_equal(steps[0].truth.depth, depth)
        assert not any(array.flags.writeable for array in (steps[0].light, steps[0].events, steps[0].truth.depth))


class Late(Exception):
    """An error of the program's own."""


@pytest.mark.parametrize("error", [KeyboardInterrupt, Late])
def test_an_error_within_a_step_closes_the_simulation(error, monkeypatch, caplog):
    """As a signal's handler raises it while the program waits for the step; a state goes on in another simulation."""
    rig = rig_of()
    with Simulation(rig) as sim:
        sim.step(4_000)
        state, threads = sim.save(), threading.active_count()
        go_to = type(sim._program).go_to

        def interrupted(program, t_ns):
            with program.changed:
                program.limit_ns = t_ns
                program.changed.notify_all()
            raise error

        monkeypatch.setattr("emulator.run.simulation._Program.go_to", interrupted)
        with pytest.raises(error):
            sim.step(400_000)
        assert threading.active_count() < threads
        monkeypatch.setattr("emulator.run.simulation._Program.go_to", go_to)
        for refused in (lambda: sim.step(1000), sim.save, lambda: sim.restore(state), lambda: sim.light):
            with pytest.raises(RuntimeError, match=f"has ended: {error.__name__} within a step closed it: begin"):
                refused()
    assert f"{error.__name__} within a step closed it" in caplog.text
    assert sim.result.ledger.balanced
    with Simulation(rig) as sim:
        expected = [sim.step(4_000), *flown(sim)]
    with Simulation(rig) as again:
        again.restore(state)
        assert_same(flown(again), expected[1:])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_fork_is_refused_at_once():
    with Simulation(rig_of()) as sim:
        sim.step(4_000)
        reader, writer = os.pipe()
        if not (child := os.fork()):  # as multiprocessing does it
            said = []
            for call in (lambda: sim.step(4_000), sim.save, sim.close):
                try:
                    call()
                except RuntimeError as error:
                    said.append(str(error))
            os.write(writer, "\n".join(said).encode())
            os._exit(0)
        os.close(writer)
        with os.fdopen(reader) as answer:
            said = answer.read().splitlines()
        assert os.waitpid(child, 0)[1] == 0
        assert len(said) == 2
        assert all("a fork" in line and "begin another Simulation" in line for line in said)
        assert sim.step(4_000).t_us == 8_000


@pytest.mark.parametrize("links", [False, True])
def test_a_simulation_without_a_link_can_be_recorded(links, tmp_path):
    rig, file = rig_of(), tmp_path / "flight.aedat4"
    with Simulation(rig, record=file, links=links) as sim:
        steps = flown(sim)
        with pytest.raises(RuntimeError, match="a record cannot be saved"):
            sim.save()
    with Simulation(rig) as sim:
        assert_same(flown(sim), steps)
    read = evstim.read_events(file)
    sent = np.concatenate([step.events for step in steps])
    np.testing.assert_array_equal(read["t"][: len(sent)], sent["t"])
    assert len(read) - len(sent) < 5
    with pytest.raises(ValueError, match="none of the suffixes"):
        Simulation(rig, record=tmp_path / "flight.xyz")


def test_without_poses_it_is_the_rigs_own_run(tmp_path):
    rig = rig_of()
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, drawing_us=1))  # as where poses come from outside
    recorded = dataclasses.replace(rig, links=(evstim.FileLink(path=str(tmp_path / "events.raw")),))
    whole = dataclasses.replace(rig, run=dataclasses.replace(rig.run, step_us=10_000))
    with Simulation(rig) as sim:
        steps = [sim.step(4_000) for _ in range(10)]
    with evstim.run(recorded, seconds=0.04, pace="free") as run:
        events = np.concatenate(list(run))
    # What the read-out has not sent at the end comes at the end of the run, which a simulation does not have.
    simulated = np.concatenate([step.events for step in steps])
    np.testing.assert_array_equal(simulated, events[: len(simulated)])
    assert len(events) - len(simulated) < 5
    with Simulation(whole) as sim:
        assert len(sim.step(40_000).events) != len(simulated)  # the rig's own steps count


def fixed(camera, ball):
    """The rig with camera and ball at two poses at first, and as near in the end as in the rig: facets are as fine."""
    rig = rig_of()
    ends = Pose(np.array([1.0, 0.0, -3.0]), AS_THE_WORLD), Pose(ORIGIN, AS_THE_WORLD)
    paths = [
        [(tuple(pose.position_m), tuple(pose.q_world_from_body)) for pose in path]
        for path in zip((camera, ball), ends, strict=True)
    ]
    tables = [
        evstim.KeyframePath(tuple(evstim.Keyframe(t_s, *pose) for t_s, pose in zip((0.0, 10.0), path, strict=True)))
        for path in paths
    ]
    bodies = (dataclasses.replace(rig.scene.bodies[0], path=tables[1]), *rig.scene.bodies[1:])
    return dataclasses.replace(rig, scene=dataclasses.replace(rig.scene, camera=tables[0], bodies=bodies))


def test_a_step_ends_at_the_poses_that_were_given():
    """Light, poses and depth, against a scene with fixed paths."""
    turned = Pose(np.array([0.2, 0.1, 0.0]), np.array([np.cos(0.3), 0.0, np.sin(0.3), 0.0]))
    with Simulation(rig_of()) as sim:
        sim.step(3_000, camera=at(1))
        step = sim.step(50_000, camera=at(4), bodies={"ball": turned}, truth=True)
    light = np.zeros((48, 64), np.float32)
    with evstim.build_scene(fixed(at(4), turned)) as scene:
        scene.light(0, light)
    np.testing.assert_allclose(step.light, light, rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(step.truth.poses.camera_m, at(4).position_m)
    np.testing.assert_allclose(step.truth.poses.bodies_m[0], turned.position_m)
    np.testing.assert_allclose(step.truth.poses.q_world_from_bodies[0], turned.q_world_from_body)
    assert step.truth.names == ("ball", "moon")
    assert np.linalg.norm(at(4).position_m - turned.position_m) - 1.01 < step.truth.depth.min()
    assert set(np.unique(step.truth.labels)) == {0, 1, 2}
    assert step.truth.flow.shape == (48, 64, 2)


def test_the_inertial_unit_is_carried_along():
    """A turn of 0.1 rad in 100 ms about the camera's y axis is 57.3 degrees a second."""
    with Simulation(rig_of(RIG.replace("imu = {}", "imu = {gyroscope_noise_deg_s = 0.0}"))) as sim:
        sim.step(50_000, camera=Pose(np.array([0.0, 0.0, -4.0]), AS_THE_WORLD))
        imu = sim.step(
            100_000, camera=Pose(np.array([0.0, 0.0, -4.0]), np.array([np.cos(0.05), 0, np.sin(0.05), 0]))
        ).imu
    rates = np.array([imu[f"gyroscope_{axis}"] for axis in "xyz"])
    assert len(imu) == 100
    assert np.abs(rates).mean(axis=1).max() == pytest.approx(np.degrees(1.0), rel=0.03)


def test_without_a_pose_a_driven_camera_stands_still():
    with Simulation(rig_of()) as sim:
        lights = [sim.step(10_000, camera=pose, bodies={"ball": at(0)}).light for pose in (at(3), None, None)]
        assert not np.array_equal(lights[0], np.zeros_like(lights[0]))
        np.testing.assert_allclose(sim.step(30_000, truth=True).truth.poses.camera_m, at(3).position_m)


def test_a_body_that_stands_still_in_the_rig_moves_where_it_is_named():
    with Simulation(rig_of(), bodies=["moon"]) as sim:
        far = Pose(np.array([0.0, 0.0, 50.0]), AS_THE_WORLD)
        assert 2 not in sim.step(20_000, bodies={"moon": far}, truth=True).truth.labels


NAN = np.array([np.nan, 0.0, 0.0])


REFUSED = [
    (lambda sim: sim.step(0), "a step of 0 us"),
    (lambda sim: sim.step(-5), "a step of -5 us"),
    (lambda sim: sim.step(LONGEST_US + 1), "take several"),
    (lambda sim: sim.step(10**18), "if it is in nanoseconds, divide it by 1000"),
    (lambda sim: sim.step(0.02), r"us is 0.02: whole microseconds \(1 s is 1000000\) are needed"),
    (lambda sim: sim.step(True), "whole microseconds"),
    (lambda sim: sim.step(np.float64(2.0)), "whole microseconds"),
    (lambda sim: sim.restore((1, 2)), "a state is what `save` returns, got tuple"),
    (lambda sim: sim.step(1000, camera=Pose(NAN, AS_THE_WORLD)), "three finite metres"),
    (lambda sim: sim.step(1000, camera=Pose(ORIGIN, np.zeros(4))), "unit quaternion"),
    (lambda sim: sim.step(1000, camera=(ORIGIN, AS_THE_WORLD)), "the camera: a pose is an evstim.Pose, got tuple"),
    (lambda sim: sim.step(1000, bodies={"moon": at(1)}), "body 'moon' takes no poses in a, where the camera, ball"),
    (lambda sim: sim.step(1000, bodies={"sun": at(1)}), "body 'sun' takes no poses"),
]


def test_what_cannot_be_is_refused_and_nothing_has_happened():
    with Simulation(rig_of()) as sim, Simulation(rig_of()) as other:
        for step, why in REFUSED:
            with pytest.raises(ValueError, match=why):
                step(sim)
            assert sim.t_us == 0
        assert_same(flown(sim), flown(other))


def test_unknown_bodies_and_rigs_are_refused():
    with pytest.raises(ValueError, match="no body 'sun'; it has ball, moon"):
        Simulation(rig_of(), bodies=["sun"])
    with pytest.raises(evstim.RigError):
        Simulation("no-such-rig")
    with Simulation(dataclasses.replace(evstim.load_rig("loopback"), links=())) as sim:
        assert len(sim.step(5_000).events)
        with pytest.raises(ValueError, match="the camera takes no poses in loopback, where nothing does"):
            sim.step(1_000, camera=at(0))


def test_a_scene_that_cannot_be_built_is_reported_and_no_thread_is_left():
    before = threading.active_count()
    inside = RIG.replace("position_m = [0.0, 0.0, -4.0]", "position_m = [0.0, 0.0, 0.0]")
    with pytest.raises(evstim.SceneError, match="inside"):
        Simulation(rig_of(inside))
    assert threading.active_count() == before


def test_an_interrupt_while_the_scene_is_built_ends_the_thread(monkeypatch):
    def interrupt(program, t_ns):
        raise KeyboardInterrupt

    before = threading.active_count()
    monkeypatch.setattr("emulator.run.simulation._Program.go_to", interrupt)
    with pytest.raises(KeyboardInterrupt):
        Simulation(rig_of())
    assert threading.active_count() == before


def test_the_inertial_unit_feels_the_body_of_the_rig_s_orbit():
    rig = evstim.load_rig("eros-flyover")
    camera = dataclasses.replace(rig.camera, imu=evstim.ImuParameters())
    driven, _ = _driven(dataclasses.replace(rig, camera=camera), ())
    assert _gravity_of(driven).gm_m3_s2 == rig.scene.camera.gm_m3_s2 > 0


def test_an_error_of_the_scene_ends_the_run_and_is_raised_from_then_on(monkeypatch):
    sim = Simulation(rig_of())
    sim.step(4_000)

    def fail(t_ns, light, rate):
        raise evstim.SceneError("the lamp is broken")

    monkeypatch.setattr(sim._scene, "light_and_rate", fail)
    for _ in range(2):
        with pytest.raises(evstim.SceneError, match="the lamp is broken"):
            sim.step(4_000)
    sim.close()
    assert sim.result.ledger.balanced


def test_after_its_end_a_run_takes_no_step():
    sim = Simulation(rig_of())
    with pytest.raises(RuntimeError, match="no result before"):
        _ = sim.result
    sim.close()
    sim.close()
    for refused in (lambda: sim.step(1000), sim.save, lambda: sim.light):
        with pytest.raises(RuntimeError, match="has ended"):
            refused()


def is_alive(group):
    """Return whether a group of processes has one."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("links", [False, True])
def test_a_program_that_is_interrupted_and_closes_nothing_ends_with_all_its_processes(links):
    code = f"""
import evstim
sim = evstim.Simulation("loopback", links={links})
print("here", flush=True)
while True:
    sim.step(1000)
"""
    command = [sys.executable, "-c", f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler){code}"]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    program = subprocess.Popen(command, start_new_session=True, **streams)
    try:
        assert program.stdout.readline() == "here\n"
        program.send_signal(signal.SIGINT)
        _, error = program.communicate(timeout=120)
        assert error.strip().endswith("KeyboardInterrupt")
        deadline_s = time.monotonic() + 60  # helpers of multiprocessing end a moment later
        while is_alive(program.pid):
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(program.pid, signal.SIGKILL)

"""A run in step with a simulation: requests of a scripted peer, and what the session does between them."""

import dataclasses
import sys
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from emulator.light import Scene, SceneFrames
from emulator.plan.step_control import FixedSteps
from emulator.rig.loading import RigError, parse_rig
from emulator.rig.remarks import remarks
from emulator.run.basilisk import BasiliskRun, camera_differs, connected
from emulator.run.session import Schedule, Session
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from emulator.trajectory.live import GivenPath, SimulatedPath
from emulator.trajectory.parameters import BasiliskPath
from emulator.trajectory.pose import Fixed
from firmware_protocol.events import EVENT
from firmware_protocol.vizard import CameraState
from transports.link.pacing import FakeClock

sys.path.insert(0, str(Path(__file__).parents[2] / "firmware_protocol" / "vizard"))

from wire_writer import update

SENSOR = dataclasses.replace(
    PRESETS["davis346"], width=24, height=16, leak_hz=0.0, parasitic_hz_at_reference=0.0, source_follower_hz=0.0,
    noise=NoiseParameters(),
)  # fmt: skip
MS = 1_000_000
PING, INPUT, IMAGE = [b"PING"], [b"REQUEST_INPUT"], [b"REQUEST_IMAGE_1"]


def state(t_ms, x=0.0, name="craft"):
    place = [x, 0.0, 0.0]
    camera = (1, name, [0.0, 0.0, 0.0], [1 / 3, 1 / 3, -1 / 3])
    return [b"SIM_UPDATE", b"", b"", update(t_ms * MS, [(name, place, [0.0] * 3)], cameras=[camera])]


class Peer:
    """A simulation that asks as the script says, each time when the reply to the request before is there."""

    def __init__(self, *script, leaves=True):
        self.script, self.leaves = deque(script), leaves
        self.replies, self.waiting, self.peer_gone, self.forgotten, self.looks = [], False, False, 0, 0

    def receive(self, timeout_ms):
        assert not self.waiting, "a second request before the reply"
        self.looks += 1
        assert self.looks < 1000
        if not self.script:
            self.peer_gone = self.leaves
            return None
        if self.script[0] == "leave":
            self.script.popleft()
            self.peer_gone = True
            return None
        self.waiting = True
        return self.script.popleft()

    def send(self, parts):
        assert self.waiting
        self.waiting = False
        self.replies.append(list(parts))

    def forget_peer(self):
        self.peer_gone, self.forgotten = False, self.forgotten + 1


class Seen(Scene):
    """Takes down the time of each picture and the place of the camera in it."""

    size = (24, 16)
    motion_bound_px_s = 0.0

    def __init__(self, path):
        self.path, self.drawn = path, []

    def light(self, t_ns, out):
        self.drawn.append((t_ns // MS, round(float(self.path.pose(t_ns).position_m[0]), 9)))
        out[:] = 0.5

    def close(self):
        pass


def run(peer, *, seconds=None, step_ms=10, stop_after=None):
    path, clock = SimulatedPath(Fixed()), FakeClock()
    scene, simulation = Seen(path), None
    simulation = BasiliskRun(
        peer, [GivenPath(BasiliskPath(camera=1), path)], lambda light: b"png" + bytes(light[0, :1]), clock
    )
    session = Session(SceneFrames(scene, with_rate=False), Sensor(SENSOR, 1), FixedSteps(step_ms * MS), [], clock)

    def look(_):
        if stop_after is not None and peer.looks >= stop_after:
            session.stop()

    def advancing(timeout_ms, receive=peer.receive):
        clock.advance(4 * timeout_ms * MS)  # so that a status is due at each look
        return receive(timeout_ms)

    peer.receive = advancing
    duration_ns = None if seconds is None else round(seconds * 1e9)
    result = session.run(Schedule(duration_ns=duration_ns, paced=False, simulation=simulation), look)
    simulation.end("evstim has ended its run")
    return scene, simulation, result


def test_the_run_goes_as_far_as_each_update_and_no_further():
    peer = Peer(PING, PING, state(40, 1.0), INPUT, state(80, 3.0), INPUT, state(105, 3.0), INPUT)
    scene, simulation, result = run(peer)
    assert scene.drawn == [
        (0, 1.0), (10, 1.5), (20, 2.0), (30, 2.5), (40, 3.0), (50, 3.0), (60, 3.0), (65, 3.0),
    ]  # fmt: skip
    ok, no_input = [b"OK"], [b"VIZARD_INPUT", b""]
    assert peer.replies == [[b"PONG"], [b"PONG"], ok, no_input, ok, no_input, ok, no_input]
    assert result.sim_seconds == pytest.approx(0.065)
    assert simulation.counters.updates == 3
    assert (simulation.first_ns, simulation.last_ns) == (40 * MS, 105 * MS)


def test_an_update_is_answered_when_its_last_picture_is_drawn():
    peer = Peer(state(0), state(30))
    drawn_at_reply, send = [], peer.send
    path, clock = SimulatedPath(Fixed()), FakeClock()
    scene = Seen(path)
    peer.send = lambda parts: (drawn_at_reply.append(scene.drawn[-1][0]), send(parts))
    simulation = BasiliskRun(peer, [GivenPath(BasiliskPath(camera=1), path)], lambda light: b"", clock)
    session = Session(SceneFrames(scene, with_rate=False), Sensor(SENSOR, 1), FixedSteps(10 * MS), [], clock)
    session.run(Schedule(paced=False, simulation=simulation))
    assert drawn_at_reply == [0, 30]


def test_images_are_of_the_last_update_and_of_the_rigs_camera_alone():
    peer = Peer(IMAGE, state(0), IMAGE, [b"REQUEST_IMAGE_2"], state(10), IMAGE)
    _, simulation, _ = run(peer)
    none, image = [bytes(4), b""], [b"\0\0\0\x07", b"png" + b"\0\0\0\x3f"]  # 0.5 as float32
    assert peer.replies == [none, [b"OK"], image, none, [b"OK"], image]
    assert (simulation.counters.images, simulation.counters.no_images) == (2, 2)


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        ([b"HELLO"], "is no request"),
        ([b"SIM_UPDATE", b"", b"", b"\xff" * 9], "no VizMessage"),
        (state(5), "simulated time went from 0.01 s to 0.005 s"),
        (state(10), "simulated time went"),
        (state(20, float("nan")), "must be finite"),
        (state(20, name="moth")[:3] + [update(20 * MS)], "no camera 1"),
    ],
)
def test_what_cannot_be_used_is_refused_and_the_run_goes_on(request_, why):
    peer = Peer(state(10), request_, state(30))
    scene, simulation, _ = run(peer)
    assert peer.replies[1][0].startswith(b"ERROR: ")
    assert why in peer.replies[1][0].decode()
    assert why in simulation.counters.last_refusal
    assert (peer.replies[2], scene.drawn[-1][0], simulation.counters.refused) == ([b"OK"], 20, 1)


def test_the_time_from_an_update_to_its_first_event_is_measured():
    clock, path = FakeClock(), SimulatedPath(Fixed())
    simulation = BasiliskRun(Peer(state(0)), [GivenPath(BasiliskPath(camera=1), path)], lambda light: b"", clock)
    some = np.zeros(1, EVENT)
    simulation.take(some)  # before any update
    simulation.begin(lambda: None, lambda: True)
    for after_ms, events in ((3, some[:0]), (4, some), (5, some)):
        clock.advance(after_ms * MS)
        simulation.take(events)
    summary = simulation.counters.first_event.summary()
    assert (summary.p50, summary.max) == (7000.0, 7000.0)


def test_a_simulation_that_leaves_before_its_first_update_may_come_again():
    peer = Peer(PING, "leave", PING, state(0), state(10))
    scene, _, _ = run(peer)
    assert peer.forgotten == 1
    assert scene.drawn[-1][0] == 10


def test_a_run_that_ends_first_refuses_the_update_that_waits():
    peer = Peer(state(0), state(20), state(40), leaves=False)
    _, _, result = run(peer, seconds=0.02)
    assert peer.replies == [[b"OK"], [b"ERROR: evstim has ended its run"]]
    assert result.sim_seconds == pytest.approx(0.02)


def test_a_run_that_is_stopped_between_two_updates_refuses_the_next():
    peer = Peer(state(0), INPUT, state(20), leaves=False)
    run(peer, stop_after=2)
    assert peer.replies == [[b"OK"], [b"VIZARD_INPUT", b""], [b"ERROR: evstim has ended its run"]]


@pytest.mark.parametrize("script", [[], [PING], [state(0), state(10)]])
def test_stop_ends_a_run_that_waits(script):
    peer = Peer(*script, leaves=False)
    _, _, result = run(peer, stop_after=20)
    assert peer.looks < 100
    assert result.ledger.balanced


RIG = """
[scene]
kind = "bodies"
camera = {kind = "basilisk", camera = 3}
[[scene.bodies]]
shape = "globe"
path = {kind = "basilisk", body = "moon", position_m = [0.0, 0.0, 9.0]}
[camera.lens]
field_of_view_deg = 21.0
"""


def test_the_paths_of_a_rig_are_connected_wherever_they_are():
    rig, paths = connected(parse_rig(RIG, "a.toml", "a"))
    assert [(given.table.camera, given.table.body) for given in paths] == [(3, ""), (None, "moon")]
    assert rig.scene.camera is paths[0]
    assert rig.scene.bodies[0].path is paths[1]
    assert paths[1].path.pose(0).position_m[2] == 9.0
    assert rig.run.pace == "free"


def test_paths_that_no_simulation_flies_are_remarked_on():
    rig = parse_rig(RIG, "a.toml", "a")
    assert [text.split()[0] for text in remarks(rig)] == ["scene.camera", "scene.bodies[0].path"]
    assert remarks(connected(rig)[0]) == []


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (RIG.replace('"bodies"', '"bodies"\ntime_scale = 2.0'), "time_scale: it must be 1"),
        ('[scene]\nkind = "checkerboard"', 'kind = "basilisk"'),
        (
            RIG + '[run]\npace = "lockstep"\nlockstep_us = 5\n[trigger]\nsource = "can"\n[[links]]\nkind = "can"\n',
            "no bus can",
        ),
    ],
)
def test_a_rig_that_no_simulation_can_drive(text, why):
    with pytest.raises(RigError, match=why):
        connected(parse_rig(text, "a.toml", "a"))


@pytest.mark.parametrize(
    ("size", "height_deg", "told"),
    [((346, 260), 15.857, ""), ((346, 260), 20.0, "focal length of 737.3"), ((512, 512), 30.69, "512 x 512")],
)
def test_a_camera_that_differs_is_told(size, height_deg, told):
    rig = parse_rig(RIG, "a.toml", "a")
    text = camera_differs(rig, CameraState("", (), (), height_deg, size))
    assert bool(text) == bool(told)
    assert told in text

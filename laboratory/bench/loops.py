"""Cost of what stands around a scene and a sensor: a loop in Python, live poses, an external renderer, a campaign.

`simulation_step`: a step of `evstim.Simulation` over the same scene and sensor alone, with one light frame a step, in
turns.

`pose_to_bytes`: the camera of a sky of stars stands still, and now and then turns by a third of a degree at once, by a
live pose for now. The sensor has no noise, so that the first datagram of the rig's UDP link after it carries events of
that motion. 346 x 260 pixels in real time, in steps of 2 ms: a pose acts on the next light frame, and frames are drawn
10 ms before their time.

`RendererImages`: a renderer in another process copies a finished image of 1280 x 720 float32 into each slot; evstim
copies it again, checks every number, and writes the light frame half way to the next.

`campaign_run`: processor time of all processes of a campaign less that of its runs (`machine.cpu_s` of each row); a
second campaign of as many runs as workers gives what is paid once.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import multiprocessing
import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import evstim
from emulator.campaign.report import numbers
from emulator.campaign.table import read_rows
from emulator.geometry.camera import Pinhole
from emulator.rig.loading import load_rig
from emulator.run.assembly import build_frames, build_scene, build_sensor, planned_sensor
from emulator.scene.external.external import External
from emulator.scene.external.joining import compile_kernels
from emulator.scene.external.table import ExternalParameters
from evstim.renderer import Renderer
from firmware_protocol.pose_message import NOW, PoseMessage
from firmware_protocol.renderer import Camera
from laboratory.bench.streams import BenchFailed
from transports.output_file import TemporaryFolder
from transports.renderer import RendererServer

_ROUNDS, _LOOP_STEPS, _FIRST_STEPS = 3, 300, 5


def simulation_step() -> float:
    """Times that a step of `evstim.Simulation` takes over scene and sensor alone, checkerboard, 1 ms steps."""
    rig, alone_s, whole_s = load_rig("checkerboard"), list[float](), list[float]()
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, pace="free", seconds=0.0))
    step_us = rig.run.step_us
    for _ in range(_ROUNDS):
        with build_scene(rig) as scene, evstim.Simulation(rig) as simulation:
            frames, sensor = build_frames(rig, scene), build_sensor(rig, planned_sensor(rig, scene))
            sensor.reset(frames.draw(0))
            for k in range(1, _FIRST_STEPS + _LOOP_STEPS):
                begun_s = time.perf_counter()
                sensor.expose(frames.draw(k * step_us * 1000))
                middle_s = time.perf_counter()
                simulation.step(step_us)
                if k > _FIRST_STEPS:
                    alone_s.append(middle_s - begun_s)
                    whole_s.append(time.perf_counter() - middle_s)
    return statistics.median(whole_s) / statistics.median(alone_s)


_LIVE_RIG = """
[scene]
kind = "stars"
faintest_v = 6.5
sun.direction = [0.0, -1.0, 0.2]
[scene.camera]
kind = "live"
port = {poses}
hold_ms = 1.0
q_world_from_body = [0.7071067811865476, -0.7071067811865476, 0.0, 0.0]  # to Orion
[camera]
model = "ideal"
sensor = {{width = 346, height = 260}}
lens = {{field_of_view_deg = 25.0, f_number = 1.4, blur_px = 0.6}}
[run]
step_us = 2000
lead_us = 10000
[[links]]
kind = "udp"
port = {events}
"""
_MOVES, _FIRST_MOVES = 40, 5
_PAUSE_S, _QUIET_S, _RETRY_S, _PATIENCE_S = 0.15, 0.05, 0.2, 120.0
_MOST_BYTES = 1 << 16


def pose_to_bytes() -> float:
    """Median ms from handing a live pose to the socket until the first datagram of its events is there."""
    with TemporaryFolder("bench") as folder, _datagrams() as link, _datagrams() as poses:
        with _datagrams() as probe:
            address = probe.getsockname()
        rig = Path(folder, "rig.toml")
        rig.write_text(_LIVE_RIG.format(poses=address[1], events=link.getsockname()[1]))
        command = [sys.executable, "-m", "evstim", "run", str(rig), "--quiet"]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            try:
                _wait_for_motion(process, lambda k: poses.sendto(_pose(k), address), link)
                return statistics.median(_delays_ms(lambda k: poses.sendto(_pose(k), address), link))
            finally:
                process.kill()


def _datagrams() -> closing[socket.socket]:
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    endpoint.bind(("127.0.0.1", 0))
    return closing(endpoint)


def _pose(k: int) -> bytes:
    """Return the pose of the k-th move: about the axis of the picture's columns, to and fro."""
    half = math.radians(0.3) / 2 * (k % 2)
    w, x = math.sqrt(0.5), -math.sqrt(0.5)
    c, s = math.cos(half), math.sin(half)
    turned = (c * w, c * x, s * w, s * x)  # that of the rig, times a turn about the camera's y
    return bytes(PoseMessage(NOW, (0.0, 0.0, 0.0), turned, counter=k))


def _wait_for_motion(process: subprocess.Popen[bytes], move: Callable[[int], object], link: socket.socket) -> None:
    """Move the camera until events come: the run has begun."""
    link.settimeout(_RETRY_S)
    for k in range(round(_PATIENCE_S / _RETRY_S)):
        if process.poll() is not None:
            raise BenchFailed("evstim run has ended")
        move((1 << 20) + k)
        with suppress(TimeoutError):
            link.recv(_MOST_BYTES)
            return
    raise BenchFailed("no event came")


def _delays_ms(move: Callable[[int], object], link: socket.socket) -> list[float]:
    """Move the camera, and return the time to the first datagram of each move, ms."""
    delays, rng = [], np.random.default_rng(1)
    for k in range(_FIRST_MOVES + _MOVES + 1):
        time.sleep(_PAUSE_S + rng.uniform(0, 0.02))
        link.settimeout(_QUIET_S)
        with suppress(TimeoutError):
            while True:
                link.recv(_MOST_BYTES)
        link.settimeout(_PATIENCE_S)
        begun_s = time.monotonic()
        move(k)
        if k:  # before that the camera may look this way already
            link.recv(_MOST_BYTES)
        delays.append(1e3 * (time.monotonic() - begun_s))
    return delays[_FIRST_MOVES + 1 :]


_SIZE, _PERIOD_NS, _IMAGES = (1280, 720), 10_000_000, 200


def _draw(port: int, *, shared: bool) -> None:
    """Draw until evstim ends."""
    ready = np.random.default_rng(1).random(_SIZE[::-1], np.float32)
    with Renderer(f"127.0.0.1:{port}", shared=shared) as renderer:
        for image in renderer:
            image.light[:] = ready
            image.send()


@dataclass(frozen=True)
class RendererImages:
    """Images a second of an external renderer, through shared memory or through its TCP connection."""

    shared: bool

    def __call__(self) -> float:
        """Return the median of five rates."""
        compile_kernels()
        return statistics.median(self._rate() for _ in range(5))

    def _rate(self) -> float:
        p = ExternalParameters(period_ms=_PERIOD_NS * 1e-6, white_w_m2_sr=1.0)
        server = RendererServer("127.0.0.1", 0)
        spawning = multiprocessing.get_context("spawn")
        drawing = spawning.Process(target=_draw, args=(server.address[1],), kwargs={"shared": self.shared})
        drawing.start()
        connection = server.accept(Camera(_SIZE, 1000.0, _PERIOD_NS, p.slots, 0), 60.0)
        if connection is None:
            raise BenchFailed("the renderer did not connect")
        scene, out = External(connection, p, Pinhole(*_SIZE, 1000.0)), np.zeros(_SIZE[::-1], np.float32)
        scene.around(0)
        begun_s = time.perf_counter()
        for k in range(1, _IMAGES + 1):
            scene.light(k * _PERIOD_NS - _PERIOD_NS // 2, out)
        spent_s = time.perf_counter() - begun_s
        scene.close()
        drawing.join()
        return _IMAGES / spent_s


_CAMPAIGN = """
rig = "checkerboard"
count = {runs}
[set]
links = []
run = {{seconds = 0.1, pace = "free"}}
camera.sensor = {{width = 32, height = 32}}
[[parameters]]
key = "scene.speed_px_s"
kind = "log-uniform"
low = 30
high = 600
"""
_RUNS, _WORKERS = 500, 2
HAS_CAMPAIGNS = importlib.util.find_spec("pyarrow") is not None
"""False: what campaigns need is not installed."""


def campaign_run() -> float:
    """Ms of processor time that `evstim campaign` adds to each of its runs."""
    whole_s, once_s = _beside_runs_s(_RUNS), _beside_runs_s(_WORKERS)
    return 1e3 * (whole_s - once_s) / (_RUNS - _WORKERS)


def _beside_runs_s(runs: int) -> float:
    """Return the processor time of a campaign less that of its runs, s."""
    with TemporaryFolder("bench") as folder:
        file = Path(folder, "overhead.toml")
        file.write_text(_CAMPAIGN.format(runs=runs))
        command = [sys.executable, "-m", "evstim", "--quiet", "campaign", str(file), "--workers", str(_WORKERS)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, code, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(code)
        if process.returncode:
            raise BenchFailed("the campaign did not end well")
        rows = read_rows(file.with_suffix("") / "rows")
    return used.ru_utime + used.ru_stime - float(np.sum(numbers(rows, "machine.cpu_s")))

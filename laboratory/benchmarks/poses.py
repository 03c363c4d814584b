"""Loops with poses from outside: from a pose to its events, and the steps and updates that a run keeps up with.

python -m laboratory.benchmarks.poses python [ROUNDS]
python -m laboratory.benchmarks.poses live [MOVES [LEAD_US]]
python -m laboratory.benchmarks.poses vizard [UPDATES]
python -m laboratory.benchmarks.poses basilisk PYTHON_WITH_BSK [RIG] [SECONDS] [STEP_US]
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import App

import evstim
from emulator.rig.loading import load_rig
from emulator.run.assembly import build_frames, build_scene, build_sensor, planned_sensor
from firmware_protocol.pose_message import NOW, PoseMessage
from firmware_protocol.vizard import message_class

app = App(name="poses")

LOOPS = {"eros": (40_000, 60), "malapert": (20_000, 40), "checkerboard": (1000, 600)}  # us of a step, and their number
FIRST_STEPS = 5  # steps that are not counted


def times_s(step: Callable[[int], object], count: int) -> list[tuple[float, float]]:
    """Return wall and processor time of each of `count` steps but the first; `step` gets their numbers, from 1 on."""
    times = []
    for k in range(1, count + 1):
        begun_s, begun_cpu_s = time.perf_counter(), time.process_time()
        step(k)
        times.append((time.perf_counter() - begun_s, time.process_time() - begun_cpu_s))
    return times[FIRST_STEPS:]


@app.command(name="python")
def loop(rounds: int = 3) -> None:
    """Measure a step of `evstim.Simulation` over scene and sensor alone, of shipped rigs without links, in turns.

    A step has one light frame, and the camera follows the rig's path. Printed are medians of a step and their ratio.
    """
    for name, (step_us, count) in LOOPS.items():
        rig, alone, stepped = load_rig(name), [], []
        run = dataclasses.replace(rig.run, step_us=step_us, pace="free", seconds=0.0)
        rig = dataclasses.replace(rig, run=run)
        for _ in range(rounds):
            with build_scene(rig) as scene, evstim.Simulation(rig) as simulation:
                frames, sensor = build_frames(rig, scene), build_sensor(rig, planned_sensor(rig, scene))
                sensor.reset(frames.draw(0))
                alone += times_s(lambda k: sensor.expose(frames.draw(k * step_us * 1000)), count)  # noqa: B023
                stepped += times_s(lambda _: simulation.step(step_us), count)  # noqa: B023
        for clock, step_s, alone_s in zip(("wall", "CPU"), *np.median((stepped, alone), axis=1), strict=True):
            print(f"{name}, {clock}: {1000 * step_s:.2f} over {1000 * alone_s:.2f} ms, {step_s / alone_s:.3f} times")


LIVE_RIG = """
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
sensor = {{width = {width}, height = {height}}}
lens = {{field_of_view_deg = 25.0, f_number = 1.4, blur_px = 0.6}}
[run]
step_us = {step_us}
lead_us = {lead_us}
[[links]]
kind = "udp"
port = {port}
"""
SIZES = ((346, 260, 2000), (1024, 512, 5000))  # width, height, us a step; the datagrams number no more pixels
TURN_RAD = math.radians(0.3)
PAUSE_S = 0.15  # from one motion to the next, beside a random part
QUIET_S = 0.05
PATIENCE_S = 120.0
FIRST_MOVES = 5  # moves that are not counted


def pose(k: int) -> bytes:
    """Return the pose of the k-th move: about the axis of the picture's columns, to and fro."""
    half = TURN_RAD / 2 * (k % 2)
    w, x = math.sqrt(0.5), -math.sqrt(0.5)
    c, s = math.cos(half), math.sin(half)
    turned = (c * w, c * x, s * w, s * x)  # that of the rig, times a turn about the camera's y
    return bytes(PoseMessage(NOW, (0.0, 0.0, 0.0), turned, counter=k))


def drain(link: socket.socket, quiet_s: float) -> None:
    """Return when nothing has come for a while."""
    link.settimeout(quiet_s)
    with suppress(TimeoutError):
        while True:
            link.recv(65536)
    link.settimeout(PATIENCE_S)


def delays_ms(moves: int, address: tuple[str, int], link: socket.socket) -> np.ndarray:
    """Move the camera, and return the time to the first datagram of each move, (moves,) ms."""
    delays, rng = [], np.random.default_rng(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as poses:
        for k in range(FIRST_MOVES + moves + 1):
            time.sleep(PAUSE_S + rng.uniform(0, 0.02))
            drain(link, QUIET_S)
            begun = time.monotonic()
            poses.sendto(pose(k), address)
            if k:  # before that the camera may look this way already
                link.recv(65536)
            delays.append(1000 * (time.monotonic() - begun))
    return np.array(delays[FIRST_MOVES + 1 :])


@contextmanager
def running(rig: str) -> Iterator[subprocess.Popen[str]]:
    """Run a rig until the block ends."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "rig.toml")
        path.write_text(rig)
        command = [sys.executable, "-m", "evstim", "run", str(path), "--json", "--quiet"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                yield process
            finally:
                process.kill()


def free_port() -> int:
    """Return a UDP port that was free just now."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for_motion(process: subprocess.Popen[str], address: tuple[str, int], link: socket.socket) -> None:
    """Move the camera until events come: the run has begun."""
    link.settimeout(0.2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as poses:
        for k in range(round(5 * PATIENCE_S)):
            if process.poll() is not None:
                raise SystemExit("evstim run has ended")
            poses.sendto(pose(2**20 + k), address)
            with suppress(TimeoutError):
                link.recv(65536)
                return
    raise SystemExit("no event came")


@app.command
def live(moves: int = 100, lead_us: int = 10_000) -> None:
    """Measure the time from a live pose to the first bytes of its events.

    The camera of a sky of stars has kind "live" and stands still; now and then it turns by a third of a degree at once,
    by a pose for now. The sensor has no noise, so the first datagram of the rig's UDP link after it carries events of
    that motion. At 346x260 with steps of 2 ms and at 1024x512 with steps of 5 ms, in real time: a pose acts on the next
    light frame, and frames are drawn LEAD_US before their time.

    For each size: median, 99th percentile and maximum from handing the pose to the socket until the datagram is there,
    ms, and the late steps of the run.
    """
    for width, height, step_us in SIZES:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.bind(("127.0.0.1", 0))
            poses = free_port()
            keys = {"width": width, "height": height, "step_us": step_us, "lead_us": lead_us}
            with running(LIVE_RIG.format(poses=poses, port=link.getsockname()[1], **keys)) as process:
                wait_for_motion(process, ("127.0.0.1", poses), link)
                found_ms = delays_ms(moves, ("127.0.0.1", poses), link)
                process.send_signal(signal.SIGINT)
                report = json.loads((process.stdout.read() if process.stdout else "").splitlines()[-1])
        p50, p99 = np.quantile(found_ms, [0.5, 0.99])
        print(
            f"{width}x{height}, steps of {step_us / 1000:g} ms, lead {lead_us / 1000:g} ms: motion to bytes "
            f"p50 {p50:.1f} ms, p99 {p99:.1f} ms, max {found_ms.max():.1f} ms; lateness {report['lateness']}"
        )


BASILISK_RIG = """
[scene]
kind = "stars"
camera = {{kind = "basilisk", camera = 1}}
sun.direction = [0.0, 0.0, -1.0]
[camera.lens]
field_of_view_deg = 40.0
f_number = 1.4
[run]
step_us = {step_us}
[[links]]
kind = "udp"
port = {port}
"""
UPDATE_QUIET_S = 0.02
FIRST_UPDATES = 20  # updates that are not counted


def update(t_ns: int, turn: float) -> list[bytes]:
    """Return a SIM_UPDATE of a spacecraft that turns about z, with a camera that looks along x."""
    message = message_class("VizMessage")()
    message.currentTime.simTimeElapsed = t_ns
    message.spacecraft.add(spacecraftName="craft", position=[0.0] * 3, rotation=[0.0, 0.0, turn])
    camera = message.cameras.add(cameraID=1, parentName="craft", fieldOfView=30.0, resolution=[346, 260])
    camera.cameraPos_B.extend([0.0] * 3)
    camera.cameraDir_B.extend([0.0] * 3)
    return [b"SIM_UPDATE", b"", b"", message.SerializeToString()]


def update_times_s(peer: Any, link: socket.socket, updates: int) -> np.ndarray:
    """Return (updates, 3): seconds from an update to the first datagram, to the reply and to the image."""
    rows = []
    for k in range(updates + FIRST_UPDATES):
        message = update(40_000_000 * k, 1e-4 * k)
        begun = time.monotonic()
        peer.send_multipart(message)
        if k:
            link.recv(65536)
        event = time.monotonic() if k else begun
        assert peer.recv_multipart() == [b"OK"]
        answered = time.monotonic()
        peer.send(b"REQUEST_IMAGE_1")
        peer.recv_multipart()
        rows.append((event - begun, answered - begun, time.monotonic() - begun))
        drain(link, UPDATE_QUIET_S)
    return np.array(rows[FIRST_UPDATES:])


@app.command
def vizard(updates: int = 200) -> None:
    """Measure the time from a pose to the first event on the link, of `evstim vizard`.

    A peer sends SIM_UPDATEs 40 ms of simulated time apart and reads the datagrams of the rig's UDP link, with one and
    with four pictures for each update. For each update it takes the time from handing it to the socket until the first
    datagram after it, until the reply, and until the image.
    """
    import zmq

    for step_us in (40_000, 10_000):
        with (
            tempfile.TemporaryDirectory() as folder,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
            zmq.Context() as context,
            context.socket(zmq.REQ) as peer,
        ):
            link.bind(("127.0.0.1", 0))
            rig = Path(folder, "rig.toml")
            rig.write_text(BASILISK_RIG.format(step_us=step_us, port=link.getsockname()[1]))
            command = [sys.executable, "-c", START, "--quiet", "vizard", rig, "--at", "127.0.0.1:5599", "--json"]
            with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
                peer.connect("tcp://127.0.0.1:5599")
                times_ms = 1000 * update_times_s(peer, link, updates)
                peer.close(0)
                process.wait(60)
        for name, column in zip(("first event", "reply", "image"), times_ms.T, strict=True):
            p50, p99 = np.quantile(column, [0.5, 0.99])
            print(f"step {step_us / 1000:g} ms: update to {name}: p50 {p50:.1f} ms, p99 {p99:.1f} ms")


EXAMPLE = Path(__file__).parents[2] / "examples" / "basilisk"
START = "from emulator.cli import main; main()"


def cpu_so_far_s(pid: int) -> float:
    """Return the CPU time of a process and its dead children so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def spent_s(process: subprocess.Popen[str], before_s: float) -> float:
    """Wait for the end of a process; return the CPU time that it has taken since it had `before_s`."""
    used = os.wait4(process.pid, 0)[2]
    process.returncode = 0
    return used.ru_utime + used.ru_stime - before_s


def flight_of(python: str, rig: Path, seconds: float) -> dict[str, object]:
    """Return what one flight took."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    run = [sys.executable, "-c", START, "vizard", str(rig), "--at", "127.0.0.1:0", "--json"]
    with tempfile.TemporaryDirectory() as folder, subprocess.Popen(run, **pipes) as camera:  # type: ignore[call-overload]
        port = camera.stderr.readline().strip().rpartition(":")[2]
        program = [python, str(EXAMPLE / "simulation.py"), "--port", port, "--seconds", str(seconds)]
        with subprocess.Popen(program, cwd=folder, stdout=subprocess.DEVNULL) as dynamics:
            while "Basilisk is here" not in camera.stderr.readline():
                pass
            begun_s, before_s = time.monotonic(), (cpu_so_far_s(camera.pid), cpu_so_far_s(dynamics.pid))
            counts = json.loads(camera.stdout.read().splitlines()[-1])["basilisk"]
            wall_s = time.monotonic() - begun_s
            used_s = spent_s(camera, before_s[0]), spent_s(dynamics, before_s[1])
        known = json.loads(Path(folder, "simulation.json").read_text())
    each_ms = [1000 * cpu_s / counts["updates"] for cpu_s in used_s]
    return {
        "updates": counts["updates"],
        "updates/s, wall": counts["updates"] / wall_s,
        "CPU ms an update, evstim / Basilisk": each_ms,
        "updates/s of their CPU time": 1000 / sum(each_ms),
        "clocks apart, ns": counts["last_ns"] - known["nanoseconds"],
        "load": os.getloadavg()[0],
        "told": counts,
    }


@app.command
def basilisk(
    python_with_bsk: str, rig: Path = EXAMPLE / "eros.toml", seconds: float = 40.0, step_us: int | None = None
) -> None:
    """Measure updates a second that `evstim vizard` keeps up with, with Basilisk and the shipped example.

    An update is one SIM_UPDATE and the image requested after it, 346 x 260. CPU time is counted from the first update
    on: on a machine that does nothing else the two programs take turns, so 1 / (evstim + Basilisk) is the rate to
    expect there.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "rig.toml")
        text = rig.read_text()
        copy.write_text(re.sub(r"(?m)^step_us = \d+", f"step_us = {step_us}", text) if step_us else text)
        for name, value in flight_of(python_with_bsk, copy, seconds).items():
            print(f"{name}: {value}")


if __name__ == "__main__":
    app()

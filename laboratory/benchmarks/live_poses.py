"""Time from a pose to the first bytes of its events:  python -m laboratory.benchmarks.live_poses [MOVES [LEAD_US]]

The camera of a sky of stars has kind "live" and stands still; now and then it turns by a third of a degree at once, by
a pose for now. The sensor has no noise, so the first datagram of the rig's UDP link after it carries events of that
motion. At 346x260 with steps of 2 ms and at 1024x512 with steps of 5 ms, in real time: a pose acts on the next light
frame, and frames are drawn LEAD_US (10 000) before their time.

For each size: median, 99th percentile and maximum from handing the pose to the socket until the datagram is there, ms,
and the late steps of the run.
"""

from __future__ import annotations

import json
import math
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from firmware_protocol.pose_message import NOW, PoseMessage

RIG = """
[scene]
kind = "stars"
faintest_v = 6.5
[scene.camera]
kind = "live"
port = {poses}
hold_ms = 1.0
q_world_from_body = [0.7071067811865476, -0.7071067811865476, 0.0, 0.0]  # to Orion
[scene.sun]
direction = [0.0, -1.0, 0.2]
[camera]
model = "ideal"
[camera.sensor]
width = {width}
height = {height}
[camera.lens]
field_of_view_deg = 25.0
f_number = 1.4
blur_px = 0.6
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
FIRST = 5  # moves that are not counted


def pose(k: int) -> bytes:
    """Return the pose of the k-th move: about the axis of the picture's columns, to and fro."""
    half = TURN_RAD / 2 * (k % 2)
    w, x = math.sqrt(0.5), -math.sqrt(0.5)
    c, s = math.cos(half), math.sin(half)
    turned = (c * w, c * x, s * w, s * x)  # that of the rig, times a turn about the camera's y
    return bytes(PoseMessage(NOW, (0.0, 0.0, 0.0), turned, counter=k))


def drain(link: socket.socket) -> None:
    """Return when nothing has come for a while."""
    link.settimeout(QUIET_S)
    try:
        while True:
            link.recv(65536)
    except TimeoutError:
        link.settimeout(PATIENCE_S)


def delays_ms(moves: int, address: tuple[str, int], link: socket.socket) -> np.ndarray:
    """Move the camera, and return the time to the first datagram of each move, (moves,) ms."""
    delays, rng = [], np.random.default_rng(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as poses:
        for k in range(1, FIRST + moves + 1):
            time.sleep(PAUSE_S + rng.uniform(0, 0.02))
            drain(link)
            begun = time.monotonic()
            poses.sendto(pose(k), address)
            link.recv(65536)
            delays.append(1000 * (time.monotonic() - begun))
    return np.array(delays[FIRST:])


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
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
    return port


def wait_for_motion(process: subprocess.Popen[str], address: tuple[str, int], link: socket.socket) -> None:
    """Move the camera until events come: the run has begun."""
    link.settimeout(0.2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as poses:
        for k in range(round(5 * PATIENCE_S)):
            if process.poll() is not None:
                raise SystemExit("evstim run has ended")
            poses.sendto(pose(2**20 + k), address)
            try:
                link.recv(65536)
            except TimeoutError:
                continue
            return
    raise SystemExit("no event came")


def main(moves: int = 100, lead_us: int = 10_000) -> None:
    """Measure at both sizes, and print."""
    for width, height, step_us in SIZES:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.bind(("127.0.0.1", 0))
            poses = free_port()
            keys = {"width": width, "height": height, "step_us": step_us, "lead_us": lead_us}
            with running(RIG.format(poses=poses, port=link.getsockname()[1], **keys)) as process:
                wait_for_motion(process, ("127.0.0.1", poses), link)
                found = delays_ms(moves, ("127.0.0.1", poses), link)
                process.send_signal(signal.SIGINT)
                report = json.loads((process.stdout.read() if process.stdout else "").splitlines()[-1])
        p50, p99 = np.quantile(found, [0.5, 0.99])
        sys.stdout.write(
            f"{width}x{height}, steps of {step_us / 1000:g} ms, lead {lead_us / 1000:g} ms: motion to bytes "
            f"p50 {p50:.1f} ms, p99 {p99:.1f} ms, max {found.max():.1f} ms; lateness {report['lateness']}\n"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

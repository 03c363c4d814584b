"""Time from a pose to the first event on the link, of `evstim vizard`.

    python -m laboratory.benchmarks.vizard_latency [UPDATES]

A peer sends SIM_UPDATEs 40 ms of simulated time apart and reads the datagrams of the rig's UDP link. For each update it
takes the time from handing it to the socket until the first datagram after it, until the reply, and until the image.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import zmq

from firmware_protocol.vizard import message_class

RIG = """
[scene]
kind = "stars"
camera = {{kind = "basilisk", camera = 1}}
[scene.sun]
direction = [0.0, 0.0, -1.0]
[camera.lens]
field_of_view_deg = 40.0
f_number = 1.4
[run]
step_us = {step_us}
[[links]]
kind = "udp"
port = {port}
"""
QUIET_S = 0.02
FIRST = 20  # updates that are not counted


def update(t_ns: int, turn: float) -> list[bytes]:
    """Return a SIM_UPDATE of a spacecraft that turns about z, with a camera that looks along x."""
    message = message_class("VizMessage")()
    message.currentTime.simTimeElapsed = t_ns
    message.spacecraft.add(spacecraftName="craft", position=[0.0] * 3, rotation=[0.0, 0.0, turn])
    camera = message.cameras.add(cameraID=1, parentName="craft", fieldOfView=30.0, resolution=[346, 260])
    camera.cameraPos_B.extend([0.0] * 3)
    camera.cameraDir_B.extend([0.0] * 3)
    return [b"SIM_UPDATE", b"", b"", message.SerializeToString()]


def first_datagram_s(link: socket.socket) -> float:
    """Return when the next datagram comes."""
    link.recv(65536)
    return time.monotonic()


def drain(link: socket.socket) -> None:
    """Return when nothing has come for a while."""
    link.settimeout(QUIET_S)
    try:
        while True:
            link.recv(65536)
    except TimeoutError:
        link.settimeout(60.0)


def measure(peer: zmq.Socket[bytes], link: socket.socket, updates: int) -> np.ndarray:
    """Return (updates, 3): seconds from an update to the first datagram, to the reply and to the image."""
    rows = []
    for k in range(updates + FIRST):
        message = update(40_000_000 * k, 1e-4 * k)
        begun = time.monotonic()
        peer.send_multipart(message)
        event = first_datagram_s(link) if k else begun
        assert peer.recv_multipart() == [b"OK"]
        answered = time.monotonic()
        peer.send(b"REQUEST_IMAGE_1")
        peer.recv_multipart()
        rows.append((event - begun, answered - begun, time.monotonic() - begun))
        drain(link)
    return np.array(rows[FIRST:])


def main(updates: int = 200) -> None:
    """Measure with one and with four pictures for each update."""
    for step_us in (40_000, 10_000):
        with (
            tempfile.TemporaryDirectory() as folder,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
            zmq.Context() as context,
            context.socket(zmq.REQ) as peer,
        ):
            link.bind(("127.0.0.1", 0))
            rig = Path(folder, "rig.toml")
            rig.write_text(RIG.format(step_us=step_us, port=link.getsockname()[1]))
            start = "from emulator.cli import main; main()"
            command = [sys.executable, "-c", start, "--quiet", "vizard", rig, "--at", "127.0.0.1:5599", "--json"]
            with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
                peer.connect("tcp://127.0.0.1:5599")
                times_ms = 1000 * measure(peer, link, updates)
                peer.close(0)
                process.wait(60)
        for name, column in zip(("first event", "reply", "image"), times_ms.T, strict=True):
            p50, p99 = np.quantile(column, [0.5, 0.99])
            print(f"step {step_us / 1000:g} ms: update to {name}: p50 {p50:.1f} ms, p99 {p99:.1f} ms")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

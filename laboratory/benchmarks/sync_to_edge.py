"""From a SYNC on a CAN bus to the edge in the camera's stream: how far is the edge's time from when the SYNC was sent?

    python -m laboratory.benchmarks.sync_to_edge [SECONDS] [FIFO_PRIORITY]

A process of its own sends SYNCs at random moments on a bus that evstim makes (`interface = "served"`, over TCP), notes
CLOCK_MONOTONIC before each, and compares with the edges in the record of another link of the same run, a camera read by
the loopback host. The difference holds the wire (50 us at 1 Mbit/s), the TCP connection, and the time until the link's
process reads it; its least value is what a loopback would calibrate away. Run it as root under `chrt -f 60` to keep the
sender itself punctual on a busy machine; evstim is started under the normal policy all the same.
"""

from __future__ import annotations

import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import can
import numpy as np
import numpy.typing as npt

from firmware_protocol.events import EdgeKind

Times = npt.NDArray[np.int64]

RIG = """
[scene]
kind = "checkerboard"
square_px = 40.0
speed_px_s = 0.5
[camera.clock]
[camera.sensor]
width = 64
height = 48
leak_hz = 0.0
[trigger]
source = "can"
kind = "rising"
[run]
seconds = {seconds}
step_us = 5000
lead_us = 50000
fifo_priority = {priority}
[[links]]
kind = "can"
interface = "served"
port = {port}
channel = "can0"
[[links]]
kind = "loopback"
"""
SYNC = can.Message(arbitration_id=0x80, is_extended_id=False, data=b"")


def normal_policy() -> None:
    """Let evstim run as users run it, however urgent this program is."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def free_port() -> int:
    """Return a TCP port that is not in use."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
    return port


def joined(port: int, deadline_s: float = 60.0) -> can.BusABC:
    """Return the bus as soon as evstim serves it."""
    deadline = time.monotonic() + deadline_s
    while time.monotonic() < deadline:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
        except ConnectionRefusedError:
            time.sleep(0.05)
        else:
            return can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="can0")
    raise TimeoutError(f"no bus on port {port}")


def send_syncs(bus: can.BusABC, running: subprocess.Popen[str]) -> Times:
    """Send SYNCs while the run lasts; return when each was given to the socket, ns."""
    sent, moments = [], random.Random(1)
    while running.poll() is None:
        sent.append(time.monotonic_ns())
        try:
            bus.send(SYNC)
        except (can.CanError, OSError):  # the run has ended, and the bus with it
            return np.array(sent[:-1], np.int64)
        time.sleep(0.005 + 0.01 * moments.random())
    return np.array(sent, np.int64)


def errors_us(sent_ns: Times, edges_ns: Times) -> npt.NDArray[np.float64]:
    """Return each edge's time less its SYNC's, us: the SYNCs before the run made no edge, those after it neither."""
    shifts = range(len(sent_ns) - len(edges_ns) + 1)
    possible = [k for k in shifts if (edges_ns >= sent_ns[k : k + len(edges_ns)]).all()]
    return (edges_ns - sent_ns[possible[-1] : possible[-1] + len(edges_ns)]) / 1000


def measure(folder: Path, seconds: float, priority: int) -> dict[str, Any]:
    """Do one run; return percentiles of the error, us."""
    port, rig = free_port(), folder / "rig.toml"
    rig.write_text(RIG.format(seconds=seconds, priority=priority, port=port))
    evstim = [str(Path(sys.executable).with_name("evstim")), "run", str(rig), "--json"]
    files = ["--record", str(folder / "r.npz"), "--truth", str(folder / "t.csv")]
    with subprocess.Popen([*evstim, *files], stdout=subprocess.PIPE, text=True, preexec_fn=normal_policy) as running:
        sent_ns = send_syncs(joined(port), running)
        said, _ = running.communicate()
    monotonic_ns, stream_us = np.loadtxt(folder / "t-loopback.csv", delimiter=",", skiprows=1)[-1, :2]
    edges = np.load(folder / "r-loopback.npz")["edges"]
    rising = edges[edges["kind"] == EdgeKind.RISING]["t"].astype(np.int64)
    error = errors_us(sent_ns, rising * 1000 + int(monotonic_ns - stream_us * 1000))
    link = json.loads(said.splitlines()[-1])["links"]["loopback"]["edges"]
    quantiles = dict(
        zip(("least", "p50", "p90", "p99", "worst"), np.percentile(error, [0, 50, 90, 99, 100]), strict=True)
    )
    return {"edges": len(rising), "late": link["late"], **{name: round(value) for name, value in quantiles.items()}}


def main() -> None:
    """Measure and print one JSON object."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    priority = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    with tempfile.TemporaryDirectory() as folder:
        sys.stdout.write(json.dumps(measure(Path(folder), seconds, priority)) + "\n")


if __name__ == "__main__":
    main()

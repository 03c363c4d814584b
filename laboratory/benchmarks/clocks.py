"""Errors of the camera's clocks and edges: by a timestamp latch, beside ptp4l, and from a SYNC on a CAN bus.

python -m laboratory.benchmarks.clocks latch [SECONDS]
python -m laboratory.benchmarks.clocks ptp [SECONDS [LOG_SYNC_INTERVAL]]      as root, with linuxptp
python -m laboratory.benchmarks.clocks sync [SECONDS] [FIFO_PRIORITY]
"""

from __future__ import annotations

import json
import os
import random
import select
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from cyclopts import App

from firmware_protocol.events import EdgeKind
from firmware_protocol.gige.registers import Register
from firmware_protocol.ptp.slave import PortState
from firmware_protocol.receiver.clock_estimator import ClockEstimator
from transports.gige.host import CameraGone, GigeHost
from transports.gige.ptp_port import PtpPort, ptp_slave
from transports.link.pacing import wall_less_monotonic_ns

app = App(name="clocks")

ADDRESS = "127.0.0.17"
LATCH = 1 << 1
LATCH_RIG = f"""
scene = {{kind = "checkerboard", square_px = 40.0, speed_px_s = 0.5}}
run.step_us = 5000
[camera]
model = "triton2"
clock.drift_ppm = 20.0
sensor = {{width = 64, height = 48, leak_hz = 0.0}}
[[links]]
kind = "gige"
host = "{ADDRESS}"
"""

Numbers = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]


def latched(host: GigeHost) -> tuple[int, int, int]:
    """Return the camera's clock, and CLOCK_MONOTONIC before and after the request, ns."""
    before_ns = time.monotonic_ns()
    host.write(Register.TIME_CONTROL, LATCH)
    after_ns = time.monotonic_ns()
    clock_ns = host.read_register(Register.TIME_HIGH) << 32 | host.read_register(Register.TIME_LOW)
    return clock_ns, before_ns, after_ns


@app.command
def latch(seconds: float = 30.0) -> None:
    """Measure the camera's clock by GigE Vision's timestamp latch: how far is an estimate from its true reading?

    A camera whose clock drifts by 20 ppm is read on the loopback interface. Ten times a second a host notes the
    monotonic clock, latches the camera's time, reads it, and takes the middle of the request for the host's time of the
    latch. The truth is the line that `evstim run --truth` writes of the camera's clock. Two estimates are judged: each
    latch alone, and `ClockEstimator` over all of them. Without a PTP master the latched time is the stream's as of the
    last millisecond.
    """
    with tempfile.TemporaryDirectory() as folder:
        rig, truth, ready = (Path(folder) / name for name in ("latch.toml", "truth.csv", "ready"))
        rig.write_text(LATCH_RIG)
        command = [sys.executable, "-c", "from emulator.cli import main; main()", "run", str(rig), "--quiet"]
        command += ["--seconds", str(seconds + 10), "--truth", str(truth), "--ready-file", str(ready)]
        run = subprocess.Popen(command)
        while not ready.exists() and run.poll() is None:
            time.sleep(0.1)
        taken = _taken(seconds)
        run.wait()
        _judge(np.array(taken, np.int64), np.loadtxt(truth, delimiter=",", skiprows=1))


def _taken(seconds: float) -> list[tuple[int, int, int]]:
    host = GigeHost(ADDRESS, now_ns=time.monotonic_ns)
    end_s, taken = time.monotonic() + seconds, []
    with suppress(CameraGone):  # its run has ended
        while time.monotonic() < end_s:
            taken.append(latched(host))
            time.sleep(0.1)
        host.close()
    return taken


def _judge(taken: npt.NDArray[np.int64], truth: Numbers) -> None:
    """Print the errors: of a latch by itself, and of the estimator at the end."""
    origin_ns = int(truth[0, 0])
    clock_ns, middle_ns = taken[:, 0], (taken[:, 1] + taken[:, 2]) // 2
    slope, offset_us = np.polyfit(truth[:, 0] - origin_ns, truth[:, 2], 1)
    true_ns = 1000 * (slope * (middle_ns - origin_ns) + offset_us)
    inside = clock_ns > 0
    _show("a latch", (clock_ns - true_ns)[inside] * 1e-3)
    _show("half of its request", (taken[:, 2] - taken[:, 1])[inside] / 2000)
    estimator = ClockEstimator()
    for clock, after in zip(clock_ns[inside].tolist(), taken[:, 2][inside].tolist(), strict=True):
        estimator.add(clock, after)
    line = estimator.estimate
    if line is None:
        return
    last_ns = int(clock_ns[-1])
    true_host_ns = origin_ns + (last_ns / 1000 - offset_us) / slope
    print(
        f"ClockEstimator after {len(clock_ns)} latches: {(line.host_ns(last_ns) - true_host_ns) * 1e-3:.1f} us late, "
        f"drift {line.drift_ppm:.2f} ppm"
    )


def _show(name: str, values: Numbers) -> None:
    shares = ", ".join(f"{value:.2f}" for value in np.percentile(values, [0, 5, 50, 95, 100]))
    rms = np.sqrt(np.mean(values**2))
    print(f"{name}: least, 5 %, median, 95 %, most of {len(values)}: {shares} us; rms {rms:.2f} us")


SLAVE, MASTER = "10.78.1.1", "10.78.1.2"
SETTINGS = """[global]
free_running 1
masterOnly 1
logAnnounceInterval 0
logSyncInterval {log}
logMinDelayReqInterval {log}
uds_address {uds}
"""
TURN_MS = 50  # as the process that answers hosts
WAIT_S = 60.0


@app.command
def ptp(seconds: float = 60.0, log_sync_interval: int = 0) -> None:
    """Measure a slave of the Precision Time Protocol beside ptp4l; as root, with linuxptp.

    Printed are its true error, its reported offset and its delay. Two network namespaces are joined by a veth pair: in
    one ptp4l serves CLOCK_REALTIME with time stamps of the kernel, in the other the camera's slave follows it. Both
    share the machine's clocks, so that the slave's true error can be read: its time less CLOCK_REALTIME at the same
    instant, between two readings of CLOCK_MONOTONIC. Reading begins when it is locked.
    """
    from tests.guest.own_network import OwnNetwork

    program = shutil.which("ptp4l", path="/usr/sbin:/sbin:/usr/bin:/usr/local/sbin")
    if program is None:
        sys.exit("there is no ptp4l: apt install linuxptp")
    with OwnNetwork() as ours, OwnNetwork() as theirs, tempfile.TemporaryDirectory() as folder:
        ours.join(theirs, SLAVE, MASTER)
        settings = Path(folder) / "ptp4l.cfg"
        settings.write_text(SETTINGS.format(log=log_sync_interval, uds=Path(folder) / "uds"))
        master = subprocess.Popen(theirs.inside(program, "-4", "-S", "-i", "cable", "-f", str(settings)))
        subprocess.run(ours.inside(sys.executable, __file__, "follow", str(seconds)), check=True)
        master.kill()
        master.wait()


@app.command(show=False)
def follow(seconds: float) -> None:
    """Follow the master in this network and print the errors: the second process of `ptp`."""
    slave = ptp_slave(0x1C0FAFFFFE000001, 0)
    port = PtpPort(slave, SLAVE, (MASTER,))
    slave.enable()
    news = select.poll()
    for descriptor in port.descriptors:
        news.register(descriptor, select.POLLIN)
    begin_s, locked_s, rows = time.monotonic(), 0.0, []
    while not locked_s or time.monotonic() < locked_s + seconds:
        news.poll(TURN_MS)
        port.turn()
        if slave.state == PortState.SLAVE and slave.timebase is not None:
            locked_s = locked_s or time.monotonic()
            now_ns, status = time.monotonic_ns(), slave.status
            rows.append(
                (slave.timebase.at(now_ns) - now_ns - wall_less_monotonic_ns(), status.offset_ns, status.delay_ns)
            )
        elif time.monotonic() > begin_s + WAIT_S:
            sys.exit(f"no slave after {WAIT_S:.0f} s: {slave.state.name}, {dict(slave.counts)}")
    print(f"SLAVE after {locked_s - begin_s:.1f} s; {len(rows)} readings in {seconds:.0f} s, in us:")
    for name, values in zip(("true error", "offset", "delay"), np.array(rows).T * 1e-3, strict=True):
        _show(name, values)


SYNC_RIG = """
scene = {{kind = "checkerboard", square_px = 40.0, speed_px_s = 0.5}}
trigger = {{source = "can", kind = "rising"}}
[camera]
clock = {{}}
sensor = {{width = 64, height = 48, leak_hz = 0.0}}
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


def free_port() -> int:
    """Return a TCP port that is not in use."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def joined(port: int, deadline_s: float = 60.0) -> Any:
    """Return the bus as soon as evstim serves it."""
    import can

    deadline = time.monotonic() + deadline_s
    while time.monotonic() < deadline:
        with suppress(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port)).close()
            return can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="can0")
        time.sleep(0.05)
    raise TimeoutError(f"no bus on port {port}")


def send_syncs(bus: Any, running: subprocess.Popen[str]) -> Times:
    """Send SYNCs while the run lasts; return when each was given to the socket, ns."""
    import can

    sync = can.Message(arbitration_id=0x80, is_extended_id=False, data=b"")
    sent, moments = [], random.Random(1)
    while running.poll() is None:
        sent.append(time.monotonic_ns())
        try:
            bus.send(sync)
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
    rig.write_text(SYNC_RIG.format(seconds=seconds, priority=priority, port=port))
    evstim = [str(Path(sys.executable).with_name("evstim")), "run", str(rig), "--json"]
    files = ["--record", str(folder / "r.npz"), "--truth", str(folder / "t.csv")]
    normal = partial(os.sched_setscheduler, 0, os.SCHED_OTHER, os.sched_param(0))  # however urgent this program is
    with subprocess.Popen([*evstim, *files], stdout=subprocess.PIPE, text=True, preexec_fn=normal) as running:
        sent_ns = send_syncs(joined(port), running)
        said, _ = running.communicate()
    monotonic_ns, stream_us = np.loadtxt(folder / "t-loopback.csv", delimiter=",", skiprows=1)[-1, :2]
    edges = np.load(folder / "r-loopback.npz")["edges"]
    rising = edges[edges["kind"] == EdgeKind.RISING]["t"].astype(np.int64)
    error = errors_us(sent_ns, rising * 1000 + int(monotonic_ns - stream_us * 1000))
    link = json.loads(said.splitlines()[-1])["links"]["loopback"]["edges"]
    names = ("least", "p50", "p90", "p99", "worst")
    quantiles = zip(names, np.percentile(error, [0, 50, 90, 99, 100]), strict=True)
    return {"edges": len(rising), "late": link["late"], **{name: round(value) for name, value in quantiles}}


@app.command
def sync(seconds: float = 10.0, fifo_priority: int = 0) -> None:
    """Measure from a SYNC on a CAN bus to the edge in the camera's stream: how far is its time from the sending?

    A process of its own sends SYNCs at random moments on a bus that evstim makes (`interface = "served"`, over TCP),
    notes CLOCK_MONOTONIC before each, and compares with the edges in the record of another link of the same run, a
    camera read by the loopback host. The difference holds the wire (50 us at 1 Mbit/s), the TCP connection, and the
    time until the link's process reads it; its least value is what a loopback would calibrate away. Run it as root
    under `chrt -f 60` to keep the sender itself punctual on a busy machine; evstim is started under the normal policy
    all the same. Prints one JSON object.
    """
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(Path(folder), seconds, fifo_priority)))


if __name__ == "__main__":
    app()

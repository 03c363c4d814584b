"""One run of a rig as a program of its own, `evstim run`, in free pace, with a receiver that reads everything.

    factor          stream seconds for a wall second, from the first step to the last, as the run itself reports it
    cores           processor seconds for a wall second of the session, of its links, and of the receiver
    memory          sum of the greatest memory of each process but the receiver; shared pages count more than once
    first event     from the start of the program to the first event that the receiver has decoded

Wall time and processor time are those between the first step and the last. A run ends after a span of stream time, or
after a span of wall time, at a signal; a slow machine measures a shorter stretch of the same stream.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emulator.evaluation.bench.streams import BenchFailed
from emulator.evaluation.realtime.process_use import Meter
from emulator.evaluation.realtime.receiver import Received, Receiver
from emulator.evaluation.realtime.variants import Variant

__all__ = ["Span", "Speed", "measure_speed"]


@dataclass(frozen=True)
class Span:
    """Length of a measured run: it ends after `stream_s` of stream or `wall_s` of wall time; `start_s`: to begin."""

    stream_s: float = 20.0
    wall_s: float = 10.0
    start_s: float = 180.0


@dataclass(frozen=True)
class Speed:
    """Result of a run; the module docstring defines each value, the cores are None where the run was too short.

    Attributes
    ----------
    stream_s : of the run.
    events : that the receiver has decoded.
    received_share : of the events read out by the sensor; the others came before the receiver had started the camera,
        or were in transit at the end.
    """

    factor: float
    stream_s: float
    session_cores: float | None
    link_cores: float | None
    receiver_cores: float | None
    memory_mib: float
    first_event_s: float | None
    events: int
    received_share: float


def measure_speed(variant: Variant, span: Span) -> Speed:
    """Run a variant and measure it; raises BenchFailed."""
    with tempfile.TemporaryDirectory(prefix="evstim-bench-") as name:
        folder, port = Path(name), _free_port()
        rig = _written(variant, folder / "rig", port)
        with Receiver(port, span.start_s) as receiver, _program(rig, folder, span.stream_s) as process:
            started_s = time.monotonic()
            meter = Meter(process.pid, receiver.pid)
            _wait(process, meter, folder / "ready.json", span)
            result = _result(process, folder)
            return _speed(result, meter, receiver.received(), started_s)


def _written(variant: Variant, folder: Path, port: int) -> Path:
    """Write the rig into a new folder, beside the files that lie beside the original; return its path."""
    folder.mkdir()
    for beside in variant.file.parent.iterdir():
        (folder / beside.name).symlink_to(beside.resolve())
    path = folder / variant.file.name
    path.unlink()
    path.write_text(variant.text(port))
    return path


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


_START = "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1)); from emulator.cli import main; main()"
_POLL_S = 0.05
_PATIENCE_S = 20.0  # with a program that is no longer wanted
_END_S = 60.0  # from the signal to the summary: a full ring is still to be delivered


@contextmanager
def _program(rig: Path, folder: Path, stream_s: float) -> Iterator[subprocess.Popen[bytes]]:
    """Start `evstim run` in a process group of its own: a Ctrl-C at the terminal is for the bench."""
    options = ["--pace", "free", "--seconds", str(stream_s), "--ready-file", str(folder / "ready.json"), "--json"]
    command = [sys.executable, "-P", "-c", _START, json.dumps(sys.path), "run", str(rig), *options]
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True)
    try:
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program that still runs, at a signal first: its links then release their shared memory."""
    process.terminate()
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _wait(process: subprocess.Popen[bytes], meter: Meter, ready: Path, span: Span) -> None:
    """Wait for the end of a run, sampling it from its first step on; raises BenchFailed."""
    deadline_s, is_ready = time.monotonic() + span.start_s, False
    while process.poll() is None:
        if not is_ready and ready.exists():
            is_ready, deadline_s = True, time.monotonic() + span.wall_s
        if is_ready:
            meter.sample()
        if time.monotonic() > deadline_s:
            _stop(process, is_ready)
            return
        time.sleep(_POLL_S)


def _stop(process: subprocess.Popen[bytes], is_ready: bool) -> None:
    """End a run at a signal, as Ctrl-C does."""
    if not is_ready:
        raise BenchFailed("the run did not begin in time")
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        raise BenchFailed("the run did not end after its signal") from None


def _result(process: subprocess.Popen[bytes], folder: Path) -> dict[str, Any]:
    """Return the JSON of a run that has ended; raises BenchFailed."""
    process.wait(_END_S)
    lines = (folder / "out").read_text().splitlines()
    result = json.loads(lines[-1]) if lines else {"error": (folder / "err").read_text()[-400:]}
    if "error" in result or not result["balanced"]:
        raise BenchFailed(str(result.get("error", "its ledger is not balanced")))
    return dict(result)


def _speed(result: dict[str, Any], meter: Meter, received: Received, started_s: float) -> Speed:
    events = result["events"]
    delivered = sum(link["delivered"] for link in events["links"].values())
    if received.faults or received.events > delivered:
        raise BenchFailed(f"{delivered} events delivered, {received.events} received, {received.faults} faults")
    return Speed(
        factor=result["sim_seconds"] / result["wall_seconds"],
        stream_s=result["sim_seconds"],
        session_cores=meter.session_cores,
        link_cores=meter.link_cores,
        receiver_cores=meter.receiver_cores,
        memory_mib=meter.memory_mib,
        first_event_s=None if received.first_s is None else received.first_s - started_s,
        events=received.events,
        received_share=received.events / events["read_out"] if events["read_out"] else 1.0,
    )

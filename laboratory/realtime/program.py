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
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from laboratory.bench.streams import BenchFailed
from laboratory.realtime.variants import Variant
from transports import Closing
from transports.link.pacing import MonotonicClock
from transports.output_file import TemporaryFolder
from transports.reception import Reception
from transports.usb.cameras import driver_of, receive
from transports.usb.host import CameraHost, UsbHostError
from transports.usb.usbip.client import UsbipHost

_PROC = Path("/proc")
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")
_HELPER = b"resource_tracker"  # of multiprocessing: a child that does none of the run's work


@dataclass(frozen=True)
class ProcessUse:
    """Processor time of a process so far, s, and the most memory that it had at a time, MiB."""

    cpu_s: float
    peak_mib: float


def use_of(pid: int) -> ProcessUse | None:
    """Return the use of a process; None where it has ended."""
    try:
        fields = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
        status = (_PROC / str(pid) / "status").read_text()
    except OSError:
        return None
    peak = [line for line in status.splitlines() if line.startswith("VmHWM:")]
    if not peak:  # it has ended, and its parent has not taken note of it
        return None
    return ProcessUse((int(fields[11]) + int(fields[12])) * _TICK_S, int(peak[0].split()[1]) / 1024)


def children(pid: int) -> Iterator[int]:
    """Yield the children of a process, and theirs, without helpers of multiprocessing."""
    for task in (_PROC / str(pid) / "task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, task.read_text().split()):
                if not _is_helper(child):
                    yield child
                    yield from children(child)


def _is_helper(pid: int) -> bool:
    with suppress(OSError):
        return _HELPER in (_PROC / str(pid) / "cmdline").read_bytes()
    return True


class Meter:
    """Use of the processes of a run, from the first sample after its first step to the last."""

    def __init__(self, session: int, receiver: int) -> None:
        self._session, self._receiver = session, receiver
        self._first: dict[int, ProcessUse] = {}
        self._last: dict[int, ProcessUse] = {}
        self._links: set[int] = set()
        self.begun_s = self.last_s = 0.0

    def sample(self) -> None:
        """Take a sample of all processes."""
        self._links.update(children(self._session))
        found = {pid: use for pid in (self._session, self._receiver, *self._links) if (use := use_of(pid))}
        self.last_s = time.monotonic()
        self.begun_s = self.begun_s or self.last_s
        self._first = {**found, **self._first}
        self._last |= found

    @property
    def session_cores(self) -> float | None:
        """Cores of the session."""
        return self._cores({self._session})

    @property
    def link_cores(self) -> float | None:
        """Cores of all links together."""
        return self._cores(self._links)

    @property
    def receiver_cores(self) -> float | None:
        """Cores of the receiver."""
        return self._cores({self._receiver})

    @property
    def memory_mib(self) -> float:
        """Memory of the session and its links, MiB."""
        return sum(use.peak_mib for pid, use in self._last.items() if pid != self._receiver)

    def _cores(self, pids: set[int]) -> float | None:
        seconds = self.last_s - self.begun_s
        if seconds <= 0:
            return None
        return sum(self._last[pid].cpu_s - self._first[pid].cpu_s for pid in pids if pid in self._last) / seconds


_RETRY_S = 0.01
_CONNECT_S = 5.0
_RECEIVER_END_S = 10.0


@dataclass(frozen=True)
class Received:
    """Counts of events and malformed words, and `time.monotonic` of the first event (None: there was none)."""

    events: int
    faults: int
    first_s: float | None


class Receiver(Closing):
    """The receiver of the camera at a port of this machine; it attaches as soon as the camera is there.

    The constructor returns when the process is ready to attach. A context manager: at its end the process has ended.

    Attributes
    ----------
    pid : of the process.
    """

    def __init__(self, port: int, patience_s: float) -> None:
        context = multiprocessing.get_context("spawn")
        self._mine, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_serve_receiver, args=(port, patience_s, theirs), daemon=True)
        resource_tracker.ensure_running()  # its own start would let the signal through again
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a Ctrl-C is for the bench
        try:
            self._process.start()  # which inherits the blocked signal
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.pid: int = self._process.pid or 0
        if not self._mine.poll(patience_s):  # its first message: its imports are done, and it can attach at once
            self.close()
            raise BenchFailed("the receiver did not start")
        self._mine.recv()

    def received(self) -> Received:
        """Return the reception, once the camera has gone; raises BenchFailed."""
        if not self._mine.poll(_RECEIVER_END_S):
            raise BenchFailed("the receiver did not attach before the run ended, or did not end with it")
        try:
            found: Received | str = self._mine.recv()
        except EOFError:
            raise BenchFailed("the receiver has died") from None
        if isinstance(found, str):
            raise BenchFailed(f"the receiver: {found}")
        return found

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._mine.close()


def _serve_receiver(port: int, patience_s: float, result: Connection) -> None:
    result.send(None)
    try:
        with closing(_attached(port, time.monotonic() + patience_s)) as camera:
            result.send(_read_camera(camera))
    except UsbHostError as error:
        result.send(str(error))


def _attached(port: int, deadline_s: float) -> CameraHost[Any]:
    """Return the driver of the camera, which opens its port when it is ready; raises UsbHostError."""
    while True:
        try:
            return driver_of(UsbipHost.attach("127.0.0.1", port, "1-1", timeout_s=_CONNECT_S))
        except UsbHostError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(_RETRY_S)


def _read_camera(camera: CameraHost[Any]) -> Received:
    first_s: float | None = None

    def goes_on(now: Reception) -> bool:
        nonlocal first_s
        if first_s is None and now.events:
            first_s = time.monotonic()
        return True

    reception = receive(camera, goes_on, MonotonicClock())
    return Received(reception.events, reception.faults, first_s)


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
    with TemporaryFolder("bench") as name:
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

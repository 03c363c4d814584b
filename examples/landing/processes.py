"""Processes beside the spacecraft, evstim as the camera and the flight computer; and the addresses of their links."""

from __future__ import annotations

import logging
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import can

__all__ = ["LAW_FAILED", "Ended", "Ends", "NotStarted", "bus_of", "camera", "computer"]

Ended = Callable[[], str]
"""Returns a text when a process has ended; "" while it runs."""

LAW_FAILED = "law_failed.txt"
"""File of a flight whose given law has failed: the sentence about it."""

_LACKING = 3  # exit code: the machine lacks something
_HERE = Path(__file__).parent
_READY_S = 600.0
_END_S = 10.0
_JOINED_S = 0.5  # the served bus sends no frames to a new client for a quarter of a second


@dataclass(frozen=True)
class Ends:
    """Addresses of the links: the bus's TCP port, the UDP port of poses, the serial line."""

    can_port: int
    pose_port: int
    serial: str

    @classmethod
    def free(cls, out: Path) -> Ends:
        """Return free ports, and a serial line in a folder."""
        with socket.create_server(("127.0.0.1", 0)) as bus, socket.socket(type=socket.SOCK_DGRAM) as poses:
            poses.bind(("127.0.0.1", 0))
            return cls(bus.getsockname()[1], poses.getsockname()[1], str(out / "serial"))

    def rig(self, text: str) -> str:
        """Return the text of a rig like landing.toml with these in it."""
        text = text.replace("29536", str(self.can_port)).replace("10364", str(self.pose_port))
        return text.replace("/tmp/evstim-landing", self.serial)


class NotStarted(RuntimeError):
    """A process did not start; `code` is the exit code by cause."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


@contextmanager
def camera(rig: Path, seed: int, out: Path, record: Path | None = None) -> Iterator[Ended]:
    """Run evstim until the block ends; `record` takes the events.

    Gives a function that reports its end; raises NotStarted.
    """
    ready = out / "ready"
    ready.unlink(missing_ok=True)
    command = [sys.executable, "-m", "evstim", "run", str(rig), "--json", "--seconds", "0"]
    command += ["--seed", str(seed), "--ready-file", str(ready)]
    command += ["--record", str(record)] if record else []
    with (out / "summary.json").open("w") as summary, subprocess.Popen(command, stdout=summary) as run:
        try:
            end_s = time.monotonic() + _READY_S
            while not ready.exists():
                if run.poll() is not None or time.monotonic() > end_s:
                    raise NotStarted("evstim has not started, see above", run.poll() or _LACKING)
                time.sleep(0.05)
            yield _ended(run, "evstim")
        finally:
            run.terminate()


@contextmanager
def bus_of(ends: Ends) -> Iterator[can.BusABC]:
    """Give the bus."""
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)  # it warns of frames that TCP cut in two
    with can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=ends.can_port) as bus:
        time.sleep(_JOINED_S)
        yield bus


@contextmanager
def computer(ends: Ends, known: Sequence[str], seed: int, out: Path, more: Sequence[str] = ()) -> Iterator[Ended]:
    """Run the flight computer until the block ends; `known` are the arguments with the state from navigation.

    Gives a function that reports its end; raises NotStarted.
    """
    command = [sys.executable, str(_HERE / "flight_computer.py"), "--seed", str(seed), *more]
    command += ["--serial", ends.serial, "--can-port", str(ends.can_port), "--log", str(out / "computer.jsonl")]
    command += known
    failed = out / LAW_FAILED
    failed.unlink(missing_ok=True)
    (out / "last_events.npz").unlink(missing_ok=True)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline().strip() != "ready":
                raise NotStarted("the flight computer has not started, see above", _LACKING)
            ended = _ended(process, "the flight computer")
            yield lambda: failed.read_text() if ended() and failed.exists() else ended()
        finally:
            process.terminate()
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()  # a law of the user's may hold the interpreter


def _ended(process: subprocess.Popen[str] | subprocess.Popen[bytes], name: str) -> Ended:
    """Return a function that gives a text when a process has ended."""

    def ended() -> str:
        code = process.poll()
        return "" if code is None else f"{name} has ended with {f'code {code}' if code >= 0 else f'signal {-code}'}"

    return ended

"""Runs of simulators in processes of their own, each sequence with a bound of time.

The worker (`worker.py`) runs under the interpreter that has the simulator. A simulator that raises an error fails the
sequence; one that crashes or does not end fails it too, and a new process continues with the next sequence. After
`_MOST_LOST` processes the rest is not run.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

_WORKER = Path(__file__).with_name("worker.py")
_ADAPTERS = Path(__file__).with_name("adapters.py")
_MOST_LOST = 3
_MOST_OF_A_LINE = 1 << 16
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "RAYON_NUM_THREADS")

BUNDLED = ("v2e", "esim", "openeb", "iebcs", "dvs_voltmeter", "evlib", "eventcv", "neurosim")
"""Simulators with an adapter here."""

NEEDS_NO_PATH = ("evlib", "eventcv", "neurosim")
"""Those of them that are installed as packages."""

OURS = ("evstim_refined", "evstim", "evstim_line")
"""Our own pixels, by what they get beside the frames."""


@dataclass(frozen=True)
class Adapter:
    """An adapter and the interpreter that runs it.

    Attributes
    ----------
    python : the interpreter.
    place : `FILE.py:MAKE`.
    path : place of the simulator, or "".
    threads : number of threads that the usual libraries may use; 0 leaves it to them.
    """

    python: str
    place: str
    path: str = ""
    threads: int = 1

    @classmethod
    def bundled(cls, name: str, python: str, path: str = "", threads: int = 1) -> Adapter:
        """Return the adapter of that name in `BUNDLED` or `OURS`."""
        return cls(python, f"{_ADAPTERS}:{name}", path, threads)


@dataclass
class Outcome:
    """Result of a run: `about` the simulator, and the sequences that it did not finish, with the reasons."""

    about: dict[str, str] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)


def run_adapter(
    adapter: Adapter, folder: Path, sequences: Sequence[str], out: Path, limit_s: float, done: Callable[[str], None]
) -> Outcome:
    """Run a simulator over sequences of a folder; write the events into `out`.

    Parameters
    ----------
    limit_s : longest time for the start, and for each sequence, on the clock.
    done : called with the name of each sequence that has ended in any way.
    """
    outcome, waiting, lost = Outcome(), list(sequences), 0
    while waiting:
        with tempfile.TemporaryFile() as errors, closing(_Worker(adapter, folder, out, waiting, errors)) as worker:
            reason = _follow(worker, waiting, limit_s, outcome, done)
        if not reason:
            break
        lost += 1
        failed = waiting[:] if worker.current is None or lost == _MOST_LOST else [worker.current]
        for name in failed:
            rest = "" if name == (worker.current or name) else f"not run, as {_MOST_LOST} processes were lost: "
            outcome.failures[name] = rest + reason
            done(name)
        waiting = [name for name in waiting if name not in failed]
    return outcome


def _follow(worker: _Worker, waiting: list[str], limit_s: float, outcome: Outcome, done: Callable[[str], None]) -> str:
    """Read a worker's messages until it ends, and take what it finished from `waiting`; return why it was lost."""
    while waiting:
        try:
            message = worker.message(limit_s)
        except queue.Empty:
            return f"no end after {limit_s:g} s"
        if message is None:
            return worker.ending()
        if "broken" in message:
            return f"a message that is no JSON: {message['broken']}"
        if "about" in message:
            outcome.about = message["about"]
        elif "begins" in message:
            worker.current = message["begins"]
        else:
            name = message.get("ends") or message["fails"]
            if "fails" in message:
                outcome.failures[name] = message["reason"]
            waiting.remove(name)
            worker.current = None
            done(name)
    return ""


class _Worker:
    """A process of the worker, which writes what the simulator prints into `errors`."""

    def __init__(self, adapter: Adapter, folder: Path, out: Path, sequences: Sequence[str], errors: IO[bytes]) -> None:
        command = [
            adapter.python, "-u", str(_WORKER), str(folder), str(out), adapter.place, adapter.path, *sequences,
        ]  # fmt: skip
        environment = dict(os.environ)
        if adapter.threads:
            environment |= dict.fromkeys(_THREADS, str(adapter.threads))
        self._messages: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self.current: str | None = None
        self._errors = errors
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, env=environment,
            start_new_session=True,
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def close(self) -> None:
        """Kill it with all its children."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._reader.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def message(self, limit_s: float) -> dict[str, Any] | None:
        """Return the next message, None after the last; raise queue.Empty after `limit_s`."""
        return self._messages.get(timeout=limit_s)

    def ending(self) -> str:
        """Return how the process ended, with the last line that it printed."""
        # Not reaped here: its number stays that of its group until the group is killed.
        ended = os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
        assert ended is not None
        code = ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status
        self._errors.seek(0)
        lines = self._errors.read()[-4096:].decode(errors="replace").strip().splitlines()
        how = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"{how}: {lines[-1][:300]}" if lines else how

    def _read(self) -> None:
        """Put the messages into the queue."""
        stdout = self._process.stdout
        assert stdout is not None
        while line := stdout.readline(_MOST_OF_A_LINE):
            try:
                self._messages.put(json.loads(line))
            except ValueError:
                self._messages.put({"broken": repr(line[:100])})
        self._messages.put(None)

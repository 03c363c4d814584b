"""A truth file as it is written: rows go through a pipe to a process that compresses them and waits for the disk.

    run --put--> queue --thread--> pipe --> writer process --> file

The queue is bounded. A run that is not paced waits for room; in one that is, rows that find none are left out of the
file and counted.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import threading
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from emulator.run.truth.layout import About
from emulator.run.truth.messages import Rows, encoded

__all__ = ["TruthRecorder"]

_CAPACITY_BYTES = 1 << 28
_CLOSE_S = 60.0  # a full queue is written in some seconds
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); "
    "from emulator.run.truth.writer_process import main; main()"
)


class TruthRecorder:
    """Writes rows to `path`; only the constructor raises OSError.

    Parameters
    ----------
    waits : whether `put` waits for room.

    Attributes
    ----------
    missing_pictures, missing_events : rows that found no room.
    """

    def __init__(self, path: Path, about: About, *, waits: bool) -> None:
        self.path, self._waits = path, waits
        self.missing_pictures = self.missing_events = 0
        self._why = ""
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._changed = threading.Condition()
        self._ending = self._broken = False
        self._process = _started(path, about)
        told = self._hear()
        if "opened" not in told:
            self._let_go()
            raise OSError(0, told.get("error", f"its writer ended (exit code {self._process.returncode})"), str(path))
        self._thread = threading.Thread(target=self._send_all, name="truth", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """Why the file is not whole, for people; empty where it is."""
        if self._why:
            return f"truth stopped: {self._why} ({self.path})"
        if self.missing_pictures or self.missing_events:
            lost = f"{self.missing_pictures} pictures and {self.missing_events} events"
            return f"truth lacks {lost}: they came faster than they could be written ({self.path})"
        return ""

    def put(self, rows: Rows) -> None:
        """Add rows."""
        data = encoded(rows)
        with self._changed:
            if self._waits:
                self._changed.wait_for(lambda: self._broken or self._has_room(len(data)))
            if self._broken or not self._has_room(len(data)):
                self.missing_pictures += len(rows.get("pictures/t", ()))
                self.missing_events += len(rows.get("events/t", ()))
                return
            self._queue(data)

    def close(self) -> None:
        """Let the writer finish the file, and hear its report; a second call does nothing."""
        if self._ending:
            return
        facts = {"missing_pictures": self.missing_pictures, "missing_events": self.missing_events}
        whole = not any(facts.values())
        with self._changed:
            self._queue(encoded({f"@{k}": np.array([v]) for k, v in {**facts, "complete": whole}.items()}))
            self._ending = True
            self._changed.notify_all()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self._why = f"still being written by process {self._process.pid}"

    def _has_room(self, size: int) -> bool:
        return not self._waiting_bytes or self._waiting_bytes + size <= _CAPACITY_BYTES

    def _queue(self, data: bytes) -> None:
        self._waiting.append(data)
        self._waiting_bytes += len(data)
        self._changed.notify_all()

    def _send_all(self) -> None:
        """Send what waits until the end, and then hear the report; in the thread."""
        try:
            while data := self._next():
                _write(self._process.stdin.fileno(), data)  # type: ignore[union-attr]
                with self._changed:
                    self._waiting_bytes -= len(data)
                    self._changed.notify_all()
        except OSError:  # the writer has ended
            pass
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        why = self._hear().get("trouble", "its writer was killed")
        with self._changed:
            self._broken, self._why = True, why
            self._changed.notify_all()
        self._let_go()

    def _next(self) -> bytes:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ending)
            return self._waiting.popleft() if self._waiting else b""

    def _hear(self) -> dict[str, Any]:
        """Return the writer's next line, {} where it ended without one."""
        line = self._process.stdout.readline() if self._process.stdout else b""
        try:
            told: dict[str, Any] = json.loads(line)
        except ValueError:
            return {}
        return told

    def _let_go(self) -> None:
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        self._process.stdout.close()  # type: ignore[union-attr]
        self._process.wait()


def _started(path: Path, about: About) -> subprocess.Popen[bytes]:
    order = json.dumps({"path": str(path), **dataclasses.asdict(about)})
    # A session of its own: a signal to the group of the run must not end it before its input does.
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _START, order, json.dumps(sys.path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip


def _write(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]

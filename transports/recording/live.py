"""Live recording: parts are sent through a pipe to a process that writes them, so that no disk delays a camera.

    link --append--> queue --thread--> pipe --> writer process --> file

The queue is bounded. In a run without pacing `append` waits for room; in a paced run, events that find no room are
omitted from the file and counted.

`main` is the process that writes: it reads parts from a pipe, writes one file, and reports at the end.

    stdin   parts (see `part`), until its end
    stdout  a line of JSON when the file is open, or cannot be opened; another one when it is closed

It ends with its input, so that the file is finished even if the process that feeds it is killed. Signals to the whole
group are for the session, which then ends the input.

`open_recorder` returns a recorder for a file of any format: `.npz` in the calling process, all others in a separate
process.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from contextlib import suppress
from fcntl import F_SETPIPE_SZ, fcntl
from pathlib import Path
from typing import Any

from firmware_protocol.events import EVENT
from transports.recording.format import FORMATS, Format, format_to_write, reason
from transports.recording.part import (
    Facts,
    Part,
    PipeReader,
    Reached,
    RecordingError,
    Restart,
    counts_of,
    encoded_part,
    encoded_reached,
    encoded_restart,
    facts_of,
)
from transports.recording.pipe_queue import PipeQueue
from transports.recording.record import Recorder
from transports.recording.summary import RecordingSummary, named
from transports.recording.writing import RecordingFile

__all__ = ["AnyRecorder", "LiveRecorder", "main", "open_recorder"]


_CAPACITY_BYTES = 1 << 27
_PIPE_BYTES = 1 << 20
_REACH_US = 50_000  # between two messages of the time reached
_CLOSE_S = 8.0  # a session waits 10 s for a link's last report
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); from transports.recording.live import main; main()"
)


class LiveRecorder:
    """Recorder of parts in device time to `path`. Only the constructor raises OSError.

    Attributes
    ----------
    missing : Counter[str]
        Number of records of each stream that found the queue full, or arrived when nothing could be written any more.
    report : dict[str, Any]
        Report of the writer at its end: "written", "left_out", "late", "trouble", "paths".
    """

    def __init__(self, path: Path, form: Format, facts: Facts, what: str = "record") -> None:
        self.path = path
        self._what = what
        self._process = _started(path, form, facts)
        self._opened()
        self._messages = PipeQueue(_CAPACITY_BYTES)
        self._restart: list[bytes] | None = None  # the message of a restart that could not be sent; None: of the first
        self._form = form
        self._reached_us = 0
        self.missing: Counter[str] = Counter()
        self.report: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._send_all, name="recording", daemon=True)
        self._thread.start()

    def _opened(self) -> None:
        """Wait until the file is open; raises OSError."""
        answer = self._read_line()
        if "opened" in answer:
            return
        self._let_go()
        raise OSError(
            0, answer.get("error", f"its writer ended (exit code {self._process.returncode})"), str(self.path)
        )

    @property
    def broken(self) -> bool:
        """True if the writer has ended, so that nothing more is written."""
        return self._messages.broken or self._process.poll() is not None

    @property
    def room(self) -> int:
        """Number of events that `append` accepts now."""
        return self._messages.room_bytes // EVENT.itemsize

    @property
    def trouble(self) -> str:
        """Reason for an incomplete file, for people; empty if it is complete."""
        if why := self.report.get("trouble"):
            return f"{self._what} stopped: {why} ({self.path})"
        if self.missing:
            return f"{self._what} lacks {named(self.missing)}: they came faster than it could be written ({self.path})"
        if late := self.report.get("late"):
            return f"{self._what} lacks {named(late)}: they came after what is later had been written ({self.path})"
        return ""

    @property
    def summary(self) -> RecordingSummary:
        """Summary of the closed file."""
        report = self.report
        paths = tuple(report.get("paths", [str(self.path)]))
        written, left_out = report.get("written", {}), report.get("left_out", {})
        return RecordingSummary(self._form.title, paths, written, left_out, self.trouble, closed=bool(report))

    def append(self, part: Part, *, restarted: bool = False, unix_us: int | None = None) -> None:
        """Add a part in device time; `restarted` if the clock was restarted before it.

        `unix_us` is the Unix time at which it began; None in a run without pacing, where this call may wait.
        """
        if restarted:
            self._restart = encoded_restart(unix_us or 0)
        messages = [*(encoded_restart(unix_us or 0) if self._restart is None else self._restart), *encoded_part(part)]
        self._reached_us = 0 if restarted else self._reached_us
        if self._messages.put(messages, wait=unix_us is None):
            self._restart = []
        else:
            self.missing.update(counts_of(part))

    def reach(self, t_us: int) -> None:
        """Record that no event earlier than `t_us` of device time will come."""
        if t_us - self._reached_us >= _REACH_US:
            self._reached_us = t_us
            self._messages.put(encoded_reached(t_us), wait=False)

    def close(self) -> None:
        """Let the writer finish the file, and receive its report; if that takes long, it continues by itself."""
        self._messages.end()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self.report = {"trouble": f"still being written by process {self._process.pid}"}

    def _send_all(self) -> None:
        """Send the waiting messages until the end, then read the report; runs in the thread."""
        self._messages.send_all(self._process.stdin.fileno())  # type: ignore[union-attr]
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        self.report = self._read_line() or {"trouble": "its writer was killed"}
        self._messages.stop()
        self._let_go()

    def _let_go(self) -> None:
        """Wait for the process to end, and close the pipes."""
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        self._process.stdout.close()  # type: ignore[union-attr]
        self._process.wait()

    def _read_line(self) -> dict[str, Any]:
        """Return the writer's next line, {} if it ended without one."""
        line = self._process.stdout.readline() if self._process.stdout else b""
        try:
            answer: dict[str, Any] = json.loads(line)
        except ValueError:
            return {}
        return answer


def _started(path: Path, form: Format, facts: Facts) -> subprocess.Popen[bytes]:
    known = {"size": facts.size, "camera": facts.camera, "unix_us": facts.unix_us, "streams": sorted(facts.streams)}
    order = json.dumps({"path": str(path), "format": form.name, "facts": known})
    # A separate session: a signal to the group of the run must not end it before its input ends.
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _START, order, json.dumps(sys.path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    with suppress(OSError):  # a smaller pipe serves too
        fcntl(process.stdin, F_SETPIPE_SZ, _PIPE_BYTES)  # type: ignore[arg-type]
    return process


_READ_BYTES = 1 << 20


def main() -> None:
    """Write the data of stdin to the file of the request, the first argument."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    order = json.loads(sys.argv[1])
    try:
        file = RecordingFile(Path(order["path"]), FORMATS[order["format"]], facts_of(order["facts"]))
    except BaseException as error:  # noqa: BLE001 a panic of Rust is no Exception
        _report(error=reason(error))
        return
    _report(opened=True)
    trouble = _written(file)
    paths = [str(path) for path in file.paths]
    _report(written=file.written, left_out=+file.left_out, late=+file.late, trouble=trouble, paths=paths)


def _written(file: RecordingFile) -> str:
    """Write all data; return the reason for an incomplete file, "" if it is complete."""
    try:
        _write_all(file)
    except BaseException as error:  # noqa: BLE001
        trouble = reason(error)
        with suppress(BaseException):  # the first reason is reported
            file.close()
        return trouble
    return ""


def _write_all(file: RecordingFile) -> None:
    messages = PipeReader()
    while data := os.read(0, _READ_BYTES):
        for message in messages.feed(data):
            if isinstance(message, Restart):
                file.restart(int(message))
            elif isinstance(message, Reached):
                file.reach(int(message))
            elif isinstance(message, Part):
                file.write(message)
    file.close()


def _report(**values: Any) -> None:
    try:
        os.write(1, json.dumps(values).encode() + b"\n")
    except OSError:  # no process reads it
        return


if __name__ == "__main__":
    main()


AnyRecorder = Recorder | LiveRecorder
"""Recorder that appends events and edges during a run."""


def open_recorder(path: Path, facts: Facts) -> AnyRecorder:
    """Return a recorder in the format of the file's suffix; raises OSError where it cannot be opened."""
    try:
        form = format_to_write(path)
    except RecordingError as error:
        raise OSError(0, str(error), str(path)) from error
    return Recorder(path, facts.size) if form.name == "npz" else LiveRecorder(path, form, facts)

"""Live recording: parts are sent to a process that writes them, so that no disk delays a camera (see `writer_process`).

In a run without pacing `append` waits for room; in a paced run, events that find no room are omitted from the file and
counted. `open_recorder` returns a recorder for a file of any format: `.npz` in the calling process, all others in a
separate process, whose main function is `main`. Its messages are those of `part`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_protocol.events import EVENT
from firmware_protocol.recordings.part import Facts, Part, RecordingSummary, counts_of, named
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS, Format, format_to_write, with_addition
from transports.recording.part import (
    PipeReader,
    Reached,
    RecordingError,
    Restart,
    encoded_part,
    encoded_reached,
    encoded_restart,
    facts_of,
    values_of,
)
from transports.recording.record import Recorder
from transports.recording.writer_process import WriterProcess, serve_writer

_CAPACITY_BYTES = 1 << 27
_READ_BYTES = 1 << 20
_REACH_US = 50_000  # between two messages of the time reached
_CLOSE_S = 8.0  # a session waits 10 s for a link's last report


class LiveRecorder:
    """Recorder of parts in device time to `path`. Only the constructor raises OSError.

    `missing`: records of each stream that found the queue full, or that nothing could write any more.
    """

    def __init__(self, path: Path, form: Format, facts: Facts, title: str = "record") -> None:
        self.path = path
        self._title = title
        order = {"path": str(path), "format": form.name, "facts": values_of(facts)}
        self._writer = WriterProcess(f"{__name__}:main", order, _CAPACITY_BYTES)
        self._restart: list[bytes] | None = None  # the message of a restart that could not be sent; None: of the first
        self._form = form
        self._reached_us = 0
        self.missing: Counter[str] = Counter()

    @property
    def broken(self) -> bool:
        """True if the writer has ended, so that nothing more is written."""
        return self._writer.broken

    @property
    def room(self) -> int:
        """Number of events that `append` accepts now."""
        return self._writer.room_bytes // EVENT.itemsize

    @property
    def report(self) -> Mapping[str, Any]:
        """Report of the writer at its end: "written", "left_out", "late", "trouble", "paths"; {} before."""
        return self._writer.report

    @property
    def trouble(self) -> str:
        """Reason for an incomplete file, for people; empty if it is complete."""
        if reason := self.report.get("trouble"):
            return f"{self._title} stopped: {reason} ({self.path})"
        if self.missing:
            return f"{self._title} lacks {named(self.missing)}: they came faster than it could be written ({self.path})"
        if late := self.report.get("late"):
            return f"{self._title} lacks {named(late)}: they came after what is later had been written ({self.path})"
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
        if self._writer.put(messages, wait=unix_us is None):
            self._restart = []
        else:
            self.missing.update(counts_of(part))

    def reach(self, t_us: int) -> None:
        """Record that no event earlier than `t_us` of device time will come."""
        if t_us - self._reached_us >= _REACH_US:
            self._reached_us = t_us
            self._writer.put(encoded_reached(t_us), wait=False)

    def close(self) -> None:
        """Let the writer finish the file, and receive its report; if that takes long, it continues by itself."""
        self._writer.close(_CLOSE_S)


def main(order: Mapping[str, Any]) -> None:
    """Write the data of stdin to the file of an order."""

    def opened() -> RecordingFile:
        return RecordingFile(Path(order["path"]), FORMATS[order["format"]], facts_of(order["facts"]))

    def report(file: RecordingFile) -> dict[str, Any]:
        paths = [str(path) for path in file.paths]
        return {"written": file.written, "left_out": +file.left_out, "late": +file.late, "paths": paths}

    serve_writer(opened, _write_all, report)


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


AnyRecorder = Recorder | LiveRecorder
"""Recorder that appends events and edges during a run."""


def open_recorder(path: Path, facts: Facts) -> AnyRecorder:
    """Return a recorder in the format of the file's suffix; raises OSError where it cannot be opened."""
    try:
        form = format_to_write(path)
    except RecordingError as error:
        raise OSError(0, str(error), str(path)) from error
    return Recorder(path, facts.size) if form.name == "npz" else LiveRecorder(path, form, facts)


@dataclass(frozen=True)
class FileRecorder:
    """Factory of the recorder of a link's file, in the link's process; see `transports.link.deliveries`."""

    path: Path

    def open(self, facts: Facts) -> AnyRecorder:
        """Return the recorder; raises OSError where the file cannot be opened."""
        return open_recorder(self.path, facts)

    def restarted(self, number: int) -> FileRecorder:
        """Return the factory for a file beside the earlier one."""
        return FileRecorder(with_addition(self.path, f"restart{number}"))

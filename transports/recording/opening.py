"""A recorder for a file of any format: `.npz` in the calling process, all others in one of their own."""

from __future__ import annotations

from pathlib import Path

from transports.recording.format import format_to_write
from transports.recording.live import LiveRecorder
from transports.recording.part import Facts, RecordingError
from transports.recording.record import Recorder

__all__ = ["AnyRecorder", "open_recorder"]

AnyRecorder = Recorder | LiveRecorder
"""What appends events and edges while a run lasts."""


def open_recorder(path: Path, facts: Facts) -> AnyRecorder:
    """Return a recorder in the format of the file's suffix; raises OSError where it cannot be opened."""
    try:
        form = format_to_write(path)
    except RecordingError as error:
        raise OSError(0, str(error), str(path)) from error
    return Recorder(path, facts.size) if form.name == "npz" else LiveRecorder(path, form, facts)

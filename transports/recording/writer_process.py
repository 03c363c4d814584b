"""The process that writes a live recording: parts in from a pipe, one file out, a report at the end.

    stdin   parts (see `parts_pipe`), until its end
    stdout  a line of JSON when the file is open, or cannot be; another one when it is closed

It ends with its input, so that the file is finished also when the process that feeds it is killed. Signals to the whole
group are for the session, which then ends its input.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from transports.recording.format import FORMATS
from transports.recording.part import Part
from transports.recording.parts_pipe import PipeReader, Reached, Restart, facts_of
from transports.recording.reasons import reason
from transports.recording.writing import RecordingFile

__all__ = ["main"]

_READ_BYTES = 1 << 20


def main() -> None:
    """Write what comes on stdin to the file of the order, the first argument."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    order = json.loads(sys.argv[1])
    try:
        file = RecordingFile(Path(order["path"]), FORMATS[order["format"]], facts_of(order["facts"]))
    except BaseException as error:  # noqa: BLE001 a panic of Rust is no Exception
        _tell(error=reason(error))
        return
    _tell(opened=True)
    trouble = _written(file)
    paths = [str(path) for path in file.paths]
    _tell(written=file.written, left_out=+file.left_out, late=+file.late, trouble=trouble, paths=paths)


def _written(file: RecordingFile) -> str:
    """Write all that comes; return why the file is not whole, "" where it is."""
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


def _tell(**told: Any) -> None:
    try:
        os.write(1, json.dumps(told).encode() + b"\n")
    except OSError:  # nobody is there to hear it
        return


if __name__ == "__main__":
    main()

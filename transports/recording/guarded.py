"""A recording of unknown origin, read by a child process with bounds on memory and time, in pieces.

A library that meets a damaged file may run for ever, take all memory, or end its process by a signal. In a child of its
own each of these becomes a RecordingError, after all parts before it. The child's memory does not grow with the file.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from transports.recording.format import Format
from transports.recording.kind_of_file import format_to_read
from transports.recording.part import Facts, Part, RecordingError
from transports.recording.parts_pipe import PipeReader, facts_of

__all__ = ["LibraryMissing", "OpenRecording"]

_MIB = 1 << 20
_MEMORY_BYTES = 2048 * _MIB
_READ_BYTES = 1 << 20
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); "
    "from transports.recording.reader_process import main; main()"
)


class LibraryMissing(RecordingError):
    """The optional package that reads this format is not installed."""


class OpenRecording:
    """A recording that is open, in a child process; a context manager.

    Parameters
    ----------
    size : (width, height) of the sensor, for files that do not tell it.

    Raises
    ------
    RecordingError
        It cannot be read. LibraryMissing where its library is missing. OSError where it cannot be opened.

    Attributes
    ----------
    format, facts : what it is, and what is known of it before its first event.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None = None) -> None:
        self.format: Format = format_to_read(path)
        self._messages = self._heard()
        self._cpu_s = 30 + 2 * (-(-_bytes_of(path) // _MIB))
        self._process = self._started(path, size)
        try:
            first = next(self._messages)
            if not isinstance(first, dict):
                raise RecordingError("its reader said nothing of it")
            if first["kind"] == "Z":
                raise (LibraryMissing if first["lacks"] else RecordingError)(first["trouble"])
            self.facts: Facts = facts_of(first)
        except BaseException:
            self.close()
            raise

    def _started(self, path: Path, size: tuple[int, int] | None) -> subprocess.Popen[bytes]:
        order = {
            "path": str(path), "format": self.format.name, "size": size, "memory_bytes": _MEMORY_BYTES,
            "cpu_s": self._cpu_s,
        }  # fmt: skip
        # Each arena of malloc takes 64 MiB of address space, and each thread of a BLAS more.
        environment = os.environ | {"MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(
            [sys.executable, "-P", "-c", _START, json.dumps(order), json.dumps(sys.path)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment,
        )  # fmt: skip

    def parts(self) -> Iterator[Part]:
        """Yield all parts; raises RecordingError after those that came before what is damaged."""
        for message in self._messages:
            if isinstance(message, Part):
                yield message
            elif isinstance(message, dict) and message["kind"] == "Z":
                if message["trouble"]:
                    raise RecordingError(message["trouble"])
                return

    def _heard(self) -> Iterator[Any]:
        """Yield what the child says; raises RecordingError for its death."""
        pipe = PipeReader()
        while data := self._process.stdout.read1(_READ_BYTES):  # type: ignore[union-attr]
            try:
                yield from pipe.feed(data)
            except ValueError as error:
                raise RecordingError(str(error)) from error
        raise RecordingError(self._death(self._process.wait()))

    def _death(self, code: int) -> str:
        if -code in (signal.SIGXCPU, signal.SIGKILL):
            return f"it took more than {self._cpu_s} s to read, which no sound file of its size does: it is damaged"
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return f"its reader ended by {how}: the file is damaged, or needs more than {_MEMORY_BYTES // _MIB} MiB"

    def close(self) -> None:
        """End the child."""
        self._process.kill()
        self._process.stdout.close()  # type: ignore[union-attr]
        self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _bytes_of(path: Path) -> int:
    if path.is_dir():
        return sum(one.stat().st_size for one in path.iterdir() if one.is_file())
    return path.stat().st_size

"""Reader of recordings of unknown origin: a child process with limits on memory and time reads them in pieces.

A library that meets a damaged file may run for ever, take all memory, or end its process by a signal. In a child
process each of these becomes a RecordingError, after all parts before it. The child's memory does not grow with the
file.

`main` is the child process: it writes the file's parts to stdout, under its limits.
"""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from transports.recording.format import FORMATS, Format, format_to_read, reason
from transports.recording.part import (
    Facts,
    Part,
    PipeReader,
    Reader,
    RecordingError,
    encoded_end,
    encoded_facts,
    encoded_part,
    facts_of,
)

__all__ = ["LibraryMissing", "OpenRecording", "main"]


_MIB = 1 << 20
_MEMORY_BYTES = 2048 * _MIB
_READ_BYTES = 1 << 20
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); from transports.recording.guarded import main; main()"
)


class LibraryMissing(RecordingError):
    """Error: the optional package that reads this format is not installed."""


class OpenRecording:
    """Recording that is open in a child process; a context manager.

    Parameters
    ----------
    size : tuple[int, int] or None
        (width, height) of the sensor, for files without it.

    Raises
    ------
    RecordingError
        It cannot be read. LibraryMissing if its library is missing. OSError if it cannot be opened.

    Attributes
    ----------
    format, facts
        Its format, and the facts available before its first event.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None = None) -> None:
        self.format: Format = format_to_read(path)
        self._messages = self._receive()
        self._cpu_s = 30 + 2 * (-(-_bytes_of(path) // _MIB))
        self._process = self._started(path, size)
        try:
            first = next(self._messages)
            if not isinstance(first, dict):
                raise RecordingError("its reader sent no facts")
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
        """Yield all parts; raises RecordingError after the parts before damaged data."""
        for message in self._messages:
            if isinstance(message, Part):
                yield message
            elif isinstance(message, dict) and message["kind"] == "Z":
                if message["trouble"]:
                    raise RecordingError(message["trouble"])
                return

    def _receive(self) -> Iterator[Any]:
        """Yield the messages of the child; raises RecordingError for its death."""
        pipe = PipeReader()
        while data := self._process.stdout.read1(_READ_BYTES):  # type: ignore[union-attr]
            try:
                yield from pipe.feed(data)
            except ValueError as error:
                raise RecordingError(str(error)) from error
        raise RecordingError(self._death(self._process.wait()))

    def _death(self, code: int) -> str:
        if -code in (signal.SIGXCPU, signal.SIGKILL):
            return f"it took more than {self._cpu_s} s to read, which no intact file of its size does: it is damaged"
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return f"its reader ended by {how}: the file is damaged, or needs more than {_MEMORY_BYTES // _MIB} MiB"

    def close(self) -> None:
        """End the child process."""
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


_MOST_EVENTS = 1 << 16  # in one message


def main() -> None:
    """Read the file of the request, the first argument, and write facts, parts and an end to stdout."""
    order = json.loads(sys.argv[1])
    trouble, lacks = "", False
    try:
        size = order["size"]
        reader = _opened(order, None if size is None else (size[0], size[1]))
        _send(encoded_facts(reader.facts))
        for part in reader.parts():
            _send_pieces(part)
    except BrokenPipeError:
        os._exit(0)
    except RecordingError as error:
        trouble, lacks = str(error), "pip install" in str(error)
    except BaseException as error:  # noqa: BLE001 a panic of Rust is no Exception
        trouble = reason(error)
    _send(encoded_end(trouble=trouble, lacks=lacks))


def _opened(order: dict[str, Any], size: tuple[int, int] | None) -> Reader:
    form = FORMATS[order["format"]]
    form.imported(form.reader)  # before the limits, which are meant for the file
    _limit(order["memory_bytes"], order["cpu_s"])
    return form.open_reader(Path(order["path"]), size)


def _limit(memory_bytes: int, cpu_s: int) -> None:
    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    used_s = math.ceil(sum(os.times()[:2]))
    _lower(resource.RLIMIT_AS, used_bytes + memory_bytes)
    _lower(resource.RLIMIT_CPU, used_s + cpu_s)
    _lower(resource.RLIMIT_CORE, 0)


def _lower(which: int, value: int) -> None:
    _, hard = resource.getrlimit(which)
    wanted = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(which, (wanted, hard))


def _send_pieces(part: Part) -> None:
    for start in range(0, max(1, len(part.events)), _MOST_EVENTS):
        events = part.events[start : start + _MOST_EVENTS]
        _send(encoded_part(Part(events) if start else Part(events, part.edges, part.imu, part.frames)))


def _send(messages: list[bytes]) -> None:
    data = memoryview(b"".join(messages))
    while data:
        data = data[os.write(1, data) :]


if __name__ == "__main__":
    main()

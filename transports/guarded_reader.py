"""Guarded reading: a file of unknown origin is read in a child process with bounds on memory and time.

    this process                                child
    ------------                                --------------------------------------------------
    read_guarded("module:name", path, *args) -> imports the module, then sets its own limits
                                                name(path, *args): a mapping of values, or several
    values  <------------- pipe --------------  each mapping (see `encoded`), then the end, or the error

A library that meets a damaged file may run for ever, take all memory, or end its process by a signal. In a child of its
own each of these becomes a ForeignFileError, after all values before it. The child is a new interpreter, not a fork:
this process may have threads and a GL context.

A message between two processes of one run has named values: arrays as their bytes, everything else as JSON.

    u32 length of the head | head, JSON: [name, type, shape] of an array, [name, null, value] of another value | bytes

Nothing that a receiver executes is sent: the sender may have read a file that takes over its process.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import resource
import select
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.lib import format as npy

from transports import Closing
from transports.needs import install_command

Values = Mapping[str, Any]
"""Arrays and values of JSON by name."""

_LENGTH = struct.Struct("<I")
_MOST_HEAD_BYTES = 1 << 20
_FOREIGN = "the other process sends something else"


def encoded(values: Values) -> list[bytes | memoryview]:
    """Return a message in pieces; those of arrays share the arrays' memory where it is contiguous."""
    head: list[list[Any]] = []
    pieces: list[bytes | memoryview] = []
    for name, value in values.items():
        if not isinstance(value, np.ndarray):
            head.append([name, None, value])
            continue
        head.append([name, npy.dtype_to_descr(value.dtype), value.shape])
        pieces.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
    text = json.dumps(head).encode()
    return [_LENGTH.pack(len(text)), text, *pieces]


def decoded(read: Callable[[int], bytes | bytearray], most_bytes: int = 1 << 40) -> dict[str, Any] | None:
    """Return the next message of `read(size)`, which returns fewer bytes at the end of its input; None at that end.

    The arrays can be written where `read` returns a bytearray. Raises ValueError for other bytes, and for an array of
    more than `most_bytes`.
    """
    start = read(_LENGTH.size)
    if len(start) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(start)
    if length > _MOST_HEAD_BYTES:
        raise ValueError(_FOREIGN)
    text = read(length)
    if len(text) < length:
        return None
    values: dict[str, Any] = {}
    for name, descr, content in json.loads(text):
        if descr is None:
            values[name] = content
            continue
        if not isinstance(descr, str):
            descr = [tuple(field) for field in descr]  # numpy needs tuples, which JSON does not have
        dtype = npy.descr_to_dtype(descr)
        size = math.prod(content) * dtype.itemsize
        if not 0 <= size <= most_bytes:
            raise ValueError(_FOREIGN)
        data = read(size)
        if len(data) < size:
            return None  # the sender was killed
        values[name] = np.frombuffer(data, dtype).reshape(content)
    return values


_MIB = 1 << 20
_WALL_FACTOR = 10  # a busy machine gives the child a tenth of a processor
_READ_BYTES = 1 << 20
_MOST_TEXT = 400  # a damaged file may bring pages of text
_EXTRAS = {"PIL": "report", "faery": "files", "av": "files", "pxr": "usd", "spiceypy": "spice"}
_OWN = ("evstim", "emulator", "transports", "firmware_protocol")


class ForeignFileError(Exception):
    """Error: why a file cannot be read, without its name; `lacks`: a library is missing; `kind`: of the child's one."""

    def __init__(self, text: str, *, lacks: bool = False, kind: str = "") -> None:
        super().__init__(text)
        self.lacks, self.kind = lacks, kind


@dataclass(frozen=True)
class Limits:
    """Limits for reading a file: address space and processor time beyond those of the interpreter with the library."""

    memory_bytes: int
    cpu_s: int

    @classmethod
    def of(cls, path: Path) -> Limits:
        """Return limits that suffice for every intact file of this size: compressed events grow 26 times."""
        mib = _mib_of(path)
        return cls((512 + 64 * mib) * _MIB, 30 + 2 * mib)

    @classmethod
    def in_pieces(cls, path: Path) -> Limits:
        """Return limits for a file that is read in pieces: its size decides the time alone."""
        return cls(2048 * _MIB, 30 + 2 * _mib_of(path))


def _mib_of(path: Path) -> int:
    files = path.iterdir() if path.is_dir() else [path]
    return -(-sum(file.stat().st_size for file in files if file.is_file()) // _MIB)


def read_guarded(reader: str, path: Path, *args: Any, limits: Limits | None = None) -> dict[str, Any]:
    """Return the values that the function `reader`, "module:name", reads from `path`, a regular file or a folder.

    `args` are its further arguments, values of JSON. Raises ForeignFileError.
    """
    with GuardedReader(reader, path, *args, limits=limits) as reading:
        for values in reading.values():
            return values
    raise ForeignFileError("holds nothing")


class GuardedReader(Closing):
    """Child process that reads one file in pieces; a context manager. For the parameters see `read_guarded`."""

    def __init__(self, reader: str, path: Path, *args: Any, limits: Limits | None = None) -> None:
        if not (path.is_file() or path.is_dir()):
            raise ForeignFileError("is no regular file" if path.exists() else "no such file")
        self._limits = limits or Limits.of(path)
        order = {"reader": reader, "path": str(path), "args": args, "limits": vars(self._limits)}
        self._input, output = os.pipe()
        try:
            self._process = _start({**order, "output": output})
        except BaseException:
            os.close(self._input)
            raise
        finally:
            os.close(output)

    def values(self) -> Iterator[dict[str, Any]]:
        """Yield what the reader returns or yields; raises ForeignFileError after the values before damaged data."""
        while True:
            try:
                values = decoded(self._read, self._limits.memory_bytes)
            except ValueError as error:
                raise ForeignFileError(f"its reader failed: {error}") from error
            if values is None:
                raise ForeignFileError(self._death(self._process.wait()))
            if "@end" in values:
                return
            if "@error" in values:
                raise ForeignFileError(values["@error"], lacks=values["lacks"], kind=values["kind"])
            yield values

    def _read(self, size: int) -> bytearray:
        """Return the next bytes of the pipe; fewer at its end."""
        data = bytearray(size)
        view, count = memoryview(data), 0
        poll = select.poll()
        poll.register(self._input)
        while count < size:
            if not poll.poll(1000 * _WALL_FACTOR * self._limits.cpu_s):
                raise ForeignFileError(self._death(-signal.SIGXCPU))
            got = os.readv(self._input, [view[count : count + _READ_BYTES]])
            if not got:
                return data[:count]
            count += got
        return data

    def _death(self, code: int) -> str:
        if -code in (signal.SIGXCPU, signal.SIGKILL):
            return (
                f"took more than {self._limits.cpu_s} s to read, which no intact file of its size does: it is damaged"
            )
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return (
            f"its reader ended by {how}: the file is damaged, or needs more than {self._limits.memory_bytes // _MIB} "
            "MiB, which no intact file of its size does"
        )

    def close(self) -> None:
        """End the child process."""
        self._process.kill()
        os.close(self._input)
        self._process.wait()


def child_command(function: str, order: Mapping[str, Any]) -> list[str]:
    """Return the command that calls `function`, "module:name", with the order in a new interpreter with our modules."""
    module, _, name = function.partition(":")
    start = (
        f"import json, sys; sys.path[:] = json.loads(sys.argv.pop()); from {module} import {name}; "
        f"{name}(json.loads(sys.argv.pop()))"
    )
    return [sys.executable, "-P", "-c", start, json.dumps(order), json.dumps(sys.path)]


def _start(order: Mapping[str, Any]) -> subprocess.Popen[bytes]:
    # Each arena of malloc takes 64 MiB of address space, and each thread of a BLAS more.
    environment = os.environ | {"MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    null = subprocess.DEVNULL  # a library may print
    return subprocess.Popen(
        child_command("transports.guarded_reader:serve", order),
        stdin=null, stdout=null, stderr=null, env=environment, pass_fds=[order["output"]],
    )  # fmt: skip


def serve(order: Mapping[str, Any]) -> NoReturn:
    """Read the file of an order and write its values to the descriptor `output`: the child's main function."""
    module, _, name = order["reader"].partition(":")
    end: dict[str, Any] = {"@end": True}
    try:
        read = getattr(importlib.import_module(module), name)
        _limit(**order["limits"])
        result = read(Path(order["path"]), *order["args"])
        for values in [result] if isinstance(result, Mapping) else result:
            _send(order["output"], values)
    except BrokenPipeError:  # the reader of the values has seen enough
        os._exit(0)
    except BaseException as error:  # noqa: BLE001 a panic of Rust is no Exception
        end = _error_of(error, order)
    with suppress(BrokenPipeError):
        _send(order["output"], end)
    os._exit(0)  # without the library's clean-up, which a damaged file may disturb


def _error_of(error: BaseException, order: Mapping[str, Any]) -> dict[str, Any]:
    """Return the message of an error. The texts of our own errors are for people, those of a library need a verb."""
    is_own = type(error).__module__.partition(".")[0] in _OWN
    text = str(error) or type(error).__name__
    if isinstance(error, MemoryError):
        mib = order["limits"]["memory_bytes"] // _MIB
        text = f"needs more than {mib} MiB to read, which no intact file of its size does"
    elif isinstance(error, ImportError) and not is_own:
        # Some libraries raise the error anew, without the name.
        named = re.search(r"(?:No module named '|pip install )([\w-]+)", text)
        package = (error.name or (named[1] if named else "")).partition(".")[0]
        advice = install_command(_EXTRAS[package]) if package in _EXTRAS else f"pip install {package}"
        needs = f"{package}: {advice}" if package else f"a library that is not installed ({text[:_MOST_TEXT]})"
        text = f"reading {Path(order['path']).suffix or 'it'} needs {needs}"
    elif not is_own:
        text = f"cannot be read: {text if len(text) <= _MOST_TEXT else f'{text[:_MOST_TEXT]} ...'}"
    return {"@error": text, "lacks": isinstance(error, ImportError), "kind": type(error).__name__}


def _limit(memory_bytes: int, cpu_s: int) -> None:
    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    used_s = math.ceil(sum(os.times()[:2]))
    _lower(resource.RLIMIT_AS, used_bytes + memory_bytes)
    _lower(resource.RLIMIT_CPU, used_s + cpu_s)
    _lower(resource.RLIMIT_CORE, 0)


def _lower(resource_limit: int, value: int) -> None:
    _, hard = resource.getrlimit(resource_limit)
    soft = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(resource_limit, (soft, hard))


def _send(descriptor: int, values: Values) -> None:
    for piece in encoded(values):
        view = memoryview(piece)
        while view:
            view = view[os.write(descriptor, view) :]

"""Files that third-party libraries read, each in a child process with bounds on memory and time.

    this process                          child
    ------------                          -----------------------------------------------
    read_in_child("module:name", path) -> imports the module, then sets its own limits
                                          name(path) -> arrays
    arrays  <----- memory file ---------  their bytes, or the error

A library that reads a damaged file may run for ever, take all memory, or end its process by a signal. In a child of its
own each of these becomes a SceneError with the file's name. The child is a new interpreter, not a fork: this process
may have threads and a GL context.
"""

from __future__ import annotations

import importlib
import json
import math
import mmap
import os
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from emulator.light import MachineLacks, SceneError
from emulator.tables.toml_text import shortened
from transports.needs import install_command

__all__ = ["Limits", "answer", "read_in_child"]

_MIB = 1 << 20
_WALL_FACTOR = 10  # a busy machine gives the child a tenth of a processor
_EXTRAS = {"PIL": "report", "faery": "files", "av": "files"}
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from emulator.scene.foreign_file import answer; answer(json.loads(sys.argv[2]))"
)

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Limits:
    """Limits of memory and time for reading one file.

    Attributes
    ----------
    memory_bytes : address space, beyond that of the interpreter with the library.
    cpu_s : processor time, likewise.
    """

    memory_bytes: int
    cpu_s: int

    @classmethod
    def of(cls, path: Path) -> Limits:
        """Return limits that suffice for every intact file of this size: compressed events grow 26 times."""
        mib = -(-path.stat().st_size // _MIB)
        return cls((512 + 64 * mib) * _MIB, 30 + 2 * mib)


def read_in_child(reader: str, path: Path, limits: Limits | None = None) -> Arrays:
    """Return the arrays that the function `reader`, "module:name", reads from `path`, a regular file or a folder.

    Raises
    ------
    SceneError
        With the file's name: the reader's error, or the end of its process. MachineLacks where its library is missing.
    """
    if not (path.is_file() or path.is_dir()):
        raise SceneError(f"{path}: {'is no regular file' if path.exists() else 'no such file'}")
    limits = limits or Limits.of(path)
    descriptor = os.memfd_create("evstim")
    try:
        code = _run_child(reader, path, limits, descriptor)
        if code or not os.fstat(descriptor).st_size:
            raise SceneError(_death(code, limits))
        return _taken(descriptor)
    except SceneError as error:
        raise type(error)(f"{path}: {error}") from None
    finally:
        os.close(descriptor)


def _run_child(reader: str, path: Path, limits: Limits, descriptor: int) -> int:
    order = {
        "reader": reader,
        "path": str(path),
        "memory_bytes": limits.memory_bytes,
        "cpu_s": limits.cpu_s,
        "descriptor": descriptor,
    }
    # Each arena of malloc takes 64 MiB of address space, and each thread of a BLAS more.
    environment = os.environ | {"MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        return subprocess.run(
            [sys.executable, "-P", "-c", _START, json.dumps(sys.path), json.dumps(order)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=environment, pass_fds=[descriptor], timeout=_WALL_FACTOR * limits.cpu_s, check=False,
        ).returncode  # fmt: skip
    except subprocess.TimeoutExpired:
        return -signal.SIGXCPU


def _death(code: int, limits: Limits) -> str:
    if -code in (signal.SIGXCPU, signal.SIGKILL):
        return f"took more than {limits.cpu_s} s to read, which no sound file of this size does: it is damaged"
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return (
        f"its reader ended by {how}: the file is damaged, or needs more than {limits.memory_bytes // _MIB} MiB, "
        "which no sound file of this size does"
    )


def answer(order: dict[str, Any]) -> None:
    """Read the file of an order and write the answer into the memory file: the child's main function."""
    path, descriptor = Path(order["path"]), order["descriptor"]
    module, _, name = order["reader"].partition(":")
    try:
        read = getattr(importlib.import_module(module), name)
        _limit(order["memory_bytes"], order["cpu_s"])
        arrays = read(path)
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        advice = install_command(_EXTRAS[package]) if package in _EXTRAS else f"pip install {package}"
        _write(descriptor, {"lacks": f"reading {path.suffix or 'it'} needs {package}: {advice}"})
    except MemoryError:
        mib = order["memory_bytes"] // _MIB
        _write(descriptor, {"error": f"needs more than {mib} MiB to read, which no sound file of this size does"})
    except SceneError as error:
        _write(descriptor, {"lacks" if isinstance(error, MachineLacks) else "error": str(error)})
    except BaseException as error:  # noqa: BLE001 a panic of Rust is no Exception
        _write(descriptor, {"error": f"cannot be read: {shortened(error)}"})
    else:
        _write_arrays(descriptor, arrays)


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


def _write(descriptor: int, head: dict[str, Any]) -> None:
    with os.fdopen(descriptor, "wb") as file:
        file.write(json.dumps(head).encode() + b"\n")


def _write_arrays(descriptor: int, arrays: Arrays) -> None:
    """Write a line with names, types and shapes, then the arrays' bytes one after the other."""
    plain = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    head = [[name, npy.dtype_to_descr(array.dtype), array.shape] for name, array in plain.items()]
    with os.fdopen(descriptor, "wb") as file:
        file.write(json.dumps({"arrays": head}).encode() + b"\n")
        for array in plain.values():
            file.write(array.reshape(-1).view(np.uint8).data)


def _taken(descriptor: int) -> Arrays:
    """Return the arrays of an answer, in the child's own pages; raises SceneError for its error."""
    whole = mmap.mmap(descriptor, 0, access=mmap.ACCESS_COPY)  # lives as long as the arrays do
    start = whole.find(b"\n") + 1
    head = json.loads(whole[:start])
    if "lacks" in head:
        raise MachineLacks(head["lacks"])
    if "error" in head:
        raise SceneError(head["error"])
    arrays: Arrays = {}
    for name, descr, shape in head["arrays"]:
        dtype = npy.descr_to_dtype(_tuples(descr))
        count = math.prod(shape)
        arrays[name] = np.frombuffer(whole, dtype, count, start).reshape(shape)
        start += count * dtype.itemsize
    return arrays


def _tuples(descr: Any) -> Any:
    """Return a type in the form that numpy needs: JSON has no tuples."""
    return descr if isinstance(descr, str) else [tuple(field) for field in descr]

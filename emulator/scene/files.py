"""Files of scenes: arrays, files that third-party libraries read, and a cache of arrays that take long to compute.

Libraries read in a child process (see `guarded_reader`). The cache is $XDG_CACHE_HOME/evstim, or ~/.cache/evstim. A
file's name there is a digest of all inputs of the array, so a changed input makes a new file and an old one is never
wrong. Files are written beside their place and then renamed: a reader finds a complete file or none. They end with a
checksum: a damaged one is made anew. Those that were not used for longest make room for new ones beyond 4 GiB. A cache
that cannot be written or read costs time, nothing else.
"""

from __future__ import annotations

import hashlib
import io
import os
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from emulator.light import MachineLacks, SceneError
from emulator.tables.toml_text import shortened
from firmware_protocol.compiled import private_folder
from transports.guarded_reader import ForeignFileError, Limits, read_guarded
from transports.output_file import TemporaryFolder
from transports.recording.record import ArrayFileError, load_array


def read_array(path: Path) -> npt.NDArray[Any]:
    """Return the array of a `.npy` file; raises SceneError with the file's name."""
    try:
        return load_array(path)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ArrayFileError as error:
        raise SceneError(f"{path}: cannot be read as an array: {error}") from error


def read_in_child(reader: str, path: Path, limits: Limits | None = None) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays that the function `reader`, "module:name", reads from `path`, a regular file or a folder.

    Raises SceneError with the file's name: the reader's error, or the end of its process; MachineLacks if its library
    is missing.
    """
    try:
        return {name: np.asarray(values) for name, values in read_guarded(reader, path, limits=limits).items()}
    except ForeignFileError as error:
        raise (MachineLacks if error.lacks else SceneError)(f"{path}: {error}") from None


@contextmanager
def reader_errors(fault: str) -> Iterator[None]:
    """Raise SceneError with `fault` in place of the arbitrary exceptions of a library's reader for a damaged file."""
    try:
        yield
    except (MemoryError, ImportError, SceneError):
        raise
    except Exception as error:
        raise SceneError(f"{fault}: {shortened(error)}") from error


T = TypeVar("T", bound=np.generic)


class Kind(NamedTuple):
    """Type of an array's numbers, and number of its dimensions."""

    number: type
    dimensions: int


_PICTURES = Kind(np.float32, 3)

_FORMAT = 2
"""Version, to be increased when the same parameters give another array."""

_MOST_BYTES = 1 << 32
_MOST_HEADER_BYTES, _SUM_BYTES = 4096, 4


def report_progress(title: str, done: int, of: int) -> None:
    """Report on stderr that `done` of `of` parts of a computation are made; on a terminal one line is rewritten."""
    is_terminal, is_last = sys.stderr.isatty(), done == of
    if is_terminal or done == 0 or is_last:
        start, end = ("\r", "\n" if is_last else "") if is_terminal else ("", "\n")
        sys.stderr.write(f"{start}evstim: {title}: {100 * done // of} %{end}")
        sys.stderr.flush()


def cache_folder() -> Path:
    """Return the folder of the cache; one of this user alone below TMPDIR where that cannot be made."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "evstim"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        with suppress(OSError):
            return private_folder()
    return folder


def cached_array(
    name: str, made_from: object, make: Callable[[], npt.NDArray[T]], kind: Kind = _PICTURES
) -> npt.NDArray[T]:
    """Return the array that `make` computes, from the cache where it has this array.

    `made_from` are the inputs, which are compared by their repr; `kind` is that of what `make` gives.
    """
    digest = hashlib.sha256(f"{_FORMAT} {name} {made_from!r}".encode()).hexdigest()[:24]
    path = cache_folder() / f"{name}-{digest}.npy"
    array: npt.NDArray[T] | None = _read(path, kind)
    if array is None:
        array = make()
        _write(path, array)
    return array


def cached_arrays(
    name: str, made_from: object, make: Callable[[], Sequence[npt.NDArray[Any] | None]], kinds: Sequence[Kind]
) -> list[Any]:
    """Return the arrays that `make` computes at once, one for each kind; see `cached_array`. An empty one is None."""
    make_once = cache(make)

    def made(k: int, kind: Kind) -> npt.NDArray[Any]:
        return np.empty((0,) * kind.dimensions, kind.number) if (array := make_once()[k]) is None else array

    arrays = [cached_array(f"{name}-{k}", made_from, partial(made, k, kind), kind) for k, kind in enumerate(kinds)]
    return [array if array.size else None for array in arrays]


def _read(path: Path, kind: Kind) -> npt.NDArray[Any] | None:
    """Return the array of a file of the cache; None where it is missing, damaged, or of another kind."""
    try:
        content = np.asarray(np.memmap(path if path.is_file() else os.devnull, np.uint8, "c"))  # copied where written
        body, checksum = content[:-_SUM_BYTES], content[-_SUM_BYTES:]
        if zlib.crc32(body.data).to_bytes(_SUM_BYTES, "little") != checksum.tobytes():
            return None
        header = io.BytesIO(body[:_MOST_HEADER_BYTES].tobytes())
        npy.read_magic(header)
        shape, _, dtype = npy.read_array_header_1_0(header)
        array = body[header.tell() :].view(dtype).reshape(shape)
    except (OSError, ValueError):
        return None
    with suppress(OSError):  # a cache that can only be read
        os.utime(path)
    return array if dtype == np.dtype(kind.number) and array.ndim == kind.dimensions else None


def _write(path: Path, array: npt.NDArray[T]) -> None:
    """Write a file of the cache, and remove those that were not used for longest if there is no room for all."""
    header, numbers = io.BytesIO(), np.ascontiguousarray(array)
    npy.write_array_header_1_0(header, npy.header_data_from_array_1_0(numbers))
    checksum = zlib.crc32(numbers.data.cast("B") if numbers.size else b"", zlib.crc32(header.getvalue()))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFolder("array", path.parent) as folder:
            beside = Path(folder) / path.name
            with beside.open("wb") as file:
                file.writelines([header.getvalue(), numbers.data, checksum.to_bytes(_SUM_BYTES, "little")])
            beside.replace(path)
    except OSError as error:
        sys.stderr.write(f"evstim: {path.parent} cannot be written ({error.strerror}): arrays are computed anew\n")
        return
    used_bytes = 0
    with suppress(OSError):  # another process removes files at the same time
        for kept in sorted(path.parent.glob("*.npy"), key=lambda kept: kept.stat().st_mtime, reverse=True):
            used_bytes += kept.stat().st_size
            if used_bytes > _MOST_BYTES and kept != path:
                kept.unlink()

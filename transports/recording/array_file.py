"""Arrays from `.npy` and `.npz` files of unknown origin, checked before memory is taken for them.

The header of an array may claim any size. It is compared with the bytes that are there before any are read, and a
compressed member of an `.npz` may grow to 100 times its size in the file, or to 64 MiB. Objects (pickles) are refused.

Source of the format: NEP 1, `numpy.lib.format`.
"""

from __future__ import annotations

import math
import os
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

__all__ = ["ArrayFileError", "load_array", "load_arrays"]

_MOST_GROWTH = 100
_ALWAYS_BYTES = 1 << 26
_PIECE_BYTES = 1 << 24

_Array = npt.NDArray[Any]


class ArrayFileError(ValueError):
    """The file is no array file that can be read; the message says why, without the file's name."""


def load_array(path: Path) -> _Array:
    """Read a `.npy` file; raises ArrayFileError, or OSError where the file cannot be opened."""
    _require_regular(path)
    with path.open("rb") as file:
        return _array(file, path.stat().st_size)


def load_arrays(path: Path, names: Sequence[str]) -> dict[str, _Array]:
    """Read those of the named arrays of an `.npz` file that it has; raises ArrayFileError, or OSError."""
    _require_regular(path)
    try:
        with zipfile.ZipFile(path) as archive:
            there = set(archive.namelist())
            return {name: _member(archive, f"{name}.npy") for name in names if f"{name}.npy" in there}
    except (ArrayFileError, OSError):
        raise
    except Exception as error:  # zipfile answers a damaged archive with whatever it ran into
        raise ArrayFileError(f"it is no sound .npz archive: {_told(error)}") from error


def _require_regular(path: Path) -> None:
    if path.exists() and not path.is_file():
        raise ArrayFileError("it is no regular file")


def _member(archive: zipfile.ZipFile, name: str) -> _Array:
    info = archive.getinfo(name)
    most = max(_ALWAYS_BYTES, _MOST_GROWTH * info.compress_size)
    if info.compress_type != zipfile.ZIP_STORED and info.file_size > most:
        raise ArrayFileError(
            f"{name} would grow from {info.compress_size} to {info.file_size} bytes, beyond {_MOST_GROWTH} times"
        )
    stored = info.compress_type == zipfile.ZIP_STORED
    size = min(info.file_size, _size_of(archive)) if stored else info.file_size
    with archive.open(info) as file:
        return _array(file, size)


def _size_of(archive: zipfile.ZipFile) -> int:
    return os.fstat(archive.fp.fileno()).st_size if archive.fp is not None else 0


def _array(file: IO[bytes], size: int) -> _Array:
    """Read one array from a file that holds `size` bytes from its present place on, which is its start."""
    shape, is_fortran, dtype = _header(file)
    if dtype.hasobject:
        raise ArrayFileError("it holds Python objects, which are never read; numbers are needed")
    claimed, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if claimed > there:
        raise ArrayFileError(
            f"its header says shape {shape} of {dtype}, {claimed} bytes, and {there} follow: it is cut short or damaged"
        )
    try:
        array = np.frombuffer(_content(file, claimed), dtype)
        return array.reshape(shape, order="F" if is_fortran else "C")
    except (ValueError, TypeError) as error:
        raise ArrayFileError(f"its header says shape {shape} of {dtype}, which is no array: {_told(error)}") from error


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    try:
        version = npy.read_magic(file)
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
        if read is None:
            raise ArrayFileError(f"its header is of version {version}; 1.0 and 2.0 are read")
        with warnings.catch_warnings(action="ignore"):  # of damaged text, before it is refused
            shape, is_fortran, dtype = read(file)
    except (ArrayFileError, OSError):
        raise
    except Exception as error:  # the header is a piece of Python text: its parser raises what it likes
        raise ArrayFileError(f"its header is no header of an array: {_told(error)}") from error
    if any(n < 0 for n in shape):
        raise ArrayFileError(f"its header says shape {shape}: sizes are not negative")
    return shape, is_fortran, dtype


def _content(file: IO[bytes], count: int) -> bytearray:
    """Return exactly `count` bytes, read piece by piece: a member of an archive may hold fewer than it says."""
    content = bytearray()
    while len(content) < count:
        piece = file.read(min(_PIECE_BYTES, count - len(content)))
        if not piece:
            raise ArrayFileError(f"it ends after {len(content)} of {count} bytes")
        content += piece
    return content


def _told(error: Exception) -> str:
    return f"{error}"[:200] or type(error).__name__

"""Arrays that take long to make are kept on disk: in $XDG_CACHE_HOME/evstim, or ~/.cache/evstim.

A file's name is a digest of all that it was made from, so a changed figure makes a new file and an old one is never
wrong. Files are written beside and moved into place: whoever reads finds a whole one or none. A cache that cannot be
written or read costs time, nothing else.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from transports.recording.record import ArrayFileError, load_array

__all__ = ["Progress", "cache_folder", "kept"]

T = TypeVar("T", bound=np.generic)

_FORMAT = 2
"""To be raised when the same parameters come to mean another map."""


class Progress:
    """A line on stderr that says what is being made, and how far it is."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __call__(self, done: int, of: int) -> None:
        """Tell that `done` parts of `of` are made; on a terminal one line is written over and over."""
        is_terminal, is_last = sys.stderr.isatty(), done == of
        if is_terminal or done == 0 or is_last:
            start, end = ("\r", "\n" if is_last else "") if is_terminal else ("", "\n")
            sys.stderr.write(f"{start}evstim: {self._what}: {100 * done // of} %{end}")
            sys.stderr.flush()


def cache_folder() -> Path:
    """Return where files are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "evstim"


def kept(
    name: str, made_from: object, make: Callable[[], npt.NDArray[T]], kind: tuple[type, int] = (np.float32, 3)
) -> npt.NDArray[T]:
    """Return what `make` gives, from the cache where it lies there already.

    Parameters
    ----------
    made_from : tells one from another by its repr.
    kind : the type of numbers and the number of dimensions that `make` gives.
    """
    digest = hashlib.sha256(f"{_FORMAT} {name} {made_from!r}".encode()).hexdigest()[:24]
    path = cache_folder() / f"{name}-{digest}.npy"
    found: npt.NDArray[T] | None = _read(path, kind)
    if found is None:
        found = make()
        _write(path, found)
    return found


def _read(path: Path, kind: tuple[type, int]) -> npt.NDArray[Any] | None:
    try:
        array = load_array(path)
    except (OSError, ArrayFileError):  # not there, cut short, or not one of ours
        return None
    return array if array.dtype == np.dtype(kind[0]) and array.ndim == kind[1] else None


def _write(path: Path, array: npt.NDArray[T]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, beside = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(descriptor, "wb") as file:
                np.save(file, array)
            os.replace(beside, path)
        except OSError:
            os.unlink(beside)
            raise
    except OSError as error:
        sys.stderr.write(f"evstim: {path.parent} cannot be written ({error.strerror}): it is made anew each time\n")

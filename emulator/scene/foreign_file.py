"""Files of a scene: arrays, and files that third-party libraries read in a child process (see `guarded_reader`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import MachineLacks, SceneError
from transports.guarded_reader import ForeignFileError, Limits, read_guarded
from transports.recording.record import ArrayFileError, load_array

__all__ = ["read_array", "read_in_child"]


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

    Raises
    ------
    SceneError
        With the file's name: the reader's error, or the end of its process. MachineLacks if its library is missing.
    """
    try:
        return {name: np.asarray(values) for name, values in read_guarded(reader, path, limits=limits).items()}
    except ForeignFileError as error:
        raise (MachineLacks if error.lacks else SceneError)(f"{path}: {error}") from None

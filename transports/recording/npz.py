"""NumPy `.npz` files: see `record` for what they hold. They are read in pieces, so that memory stays flat."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from firmware_protocol.edges import EDGE
from firmware_protocol.events import EVENT
from transports.recording.array_file import ArrayFileError, load_arrays
from transports.recording.part import Facts, Part, RecordingError
from transports.recording.record import Recorder

__all__ = ["NpzReader", "NpzWriter"]

_PIECE = 1 << 16  # records


class NpzWriter:
    """Writes events and edges; the file is there when it is closed, and until then the raw `.part` files are."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._recorder = Recorder(path, facts.size)

    def write(self, part: Part) -> None:
        """Append events, edges and IMU samples."""
        self._recorder.append(part)
        self._check()

    def close(self) -> None:
        """Make the archive."""
        self._recorder.close()
        self._check()

    def _check(self) -> None:
        if self._recorder.trouble:
            raise RecordingError(self._recorder.trouble)


class NpzReader:
    """Reads events and edges, the former from the last restart of the camera's clock on."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self._path = path
        try:
            starts = load_arrays(path, ("resets", "edge_resets", "size"))
        except ArrayFileError as error:
            raise RecordingError(str(error)) from error
        told = starts.get("size", np.zeros(0))
        known = (int(told[0]), int(told[1])) if told.shape == (2,) else size
        self.facts = Facts(known, "npz")
        self.restarts = {name: [int(i) for i in starts.get(name, ())] for name in ("resets", "edge_resets")}

    def parts(self) -> Iterator[Part]:
        """Yield events and edges in the order of time; both from where device time began anew for the last time."""
        edges = _Waiting(self._pieces("edges", EDGE, self.restarts["edge_resets"]))
        for events in self._pieces("events", EVENT, self.restarts["resets"]):
            yield Part(events, edges.until(int(events["t"][-1])))
        while len(rest := edges.until(1 << 63)):
            yield Part(edges=rest)

    def _pieces(self, name: str, dtype: np.dtype[np.void], starts: list[int]) -> Iterator[npt.NDArray[Any]]:
        with zipfile.ZipFile(self._path) as archive:
            if f"{name}.npy" not in archive.namelist():
                return
            with archive.open(f"{name}.npy") as file:
                count = _count(file, dtype)
                skipped = starts[-1] if starts else 0
                for n in _numbers(skipped):
                    file.read(n * dtype.itemsize)
                for n in _numbers(count - skipped):
                    data = file.read(n * dtype.itemsize)
                    whole = len(data) // dtype.itemsize
                    yield np.frombuffer(data, dtype, whole)
                    if whole < n:
                        raise RecordingError(f"its {name} are cut short")


class _Waiting:
    """Edges in the order of time, taken up to a time."""

    def __init__(self, pieces: Iterator[npt.NDArray[Any]]) -> None:
        self._pieces = pieces
        self._next = next(pieces, np.zeros(0, EDGE))

    def until(self, t_us: int) -> npt.NDArray[Any]:
        """Return some of the edges up to `t_us`; none is left when it returns none."""
        if not len(self._next):
            self._next = next(self._pieces, np.zeros(0, EDGE))
        n = int(np.searchsorted(self._next["t"], np.uint64(t_us), "right"))
        taken, self._next = self._next[:n], self._next[n:]
        return taken


def _numbers(count: int) -> Iterator[int]:
    for start in range(0, max(0, count), _PIECE):
        yield min(_PIECE, count - start)


def _count(file: Any, dtype: np.dtype[np.void]) -> int:
    try:
        npy.read_magic(file)
        shape, _, found = npy.read_array_header_1_0(file)
    except ValueError as error:
        raise RecordingError(f"it is damaged: {error}") from error
    if found != dtype or len(shape) != 1:
        raise RecordingError(f"it holds {found} of shape {shape}, not a list of {dtype}")
    return int(shape[0])

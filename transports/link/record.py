"""What was delivered, written to a file event by event.

The file is a NumPy `.npz`:

    events   EVENT[n]   in device time: microseconds since the device's clock was last zero
    resets   int64[k]   indices into `events` at which that clock started anew (a timestamp reset, or a new start)
    edges        EDGE[m]    what the external input told of, in device time
    edge_resets  int64[k]   indices into `edges` at the same restarts

A client's view after it reset the camera's timestamps is `events[resets[-1]:]`. While the run lasts the events lie in a
plain file beside it (`.part`), so that memory does not grow with the run and a killed run leaves its data.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import EDGE, Edges
from firmware_protocol.events import EVENT, Events
from transports.link.array_file import ArrayFileError, load_arrays

__all__ = ["Recorder", "load_edges", "load_record", "save_record"]


class Recorder:
    """Appends delivered events and edges; `close` makes the `.npz`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._events = _Part(path.with_suffix(path.suffix + ".part"))
        self._edges = _Part(path.with_suffix(path.suffix + ".edges.part"))

    def append(self, events: Events, *, edges: Edges | None = None, restarted: bool = False) -> None:
        """Add events and edges in device time; `restarted` when that time began anew before them."""
        if restarted or not self._events.resets:
            self._events.restart()
            self._edges.restart()
        self._events.append(events)
        if edges is not None:
            self._edges.append(edges)

    def close(self) -> None:
        """Write the `.npz` and remove the raw files."""
        events, edges = self._events.content(EVENT), self._edges.content(EDGE)
        with self.path.open("wb") as file:
            np.savez(
                file,
                events=events,
                resets=np.array(self._events.resets, np.int64),
                edges=edges,
                edge_resets=np.array(self._edges.resets, np.int64),
            )
        del events, edges
        self._events.remove()
        self._edges.remove()


class _Part:
    """One kind of record in a raw file, and at which of them time began anew."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BinaryIO = path.open("wb")
        self._count = 0
        self.resets: list[int] = []

    def restart(self) -> None:
        self.resets.append(self._count)

    def append(self, records: npt.NDArray[np.void]) -> None:
        self._file.write(records.tobytes())
        self._count += len(records)

    def content(self, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
        self._file.close()
        return np.memmap(self._path, dtype, "r") if self._count else np.zeros(0, dtype)

    def remove(self) -> None:
        self._path.unlink()


def save_record(path: Path, events: Events, resets: list[int]) -> None:
    """Write events (n,) in device time and the indices at which that time started anew; no edges."""
    with path.open("wb") as file:
        np.savez(file, events=events, resets=np.array(resets, np.int64))


def load_record(path: str | Path) -> tuple[Events, list[int]]:
    """Read a record: events (n,) EVENT in device time, and the indices at which device time started anew.

    Raises ArrayFileError with the file's name, or OSError where it cannot be opened.
    """
    return _load(Path(path), EVENT, "events", "resets")


def load_edges(path: Path) -> tuple[Edges, list[int]]:
    """Read a record's edges, (m,) EDGE in device time, and the indices at which device time started anew.

    Raises ArrayFileError with the file's name, or OSError where it cannot be opened.
    """
    return _load(path, EDGE, "edges", "edge_resets")


def _load(path: Path, dtype: np.dtype[np.void], name: str, resets: str) -> tuple[npt.NDArray[np.void], list[int]]:
    try:
        there = load_arrays(path, (name, resets))
        if name not in there and dtype == EDGE:  # records of events alone have none
            return np.zeros(0, EDGE), []
        records, starts = (there.get(key, np.zeros(0)) for key in (name, resets))
        if records.dtype != dtype or records.ndim != 1:
            raise ArrayFileError(f"its {name} are {records.dtype} of shape {records.shape}, not a list of {dtype}")
        if starts.ndim != 1 or (starts.size and (starts.dtype.kind not in "iu" or _outside(starts, len(records)))):
            raise ArrayFileError(f"its {resets} are no list of places among {len(records)} {name}")
        return records, [int(i) for i in starts]
    except ArrayFileError as error:
        raise ArrayFileError(f"{path}: cannot be read as a recording of evstim: {error}") from error


def _outside(starts: npt.NDArray[np.generic], count: int) -> bool:
    return int(starts.min()) < 0 or int(starts.max()) > count

"""NumPy `.npz` files: see `record` for their contents. They are read in pieces, so that memory stays constant."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from firmware_protocol.events import EDGE, EVENT
from transports.recording.part import IMU, Facts, Frame, Part, RecordingError
from transports.recording.record import ArrayFileError, Recorder, frame_record, load_arrays

__all__ = ["NpzReader", "NpzWriter"]

_PIECE_BYTES = 1 << 20
_MOST_EVENTS = 1 << 16  # of a part
_PART_US = 1_000_000
_FOREVER_US = (1 << 63) - 1
_NONE = np.zeros(0, np.int64)
_RESTARTS = {"events": "resets", "edges": "edge_resets", "imu": "imu_resets", "frames": "frame_resets"}


class NpzWriter:
    """Writer of all streams; the file is made when it is closed, and until then the raw `.part` files exist."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._recorder = Recorder(path, facts.size)

    def write(self, part: Part) -> None:
        """Append a part."""
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
    """Reader of a record, each stream from the last restart of the camera's clock on."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self._path = path
        try:
            arrays = load_arrays(path, (*_RESTARTS.values(), "size"))
            self._starts = {name: _last(arrays.get(key, _NONE)) for name, key in _RESTARTS.items()}
        except (ArrayFileError, ValueError, TypeError) as error:
            raise RecordingError(str(error)) from error
        told = arrays.get("size", np.zeros(0))
        known = (int(told[0]), int(told[1])) if told.shape == (2,) else size
        with zipfile.ZipFile(path) as archive:
            streams = {name for name in ("edges", "imu", "frames") if f"{name}.npy" in archive.namelist()}
        self.facts = Facts(known, "npz", streams=frozenset(streams))

    def parts(self) -> Iterator[Part]:
        """Yield the data in the order of time, at most a second of them at a time."""
        events, edges, imu, frames = (
            _Waiting(self._pieces(name, dtype), dtype)
            for name, dtype in zip(_RESTARTS, (EVENT, EDGE, IMU, frame_record(self.facts.size or (0, 0))), strict=True)
        )
        while (first_us := min(one.first_us for one in (events, edges, imu, frames))) < _FOREVER_US:
            until_us = first_us + _PART_US
            some = events.until(until_us, _MOST_EVENTS)
            until_us = min(until_us, int(some["t"][-1])) if len(some) == _MOST_EVENTS else until_us
            yield Part(some, edges.until(until_us), imu.until(until_us), _frames(frames.until(until_us)))
        if any(one.left for one in (events, edges, imu, frames)):
            raise RecordingError("it holds times beyond 2^63 us")

    def _pieces(self, name: str, dtype: np.dtype[np.void]) -> Iterator[npt.NDArray[Any]]:
        with zipfile.ZipFile(self._path) as archive:
            if f"{name}.npy" not in archive.namelist():
                return
            with archive.open(f"{name}.npy") as file:
                count, most = _count(file, dtype), max(1, _PIECE_BYTES // dtype.itemsize)
                for n in _numbers(self._starts[name], most):
                    file.read(n * dtype.itemsize)
                for n in _numbers(count - self._starts[name], most):
                    data = file.read(n * dtype.itemsize)
                    whole = len(data) // dtype.itemsize
                    yield np.frombuffer(data, dtype, whole)
                    if whole < n:
                        raise RecordingError(f"its {name} are cut short")


class _Waiting:
    """Queue of records in the order of time, taken up to a time."""

    def __init__(self, pieces: Iterator[npt.NDArray[Any]], dtype: np.dtype[np.void]) -> None:
        self._pieces = pieces
        self._none = np.zeros(0, dtype)
        self._next = next(pieces, self._none)

    @property
    def first_us(self) -> int:
        """Time of the next record; the largest time if none is left."""
        if not len(self._next):
            self._next = next(self._pieces, self._none)
        return int(self._next["t"][0]) if len(self._next) else _FOREVER_US

    @property
    def left(self) -> bool:
        """True if there are records after the latest possible time."""
        return len(self._next) > 0

    def until(self, t_us: int, most: int = 1 << 62) -> npt.NDArray[Any]:
        """Return at most `most` of the records up to `t_us`, in order."""
        taken = [self._none]
        while most > 0 and self.first_us <= t_us:
            due = int(np.count_nonzero(np.maximum.accumulate(self._next["t"].astype(np.int64)) <= t_us))
            n = min(due, most)
            taken.append(self._next[:n])
            self._next, most = self._next[n:], most - n
        return np.concatenate(taken)


def _last(starts: npt.NDArray[Any]) -> int:
    """Return the last of the indices at which the clock was restarted; 0 for none."""
    return int(starts.ravel()[-1]) if starts.size else 0


def _frames(records: npt.NDArray[Any]) -> tuple[Frame, ...]:
    return tuple(
        Frame(int(one["t"]), int(one["exposure_begin"]), int(one["exposure_end"]), one["pixels"]) for one in records
    )


def _numbers(count: int, most: int) -> Iterator[int]:
    for start in range(0, max(0, count), most):
        yield min(most, count - start)


def _count(file: Any, dtype: np.dtype[np.void]) -> int:
    try:
        npy.read_magic(file)
        shape, _, found = npy.read_array_header_1_0(file)
    except ValueError as error:
        raise RecordingError(f"it is damaged: {error}") from error
    if found != dtype or len(shape) != 1:
        raise RecordingError(f"it holds {found} of shape {shape}, not a list of {dtype}")
    return int(shape[0])

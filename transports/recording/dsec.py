"""HDF5 files in the layout of the DSEC data set: /events/{x, y, t, p}, /t_offset and /ms_to_idx.

Element k of `ms_to_idx` is the index of the first event at or after k milliseconds. `t_offset` is the Unix time of t =
0, us, or 0. The size of the sensor is in the attributes `width` and `height` of /events, which DSEC does not have.

HDF5 refuses a file that was cut. Followed by zeros it is opened if its lists of arrays and chunks are before the cut;
events are read as far as the chunks of all four arrays are.

Source: github.com/uzh-rpg/DSEC, "Data format".
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from firmware_protocol.events import make_events
from firmware_protocol.recordings.part import Facts, Part
from transports.recording.part import DamagedRecording, RecordingError, Size

_CHUNK = 1 << 16
_MS = 1000
_MOST_GROWTH = 1032  # of gzip; a chunk that was never written has no events
_FIELDS = {"x": "<u2", "y": "<u2", "t": "<u4", "p": "u1"}


class DsecWriter:
    """Writer of events to data sets that grow."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._file = h5py.File(path, "w")
        width, height = facts.size or (0, 0)
        group = self._file.create_group("events")
        group.attrs.update(width=width, height=height, camera=facts.camera)
        self._sets = {name: self._growing(f"events/{name}", dtype) for name, dtype in _FIELDS.items()}
        self._starts = self._growing("ms_to_idx", "<u8")
        self._file["t_offset"] = np.int64(facts.unix_us)
        self._count = 0

    def _growing(self, name: str, dtype: str) -> h5py.Dataset:
        options = {"chunks": (_CHUNK,), "compression": "gzip", "compression_opts": 1, "shuffle": True}
        return self._file.create_dataset(name, (0,), dtype, maxshape=(None,), **options)

    def write(self, part: Part) -> None:
        """Append the events."""
        events = part.events
        if not len(events):
            return
        first_ms = self._starts.shape[0]
        marks_us = np.arange(first_ms, int(events["t"][-1]) // _MS + 1, dtype=np.uint64) * np.uint64(_MS)
        _append(self._starts, np.searchsorted(events["t"], marks_us) + self._count)
        for name, data in self._sets.items():
            _append(data, events["on" if name == "p" else name])
        self._count += len(events)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _append(data: h5py.Dataset, values: np.ndarray) -> None:
    before = data.shape[0]
    data.resize(before + len(values), axis=0)
    data[before:] = values


class DsecReader:
    """Reader of /events in pieces."""

    def __init__(self, path: Path, size: Size | None) -> None:
        with contextlib.suppress(ImportError):
            __import__("hdf5plugin")  # the files of the data set itself are compressed by Blosc
        self._end, self._cut = path.stat().st_size, ""
        try:
            self._file = self._opened(path)
            self.facts = self._facts(size)
        except Exception as error:  # of any type where lists are missing
            if not self._cut:
                raise
            advice = "copy the file again, or record in a format that is read up to a cut, such as .aedat4 or .raw"
            raise DamagedRecording(f"{self._cut}: no array is known by what is before that; {advice}") from error

    def _opened(self, path: Path) -> h5py.File:
        try:
            return h5py.File(path, "r")
        except OSError as error:
            if (stored := re.search(r"stored_eof = (\d+)", str(error))) is None:
                raise
            self._cut = f"it is cut at octet {self._end} of {stored[1]}"
            return h5py.File(_Padded(path, int(stored[1])), "r")

    def _facts(self, size: Size | None) -> Facts:
        """Find the arrays and return the facts; raises RecordingError."""
        group = self._file.get("events")
        if not isinstance(group, h5py.Group) or not all(name in group for name in _FIELDS):
            raise RecordingError("it has no /events with x, y, t and p: HDF5 is read as the DSEC data set has it")
        self._sets = [group[name] for name in _FIELDS]
        if len({data.shape for data in self._sets}) != 1 or self._sets[0].ndim != 1:
            raise RecordingError("its x, y, t and p are no lists of the same length")
        if any(data.dtype.kind not in "iu" for data in self._sets[:3]):
            raise RecordingError("its x, y and t are no integers: t is read in us")
        if not self._cut:
            stored = sum(data.id.get_storage_size() for data in self._sets)
            if sum(data.nbytes for data in self._sets) > _MOST_GROWTH * stored:
                raise RecordingError(f"it is damaged: it claims {self._sets[0].size} events in {stored} bytes")
        size_in_file = (int(group.attrs.get("width", 0)), int(group.attrs.get("height", 0)))
        offset = int(self._file["t_offset"][()]) if "t_offset" in self._file else 0
        camera = str(group.attrs.get("camera", "dsec"))
        return Facts(size_in_file if all(size_in_file) else size, camera, max(0, offset), frozenset())

    def parts(self) -> Iterator[Part]:
        """Yield events."""
        count = self._sets[0].shape[0]
        stop = min(_rows_before(data, self._end) for data in self._sets) if self._cut else count
        with self._file:
            for start in range(0, stop, _CHUNK):
                x, y, t, p = (data[start : min(start + _CHUNK, stop)] for data in self._sets)
                is_wrong = (t < 0) | (x < 0) | (y < 0) | (np.maximum(x, y) > np.iinfo(np.uint16).max)
                sound = int(np.append(is_wrong, True).argmax())
                yield Part(make_events(t[:sound], x[:sound], y[:sound], p[:sound] > 0))
                if sound < len(t):
                    event = f"event {start + sound} at {t[sound]} us, ({x[sound]}, {y[sound]})"
                    raise RecordingError(f"it is damaged: {event}, cannot be")
        if self._cut:
            raise RecordingError(f"{self._cut}: the first {stop} of its {count} events are before that")


def _rows_before(data: h5py.Dataset, end: int) -> int:
    """Return the number of first elements of a list that are stored before octet `end`."""
    count = int(data.shape[0])
    if data.chunks is None:
        start = data.id.get_offset()
        return 0 if start is None else min(count, max(0, end - start) // data.dtype.itemsize)
    for first in range(0, count, data.chunks[0]):
        try:
            chunk = data.id.get_chunk_info_by_coord((first,))
        except (OSError, RuntimeError, ValueError):  # its list is cut
            return first
        if chunk.byte_offset is None or chunk.byte_offset + chunk.size > end:
            return first
    return count


class _Padded(io.FileIO):
    """File of `size` octets: those of a file, and zeros."""

    def __init__(self, path: Path, size: int) -> None:
        super().__init__(path)
        self._size = size

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return super().seek(self._size + offset) if whence == os.SEEK_END else super().seek(offset, whence)

    def readinto(self, buffer: Any) -> int:
        read = super().readinto(buffer) or 0
        buffer[read:] = bytes(len(buffer) - read)
        self.seek(len(buffer) - read, os.SEEK_CUR)
        return len(buffer)

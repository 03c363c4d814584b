"""The `.npz` record of what was delivered, written event by event.

    events   EVENT[n]   in device time: microseconds since the device's clock was last zero
    resets   int64[k]   indices into `events` at which that clock started anew (a timestamp reset, or a new start)
    edges        EDGE[m]    edges on the external input, in device time, sorted between two restarts
    edge_resets  int64[k]   indices into `edges` at the same restarts
    imu          IMU[j]     samples of the inertial unit, see `part`; and imu_resets, as for edges
    size         int64[2]   width and height of the sensor, where they are known
    frames       frame_record[f]   where there are any: times, and pixels of 10 bits; 0 outside a region of interest;
                                   and frame_resets, as for edges

A client's view after it reset the camera's timestamps is `events[resets[-1]:]`. While the run lasts the events lie in a
plain file beside it (`.part`), so that memory does not grow with the run and a killed run leaves its data. A record
that can be written no more (a full disk) stops, and its link goes on: see `Recorder.trouble`.

Arrays from `.npy` and `.npz` files of unknown origin, checked before memory is taken for them.

The header of an array may claim any size. It is compared with the bytes that are there before any are read, and a
compressed member of an `.npz` may grow to 100 times its size in the file, or to 64 MiB. Objects (pickles) are refused.

Source of the format: NEP 1, `numpy.lib.format`.

`NpzWriter` and `NpzReader` are those of the format "npz": a record is read in pieces, so that memory stays constant.
The directory of an archive is at its end: of one that was cut, `_CutArchive` finds the members by their local headers.
`RawEvents` recovers the raw events of a run that was killed.
"""

from __future__ import annotations

import math
import os
import re
import struct
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from firmware_protocol.events import EDGE, EVENT, Events, make_events
from firmware_protocol.recordings.part import IMU, Facts, Frame, Part, RecordingSummary
from transports.output_file import OutputFile
from transports.recording.part import DamagedRecording, RecordingError, Size

_MOST_GROWTH = 100
_ALWAYS_BYTES = 1 << 26
_PIECE_BYTES = 1 << 24

_Array = npt.NDArray[Any]


class ArrayFileError(ValueError):
    """Error: the file is not a readable array file; the message gives the reason, without the file's name."""


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
            return _members(archive, names)
    except (ArrayFileError, OSError):
        raise
    except Exception as error:  # zipfile raises errors of any type for a damaged archive
        raise ArrayFileError(_UNSOUND + _text_of(error)) from error


_UNSOUND = "it is no sound .npz archive: "


def _members(archive: zipfile.ZipFile, names: Iterable[str]) -> dict[str, _Array]:
    """Read those of the named arrays that an archive has."""
    members = set(archive.namelist())
    return {name: _member(archive, f"{name}.npy") for name in names if f"{name}.npy" in members}


def _require_regular(path: Path) -> None:
    if path.exists() and not path.is_file():
        raise ArrayFileError("it is no regular file")


def _member(archive: zipfile.ZipFile, name: str) -> _Array:
    info = archive.getinfo(name)
    limit_bytes = max(_ALWAYS_BYTES, _MOST_GROWTH * info.compress_size)
    if info.compress_type != zipfile.ZIP_STORED and info.file_size > limit_bytes:
        raise ArrayFileError(
            f"{name} would grow from {info.compress_size} to {info.file_size} bytes, beyond {_MOST_GROWTH} times"
        )
    size = info.file_size
    if info.compress_type == zipfile.ZIP_STORED and archive.fp is not None:
        size = min(size, os.fstat(archive.fp.fileno()).st_size)
    with archive.open(info) as file:
        return _array(file, size)


def _array(file: IO[bytes], size: int) -> _Array:
    """Read one array from a file that holds `size` bytes from its present place on, which is its start."""
    shape, is_fortran, dtype = _header(file)
    if dtype.hasobject:
        raise ArrayFileError("it holds Python objects, which are never read; numbers are needed")
    claimed_bytes = math.prod(shape) * dtype.itemsize
    following_bytes = size - file.tell()
    if claimed_bytes > following_bytes:
        raise ArrayFileError(
            f"its header has shape {shape} of {dtype}, {claimed_bytes} bytes, and {following_bytes} follow: "
            "it is cut short or damaged"
        )
    try:
        array = np.frombuffer(_content(file, claimed_bytes), dtype)
        return array.reshape(shape, order="F" if is_fortran else "C")
    except (ValueError, TypeError) as error:
        raise ArrayFileError(
            f"its header has shape {shape} of {dtype}, which is no array: {_text_of(error)}"
        ) from error


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
    except Exception as error:  # the header is Python text: its parser raises errors of any type
        raise ArrayFileError(f"its header is no header of an array: {_text_of(error)}") from error
    if any(n < 0 for n in shape):
        raise ArrayFileError(f"its header has shape {shape}: sizes are not negative")
    return shape, is_fortran, dtype


def _content(file: IO[bytes], count: int) -> bytearray:
    """Return exactly `count` bytes, read in pieces: a member of an archive may contain fewer than its header gives."""
    content = bytearray()
    while len(content) < count:
        piece = file.read(min(_PIECE_BYTES, count - len(content)))
        if not piece:
            raise ArrayFileError(f"it ends after {len(content)} of {count} bytes")
        content += piece
    return content


def _text_of(error: Exception) -> str:
    return f"{error}"[:200] or type(error).__name__


def frame_record(size: tuple[int, int]) -> np.dtype[np.void]:
    """Return the dtype of a frame of a sensor of `size` = (width, height); times in us of device time."""
    times = [(name, "<i8") for name in ("t", "exposure_begin", "exposure_end")]
    return np.dtype([*times, ("pixels", "<u2", (size[1], size[0]))])


def _frame(frame: Frame, size: tuple[int, int]) -> npt.NDArray[np.void]:
    record = np.zeros(1, frame_record(size))
    record["t"] = frame.t_us
    record["exposure_begin"], record["exposure_end"] = frame.exposure_begin_us, frame.exposure_end_us
    (column, row), (rows, columns) = frame.origin, frame.pixels.shape
    record["pixels"][0, row : row + rows, column : column + columns] = frame.pixels
    return record


class Recorder:
    """Recorder of delivered data; `close` makes the `.npz`. Only the constructor raises OSError."""

    def __init__(self, path: Path, size: Size | None = None) -> None:
        self.path = path
        self._size = size
        self._events = _Raw(path.with_suffix(path.suffix + ".part"), EVENT)
        self._edges = _Raw(path.with_suffix(path.suffix + ".edges.part"), EDGE)
        self._imu = _Raw(path.with_suffix(path.suffix + ".imu.part"), IMU)
        self._kept = [self._events, self._edges, self._imu]
        self._frames: _Raw | None = None
        self._frames_left_out = 0  # the size of the sensor is not known
        self._closed = False

    @property
    def trouble(self) -> str:
        """Reason for an incomplete record, for people; empty if it is complete."""
        return next((kept.trouble for kept in self._kept if kept.trouble), "")

    @property
    def summary(self) -> RecordingSummary:
        """Summary of the closed file."""
        if not self._closed:
            return RecordingSummary("NumPy", (str(self._events.path),))
        frames = 0 if self._frames is None else self._frames.count
        written = Counter(events=self._events.count, edges=self._edges.count, imu=self._imu.count, frames=frames)
        left_out = Counter(frames=self._frames_left_out)
        return RecordingSummary("NumPy", (str(self.path),), dict(+written), dict(+left_out), self.trouble, closed=True)

    def append(self, part: Part, *, restarted: bool = False, unix_us: int | None = None) -> None:
        """Add a part in device time; `restarted`: the clock restarted before it. There is no field for `unix_us`."""
        if self.trouble:
            return
        if restarted or not self._events.resets:
            for kept in self._kept:
                kept.restart()
        for kept, records in zip(self._kept, (part.events, part.edges, part.imu), strict=False):
            kept.append(records)
        if part.frames and self._size is not None:
            self._add_frames(part.frames, self._size)
        elif part.frames:
            self._frames_left_out += len(part.frames)

    def reach(self, t_us: int) -> None:
        """Do nothing: no data wait here."""

    def _add_frames(self, frames: tuple[Frame, ...], size: tuple[int, int]) -> None:
        if self._frames is None:
            self._frames = _Raw(self.path.with_suffix(self.path.suffix + ".frames.part"), frame_record(size))
            self._frames.resets = [0] * len(self._events.resets)
            self._kept.append(self._frames)
        self._frames.append(np.concatenate([_frame(frame, size) for frame in frames]))

    def close(self) -> None:
        """Write the `.npz` and remove the raw files, which stay if that is not possible."""
        self._closed = True
        for kept in self._kept:
            kept.close()
        if self.trouble:
            return
        try:
            self._write()
        except OSError as error:
            self._events.stop(error)
            self.path.unlink(missing_ok=True)  # half an archive is of no use, and the raw files have it all
            return
        for kept in self._kept:
            kept.remove()

    def _write(self) -> None:
        frames: dict[str, Any] = {}
        if self._frames is not None:
            frames = {"frames": self._frames.content(), "frame_resets": np.array(self._frames.resets, np.int64)}
        with self.path.open("wb") as file:
            np.savez(
                file,
                events=self._events.content(),
                resets=np.array(self._events.resets, np.int64),
                edges=self._edges.sorted_content(),
                edge_resets=np.array(self._edges.resets, np.int64),
                imu=self._imu.content(),
                imu_resets=np.array(self._imu.resets, np.int64),
                size=np.array(self._size or (), np.int64),
                **frames,
            )


class _Raw:
    """One kind of record in a raw file, and the indices of clock restarts; `count`: the records that were written."""

    def __init__(self, path: Path, dtype: np.dtype[np.void]) -> None:
        self.path = path
        self._file = OutputFile(path, "record")
        self._dtype = dtype
        self.count = 0
        self.resets: list[int] = []
        self.stop, self.close = self._file.stop, self._file.close

    @property
    def trouble(self) -> str:
        return self._file.trouble

    def restart(self) -> None:
        self.resets.append(self.count)

    def append(self, records: npt.NDArray[np.void]) -> None:
        if len(records) and self._file.write(np.ascontiguousarray(records).data):
            self.count += len(records)

    def content(self) -> npt.NDArray[np.void]:
        return np.memmap(self._file.path, self._dtype, "r") if self.count else np.zeros(0, self._dtype)

    def sorted_content(self) -> npt.NDArray[np.void]:
        """Return the records, those between two restarts in the order of time."""
        content = self.content()
        starts = np.zeros(len(content), np.int64)
        np.add.at(starts, [k for k in self.resets if k < len(content)], 1)
        order = np.lexsort((content["t"], np.cumsum(starts)))
        return content if bool((np.diff(order) == 1).all()) else content[order]

    def remove(self) -> None:
        self._file.path.unlink()


def load_record(path: str | Path) -> tuple[Events, list[int]]:
    """Read a record: (n,) EVENT in device time, and indices of clock restarts. Raises ArrayFileError, OSError."""
    try:
        arrays = load_arrays(Path(path), ("events", "resets"))
        events, starts = (arrays.get(key, np.zeros(0)) for key in ("events", "resets"))
        if events.dtype != EVENT or events.ndim != 1:
            raise ArrayFileError(f"its events are {events.dtype} of shape {events.shape}, not a list of {EVENT}")
        is_list = starts.ndim == 1 and (not starts.size or starts.dtype.kind in "iu")
        if not is_list or (starts.size and not 0 <= int(starts.min()) <= int(starts.max()) <= len(events)):
            raise ArrayFileError(f"its resets are no list of places among {len(events)} events")
        return events, [int(i) for i in starts]
    except ArrayFileError as error:
        raise ArrayFileError(f"{path}: cannot be read as a recording of evstim: {error}") from error


_NPZ_PIECE_BYTES = 1 << 20
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


_SEQUENCE = {"t": "<u8", "x": "<u2", "y": "<u2", "p": "u1"}
"""Arrays of the events of a sequence of `evstim dataset`, below "events/"."""


_LOCAL = struct.Struct("<4s4xH4xIIIHH")
_SIZES = struct.Struct("<4xQQ")  # of the extra field, where sizes have 64 bits


class _CutArchive(zipfile.ZipFile):
    """Archive by the local headers of its members; `cut` is the name of the last one where its end is missing."""

    cut = ""

    def _RealGetContents(self) -> None:  # by which ZipFile reads its directory
        file: Any = self.fp
        end, at = file.seek(0, os.SEEK_END), file.seek(0)
        while not self.cut and len(head := file.read(_LOCAL.size)) == _LOCAL.size and head.startswith(b"PK\x03\x04"):
            _, method, crc, packed, size, name_length, extra_length = _LOCAL.unpack(head)
            member = zipfile.ZipInfo(file.read(name_length).decode())
            extra = file.read(extra_length)
            if packed == 0xFFFFFFFF and len(extra) >= _SIZES.size:
                size, packed = _SIZES.unpack_from(extra)
            left = max(0, end - file.tell())
            if 0 < packed <= left:
                member.CRC = crc
            else:  # 0: it was not closed
                self.cut = member.filename.removesuffix(".npy")
                packed, size = left, 1 << 62
            member.header_offset, member.compress_type = at, method
            member.compress_size, member.file_size = packed, size
            self.filelist.append(member)
            at = file.seek(packed, os.SEEK_CUR)
        self.NameToInfo = {member.filename: member for member in self.filelist if member.filename}
        if not self.NameToInfo:
            raise zipfile.BadZipFile("it has neither a directory nor a member")


class NpzReader:
    """Reader of a record, each stream from the last restart of the camera's clock on, or of a data set's sequence."""

    def __init__(self, path: Path, size: Size | None) -> None:
        self._damage, cut = "", ""
        archive: zipfile.ZipFile | None = None
        try:
            with suppress(Exception):  # of any type for a damaged directory
                self._archive = archive = zipfile.ZipFile(path)
            if archive is None:
                self._archive = archive = _CutArchive(path)
                cut = archive.cut
                self._damage = f"it is cut at octet {path.stat().st_size}, in {cut or 'its directory'}"
            names = {name.removesuffix(".npy") for name in archive.namelist()}
            arrays = _members(archive, {*_RESTARTS.values(), "size"} - {cut})
            restarts = {name: arrays.get(key, _NONE).ravel() for name, key in _RESTARTS.items()}
            self._starts = {name: int(indices[-1]) if indices.size else 0 for name, indices in restarts.items()}
            pictures = {name for name in names if re.fullmatch("pictures/(light|depth|flow|labels)", name)} - {cut}
            if pictures:
                with archive.open(f"{min(pictures)}.npy") as file:
                    _, height, width = (*_header(file)[0], 0, 0, 0)[:3]
                size = (width, height) if width and height else size
        except (ArrayFileError, OSError) as error:
            raise RecordingError(str(error)) from error
        except Exception as error:
            raise RecordingError(_UNSOUND + _text_of(error)) from error
        stored = arrays.get("size", np.zeros(0))
        if stored.shape == (2,):
            size = int(stored[0]), int(stored[1])
        missing = [f"events/{name}" for name in _SEQUENCE if f"events/{name}" not in names]
        self._is_sequence = "events" not in names
        if self._is_sequence and missing:
            parts = f"a record has events; a sequence of `evstim dataset` lacks {', '.join(missing)}"
            only = f"it holds no events, only {', '.join(sorted(names)[:9]) or 'nothing'}: {parts}"
            if self._damage:
                raise DamagedRecording(f"{self._damage}; before that {only}")
            raise RecordingError(only)
        if self._damage and "resets" not in arrays:
            self._damage += "; where its clock was restarted is behind the cut"
        self.facts = Facts(size, "npz", streams=frozenset({"edges", "imu", "frames"} & names))

    def parts(self) -> Iterator[Part]:
        """Yield the data in the order of time, at most a second of them at a time."""
        queues = [
            _Waiting(self._pieces(name, dtype), dtype)
            for name, dtype in zip(_RESTARTS, (EVENT, EDGE, IMU, frame_record(self.facts.size or (0, 0))), strict=True)
        ]
        events, edges, imu, frames = queues
        while (first_us := min(queue.first_us for queue in queues)) < _FOREVER_US:
            until_us = first_us + _PART_US
            due = events.until(until_us, _MOST_EVENTS)
            until_us = min(until_us, int(due["t"][-1])) if len(due) == _MOST_EVENTS else until_us
            yield Part(due, edges.until(until_us), imu.until(until_us), _frames(frames.until(until_us)))
        if any(queue.left for queue in queues):
            raise RecordingError("it holds times beyond 2^63 us")
        if self._damage:
            raise RecordingError(self._damage)

    def _sequence(self) -> Iterator[Events]:
        """Yield the events of a sequence."""
        with ExitStack() as stack:
            files = {name: stack.enter_context(self._archive.open(f"events/{name}.npy")) for name in _SEQUENCE}
            counts = {_count(files[name], np.dtype(dtype)) for name, dtype in _SEQUENCE.items()}
            if len(counts) != 1:
                raise RecordingError("its events/t, x, y and p are not of the same length")
            for n in _piece_counts(counts.pop(), EVENT):
                content = {name: files[name].read(n * np.dtype(dtype).itemsize) for name, dtype in _SEQUENCE.items()}
                complete = min(len(content[name]) // np.dtype(dtype).itemsize for name, dtype in _SEQUENCE.items())
                t, x, y, p = (np.frombuffer(content[name], _SEQUENCE[name], complete) for name in "txyp")
                yield make_events(t, x, y, p > 0)
                if complete < n:
                    raise RecordingError("its events are cut short")

    def _pieces(self, name: str, dtype: np.dtype[np.void]) -> Iterator[npt.NDArray[Any]]:
        """Yield the records of a stream, in a file that is cut those before the cut."""
        try:
            yield from self._sequence() if name == "events" and self._is_sequence else self._records(name, dtype)
        except Exception:  # zipfile raises errors of any type
            if not self._damage:
                raise

    def _records(self, name: str, dtype: np.dtype[np.void]) -> Iterator[npt.NDArray[Any]]:
        if f"{name}.npy" not in self._archive.namelist():
            return
        with self._archive.open(f"{name}.npy") as file:
            count = _count(file, dtype)
            for n in _piece_counts(self._starts[name], dtype):
                file.read(n * dtype.itemsize)
            for n in _piece_counts(count - self._starts[name], dtype):
                data = file.read(n * dtype.itemsize)
                whole_records = len(data) // dtype.itemsize
                yield np.frombuffer(data, dtype, whole_records)
                if whole_records < n:
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

    def until(self, t_us: int, limit: int = 1 << 62) -> npt.NDArray[Any]:
        """Return at most `limit` of the records up to `t_us`, in order."""
        taken = [self._none]
        while limit > 0 and self.first_us <= t_us:
            due = int(np.count_nonzero(np.maximum.accumulate(self._next["t"].astype(np.int64)) <= t_us))
            n = min(due, limit)
            taken.append(self._next[:n])
            self._next = self._next[n:]
            limit -= n
        return np.concatenate(taken)


def _frames(records: npt.NDArray[Any]) -> tuple[Frame, ...]:
    return tuple(
        Frame(int(record["t"]), int(record["exposure_begin"]), int(record["exposure_end"]), record["pixels"])
        for record in records
    )


def _piece_counts(count: int, dtype: np.dtype[np.void]) -> Iterator[int]:
    """Yield the number of records of each piece in which `count` records are read."""
    records = max(1, _NPZ_PIECE_BYTES // dtype.itemsize)
    for start in range(0, max(0, count), records):
        yield min(records, count - start)


def _count(file: Any, dtype: np.dtype[np.void]) -> int:
    try:
        shape, _, dtype_in_file = _header(file)
    except ArrayFileError as error:
        raise RecordingError(f"it is damaged: {error}") from error
    if dtype_in_file != dtype or len(shape) != 1:
        raise RecordingError(f"it holds {dtype_in_file} of shape {shape}, not a list of {dtype}")
    return int(shape[0])


class RawEvents:
    """Reader of the `.part` file of an `.npz` record whose run was killed, from the last clock restart on."""

    def __init__(self, path: Path, size: Size | None) -> None:
        self.facts = Facts(size, "record", streams=frozenset())
        self._path = path

    def parts(self) -> Iterator[Part]:
        """Yield the whole events; if time goes back, the clock was restarted, and earlier events are omitted."""
        count = self._path.stat().st_size // EVENT.itemsize
        if not count:
            return
        events = np.memmap(self._path, EVENT, "r", shape=(count,))
        step = _NPZ_PIECE_BYTES // EVENT.itemsize
        back = [
            int(k) + start + 1
            for start in range(0, count, step)
            for k in np.flatnonzero(np.diff(events["t"][start : start + step + 1].astype(np.int64)) < 0)
        ]
        for start in range(back[-1] if back else 0, count, step):
            yield Part(np.array(events[start : start + step]))

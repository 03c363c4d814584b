"""The layout of a truth file, HDF5, version 1.

    /                   attributes    format "evstim-truth", version, evstim, rig, title, seed, camera, width, height,
                                      unix_us, light_unit, absent, complete, missing_pictures, missing_events
                                      and, where the scene is seen through a lens: focal_px, centre_px,
                                      distortion (k1 k2 p1 p2 k3), radiance_per_light
    /t_offset           () i8, us                   always 0: times of events are whole (as in DSEC)
    /ms_to_idx          (k,) u8                     first event from millisecond j on (as in DSEC), at the end
    /labels/name        (b + 1,) text               name of each label; 0 is "sky"
    /poses/t            (m,) f8, us                 every light frame of the run
          /camera_position_m            (m, 3) f8         in the world
          /camera_q_world_from_camera   (m, 4) f8         scalar first; camera axes x right, y down, z out
          /bodies_position_m            (m, b, 3) f8      body k - 1 has label k
          /bodies_q_world_from_body     (m, b, 4) f8
    /pictures/t         (n,) f8, us                 25 light frames a second, or every n-th
             /light     (n, height, width) f4       what the sensor gets, linear, 1 at the sensor's reference
             /depth     (n, height, width) f4, m    along the boresight (z); inf: sky
             /flow      (n, height, width, 2) f4    px/s to the right and down, of the point at the pixel's middle
             /labels    (n, height, width) u2       what the pixel's middle shows
    /events/t           (e,) u8, us                 as the sensor reads them out
           /x  /y       (e,) u2                     column, row; (0, 0) is the upper left pixel
           /p           (e,) u1                     1: brighter
           /origin      (e,) u1, an HDF5 enum       what raised it: unknown, signal, leak, noise, background, particle
           /label       (e,) u2                     of its pixel in the nearest of /pictures, before or after it
    /clean_events/t  /x  /y  /p  /label             of an ideal sensor of the same thresholds on the same light

All times are microseconds of stream time: the camera's own time where its clock has no error and is not reset.
The world is right-handed, in metres; q_world_from_x turns coordinates along the axes of x into those along the world's.
Quantities that a scene does not have, or that were not selected, are no data set; `absent` contains the reason of the
former. While it is written, and after its writer was killed, the file opens as h5py.File(path, swmr=True).

A separate process compresses the rows and waits for the disk (see `transports.recording.writer_process`). A message to
it is a mapping of data sets to rows that are added to them; the last one contains attributes of the file. A run that is
not paced waits for room in its queue; in one that is, rows without room are left out of the file and counted.

`evstim info` reads a truth file in a child process (see `guarded_reader`), because HDF5 may crash on a damaged file.
"""

from __future__ import annotations

import dataclasses
import math
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import numpy.typing as npt

from emulator.run.truth.origins import Origin
from transports.guarded_reader import ForeignFileError, Limits, decoded, encoded, read_guarded
from transports.recording.writer_process import WriterProcess, serve_writer

if TYPE_CHECKING:
    import h5py


FORMAT, VERSION = "evstim-truth", 1
LAYERS = ("light", "depth", "flow", "labels", "poses", "clean_events")

_CHUNK_BYTES = 1 << 15
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
_EVENTS = {"t": "<u8", "x": "<u2", "y": "<u2", "p": "u1"}


@dataclass(frozen=True)
class About:
    """Description of the run in a truth file.

    Attributes
    ----------
    size : (width, height).
    names : of the labels from 1 on.
    layers : what is written beside the events, of `LAYERS`.
    facts : attributes of the file.
    """

    size: tuple[int, int]
    names: Sequence[str] = ()
    layers: Sequence[str] = LAYERS
    facts: Mapping[str, Any] = field(default_factory=dict)


def create(path: Path, about: About) -> h5py.File:
    """Return a new file with all its data sets, empty, which others may read while it grows; raises OSError."""
    import h5py

    file = h5py.File(path, "w", libver="latest")
    file.attrs.update(format=FORMAT, version=VERSION, **about.facts)
    file.attrs.update(complete=False, missing_pictures=0, missing_events=0)
    width, height = about.size
    names = np.array(["sky", *about.names], h5py.string_dtype())
    file.create_dataset("labels/name", data=names)  # by file["labels/name"] = the group would store the time
    bodies, picture = len(about.names), (height, width)
    if "poses" in about.layers:
        _poses(file, bodies)
    _rows(file, "pictures/t", (), "<f8", unit="us")
    if "light" in about.layers:
        _rows(file, "pictures/light", picture, "<f4", unit="1 at the sensor's reference, linear")
    if "depth" in about.layers:
        _rows(file, "pictures/depth", picture, "<f4", unit="m along the boresight; inf: sky")
    if "flow" in about.layers:
        _rows(file, "pictures/flow", (*picture, 2), "<f4", unit="px/s, to the right and down")
    if "labels" in about.layers:
        _rows(file, "pictures/labels", picture, "<u2")
    _events(file, about)
    file.swmr_mode = True
    return file


def _poses(file: h5py.File, bodies: int) -> None:
    _rows(file, "poses/t", (), "<f8", unit="us")
    _rows(file, "poses/camera_position_m", (3,), "<f8")
    _rows(file, "poses/camera_q_world_from_camera", (4,), "<f8", unit="w x y z")
    if bodies:
        _rows(file, "poses/bodies_position_m", (bodies, 3), "<f8")
        _rows(file, "poses/bodies_q_world_from_body", (bodies, 4), "<f8", unit="w x y z")


def _events(file: h5py.File, about: About) -> None:
    import h5py

    for group in ("events", "clean_events") if "clean_events" in about.layers else ("events",):
        for name, kind in _EVENTS.items():
            _rows(file, f"{group}/{name}", (), kind)
        if "labels" in about.layers:
            _rows(file, f"{group}/label", (), "<u2")
        file[group].attrs.update(width=about.size[0], height=about.size[1])
    codes = {origin.name.lower(): int(origin) for origin in Origin}
    _rows(file, "events/origin", (), h5py.enum_dtype(codes, basetype="u1"))


def _rows(file: h5py.File, name: str, shape: tuple[int, ...], kind: Any, unit: str = "") -> None:
    """Make a data set of rows of this shape that grows; a large light frame is a chunk of its own."""
    chunk = max(1, _CHUNK_BYTES // (math.prod(shape) * np.dtype(kind).itemsize))
    data = file.create_dataset(name, (0, *shape), kind, maxshape=(None, *shape), chunks=(chunk, *shape), **_PACKED)
    if unit:
        data.attrs["unit"] = unit


Rows = Mapping[str, npt.NDArray[Any]]
"""Rows to add, by the path of their data set."""

_CAPACITY_BYTES = 1 << 28
_CLOSE_S = 60.0  # a full queue is written in some seconds


class TruthRecorder:
    """Writer of rows to `path`, whose `put` waits for room where `waits` is True; only the constructor raises OSError.

    Attributes
    ----------
    missing_pictures, missing_events : rows that found no room.
    """

    def __init__(self, path: Path, about: About, *, waits: bool) -> None:
        self.path, self._waits = path, waits
        self.missing_pictures = self.missing_events = 0
        order = {"path": str(path), **dataclasses.asdict(about)}
        self._writer = WriterProcess(f"{__name__}:write_file", order, _CAPACITY_BYTES)
        self._closed = False

    @property
    def trouble(self) -> str:
        """Reason why the file is not complete, for people; "" where it is."""
        if reason := self._writer.report.get("trouble"):
            return f"truth stopped: {reason} ({self.path})"
        if self.missing_pictures or self.missing_events:
            lost = f"{self.missing_pictures} pictures and {self.missing_events} events"
            return f"truth lacks {lost}: they came faster than they could be written ({self.path})"
        return ""

    def put(self, rows: Rows) -> None:
        """Add rows."""
        if not self._writer.put([b"".join(encoded(rows))], wait=self._waits):
            self.missing_pictures += len(rows.get("pictures/t", ()))
            self.missing_events += len(rows.get("events/t", ()))

    def close(self) -> None:
        """Wait for the writer to finish the file, and receive its report; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        facts = {"missing_pictures": self.missing_pictures, "missing_events": self.missing_events}
        attributes = {**facts, "complete": not any(facts.values())}
        self._writer.close(_CLOSE_S, [b"".join(encoded({"attributes": attributes}))])


_FLUSH_US = 500_000.0  # of stream time: by the wall clock, runs would lay out the same rows differently


def write_file(order: Mapping[str, Any]) -> NoReturn:
    """Write the messages on stdin to the file of an order, in a process of its own.

    HDF5 has no journal; in its mode for one writer and many readers (SWMR) a file stays readable up to the last flush
    if this process is killed.
    """
    path = Path(order["path"])
    about = About(tuple(order["size"]), order["names"], order["layers"], order["facts"])
    serve_writer(lambda: create(path, about), lambda file: _write(file, path), lambda file: {})
    os._exit(0)  # without the library's clean-up, which would try to write failed data once more


def _write(file: h5py.File, path: Path) -> None:
    """Write all messages, then the attributes of the last one."""
    import h5py

    counted: list[tuple[Any, Any]] = []
    attributes = _write_rows(file, counted)
    file.close()
    with h5py.File(path, "r+") as closed:  # neither attributes nor new data sets while others may read
        closed.attrs.update(attributes)
        closed["t_offset"], closed["ms_to_idx"] = np.int64(0), _first_of_each_ms(counted)


def _write_rows(file: h5py.File, counted: list[tuple[Any, Any]]) -> Mapping[str, Any]:
    """Add all rows, and milliseconds with their numbers of events to `counted`: to read all again may take minutes.

    Return the attributes of the last message, {} where the run was killed before it.
    """
    flushed_us = 0.0
    sets: dict[str, h5py.Dataset] = {}  # open to the end: h5py ignores a full disk at their close, then flush crashes
    while (rows := decoded(sys.stdin.buffer.read)) is not None:
        if "attributes" in rows:
            return rows["attributes"]  # type: ignore[no-any-return]
        for name, values in rows.items():
            data = sets[name] = sets.get(name) or file[name]
            before = len(data)
            data.resize(before + len(values), axis=0)
            data[before:] = values
            if name == "events/t":
                counted.append(np.unique(values // 1000, return_counts=True))
        t_us = rows.get("poses/t", rows.get("pictures/t", (flushed_us,)))[-1]
        if t_us - flushed_us >= _FLUSH_US:
            file.flush()
            flushed_us = t_us
    return {}


def _first_of_each_ms(counted: Sequence[tuple[Any, Any]]) -> npt.NDArray[np.uint64]:
    """Return for each millisecond, up to that of the last event, the number of events before it."""
    events = np.zeros(1 + max((int(ms[-1]) for ms, _ in counted if len(ms)), default=-1), np.uint64)
    for ms, numbers in counted:
        events[ms] += numbers.astype(np.uint64)
    return np.cumsum(events) - events


_MAGIC = b"\x89HDF\r\n\x1a\n"
_LIMITS = Limits(memory_bytes=1 << 31, cpu_s=120)
_CHUNK = 1 << 20


def truth_in(path: Path) -> dict[str, Any] | None:
    """Return the content of a truth file; None where it is none, or cannot be read."""
    if not path.is_file():
        return None
    with suppress(OSError, ForeignFileError), path.open("rb") as file:
        if file.read(len(_MAGIC)) == _MAGIC:
            return read_guarded(f"{__name__}:survey", path, limits=_LIMITS) or None
    return None


def survey(path: Path) -> dict[str, Any]:
    """Return the attributes of a truth file and the numbers of its rows; {} for another file. In the child process."""
    import h5py

    try:
        file = h5py.File(path, "r")
    except OSError:  # its writer still has it, or was killed
        file = h5py.File(path, "r", swmr=True)
    with file:
        if file.attrs.get("format") != FORMAT:
            return {}
        plain = {name: value for name, value in file.attrs.items() if getattr(value, "ndim", 0) == 0}
        facts = {name: value.item() if hasattr(value, "item") else value for name, value in plain.items()}
        counts = {group: len(file[f"{group}/t"]) if group in file else 0 for group in ("events", "clean_events")}
        return {
            **facts,
            **counts,
            "poses": len(file["poses/t"]) if "poses" in file else 0,
            "pictures": len(file["pictures/t"]),
            "of_each_picture": sorted(set(file["pictures"]) - {"t"}),
            "seconds": float(file["pictures/t"][-1]) * 1e-6 if len(file["pictures/t"]) else 0.0,
            "names": [name.decode() for name in file["labels/name"][:]],
            "origins": _counted(file["events/origin"]),
        }


def _counted(codes: Any) -> dict[str, int]:
    """Return the number of events of each origin, without the origins that have none."""
    import h5py

    names = {code: name for name, code in h5py.check_enum_dtype(codes.dtype).items()}
    counts = np.zeros(256, np.int64)
    for start in range(0, len(codes), _CHUNK):
        counts += np.bincount(codes[start : start + _CHUNK], minlength=256)
    return {names.get(code, str(code)): int(counts[code]) for code in np.flatnonzero(counts)}

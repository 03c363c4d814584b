"""Recordings in any format as files: `RecordingFile` writes, `OpenRecording` reads those of unknown origin.

Data are written in pieces of a suitable size, in the order of time, one file for each clock.
Links pass on data when they leave: an edge before the events of its time, a frame when it has been read out, with the
time of its exposure. So data are held for a time, and older data are written in the order of time. The holding time is
stream time only, so that the file depends neither on the step nor on the load of the machine. Data that arrive later
are omitted and counted, if the format has one order of time for them and the written data.

A format holds one time that never goes back. A restart of the camera's clock begins a new file: NAME.aedat4 is followed
by NAME-clock2.aedat4.

`HeldRecords` and `HeldFrames` are queues of records and frames, which are taken up to a time, in the order of time.

A recording is read part by part in a child process (see `guarded_reader`), whose memory does not grow with the file.
Damaged data become a RecordingError, after all data before them. Events that go back in time or lie outside the sensor
are damage in every format, because none of them has such events. `read_events` returns the events of a
recording, `iter_events` yields them.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
import warnings
from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import EDGE, EVENT, EdgeKind, Events, join_events
from firmware_protocol.recordings.event_table import TableForm, TimeUnit
from firmware_protocol.recordings.part import IMU, Facts, Frame, Part, counts_of
from transports import Closing
from transports.guarded_reader import ForeignFileError, GuardedReader, Limits
from transports.recording.format import FORMATS, Format, format_to_read, reason, with_addition
from transports.recording.part import (
    MOST_PIXELS,
    DamagedRecording,
    LibraryMissing,
    PipeReader,
    RecordingError,
    Size,
    Writer,
    encoded_facts,
    encoded_part,
    facts_of,
    wrong_event,
)

_Records = npt.NDArray[Any]


class HeldRecords:
    """Records of one stream with a time `t`, u64 us, in sorted pieces; one may begin before the preceding one ends."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype, self._none = dtype, np.zeros(0, dtype)
        self._pieces: deque[_Records] = deque()
        self._last_us = 0
        self._is_sorted = True

    def time_of(self, index: int) -> int | None:
        """Return the time of the waiting record at `index`; None if fewer wait."""
        self._sort()
        for piece in self._pieces:
            if index < len(piece):
                return int(piece["t"][index])
            index -= len(piece)
        return None

    def add(self, records: _Records) -> None:
        """Add a piece, (n,)."""
        if not len(records):
            return
        self._is_sorted = self._is_sorted and (not self._pieces or int(records["t"][0]) >= self._last_us)
        self._last_us = max(self._last_us, int(records["t"][-1]))
        self._pieces.append(records)

    def take(self, until_us: int) -> _Records:
        """Return the records up to `until_us`, (n,) in the order of time; records of equal time in order of arrival."""
        if not self._pieces:
            return self._none
        self._sort()
        taken = []
        while self._pieces and int(self._pieces[0]["t"][0]) <= until_us:
            piece = self._pieces.popleft()
            n = int(np.searchsorted(piece["t"], np.uint64(until_us), "right"))
            taken.append(piece[:n])
            if n < len(piece):
                self._pieces.appendleft(piece[n:])
                break
        return self._joined(taken)

    def _sort(self) -> None:
        if not self._is_sorted:
            records = self._joined(list(self._pieces))
            self._pieces = deque([records[np.argsort(records["t"], kind="stable")]])
            self._is_sorted = True

    def _joined(self, pieces: list[_Records]) -> _Records:
        if self._dtype == EVENT:
            return join_events(pieces)
        return np.concatenate([self._none, *pieces])


class HeldFrames:
    """Queue of frames, by the time of each."""

    def __init__(self) -> None:
        self._frames: list[Frame] = []

    def time_of(self, index: int) -> int | None:
        """Return the time of the waiting frame at `index`; None if fewer wait."""
        return self._frames[index].t_us if index < len(self._frames) else None

    def add(self, frames: tuple[Frame, ...]) -> None:
        """Add frames, in any order."""
        self._frames = sorted([*self._frames, *frames], key=lambda frame: frame.t_us)

    def take(self, until_us: int) -> tuple[Frame, ...]:
        """Return the frames up to `until_us`, in the order of time."""
        taken = tuple(frame for frame in self._frames if frame.t_us <= until_us)
        self._frames = self._frames[len(taken) :]
        return taken


_PIECE_EVENTS = 1 << 14
_HELD_PARTS = 4
_HOLD_US = 100_000
_HOLD_FRAMES_US = 1_000_000  # with events: longest time of a frame from its exposure to its last line
_ALONE_US = 10_000_000  # data that no event follows for this time do not wait for events
_FOREVER_US = 1 << 62


class RecordingFile:
    """Writer of parts to `path`, and to further files after restarts of the clock.

    Parameters
    ----------
    hold : bool
        True if the parts come from a file with separate packets for each stream: data that arrived with the last four
        parts with events then wait for them.

    Attributes
    ----------
    paths : list[Path]
        The files.
    written, left_out : Counter[str]
        Number of records of each stream in them, and of those that the format cannot hold.
    late : Counter[str]
        Number of records of each stream omitted because later data had been written.
    """

    def __init__(self, path: Path, form: Format, facts: Facts, *, hold: bool = False) -> None:
        self._first = path
        self._form = form
        self._facts = facts
        self._parts = _HELD_PARTS if hold else 0
        self._hold_us = _hold_us(form, facts)
        self._streams = {"events", *facts.streams} & set(form.holds)
        self.paths: list[Path] = []
        self.written: Counter[str] = Counter()
        self.left_out: Counter[str] = Counter()
        self.late: Counter[str] = Counter()
        self._writer: Writer | None = None
        self._begin()

    def _begin(self) -> None:
        number = len(self.paths) + 1
        path = self._first if number == 1 else with_addition(self._first, f"clock{number}")
        self._held = {"events": HeldRecords(EVENT), "edges": HeldRecords(EDGE), "imu": HeldRecords(IMU)}
        self._frames = HeldFrames()
        self._starts_us: deque[int] = deque([0] * self._parts, self._parts)
        self._last_us = self._newest_us = 0
        self._limit_us = self._flushed_us = -1
        self._written_us = dict.fromkeys(("events", "edges", "imu", "frames"), 0)
        self._since_flush = 0
        self._is_new = True
        self._writer = self._form.open_writer(path, self._facts)
        self.paths.append(path)

    def restart(self, unix_us: int) -> None:
        """Begin a new file for a clock that is zero at the Unix time `unix_us`, 0 if that is not known."""
        if self._is_new and unix_us == self._facts.unix_us:
            return
        self.flush()
        self._facts = dataclasses.replace(self._facts, unix_us=unix_us)
        is_new = self._is_new
        self.close()
        if is_new:  # no data have arrived, so the same file is used
            _remove(self.paths.pop())
        self._begin()

    def write(self, part: Part) -> None:
        """Append a part; raises RecordingError for events that the format cannot hold, and its writer's errors."""
        self._is_new = False
        self.left_out.update({name: n for name, n in counts_of(part).items() if name not in self._streams})
        if len(part.events):
            if (wrong := wrong_event(part.events, self._last_us, self._facts.size or (0, 0))) is not None:
                raise RecordingError(f"an event {wrong[1]}")
            self._starts_us.append(int(part.events["t"][0]))
            self._last_us = int(part.events["t"][-1])
            self._since_flush += len(part.events)
        edges = part.edges
        if self._form.is_evt:
            edges = edges[edges["kind"] != EdgeKind.PULSE]
            self.left_out["edges"] += len(part.edges) - len(edges)
        for name, records in (("events", part.events), ("edges", edges), ("imu", part.imu)):
            if len(records) and name in self._streams:
                # Edges and samples of other programs' files may have another order.
                is_sorted = name == "events" or bool((records["t"][1:] >= records["t"][:-1]).all())
                self._hold_records(name, records if is_sorted else records[np.argsort(records["t"], kind="stable")])
        if part.frames and "frames" in self._streams:
            self._hold_frames(part.frames)
        self.reach(self._last_us)

    def reach(self, t_us: int) -> None:
        """Record that no event earlier than `t_us` will come, and write the data that need not wait any longer."""
        self._newest_us = max(self._newest_us, t_us)
        limit_us = self._newest_us - self._hold_us
        if self._parts:
            limit_us = min(limit_us, self._starts_us[0] - 1)
        self._limit_us = max(self._limit_us, limit_us)
        if self._since_flush >= _PIECE_EVENTS or self._limit_us - self._flushed_us >= self._form.piece_us:
            self._flush(self._limit_us)

    def _hold_records(self, name: str, records: npt.NDArray[Any]) -> None:
        last_us = int(records["t"][-1])
        if last_us >= self._form.until_us:
            raise RecordingError(f"{self._form.title} holds no time beyond {self._form.until_us // 1_000_000} s")
        late = int(np.searchsorted(records["t"], np.uint64(self._earliest_us(name))))
        self.late[name] += late
        self._held[name].add(records[late:])
        self._newest_us = max(self._newest_us, last_us - _ALONE_US)

    def _hold_frames(self, frames: tuple[Frame, ...]) -> None:
        width, height = self._facts.size or (0, 0)
        inside = []
        for frame in frames:
            rows, columns = frame.pixels.shape[:2]
            if frame.origin[0] + columns <= width and frame.origin[1] + rows <= height:
                inside.append(frame)
        earliest_us = self._earliest_us("frames")
        timely = tuple(frame for frame in inside if frame.t_us >= earliest_us)
        self.left_out["frames"] += len(frames) - len(inside)
        self.late["frames"] += len(inside) - len(timely)
        self._frames.add(timely)
        self._newest_us = max(self._newest_us, frames[-1].t_us - _ALONE_US)

    def _earliest_us(self, name: str) -> int:
        """Return the earliest time at which data of a stream can still be written."""
        if name in self._form.ordered:
            return max(0, self._limit_us)
        return self._written_us[name] if name != "frames" else -_FOREVER_US

    def flush(self) -> None:
        """Write all waiting data."""
        self._flush(_FOREVER_US)

    def _flush(self, until_us: int) -> None:
        """Write the waiting data up to a time, in pieces like the packets of cameras."""
        while (piece_us := self._end_of_piece_us()) is not None and piece_us < until_us:
            self._write_piece(piece_us)
        self._write_piece(until_us)
        self._flushed_us, self._since_flush = max(self._flushed_us, min(until_us, self._newest_us)), 0

    def _end_of_piece_us(self) -> int | None:
        """Return the time up to which the waiting data make a piece; None if no data wait."""
        firsts = [*(held.time_of(0) for held in self._held.values()), self._frames.time_of(0)]
        first_us = min((t_us for t_us in firsts if t_us is not None), default=None)
        if first_us is None:
            return None
        full_us = self._held["events"].time_of(_PIECE_EVENTS)
        end_us = first_us + self._form.piece_us
        return end_us if full_us is None else min(end_us, full_us)

    def _write_piece(self, until_us: int) -> None:
        taken = {name: held.take(until_us) for name, held in self._held.items()}
        part = Part(taken["events"], taken["edges"], taken["imu"], self._frames.take(until_us))
        counts = counts_of(part)
        if not counts or self._writer is None:
            return
        self._writer.write(part)
        self.written.update(counts)
        for name, records in taken.items():
            if len(records):
                self._written_us[name] = int(records["t"][-1])

    def close(self) -> None:
        """Write the waiting data and finish the file."""
        writer = self._writer
        if writer is None:
            return
        try:
            self.flush()
        finally:
            self._writer = None
            writer.close()


def _hold_us(form: Format, facts: Facts) -> int:
    """Return the holding time of data; 0 if a file has events only."""
    if form.holds == ("events",):
        return 0
    return _HOLD_FRAMES_US if "frames" in form.ordered and "frames" in facts.streams else _HOLD_US


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    elif path.is_file():  # a device stays
        path.unlink()


_MOST_EVENTS = 1 << 16  # in one message
_MOST_GROWTH = 1000  # from a file to its records; those of a regular pattern grow 700 times
_ALWAYS_BYTES = 1 << 26


class OpenRecording(Closing):
    """Recording that is open in a child process; a context manager.

    Raises RecordingError if it cannot be read, LibraryMissing without its library, OSError if it cannot be opened.

    Parameters
    ----------
    size : (width, height) of the sensor, for files without it.
    strict : False: events that go back in time or lie outside the sensor are no error.
    table : columns and unit of the times of a table of text.
    topic : topic of the events; None: the only one of the file, RecordingError if it has several. Empty: the first one.

    Attributes
    ----------
    format, facts : its format, and the facts available before its first event.
    """

    def __init__(
        self,
        path: Path,
        size: Size | None = None,
        *,
        strict: bool = True,
        table: TableForm | None = None,
        topic: str | None = None,
    ) -> None:
        self._strict = strict
        self.format: Format = format_to_read(path)
        columns = vars(table or TableForm())
        arguments = (f"{__name__}:read_messages", path, self.format.name, size, columns, topic or "")
        self._reader = GuardedReader(*arguments, limits=Limits.in_pieces(path))
        self._messages = self._received()
        try:
            self.facts: Facts = facts_of(next(self._messages))
            if topic is None and len(self.facts.topics) > 1:
                names = ", ".join(f"{name} ({count} messages)" for name, count in self.facts.topics.items())
                raise RecordingError(f"it has events of {names}: choose a topic by --topic, in Python by topic=")
        except BaseException:
            self.close()
            raise

    def parts(self) -> Iterator[Part]:
        """Yield all parts; raises RecordingError after the data before damaged data."""
        count = last_us = 0
        size = self.facts.size or (1 << 16, 1 << 16)
        for part in self._messages:
            events = part.events
            if self._strict and (wrong := wrong_event(events, last_us, size)) is not None:
                yield Part(events[: wrong[0]])
                raise RecordingError(f"event {count + wrong[0]} {wrong[1]}; read_events with strict=False returns all")
            yield part
            count, last_us = count + len(events), int(events["t"][-1]) if len(events) else last_us

    def _received(self) -> Iterator[Any]:
        """Yield the facts and the parts; raises RecordingError."""
        pipe = PipeReader()
        try:
            for values in self._reader.values():
                yield from pipe.feed(values["messages"].tobytes())
        except ForeignFileError as error:
            named = DamagedRecording if error.kind == DamagedRecording.__name__ else RecordingError
            raise (LibraryMissing if error.lacks else named)(str(error)) from None

    def close(self) -> None:
        """End the child process."""
        self._reader.close()


def read_messages(
    path: Path, form: str, size: list[int] | None, table: dict[str, Any], topic: str = ""
) -> Iterator[dict[str, Any]]:
    """Yield the messages of a recording's facts and parts (see `part`), in the child; raises RecordingError."""
    files = path.iterdir() if path.is_dir() else [path]
    left_bytes = _MOST_GROWTH * sum(file.stat().st_size for file in files) + _ALWAYS_BYTES
    try:
        in_file = None if size is None else (size[0], size[1])
        reader = FORMATS[form].open_reader(path, in_file, TableForm(**table), topic)
        yield _message(encoded_facts(reader.facts))
        for part in reader.parts():
            left_bytes -= part.events.nbytes + part.edges.nbytes + part.imu.nbytes
            if left_bytes < 0:
                raise RecordingError("it is damaged: it would grow to more data than a file of its size can hold")
            if any(math.prod(frame.pixels.shape[:2]) > MOST_PIXELS for frame in part.frames):
                raise RecordingError(f"it is damaged: a frame has more than {MOST_PIXELS} pixels")
            for start in range(0, max(1, len(part.events)), _MOST_EVENTS):
                events = part.events[start : start + _MOST_EVENTS]
                piece = Part(events) if start else Part(events, part.edges, part.imu, part.frames)
                yield _message(encoded_part(piece))
    except (RecordingError, GeneratorExit):
        raise
    except BaseException as error:
        raise RecordingError(reason(error)) from error


def _message(pieces: list[bytes]) -> dict[str, Any]:
    return {"messages": np.frombuffer(b"".join(pieces), np.uint8)}


def read_events(
    path: str | Path,
    *,
    size: Size | None = None,
    strict: bool = True,
    columns: str = "",
    time_unit: TimeUnit = "",
    topic: str | None = None,
) -> Events:
    """Return all events of a recording, (n,) EVENT, t in us since its start.

    They are sorted unless `strict` is False. Of a `.npz` record they are those since the last restart of the camera's
    clock (`load_record` returns the others too). Raises OSError if the file cannot be opened; RecordingError if it is
    damaged or in none of the formats, or the library that reads its format is missing. A file whose events go back in
    time or lie outside its sensor is damaged.

    Parameters
    ----------
    path : file, or folder of a ROS 2 bag, in any format of docs/recordings.md. Its first bytes decide which one.
    size : (width, height) of the sensor, for a format that does not contain it.
    strict : False: return the events of a damaged file that go back in time or lie outside the sensor, too.
    columns : of a table of text, the names of its columns in their order, such as "x,y,p,t".
    time_unit : of a table of text: "s", "ms", "us" or "ns". What is assumed without these two is a warning.
    topic : topic of a ROS bag with the events of several cameras, which is refused without it.
    """
    events = iter_events(path, size=size, strict=strict, columns=columns, time_unit=time_unit, topic=topic)
    return join_events(list(events)).copy()


def iter_events(
    path: str | Path,
    *,
    size: Size | None = None,
    strict: bool = True,
    columns: str = "",
    time_unit: TimeUnit = "",
    topic: str | None = None,
) -> Iterator[Events]:
    """Yield the events of a recording in pieces, (n > 0,) EVENT, read-only: memory does not grow with the file.

    Arguments and errors are those of `read_events`. A damaged file raises RecordingError after the events before the
    damage. Another process reads the file; closing the iterator ends it.
    """
    file = Path(path)
    try:
        with OpenRecording(file, size, strict=strict, table=TableForm(columns, time_unit), topic=topic) as recording:
            for remark in recording.facts.remarks:
                warnings.warn(f"{file}: {remark}", stacklevel=2)
            yield from (part.events for part in recording.parts() if len(part.events))
    except RecordingError as error:
        raise type(error)(f"{file}: {error}") from error

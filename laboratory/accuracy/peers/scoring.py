"""Scores of a simulator's events against ideal pixels, its time for a frame, and the remarks on its events.

Events of a sequence are in a file of the sequence's name in the folder of events: `NAME.npz` with t_us, x, y and on, or
`NAME.csv` with those four columns, a line an event, with or without a heading. Times are us since the first frame. A
file of the worker has more: the frame with which each event came, and the times that frames took.

What cannot be compared (times that are not finite, pixels outside the array, a file that is none) fails the sequence,
with the reason. Times outside the step of their frame, and times that go back within it, are remarks: the events are
scored as they are.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from laboratory.accuracy.peers.sequences import TIMING, FrameSequence, SequenceFolder
from laboratory.accuracy.scores import Stream, compare

_COLUMNS = ("t_us", "x", "y", "on")
_TOLERANCE_US = 1.0
_WARM_UP = 3


class EventsError(Exception):
    """The events of a sequence are missing or cannot be compared; the message contains the reason."""


@dataclass(frozen=True)
class PeerEvents:
    """The events of a sequence.

    Attributes
    ----------
    t_us : (n,) float64, times since the first frame.
    x, y : (n,) int64, pixels.
    on : (n,) bool, polarities.
    frame : (n,) int64, number of the frame with which each event came; the number of frames for those of the end.
    wall_ns, cpu_ns : (frames,) int64, clock and time of all processors that each frame took.
    """

    t_us: npt.NDArray[np.float64]
    x: npt.NDArray[np.int64]
    y: npt.NDArray[np.int64]
    on: npt.NDArray[np.bool_]
    frame: npt.NDArray[np.int64] | None = None
    wall_ns: npt.NDArray[np.int64] | None = None
    cpu_ns: npt.NDArray[np.int64] | None = None


@dataclass(frozen=True)
class SequenceScore:
    """Scores of one sequence; None where nothing can be compared.

    Attributes
    ----------
    right, false, missed : share of the sequences of pixels that are right; false and missing events over the true ones.
    t50_us, t95_us : quantiles of |time error| over the events of the right pixels.
    failure : the reason why there are no scores, or "".
    """

    sequence: str
    scene: str
    images_per_s: float
    events: int = 0
    true_events: int = 0
    right: float | None = None
    t50_us: float | None = None
    t95_us: float | None = None
    false: float | None = None
    missed: float | None = None
    failure: str = ""


@dataclass(frozen=True)
class FrameTime:
    """Time for a frame of a timing sequence, us, on the clock and of all processors; events a frame.

    It is the least of all frames after the first, so that a busy machine does as little harm as possible.
    """

    pixels: int
    wall_us: float
    cpu_us: float
    events: float


@dataclass(frozen=True)
class Summary:
    """Scores at one frame rate: means over the scenes of shares, medians of times; scenes scored, of all."""

    images_per_s: float
    right: float | None
    t50_us: float | None
    t95_us: float | None
    false: float | None
    missed: float | None
    scenes: int
    of: int


@dataclass(frozen=True)
class Report:
    """The results of a simulator.

    Attributes
    ----------
    about : its name, version, date, takes, notes and device.
    day : date of the run.
    machine : the machine.
    scores : of all sequences with a truth.
    frame_times : by the timing sequence.
    remarks : on its events.
    """

    about: dict[str, str]
    day: str
    machine: str
    scores: tuple[SequenceScore, ...]
    frame_times: dict[str, FrameTime] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name for tables."""
        return self.about.get("name") or "unnamed"

    def summaries(self) -> list[Summary]:
        """Return a summary for each frame rate, in rising order."""
        rates = sorted({one.images_per_s for one in self.scores})
        return [_summary(rate, [one for one in self.scores if one.images_per_s == rate]) for rate in rates]

    def failures(self) -> dict[str, list[str]]:
        """Return the sequences that failed, by the reason."""
        found: dict[str, list[str]] = {}
        for one in self.scores:
            if one.failure:
                found.setdefault(one.failure, []).append(one.sequence)
        return found

    def frame_us(self, which: str) -> float | None:
        """Return the time for a frame of a timing sequence, us: of all processors, or on the clock for a GPU."""
        time = self.frame_times.get(which)
        return None if time is None else time.wall_us if self.about.get("device") == "gpu" else time.cpu_us


def _summary(rate: float, scores: list[SequenceScore]) -> Summary:
    known = [one for one in scores if one.right is not None]

    def over(name: str, how: str) -> float | None:
        values = [value for one in known if (value := getattr(one, name)) is not None]
        return float(getattr(statistics, how)(values)) if values else None

    right, false, missed = (over(name, "mean") for name in ("right", "false", "missed"))
    return Summary(
        rate, right, over("t50_us", "median"), over("t95_us", "median"), false, missed, len(known), len(scores)
    )


def read_events(folder: Path, name: str) -> PeerEvents:
    """Return the events of a sequence.

    Raises EventsError where there is no file for it, or the file is of another form.
    """
    archive, table = folder / f"{name}.npz", folder / f"{name}.csv"
    try:
        if archive.exists():
            with np.load(archive) as stored:
                return _typed({key: stored[key] for key in stored.files})
        if table.exists():
            return _typed(_csv(table))
    except (OSError, ValueError, KeyError) as error:
        raise EventsError(f"{(archive if archive.exists() else table).name} is damaged: {error}") from error
    raise EventsError(f"there is no {archive.name} and no {table.name}")


def _csv(file: Path) -> dict[str, npt.NDArray[np.float64]]:
    with file.open() as lines:
        heading = int(any(letter.isalpha() for letter in lines.readline().replace("e", "")))
    if file.stat().st_size == 0:
        return {name: np.empty(0) for name in _COLUMNS}
    columns = np.loadtxt(file, delimiter=",", skiprows=heading, ndmin=2)
    if columns.size and columns.shape[1] != len(_COLUMNS):
        raise ValueError(f"{columns.shape[1]} columns: must be {', '.join(_COLUMNS)}")
    return dict(zip(_COLUMNS, columns.T if columns.size else np.empty((4, 0)), strict=True))


def _typed(stored: Mapping[str, npt.NDArray[np.generic]]) -> PeerEvents:
    missing = [name for name in _COLUMNS if name not in stored]
    if missing:
        raise ValueError(f"it has no {', '.join(missing)}")
    t, x, y, on = (stored[name] for name in _COLUMNS)
    if not t.ndim == 1 or not t.shape == x.shape == y.shape == on.shape:
        raise ValueError(f"t_us {t.shape}, x {x.shape}, y {y.shape}, on {on.shape}: must be of one length")
    if not all(np.isfinite(part.astype(np.float64)).all() for part in (t, x, y)):
        raise ValueError("times or pixels are not finite")
    more = {name: stored[name].astype(np.int64) for name in ("frame", "wall_ns", "cpu_ns") if name in stored}
    return PeerEvents(
        t.astype(np.float64), x.astype(np.int64), y.astype(np.int64), np.asarray(on.astype(np.float64) > 0), **more
    )


def score_events(
    folder: SequenceFolder, events: Path, failures: Mapping[str, str]
) -> tuple[tuple[SequenceScore, ...], dict[str, FrameTime], tuple[str, ...]]:
    """Return the scores of a folder of events, times for a frame, and remarks.

    Parameters
    ----------
    failures : sequences that a run did not finish, with the reasons.

    Raises FolderError where the truth is missing.
    """
    scores = []
    times = {}
    checks = _Checks()
    for name, sequence in folder.sequences.items():
        timing = sequence.scene in TIMING
        try:
            if name in failures:
                raise EventsError(failures[name])
            found = read_events(events, name)
            if not timing:
                scores.append(_score(name, sequence, found, folder.truth(name)))
                checks.add(found, sequence)
            elif found.cpu_ns is not None and found.wall_ns is not None:
                times[name] = _frame_time(found.wall_ns, found.cpu_ns, found.t_us.size, sequence)
        except EventsError as error:
            if not timing:
                scores.append(SequenceScore(name, sequence.scene, sequence.images_per_s, failure=str(error)))
    return tuple(scores), times, checks.remarks()


def _score(name: str, sequence: FrameSequence, found: PeerEvents, truth: Stream) -> SequenceScore:
    width, height = sequence.width, sequence.height
    outside = (found.x < 0) | (found.x >= width) | (found.y < 0) | (found.y >= height)
    if outside.any():
        where = int(np.flatnonzero(outside)[0])
        place = f"({found.x[where]}, {found.y[where]})"
        raise EventsError(f"{outside.sum()} events are outside {width} x {height} pixels, one at {place}")
    scores = compare(Stream.of(found.t_us, found.y * width + found.x, found.on, width * height), truth)
    wrong, surplus, true = round(scores.wrong_events * len(truth)), found.t_us.size - len(truth), len(truth)
    t50_us, t95_us = (None if math.isnan(time) else time for time in (scores.t50_us, scores.t95_us))
    false, missed = (wrong + surplus) / 2 / true, (wrong - surplus) / 2 / true
    return SequenceScore(
        name, sequence.scene, sequence.images_per_s, scores.events, true, scores.right, t50_us, t95_us, false, missed
    )


def _frame_time(
    wall_ns: npt.NDArray[np.int64], cpu_ns: npt.NDArray[np.int64], events: int, sequence: FrameSequence
) -> FrameTime:
    wall, cpu = (float(part[_WARM_UP:].min()) * 1e-3 for part in (wall_ns, cpu_ns))
    return FrameTime(sequence.width * sequence.height, wall, cpu, events / max(1, sequence.frames - 1))


class _Checks:
    """Counts of events that have times outside the step of their frame, or that go back within it."""

    def __init__(self) -> None:
        self._events = self._outside = self._back = 0
        self._furthest_us = 0.0

    def add(self, found: PeerEvents, sequence: FrameSequence) -> None:
        """Count the events of a sequence."""
        step_us, last = 1e6 / sequence.images_per_s, sequence.frames - 1
        frame = np.full(found.t_us.size, sequence.frames) if found.frame is None else found.frame
        low = np.where(frame > last, 0, frame - 1) * step_us
        high = np.minimum(frame, last) * step_us
        beyond = np.maximum(low - found.t_us, found.t_us - high)
        self._events += found.t_us.size
        self._outside += int((beyond > _TOLERANCE_US).sum())
        self._furthest_us = max(self._furthest_us, float(beyond.max(initial=0.0)))
        if found.frame is not None:
            self._back += int(((np.diff(found.t_us) < 0) & (np.diff(frame) == 0)).sum())

    def remarks(self) -> tuple[str, ...]:
        """Return a sentence for each kind."""
        found = []
        if self._outside:
            share = 100 * self._outside / self._events
            found.append(
                f"{share:.2g} % of the events have times outside the step of their frame, by up to "
                f"{self._furthest_us:.0f} us"
            )
        if self._back:
            found.append("events of a frame are not in order of time")
        return tuple(found)


def write_report(report: Report, path: Path) -> Path:
    """Write a report as JSON; return the path."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(report), indent=1) + b"\n")
    return path


def read_report(path: Path) -> Report:
    """Return the report in a file.

    Raises ValueError where the file is of another form; the message contains its name.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Report)
    except msgspec.MsgspecError as error:
        raise ValueError(f"{path}: {error}") from error

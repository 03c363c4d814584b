"""`evstim info FILE`: the content of a recording, or of a truth file."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from emulator.cli.output import BAD_VERDICT, GOOD, Json, SensorSize, Topic, print_result
from emulator.cli.recordings import AS_IT_IS, Table, recording_of
from emulator.run.truth.file import truth_in
from firmware_protocol.events import Int64s
from firmware_protocol.recordings.part import Facts, Part
from transports.recording.files import OpenRecording
from transports.recording.part import RecordingError


def _truth_lines(content: Mapping[str, Any]) -> list[str]:
    names = ", ".join(f"{k} {name}" for k, name in enumerate(content["names"]))
    origins = ", ".join(f"{count} {name}" for name, count in content["origins"].items())
    size = f"{content['width']} x {content['height']}"
    layers = ", ".join(content["of_each_picture"])
    lines = [
        f"format    {content['format']}, version {content['version']}: HDF5 (opens in h5py; see docs/recordings.md)",
        f"of        {content['rig']}: {content['title']}; {content['camera']}, {size} pixels",
        f"pictures  {content['pictures']} in {content['seconds']:.3f} s, each with {layers}",
        f"poses     {content['poses']}",
        f"labels    {names}",
        f"events    {content['events']}{': ' + origins if origins else ''}",
        f"clean     {content['clean_events']} events of the ideal sensor",
    ]
    lines += [f"absent    {content['absent']}"] if content["absent"] else []
    if content["missing_pictures"] or content["missing_events"]:
        lost = f"{content['missing_pictures']} pictures and {content['missing_events']} events"
        lines.append(f"NOTE      it lacks {lost}, which came faster than they could be written")
    elif not content["complete"]:
        lines.append("NOTE      it was not finished: the process that wrote it was killed, or the disk was full")
    return lines


_BIN_US = 100_000
_EARLIEST_US = 10**14  # the year 1973: a smaller offset of times is of a camera's clock, and no date
_STREAMS = {"events": "events", "edges": "triggers", "imu": "IMU", "frames": "frames"}


@dataclass
class StreamSurvey:
    """Count and times of one stream.

    Attributes
    ----------
    first_us, last_us : times of the earliest and of the latest record; None before the first.
    steps_back : records that are earlier than the one before.
    """

    count: int = 0
    first_us: int | None = None
    last_us: int | None = None
    steps_back: int = 0
    _before_us: int = 0

    def add(self, t_us: Int64s) -> None:
        """Add the times of records, (n,) us."""
        if not len(t_us):
            return
        if self.first_us is None or self.last_us is None:
            self.first_us = self.last_us = self._before_us = int(t_us[0])
        self.count += len(t_us)
        self.steps_back += int(np.count_nonzero(np.diff(t_us, prepend=self._before_us) < 0))
        self._before_us = int(t_us[-1])
        self.first_us, self.last_us = min(self.first_us, int(t_us.min())), max(self.last_us, int(t_us.max()))

    @property
    def seconds(self) -> float:
        """Time from the earliest record to the latest."""
        return 0.0 if self.first_us is None or self.last_us is None else (self.last_us - self.first_us) * 1e-6

    @property
    def mean_hz(self) -> float | None:
        """Records a second; None where no time passes, or where times go back: they are not all of one clock."""
        return self.count / self.seconds if self.seconds > 0 and not self.steps_back else None


@dataclass
class Survey:
    """Statistics of the streams of a recording.

    Attributes
    ----------
    streams : of "events", "edges", "imu", "frames".
    busiest : events of the busiest tenth of a second.
    extent : one more than the largest column and row.
    """

    on: int = 0
    busiest: int = 0
    extent: tuple[int, int] = (0, 0)
    streams: dict[str, StreamSurvey] = field(default_factory=lambda: {name: StreamSurvey() for name in _STREAMS})
    _bin: list[int] = field(default_factory=lambda: [0, 0])

    def add(self, part: Part) -> None:
        """Add a part of the recording."""
        for name, records in (("events", part.events), ("edges", part.edges), ("imu", part.imu)):
            self.streams[name].add(records["t"].astype(np.int64))
        self.streams["frames"].add(np.array([frame.t_us for frame in part.frames], np.int64))
        events = part.events
        if not len(events):
            return
        self.on += int(np.count_nonzero(events["on"]))
        self.extent = (max(self.extent[0], int(events["x"].max()) + 1), max(self.extent[1], int(events["y"].max()) + 1))
        self._count_bins(events["t"].astype(np.int64) // _BIN_US)

    def _count_bins(self, bins: Int64s) -> None:
        starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
        counts = np.diff(starts, append=len(bins))
        if bins[0] == self._bin[0]:
            counts[0] += self._bin[1]
        self.busiest = max(self.busiest, int(counts.max()))
        self._bin = [int(bins[starts[-1]]), int(counts[-1])]


def info(
    file: Path, /, *, size: SensorSize = None, topic: Topic = None, table: Table = AS_IT_IS, json: Json = False
) -> int:
    """Show the format, the camera and every stream of a recording or a truth file, and which programs open it.

    Parameters
    ----------
    file
        A recording in any format that can be read: see docs/recordings.md.
    """
    if (truth := truth_in(file)) is not None:
        print_result(json, {"file": file, **truth}, _truth_lines(truth))
        return GOOD if truth["complete"] else BAD_VERDICT
    survey, trouble = Survey(), ""
    with recording_of(file, size, table, topic or "", strict=False) as recording:
        try:
            for part in recording.parts():
                survey.add(part)
        except RecordingError as error:
            trouble = str(error)
    lines = _recording_lines(recording, survey)
    lines += [f"damaged: {trouble}; the values are of the part before the damage"] if trouble else []
    print_result(json, _as_json(file, recording, survey, trouble), lines)
    return BAD_VERDICT if trouble else GOOD


def _as_json(file: Path, recording: OpenRecording, survey: Survey, trouble: str) -> dict[str, object]:
    facts, events = recording.facts, survey.streams["events"]
    fields = ("count", "first_us", "last_us", "steps_back")
    streams = {name: {field: getattr(stream, field) for field in fields} for name, stream in survey.streams.items()}
    counts = {name: stream.count for name, stream in survey.streams.items()}
    return {
        "file": file, "format": recording.format.name, "size": facts.size, "camera": facts.camera,
        "unix_us": facts.unix_us if facts.unix_us >= _EARLIEST_US else None, "offset_us": facts.unix_us,
        "header": facts.header, "topics": facts.topics, **counts, "on": survey.on,
        "first_us": events.first_us, "last_us": events.last_us or 0, "seconds": events.seconds,
        "mean_hz": events.mean_hz, "busiest_hz": None if events.steps_back else survey.busiest * 1e6 / _BIN_US,
        "steps_back": events.steps_back, "assumed": facts.remarks,
        "extent": survey.extent, "streams": streams, "trouble": trouble,
    }  # fmt: skip


def _recording_lines(recording: OpenRecording, survey: Survey) -> list[str]:
    form, facts = recording.format, recording.facts
    events = survey.streams["events"]
    size = "unknown" if facts.size is None else f"{facts.size[0]} x {facts.size[1]}"
    share = f", {survey.on / events.count:.1%} ON" if events.count else ""
    busiest = f", {survey.busiest} in the busiest 0.1 s" if events.count and not events.steps_back else ""
    lines = [
        f"format    {form.title} (opens in {form.readers})",
        f"camera    {facts.camera}, {size} pixels; events reach to {survey.extent[0]} x {survey.extent[1]}",
        f"begins    {_date(facts)}",
        *(f"header    {name}: {text}" for name, text in facts.header.items()),
    ]
    if len(facts.topics) > 1:
        topics = ", ".join(f"{name} ({count} messages)" for name, count in facts.topics.items())
        lines.append(f"topics    {topics}; the values are of {facts.camera}, --topic selects another one")
    for name, title in _STREAMS.items():
        content = _stream_text(survey.streams[name], *((share, busiest) if name == "events" else ()))
        lines.append(f"{title:<9} {content if name in form.holds else 'none: the format holds none'}")
    back = {title: survey.streams[name].steps_back for name, title in _STREAMS.items()}
    return lines + [f"NOTE      the time of {title} goes back {n} times" for title, n in back.items() if n]


def _stream_text(stream: StreamSurvey, share: str = "", busiest: str = "") -> str:
    """Return count and times of a stream, with further text behind each."""
    if not stream.count:
        return "none"
    mean = "" if stream.mean_hz is None else f"; {stream.mean_hz:.4g} a second"
    return f"{stream.count}{share}, from {stream.first_us} to {stream.last_us} us{mean}{busiest}"


def _date(facts: Facts) -> str:
    if facts.unix_us < _EARLIEST_US:
        offset = f"; the file adds {facts.unix_us} us to each, which is no date" if facts.unix_us else ""
        return f"at no known date: times count from the camera's start{offset}"
    begin = datetime.datetime.fromtimestamp(facts.unix_us * 1e-6, datetime.UTC)
    return f"{begin:%Y-%m-%d %H:%M:%S} UTC (t = 0)"

"""`evstim info FILE`."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from emulator.cli.output import BAD_VERDICT, GOOD, console, print_json
from emulator.cli.recording_paths import parsed_size, reading
from emulator.cli.truth_info import show_truth
from emulator.run.truth.survey import truth_in
from firmware_protocol.events import Events
from transports.recording.guarded import OpenRecording
from transports.recording.part import Facts, Part, RecordingError

__all__ = ["info"]

_BIN_US = 100_000


@dataclass
class Survey:
    """What the parts of a recording show.

    Attributes
    ----------
    first_us, last_us : times of the first and of the latest event.
    steps_back : events that are earlier than the one before.
    busiest : events of the busiest tenth of a second.
    extent : one more than the largest column and row.
    """

    events: int = 0
    on: int = 0
    edges: int = 0
    imu: int = 0
    frames: int = 0
    first_us: int | None = None
    last_us: int = 0
    steps_back: int = 0
    busiest: int = 0
    extent: tuple[int, int] = (0, 0)
    _before_us: int = 0
    _bin: list[int] = field(default_factory=lambda: [0, 0])

    def add(self, part: Part) -> None:
        """Take a part in."""
        self.edges += len(part.edges)
        self.imu += len(part.imu)
        self.frames += len(part.frames)
        if len(part.events):
            self._add_events(part.events)

    def _add_events(self, events: Events) -> None:
        t = events["t"].astype(np.int64)
        if self.first_us is None:
            self.first_us = self._before_us = int(t[0])
        self.events += len(events)
        self.on += int(np.count_nonzero(events["on"]))
        self.steps_back += int(np.count_nonzero(np.diff(t, prepend=self._before_us) < 0))
        self._before_us = int(t[-1])
        self.last_us = max(self.last_us, int(t.max()))
        self.extent = (max(self.extent[0], int(events["x"].max()) + 1), max(self.extent[1], int(events["y"].max()) + 1))
        self._count_bins(t // _BIN_US)

    def _count_bins(self, bins: np.ndarray) -> None:
        starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
        counts = np.diff(starts, append=len(bins))
        if bins[0] == self._bin[0]:
            counts[0] += self._bin[1]
        self.busiest = max(self.busiest, int(counts.max()))
        self._bin = [int(bins[starts[-1]]), int(counts[-1])]

    @property
    def seconds(self) -> float:
        """Time from the first event to the latest."""
        return 0.0 if self.first_us is None else (self.last_us - self.first_us) * 1e-6

    @property
    def mean_hz(self) -> float | None:
        """Events a second; None where no time passes."""
        return self.events / self.seconds if self.seconds > 0 else None


def info(
    file: Path,
    /,
    *,
    size: str | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Show what a recording or a truth file is and holds, and which programs open it.

    Parameters
    ----------
    file
        A recording in any format that is read: see docs/recordings.md.
    size
        WIDTHxHEIGHT of the sensor, such as 346x260, for files that do not tell it.
    json
        Print one JSON object as the last line on stdout.
    """
    if (truth := truth_in(file)) is not None:
        return show_truth(file, truth, json=json)
    survey, trouble = Survey(), ""
    with reading(file), OpenRecording(file, parsed_size(size)) as recording:
        try:
            for part in recording.parts():
                survey.add(part)
        except RecordingError as error:
            trouble = str(error)
    told = _as_json(file, recording, survey, trouble)
    if json:
        print_json(told)
    else:
        for line in _lines(recording, survey):
            console.print(line, markup=False)
        if trouble:
            console.print(f"damaged: {trouble}; the figures are of what comes before", markup=False)
    return BAD_VERDICT if trouble else GOOD


def _as_json(file: Path, recording: OpenRecording, survey: Survey, trouble: str) -> dict[str, object]:
    facts = recording.facts
    return {
        "file": file, "format": recording.format.name, "size": facts.size, "camera": facts.camera,
        "unix_us": facts.unix_us or None, "events": survey.events, "on": survey.on, "edges": survey.edges,
        "imu": survey.imu, "frames": survey.frames, "first_us": survey.first_us, "last_us": survey.last_us,
        "seconds": survey.seconds, "mean_hz": survey.mean_hz, "busiest_hz": survey.busiest * 1e6 / _BIN_US,
        "steps_back": survey.steps_back, "extent": survey.extent, "trouble": trouble,
    }  # fmt: skip


def _lines(recording: OpenRecording, survey: Survey) -> list[str]:
    form, facts = recording.format, recording.facts
    size = "not told" if facts.size is None else f"{facts.size[0]} x {facts.size[1]}"
    share = f", {survey.on / survey.events:.1%} ON" if survey.events else ""
    lines = [
        f"format    {form.title} (opens in {form.readers})",
        f"camera    {facts.camera}, {size} pixels; events reach to {survey.extent[0]} x {survey.extent[1]}",
        f"begins    {_date(facts)}",
        f"events    {survey.events}{share}",
    ]
    if survey.first_us is not None:
        mean = "" if survey.mean_hz is None else f"; {survey.mean_hz:.0f} a second"
        busiest = survey.busiest * 1e6 / _BIN_US
        lines.append(f"times     {survey.first_us} to {survey.last_us} us{mean}, {busiest:.0f} in the busiest 0.1 s")
    others = [f"{getattr(survey, name)} {name}" for name in ("edges", "imu", "frames") if getattr(survey, name)]
    lines += [f"and       {', '.join(others)}"] if others else []
    lines += [f"NOTE      time goes back {survey.steps_back} times"] if survey.steps_back else []
    return lines


def _date(facts: Facts) -> str:
    if not facts.unix_us:
        return "at no known date: times count from the camera's start"
    when = datetime.datetime.fromtimestamp(facts.unix_us * 1e-6, datetime.UTC)
    return f"{when:%Y-%m-%d %H:%M:%S} UTC (t = 0)"

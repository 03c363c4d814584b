"""A recording beside the simulated sensor: both streams' statistics and their distances, as tables and files."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emulator.characterise.activity import Activity, activity, distances, still_pixels
from emulator.characterise.fitting import fit, toml
from emulator.playback.recording import read_events
from emulator.report.html import sentences, table, write_csv, write_json, write_page
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Events

__all__ = ["Compared", "compare", "write_comparison"]

_STEP_NS = 20_000_000
_MOST_S = 60.0


@dataclass(frozen=True)
class Compared:
    """Statistics of a recording and of simulated sensors, by their names, the recording first.

    Attributes
    ----------
    streams : statistics by name.
    fitted : figures of `[camera.sensor]` that match the recording best; None if they were not asked for.
    reading : sentences on what was compared.
    """

    streams: Mapping[str, Activity]
    fitted: dict[str, Any] | None
    reading: list[str]

    def rows(self) -> list[dict[str, object]]:
        """Return a row for each statistic and each distance."""
        figures = {name: one.figures() for name, one in self.streams.items()}
        recorded = next(iter(self.streams.values()))
        apart = {name: distances(recorded, one) for name, one in self.streams.items()}
        rows: list[dict[str, object]] = []
        for found in (figures, apart):
            for statistic in next(iter(found.values())):
                rows.append({"statistic": statistic, **{name: of[statistic] for name, of in found.items()}})
        return rows


def compare(
    path: Path, sensor: tuple[str, SensorParameters], light: float, still_hz: float = 0.0, *, fitted: bool = False
) -> Compared:
    """Measure a recording, and the sensor (name and parameters) in still light for the same time.

    `still_hz` above 0: only pixels of the recording count whose neighbours fire at that rate at most.

    Raises
    ------
    SceneError
        The file cannot be read or holds no events.
    ValueError
        No pixel of the recording is still.
    """
    name, parameters = sensor
    events, size = read_events(path)
    size = size or (
        max(parameters.width, int(events["x"].max()) + 1),
        max(parameters.height, int(events["y"].max()) + 1),
    )
    seconds = max(float(events["t"][-1] - events["t"][0]) * 1e-6, 1e-3)
    chosen = still_pixels(events, size, seconds, still_hz) if still_hz else None
    if chosen is not None and not chosen.any():
        raise ValueError(f"{path}: no pixel has neighbours that fire at {still_hz:g} Hz at most; allow more")
    recorded = activity(events, size, seconds, chosen)
    streams = {path.name: recorded, name: _simulated(parameters, light, seconds)}
    figures = fit(recorded) if fitted else None
    if figures is not None:
        streams[f"{name}, fitted"] = _simulated(_with(parameters, figures), light, seconds)
    told = f"{recorded.pixels} of {size[0] * size[1]} pixels of {path.name}, {seconds:.3g} s, {recorded.events} events"
    beside = f"beside {parameters.width} x {parameters.height} pixels of {name} in still light {light:g}, same time"
    return Compared(streams, figures, [f"{told}; {beside}."])


def _with(p: SensorParameters, figures: Mapping[str, Any]) -> SensorParameters:
    parts = {
        key: dataclasses.replace(getattr(p, key), **value) if isinstance(value, dict) else value
        for key, value in figures.items()
    }
    return dataclasses.replace(p, **parts)


def _simulated(p: SensorParameters, light: float, seconds: float) -> Activity:
    """Return the statistics of the sensor in still light, at most `_MOST_S` of them."""
    seconds = min(seconds, _MOST_S)
    picture, sensor = np.full((p.height, p.width), light, np.float32), Sensor(p, 1)
    sensor.reset(picture, 0)
    ends = [min(k * _STEP_NS, round(seconds * 1e9)) for k in range(1, math.ceil(seconds * 1e9 / _STEP_NS) + 1)]
    parts: list[Events] = [sensor.expose(picture, end) for end in ends]
    return activity(np.concatenate([*parts, sensor.finish()]), (p.width, p.height), seconds)


def write_comparison(found: Compared, name: str, out: Path) -> list[Path]:
    """Write page, tables and the fitted figures, if any, into a folder; return the files, page first."""
    rows = found.rows()
    files = [
        write_csv(rows, out / "recording.csv"),
        write_json({"reading": found.reading, "statistics": rows, "fit": found.fitted}, out / "recording.json"),
    ]
    sections = [sentences(found.reading), table(rows)]
    if found.fitted is not None:
        path = out / "fit.toml"
        path.write_text(toml(found.fitted, found.reading[0]), encoding="utf-8")
        files.append(path)
    return [write_page(f"{name} beside a recording", sections, out / "recording.html"), *files]

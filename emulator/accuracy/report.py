"""Reports of accuracy: CSV, JSON, charts, and a page that needs no network."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from emulator.accuracy.cases import Swept
from emulator.accuracy.charts import draw_rendering, draw_stability, draw_work_precision
from emulator.accuracy.effects import EffectRow
from emulator.accuracy.rendering import Drawn
from emulator.accuracy.stability import Cell, Sweep, boundary
from emulator.accuracy.work_precision import Point, frames_needed
from emulator.report.html import inline, sentences, table, write_csv, write_json, write_page

__all__ = [
    "reading",
    "reading_of_rendering",
    "reading_of_the_map",
    "write_rendering",
    "write_stability",
    "write_work_precision",
]

_TARGETS_US = (10.0, 100.0)


def write_work_precision(
    points: Sequence[Point], effects: Sequence[EffectRow], cases: Sequence[Swept], out: Path
) -> list[Path]:
    """Write the chart of speed against accuracy into folder `out`; return the files, the page first."""
    told = {swept.case.name: swept.told for swept in cases}
    files = [write_csv([point.row() for point in points], out / "work_precision.csv")]
    sections: list[str] = [sentences(reading(points, told))]
    for against, title in (
        ("frames_per_s", "Against frames rendered"),
        ("us_per_stream_ms", "Against the work for a millisecond of stream"),
        ("us_per_frame", "Against the work of a frame"),
    ):
        drawn = draw_work_precision(points, told, against, out / f"work_precision_{against}")
        files += drawn
        sections.append(f"<h2>{title}</h2>" + inline(drawn[0]))
    needs = _needs(points, told)
    sections.append("<h2>Frames a second needed</h2>" + _NEEDS + table(needs))
    effect_table = [
        {
            "effect": row.name,
            "set to": row.setting,
            "us a frame": row.us_per_frame,
            "count": row.scores.count,
            "same sequence": row.scores.right,
            "median shift us": row.scores.t50_us,
            "95 % shift us": row.scores.t95_us,
            "events changed": row.scores.wrong_events,
        }
        for row in effects
    ]
    files.append(write_csv(effect_table, out / "effects.csv"))
    sections.append("<h2>What each effect costs and changes, switched on alone</h2>" + _EFFECTS + table(effect_table))
    sections.append("<h2>All points</h2>" + table([_short(point) for point in points]))
    whole: dict[str, Any] = {
        "needs": needs,
        "points": [p.row() for p in points],
        "effects": effect_table,
        "reading": reading(points, told),
    }
    files.append(write_json(whole, out / "work_precision.json"))
    return [write_page("Speed against accuracy", sections, out / "accuracy.html"), *files]


def write_stability(cells: Sequence[Cell], sweeps: Sequence[Sweep], out: Path) -> list[Path]:
    """Write the map of where methods fail into folder `out`; return the files, the page first."""
    rows = [dataclasses.asdict(cell) for cell in cells]
    drawn = draw_stability(cells, sweeps, out / "stability")
    bounds = _bounds(cells, sweeps)
    files = [write_csv(rows, out / "stability.csv"), *drawn]
    lines = reading_of_the_map(cells, sweeps)
    files.append(write_json({"cells": rows, "boundaries": bounds, "reading": lines}, out / "stability.json"))
    sections = [
        sentences(lines),
        inline(drawn[0]),
        "<h2>Up to where 95 % of the sequences are right</h2>" + table(bounds),
        "<h2>All cells</h2>" + table(rows),
    ]
    return [write_page("Where methods fail", sections, out / "stability.html"), *files]


def write_rendering(rows: Sequence[Drawn], out: Path) -> list[Path]:
    """Write the chart of drawing time against false and missed events into folder `out`; the page first."""
    told = [row.row() for row in rows]
    drawn = draw_rendering(rows, out / "rendering")
    sections = [sentences(reading_of_rendering(rows)), inline(drawn[0]), table(told)]
    page = write_page("What drawing more cheaply costs in events", sections, out / "rendering.html")
    return [page, write_csv(told, out / "rendering.csv"), write_json({"rows": told}, out / "rendering.json"), *drawn]


def reading_of_rendering(rows: Sequence[Drawn]) -> list[str]:
    """Return the findings of the chart, in sentences."""
    said = []
    for rig in dict.fromkeys(row.rig for row in rows):
        own = [row for row in rows if row.rig == rig]
        best = [f"{r.setting} {100 * (r.false + r.missed):.1f} % in {r.ms:.1f} ms" for r in own]
        said.append(f"{rig}: false and missed events together, of {own[0].events}: {'; '.join(best)}.")
    return said


def reading(points: Sequence[Point], told: Mapping[str, str]) -> list[str]:
    """Return the findings of the chart, in sentences."""
    names = list(dict.fromkeys(p.method for p in points))
    lines = [
        "Each point is one method in one step. Full marks have at least 90 % of the pixels' sequences right, hollow "
        "ones fewer; further left and lower is better. Errors are against the continuous-time pixel integrated finely. "
        "Where no event is wrong, the mark stands at the lower edge, a share of 0.0001."
    ]
    for target_us in _TARGETS_US:
        for other in names[1:]:
            known = sorted(_ratios(points, told, other, names[0], target_us))
            finite = [ratio for ratio in known if math.isfinite(ratio)]
            words = other.replace("_", " ")
            if finite:
                lines.append(
                    f"For a 95 % timestamp error of {target_us:g} us, {words} needs {_short_number(finite[0])} to "
                    f"{_short_number(finite[-1])} times the frames that {names[0]} needs, "
                    f"{_short_number(statistics.median(finite))} in the middle of {len(finite)} scenes."
                )
            elif known:
                lines.append(f"A 95 % timestamp error of {target_us:g} us is out of reach of {words} in every scene.")
    return lines


def _ratios(
    points: Sequence[Point], told: Mapping[str, str], other: str, ours: str, target_us: float
) -> Iterator[float]:
    """Yield how many times our frames another method needs, scene by scene, where we have a figure from the sweep."""
    for case in told:
        need, theirs = (frames_needed(points, case, name, target_us) for name in (ours, other))
        if need.kind in ("between", "at most") and theirs.kind != "at most":
            yield theirs.frames_per_s / need.frames_per_s


def _short_number(value: float) -> str:
    """Return a number to two digits, never with an exponent."""
    return f"{float(f'{value:.2g}'):g}" if value < 1e5 else f"{value:.1e}"


def _needs(points: Sequence[Point], told: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the table of frames a second needed, a row a scene and error."""
    names = list(dict.fromkeys(p.method for p in points))
    return [
        {"scene": words, "95 % error, us": target_us}
        | {name: str(frames_needed(points, case, name, target_us)) for name in names}
        for target_us in _TARGETS_US
        for case, words in told.items()
    ]


def reading_of_the_map(cells: Sequence[Cell], sweeps: Sequence[Sweep]) -> list[str]:
    """Return the findings of the map, in sentences."""
    names = list(dict.fromkeys(cell.method for cell in cells))
    lines = [
        "Each column drives one thing from harmless to absurd. Above: the share of pixels whose sequence of events is "
        "right, with the line of 95 %; below: the 95 % timestamp error of those, in steps."
    ]
    for sweep in sweeps:
        limits = {name: boundary(cells, sweep, name) for name in names}
        never = [name for name, limit in limits.items() if limit is None]
        held = [f"{name} to {limit:g}" for name, limit in limits.items() if limit is not None]
        lines.append(
            f"{sweep.told} ({sweep.label}): "
            + (", ".join(held) or "none holds")
            + (f"; {', '.join(never)} nowhere" if never and held else "")
            + "."
        )
    return lines


def _bounds(cells: Sequence[Cell], sweeps: Sequence[Sweep]) -> list[dict[str, Any]]:
    names = list(dict.fromkeys(cell.method for cell in cells))
    return [
        {"axis": f"{sweep.told} ({sweep.label})"} | {name: boundary(cells, sweep, name) for name in names}
        for sweep in sweeps
    ]


def _short(point: Point) -> dict[str, Any]:
    row = point.row()
    wanted = (
        "case method step_ms us_per_frame right t50_us t95_us count wrong_events van_rossum earth_mover_us same_time"
    )
    return {name: row[name] for name in wanted.split()}


_NEEDS = (
    "<p>For a 95 % timestamp error with at least 90 % of the sequences right; “about”: beyond the shortest step swept, "
    "by the order that the three shortest show; “never”: the error does not fall with the step.</p>"
)
_EFFECTS = (
    "<p>Each effect added to the ideal sensor (equal thresholds, no leak, no low-pass, no refractory period, no noise) "
    "under the moving checkerboard; counts, sequences and shifts are against the ideal sensor's events, and the time "
    "is that of a whole step of 346 x 260 pixels.</p>"
)

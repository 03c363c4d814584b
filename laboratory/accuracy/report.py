"""Reports of accuracy: CSV, JSON, charts by matplotlib (the extra `report`), and a page that needs no network."""

from __future__ import annotations

import dataclasses
import importlib
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from emulator.report.page import Page, figure_legend, panels, save, write_csv, write_json
from laboratory.accuracy.harness import Swept
from laboratory.accuracy.rendering import Drawn
from laboratory.accuracy.stability import Cell, Sweep, boundary
from laboratory.accuracy.sweeps import (
    BLURS_PX,
    SPEEDS_PX,
    Difference,
    EffectRow,
    Point,
    frames_needed,
    reading_against_line,
)

_MARKS = {  # colour and marker
    "hermite": ("#000000", "o"),
    "refined": ("#56b4e9", "P"),
    "line": ("#0072b2", "s"),
    "pangu": ("#d55e00", "D"),
}
_COLUMNS = 4
_FLOOR_US = 1e-3
_FLOOR_SHARE = 1e-4


def _style(name: str) -> dict[str, Any]:
    colour, marker = _MARKS.get(name, ("#56b4e9", "."))
    return {
        "color": colour,
        "marker": marker,
        "label": name.replace("_", " "),
        "markersize": 5,
        "linewidth": 2.0 if name == "hermite" else 1.2,
    }


def _above(value: float, floor: float) -> float:
    """Return a value for a logarithmic axis: at least its floor; NaN stays NaN."""
    return value if math.isnan(value) else max(value, floor)


def draw_work_precision(points: Sequence[Point], descriptions: dict[str, str], against: str, stem: Path) -> list[Path]:
    """Draw timestamp error and wrong-event share of each scene against work; return the files written.

    Parameters
    ----------
    descriptions : scenes by name, in the order of the chart, with a few words on each.
    against : "frames_per_s", "us_per_frame" or "us_per_stream_ms".
    stem : path without suffix.
    """
    figure, found = panels(len(descriptions), _COLUMNS, 4.0, 2.7, high=2)
    quantities: tuple[tuple[str, Callable[[Point], float], float], ...] = (
        ("95 % timestamp error, us", lambda p: _above(p.scores.t95_us, _FLOOR_US), _FLOOR_US),
        ("wrong events, share", lambda p: _above(p.scores.wrong_events, _FLOOR_SHARE), _FLOOR_SHARE),
    )
    for k, (panel, name) in enumerate(zip(found, descriptions, strict=True)):
        for axes, (label, value, floor) in zip(panel, quantities, strict=True):
            _panel(axes, [p for p in points if p.case == name], against, value)
            axes.set_ylim(bottom=floor * 0.7)
            axes.set_ylabel(label if k % _COLUMNS == 0 else "", fontsize=9)
        panel[0].set_title(descriptions[name], fontsize=10)
        panel[1].set_xlabel(_AGAINST[against], fontsize=9)
    figure_legend(figure)
    return save(figure, stem)


_AGAINST = {
    "frames_per_s": "frames rendered for a second of stream",
    "us_per_frame": "pixel work, us a frame of 346 x 260",
    "us_per_stream_ms": "pixel work, us for a millisecond of stream",
}


def _panel(axes: Any, points: Sequence[Point], against: str, value: Callable[[Point], float]) -> None:
    """Draw one scene: a line a method, a point a setting; hollow where fewer than 90 % of the sequences are right."""
    for name in dict.fromkeys(p.method for p in points):
        row = [p for p in points if p.method == name]
        x = [getattr(p, against) for p in row]
        y = [value(p) for p in row]
        style = _style(name)
        axes.plot(x, y, **style, markerfacecolor="none", alpha=0.9)
        good = [value(p) if p.scores.right >= 0.9 else math.nan for p in row]
        axes.plot(x, good, linestyle="none", color=style["color"], marker=style["marker"], markersize=5)
    axes.set_xscale("log")
    axes.set_yscale("log")
    ticks = importlib.import_module("matplotlib.ticker")
    axes.xaxis.set_major_locator(ticks.LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axes.xaxis.set_major_formatter(ticks.FuncFormatter(lambda value, _: f"{value:,.0f}".replace(",", " ")))
    axes.xaxis.set_minor_formatter(ticks.NullFormatter())
    axes.tick_params(axis="x", rotation=45)
    axes.grid(True, which="major", alpha=0.3)
    axes.tick_params(labelsize=8)


def draw_rendering(rows: Sequence[Drawn], stem: Path) -> list[Path]:
    """Draw false and missed events of each rig's settings against the time of a light frame."""
    names = list(dict.fromkeys(row.rig for row in rows))
    settings = list(dict.fromkeys(row.setting for row in rows))
    figure, found = panels(len(names), _COLUMNS, 4.0, 4.1)
    for (axes,), name in zip(found, names, strict=True):
        for row in (row for row in rows if row.rig == name):
            k = settings.index(row.setting)
            share = 100 * _above(row.false + row.missed, _FLOOR_SHARE)
            axes.plot(row.ms, share, marker="os^Dv<>pXP*h"[k % 12], color=f"C{k % 10}", linestyle="", label=row.setting)
        axes.set_title(name, fontsize=10)
        axes.set_xlim(left=0)
        axes.set_yscale("log")
        axes.set_ylim(0.1, 200)
        axes.set_xlabel("CPU ms a step, all threads", fontsize=9)
        axes.set_ylabel("false + missed events, %", fontsize=9)
        axes.grid(True, which="both", alpha=0.3)
        axes.tick_params(labelsize=8, which="both")
    figure_legend(figure, ncols=min(4, len(settings)), fontsize=8)
    return save(figure, stem)


def draw_stability(cells: Sequence[Cell], sweeps: Sequence[Sweep], stem: Path) -> list[Path]:
    """Draw the share of right sequences and the timestamp error of every method along each axis of the map."""
    figure, found = panels(len(sweeps), _COLUMNS, 4.0, 2.4, high=2)
    for k, ((upper, lower), sweep) in enumerate(zip(found, sweeps, strict=True)):
        own = [cell for cell in cells if cell.axis == sweep.axis]
        _strip(upper, own, sweep, lambda c: 100 * c.right)
        _strip(lower, own, sweep, lambda c: _above(c.t95_steps, 1e-7))
        upper.set_ylim(-3, 103)
        upper.set_xticklabels([])
        upper.axhline(95, color="black", linewidth=0.6, linestyle=":")
        lower.set_yscale("log")
        low, high = lower.get_ylim()
        lower.set_ylim(min(low, high / 100), 1.5 * high)
        upper.set_title(sweep.description, fontsize=10)
        upper.set_ylabel("right sequences, %" if k % _COLUMNS == 0 else "", fontsize=9)
        lower.set_ylabel("95 % timestamp error, steps" if k % _COLUMNS == 0 else "", fontsize=9)
        lower.set_xlabel(sweep.label, fontsize=9)
    figure_legend(figure)
    return save(figure, stem)


def _strip(axes: Any, cells: Sequence[Cell], sweep: Sweep, value: Callable[[Cell], float]) -> None:
    """Draw one axis of the map, its values at equal distances."""
    for name in dict.fromkeys(cell.method for cell in cells):
        row = [cell for cell in cells if cell.method == name]
        axes.plot([sweep.values.index(cell.value) for cell in row], [value(cell) for cell in row], **_style(name))
    axes.set_xticks(range(len(sweep.values)), [f"{value:g}" for value in sweep.values], rotation=45, fontsize=8)
    axes.grid(True, alpha=0.3)
    axes.tick_params(labelsize=8)


_TARGETS_US = (10.0, 100.0)


def write_work_precision(
    points: Sequence[Point], effects: Sequence[EffectRow], cases: Sequence[Swept], out: Path
) -> list[Path]:
    """Write the chart of speed against accuracy into folder `out`; return the files, the page first."""
    descriptions = {swept.case.name: swept.description for swept in cases}
    quiet = {swept.case.name: swept.description for swept in cases if not swept.has_noise}
    lines, needs = [*reading(points, quiet), *_reading_of_noise(points, cases)], _needs(points, quiet)
    page = Page("Speed against accuracy").findings(lines)
    files = [write_csv([point.row() for point in points], out / "work_precision.csv")]
    for against, title in (
        ("frames_per_s", "Against frames rendered"),
        ("us_per_stream_ms", "Against the work for a millisecond of stream"),
        ("us_per_frame", "Against the work of a frame"),
    ):
        drawn = draw_work_precision(points, descriptions, against, out / f"work_precision_{against}")
        files += drawn
        page.heading(title).drawn(drawn)
    page.heading("Frames a second needed").text(_NEEDS).records(needs)
    effect_table = [_effect(row) for row in effects]
    files.append(write_csv(effect_table, out / "effects.csv"))
    page.heading("What each effect costs and changes, switched on alone").text(_EFFECTS).records(effect_table)
    page.heading("All points").records([_short(point) for point in points])
    whole = {"needs": needs, "points": [p.row() for p in points], "effects": effect_table, "reading": lines}
    files.append(write_json(whole, out / "work_precision.json"))
    return [page.write(out / "accuracy.html"), *files]


def _effect(row: EffectRow) -> dict[str, Any]:
    return {
        "effect": row.name,
        "set to": row.setting,
        "us a frame": row.us_per_frame,
        "count": row.scores.count,
        "same sequence": row.scores.right,
        "median shift us": row.scores.t50_us,
        "95 % shift us": row.scores.t95_us,
        "events changed": row.scores.wrong_events,
    }


def write_stability(cells: Sequence[Cell], sweeps: Sequence[Sweep], out: Path) -> list[Path]:
    """Write the map of the limits of methods into folder `out`; return the files, the page first."""
    rows = [dataclasses.asdict(cell) for cell in cells]
    drawn = draw_stability(cells, sweeps, out / "stability")
    bounds = _bounds(cells, sweeps)
    files = [write_csv(rows, out / "stability.csv"), *drawn]
    lines = reading_of_the_map(cells, sweeps)
    files.append(write_json({"cells": rows, "boundaries": bounds, "reading": lines}, out / "stability.json"))
    page = Page("Where methods fail").findings(lines).drawn(drawn)
    page.heading("Up to where 95 % of the sequences are right").records(bounds).heading("All cells").records(rows)
    return [page.write(out / "stability.html"), *files]


def write_rendering(rows: Sequence[Drawn], out: Path) -> list[Path]:
    """Write the chart of drawing time against false and missed events into folder `out`; the page first."""
    records = [dataclasses.asdict(row) for row in rows]
    drawn = draw_rendering(rows, out / "rendering")
    page = Page("What drawing more cheaply costs in events").findings(reading_of_rendering(rows))
    page.drawn(drawn).records(records)
    data = [write_csv(records, out / "rendering.csv"), write_json({"rows": records}, out / "rendering.json")]
    return [page.write(out / "rendering.html"), *data, *drawn]


def reading_of_rendering(rows: Sequence[Drawn]) -> list[str]:
    """Return the findings of the chart, in sentences: settings from the cheapest on."""
    lines = []
    for rig in dict.fromkeys(row.rig for row in rows):
        own = sorted((row for row in rows if row.rig == rig), key=lambda row: row.ms)
        best = [f"{r.setting} {r.ms:.1f} ms, {100 * (r.false + r.missed):.2f} %, {r.t50_ms:.2g} ms" for r in own]
        lines.append(f"{rig}: cost of a step, false and missed events of {own[0].events}, t50: {'; '.join(best)}.")
    return lines


def reading(points: Sequence[Point], descriptions: Mapping[str, str]) -> list[str]:
    """Return the findings of the chart, in sentences."""
    names = list(dict.fromkeys(p.method for p in points))
    lines = [
        "Each point is one method in one step. Full marks have at least 90 % of the pixels' sequences right, hollow "
        "marks fewer; further left and lower is better. Errors are against the continuous-time pixel in fine steps. "
        "Where no event is wrong, the mark is at the lower edge, a share of 0.0001."
    ]
    for target_us in _TARGETS_US:
        for other in names[1:]:
            known = sorted(_ratios(points, descriptions, other, names[0], target_us))
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


def _reading_of_noise(points: Sequence[Point], cases: Sequence[Swept]) -> Iterator[str]:
    """Yield the findings of each scene with noise, a sentence each."""
    for swept in cases:
        row = [p for p in points if p.case == swept.case.name]
        if swept.has_noise and row:
            yield (
                f"{swept.description}, beside {row[0].scores.true_events} events of the reference: in all steps and "
                f"methods rates differ by {max(p.scores.wrong_events for p in row):.1%} at the most, and sequences are "
                f"alike to {min(p.scores.right for p in row):.1%} at the least."
            )


def _ratios(
    points: Sequence[Point], descriptions: Mapping[str, str], other: str, ours: str, target_us: float
) -> Iterator[float]:
    """Yield the frames that another method needs over ours, scene by scene, where the sweep gives our number."""
    for case in descriptions:
        need, theirs = (frames_needed(points, case, name, target_us) for name in (ours, other))
        if need.kind in ("between", "at most") and theirs.kind != "at most":
            yield theirs.frames_per_s / need.frames_per_s


def _short_number(value: float) -> str:
    """Return a number to two digits, never with an exponent."""
    return f"{float(f'{value:.2g}'):g}" if value < 1e5 else f"{value:.1e}"


def _needs(points: Sequence[Point], descriptions: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the table of frames a second needed, a row a scene and error."""
    names = list(dict.fromkeys(p.method for p in points))
    return [
        {"scene": words, "95 % error, us": target_us}
        | {name: str(frames_needed(points, case, name, target_us)) for name in names}
        for target_us in _TARGETS_US
        for case, words in descriptions.items()
    ]


def reading_of_the_map(cells: Sequence[Cell], sweeps: Sequence[Sweep]) -> list[str]:
    """Return the findings of the map, in sentences."""
    names = list(dict.fromkeys(cell.method for cell in cells))
    lines = [
        "Each column varies one quantity from harmless to extreme. Above: the share of pixels whose sequence of events "
        "is right, with the line of 95 %; below: the 95 % timestamp error of those, in steps."
    ]
    for sweep in sweeps:
        limits = {name: boundary(cells, sweep, name) for name in names}
        never = [name for name, limit in limits.items() if limit is None]
        held = [f"{name} to {limit:g}" for name, limit in limits.items() if limit is not None]
        lines.append(
            f"{sweep.description} ({sweep.label}): "
            + (", ".join(held) or "none holds")
            + (f"; {', '.join(never)} nowhere" if never and held else "")
            + "."
        )
    return lines


def _bounds(cells: Sequence[Cell], sweeps: Sequence[Sweep]) -> list[dict[str, Any]]:
    names = list(dict.fromkeys(cell.method for cell in cells))
    return [
        {"axis": f"{sweep.description} ({sweep.label})"} | {name: boundary(cells, sweep, name) for name in names}
        for sweep in sweeps
    ]


def _short(point: Point) -> dict[str, Any]:
    row = point.row()
    wanted = "case method step_ms us_per_frame right t50_us t95_us count wrong_events earth_mover_us same_time"
    return {name: row[name] for name in wanted.split()}


_NEEDS = (
    "For a 95 % timestamp error with at least 90 % of the sequences right; “about”: beyond the shortest step swept, "
    "by the order that the three shortest show; “never”: the error does not fall with the step."
)
_EFFECTS = (
    "Each effect added to the ideal sensor (equal thresholds, no leak, no low-pass, no refractory period, no noise) "
    "under the moving checkerboard; counts, sequences and shifts are against the ideal sensor's events, and the time "
    "is that of a whole step of 346 x 260 pixels."
)


_PANELS: tuple[tuple[str, Callable[[Difference], float], float], ...] = (
    ("right sequences, points", lambda c: 100 * (c.right_hermite - c.right_line), 1.0),
    ("wrong events, points", lambda c: 100 * (c.wrong_hermite - c.wrong_line), -1.0),
)
_LIMIT = 20.0  # points, where the colours end
_DARK = 0.6  # of the limit: from there on cells are dark
_MAP_COLUMNS = 3


def write_against_line(cells: Sequence[Difference], out: Path) -> list[Path]:
    """Write the map into folder `out`; return the files, the page first."""
    rows = [dataclasses.asdict(cell) for cell in cells]
    drawn = _draw(cells, out / "against_line")
    page = Page("hermite against line").findings(reading_against_line(cells)).drawn(drawn).records(rows)
    return [page.write(out / "against_line.html"), write_csv(rows, out / "against_line.csv"), *drawn]


def _draw(cells: Sequence[Difference], stem: Path) -> list[Path]:
    """Draw one map a scene and quantity: blue where hermite is better, red where it is worse."""
    names = list(dict.fromkeys(cell.scene for cell in cells))
    figure, found = panels(len(names), _MAP_COLUMNS, 3.2, 2.6, high=2)
    for k, (panel, name) in enumerate(zip(found, names, strict=True)):
        own = {(cell.blur_px, cell.speed_px): cell for cell in cells if cell.scene == name}
        for axes, (label, value, sign) in zip(panel, _PANELS, strict=True):
            _map(axes, [[value(own[blur, speed]) for speed in SPEEDS_PX] for blur in BLURS_PX], sign)
            axes.set_title(f"{name}\n{label}", fontsize=9)
            axes.set_xlabel("px a step", fontsize=8)
            axes.set_ylabel("blur, px" if k % _MAP_COLUMNS == 0 else "", fontsize=8)
    return save(figure, stem)


def _map(axes: Any, values: list[list[float]], sign: float) -> None:
    axes.imshow([[sign * v for v in row] for row in values], cmap="RdBu", vmin=-_LIMIT, vmax=_LIMIT, aspect="auto")
    for i, row in enumerate(values):
        for k, v in enumerate(row):
            colour = "white" if abs(v) > _DARK * _LIMIT else "black"
            axes.text(k, i, f"{v:+.1f}", ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(SPEEDS_PX)), [f"{v:g}" for v in SPEEDS_PX], fontsize=7)
    axes.set_yticks(range(len(BLURS_PX)), [f"{v:g}" for v in BLURS_PX], fontsize=7)

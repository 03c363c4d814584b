"""The charts of accuracy, drawn by matplotlib (the extra `report`)."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from emulator.accuracy.rendering import Drawn
from emulator.accuracy.stability import Cell, Sweep
from emulator.accuracy.work_precision import Point
from emulator.report.figures import pyplot, save

__all__ = ["draw_rendering", "draw_stability", "draw_work_precision"]

_COLOURS = {
    "hermite": "#000000",
    "refined": "#56b4e9",
    "line": "#0072b2",
    "v2e_exact_filter": "#009e73",
    "v2e": "#e69f00",
    "pangu": "#d55e00",
    "sikorski": "#cc79a7",
    "esim": "#7f5fa8",
    "frame_difference": "#999999",
}
_MARKERS = {
    "hermite": "o",
    "refined": "P",
    "line": "s",
    "v2e_exact_filter": "v",
    "v2e": "^",
    "pangu": "D",
    "sikorski": "x",
    "esim": "+",
}
_COLUMNS = 4
_GRID: dict[str, Any] = {"squeeze": False, "layout": "constrained"}
_FLOOR_US = 1e-3
_FLOOR_SHARE = 1e-4


def _style(name: str) -> dict[str, Any]:
    return {
        "color": _COLOURS.get(name, "#56b4e9"),
        "marker": _MARKERS.get(name, "."),
        "label": name.replace("_", " "),
        "markersize": 5,
        "linewidth": 2.0 if name == "hermite" else 1.2,
        "linestyle": "--" if name in ("esim", "v2e") else "-",  # where it runs over another
    }


def _legend(figure: Any, axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)


def _above(value: float, floor: float) -> float:
    """Return a value fit for a logarithmic axis: never below its floor, NaN stays."""
    return value if math.isnan(value) else max(value, floor)


def draw_work_precision(points: Sequence[Point], told: dict[str, str], against: str, stem: Path) -> list[Path]:
    """Draw timestamp error and wrong-event share of each scene against work; return the files written.

    Parameters
    ----------
    told : scenes by name, in the order of the chart, with a few words on each.
    against : "frames_per_s", "us_per_frame" or "us_per_stream_ms".
    stem : path without suffix.
    """
    plt = pyplot()
    names = list(told)
    columns = min(_COLUMNS, len(names))
    bands = math.ceil(len(names) / columns)
    figure, grid = plt.subplots(2 * bands, columns, figsize=(4.0 * columns, 5.2 * bands + 0.5), **_GRID)
    quantities: tuple[tuple[str, Callable[[Point], float], float], ...] = (
        ("95 % timestamp error, us", lambda p: _above(p.scores.t95_us, _FLOOR_US), _FLOOR_US),
        ("wrong events, share", lambda p: _above(p.scores.wrong_events, _FLOOR_SHARE), _FLOOR_SHARE),
    )
    for k in range(bands * columns):
        for row, (label, value, floor) in enumerate(quantities):
            axes = grid[2 * (k // columns) + row][k % columns]
            if k >= len(names):
                axes.set_visible(False)
                continue
            _panel(axes, [p for p in points if p.case == names[k]], against, value)
            axes.set_ylim(bottom=floor * 0.7)
            axes.set_title(told[names[k]] if row == 0 else "", fontsize=10)
            axes.set_ylabel(label if k % columns == 0 else "", fontsize=9)
            axes.set_xlabel(_AGAINST[against] if row == 1 else "", fontsize=9)
    _legend(figure, grid[0][0])
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
        x, y, style = [getattr(p, against) for p in row], [value(p) for p in row], _style(name)
        axes.plot(x, y, **style, markerfacecolor="none", alpha=0.9)
        good = [p.scores.right >= 0.9 for p in row]
        axes.plot(
            [a for a, g in zip(x, good, strict=True) if g],
            [b for b, g in zip(y, good, strict=True) if g],
            linestyle="none", color=style["color"], marker=style["marker"], markersize=5,
        )  # fmt: skip
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
    """Draw false and missed events of each rig's settings against the time of a picture."""
    plt = pyplot()
    names = list(dict.fromkeys(row.rig for row in rows))
    settings = list(dict.fromkeys(row.setting for row in rows))
    columns = min(_COLUMNS, len(names))
    bands = math.ceil(len(names) / columns)
    figure, grid = plt.subplots(bands, columns, figsize=(4.0 * columns, 3.6 * bands + 1.0), **_GRID)
    for axes, name in zip(grid.ravel(), names, strict=False):
        for row in (row for row in rows if row.rig == name):
            k = settings.index(row.setting)
            share = 100 * _above(row.false + row.missed, _FLOOR_SHARE)
            axes.plot(row.ms, share, marker="os^Dv<>pXP*h"[k % 12], color=f"C{k % 10}", linestyle="", label=row.setting)
        _name_rendering(axes, name)
    for axes in grid.ravel()[len(names) :]:
        axes.set_visible(False)
    shown: dict[str, Any] = {}
    for axes in grid.ravel():
        shown |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(
        shown.values(), shown, loc="outside upper center", ncols=min(4, len(shown)), frameon=False, fontsize=8
    )
    return save(figure, stem)


def _name_rendering(axes: Any, name: str) -> None:
    axes.set_title(name, fontsize=10)
    axes.set_xlim(left=0)
    axes.set_yscale("log")
    axes.set_ylim(0.1, 200)
    axes.set_xlabel("CPU ms a picture, all threads", fontsize=9)
    axes.set_ylabel("false + missed events, %", fontsize=9)
    axes.grid(True, which="both", alpha=0.3)
    axes.tick_params(labelsize=8, which="both")


def draw_stability(cells: Sequence[Cell], sweeps: Sequence[Sweep], stem: Path) -> list[Path]:
    """Draw the share of right sequences and the timestamp error of every method along each axis of the map."""
    plt = pyplot()
    columns = min(_COLUMNS, len(sweeps))
    bands = math.ceil(len(sweeps) / columns)
    figure, grid = plt.subplots(2 * bands, columns, figsize=(4.0 * columns, 4.6 * bands + 0.5), **_GRID)
    for k in range(bands * columns):
        upper, lower = (grid[2 * (k // columns) + row][k % columns] for row in range(2))
        if k >= len(sweeps):
            upper.set_visible(False)
            lower.set_visible(False)
            continue
        own = [cell for cell in cells if cell.axis == sweeps[k].axis]
        _strip(upper, own, sweeps[k], lambda c: 100 * c.right)
        _strip(lower, own, sweeps[k], lambda c: _above(c.t95_steps, 1e-7))
        upper.set_ylim(-3, 103)
        upper.set_xticklabels([])
        upper.axhline(95, color="black", linewidth=0.6, linestyle=":")
        lower.set_yscale("log")
        low, high = lower.get_ylim()
        lower.set_ylim(min(low, high / 100), 1.5 * high)
        upper.set_title(sweeps[k].told, fontsize=10)
        upper.set_ylabel("right sequences, %" if k % columns == 0 else "", fontsize=9)
        lower.set_ylabel("95 % timestamp error, steps" if k % columns == 0 else "", fontsize=9)
        lower.set_xlabel(sweeps[k].label, fontsize=9)
    _legend(figure, grid[0][0])
    return save(figure, stem)


def _strip(axes: Any, cells: Sequence[Cell], sweep: Sweep, value: Callable[[Cell], float]) -> None:
    """Draw one axis of the map, its values at equal distances."""
    for name in dict.fromkeys(cell.method for cell in cells):
        row = [cell for cell in cells if cell.method == name]
        axes.plot([sweep.values.index(cell.value) for cell in row], [value(cell) for cell in row], **_style(name))
    axes.set_xticks(range(len(sweep.values)), [f"{value:g}" for value in sweep.values], rotation=45, fontsize=8)
    axes.grid(True, alpha=0.3)
    axes.tick_params(labelsize=8)

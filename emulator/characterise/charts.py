"""The charts of a characterisation: points measured, the equations as thin lines, published figures in red."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from emulator.characterise.points import CURVES, Curve, Point
from emulator.characterise.published import PUBLISHED, Published
from emulator.report.figures import pyplot, save

__all__ = ["draw"]

_COLOURS = ("#0072b2", "#009e73", "#e69f00", "#7f5fa8")
_RED = "#c0392b"
_STARS = ("*", "P", "X", "d")
_DASHES = ("--", ":", "-.", (0, (6, 2, 1, 2, 1, 2)))
_BARS = "latency"
_LABEL = 72  # letters a line


def draw(points: Sequence[Point], out: Path) -> dict[str, list[Path]]:
    """Draw every chart whose curves have points into folder `out`; return the files of each, SVG first."""
    files = {}
    drawn = {point.curve for point in points}
    for chart in dict.fromkeys(curve.chart for curve in CURVES.values()):
        names = [name for name, curve in CURVES.items() if curve.chart == chart and name in drawn]
        if names:
            files[chart] = _chart(points, names, out / chart)
    return files


def _chart(points: Sequence[Point], names: Sequence[str], stem: Path) -> list[Path]:
    size = 5.4 * len(names), 5.4
    figure, grid = pyplot().subplots(1, len(names), figsize=size, squeeze=False, gridspec_kw={"wspace": 0.25})
    for axes, name in zip(grid[0], names, strict=True):
        _panel(axes, CURVES[name], [point for point in points if point.curve == name])
        _mark(axes, [known for known in PUBLISHED if known.curve == name])
        _legend(axes)
    return save(figure, stem)


def _legend(axes: Any) -> None:
    """Put the legend below its panel: files are cut to what is drawn, however long it is."""
    handles, labels = axes.get_legend_handles_labels()
    told = ["\n".join(textwrap.wrap(label, _LABEL)) for label in labels]
    axes.legend(handles, told, fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(0, -0.11))


def _panel(axes: Any, curve: Curve, points: Sequence[Point]) -> None:
    axes.set_xscale("log" if curve.log_x else "linear")
    axes.set_yscale("log" if curve.log_y else "linear")
    for colour, name in zip(_COLOURS, dict.fromkeys(point.series for point in points), strict=False):
        row = sorted((p for p in points if p.series == name), key=lambda point: point.x)
        _line(axes, [p for p in row if p.y > curve.least or not curve.log_y], name, colour)
        modelled = [p for p in row if math.isfinite(p.model) and (p.model > 0 or not curve.log_y)]
        axes.plot([p.x for p in modelled], [p.model for p in modelled], color=colour, linewidth=0.9, zorder=1)
    shown = [p.y for p in points if p.y > curve.least]
    if curve.log_y and shown:
        axes.set_ylim(min(shown) / 3, max(shown) * 3)
    axes.set_title(curve.title, fontsize=10)
    axes.set_xlabel(curve.x_label, fontsize=9)
    axes.set_ylabel(curve.y_label, fontsize=9)
    axes.grid(True, alpha=0.3)
    axes.tick_params(labelsize=8)


def _line(axes: Any, row: Sequence[Point], name: str, colour: str) -> None:
    """Draw one series: marks alone, with bars where each point has a spread and the curve is of times."""
    x, y = [p.x for p in row], [p.y for p in row]
    axes.plot(x, y, linestyle="none", marker="o", markersize=4, color=colour, label=name)
    if row and row[0].curve == _BARS:
        below, above = [p.y - p.low for p in row], [p.high - p.y for p in row]
        axes.errorbar(x, y, yerr=[below, above], fmt="none", ecolor=colour, elinewidth=1, capsize=2)


def _mark(axes: Any, known: Sequence[Published]) -> None:
    """Draw published figures: a star where place and value are known, else a line or a band across."""
    low, high = axes.get_ylim()
    for k, figure in enumerate(known):
        dashes = _DASHES[k % len(_DASHES)]
        style: dict[str, Any] = {"color": _RED, "label": f"{figure.told} ({figure.source.split(',')[0]}; {figure.how})"}
        if not figure.y:
            axes.axvline(figure.x[0], linestyle=dashes, linewidth=1.2, **style)
        elif not figure.x and len(figure.y) == 2:
            axes.axhspan(*figure.y, alpha=0.2, linewidth=0, **style)
        elif not figure.x:
            axes.axhline(figure.y[0], linestyle=dashes, linewidth=1.2, **style)
        elif len(figure.x) > 2:
            axes.plot(figure.x, figure.y, linestyle="--", linewidth=1.4, **style)
        else:
            _place(axes, figure, _STARS[k % len(_STARS)], style)
        values = [value for value in figure.y if value > 0 and len(figure.x) < 3]
        low, high = min([low, *(value / 2 for value in values)]), max([high, *(value * 2 for value in values)])
    if axes.get_yscale() == "log":
        axes.set_ylim(low, high)


def _place(axes: Any, figure: Published, star: str, style: dict[str, Any]) -> None:
    """Draw a figure at one place, or a box where both place and value are ranges."""
    if len(figure.x) == 1:
        axes.plot(figure.x, figure.y, linestyle="none", marker=star, markersize=12, zorder=5, **style)
    else:
        (left, right), (bottom, top) = figure.x, figure.y
        axes.fill([left, right, right, left], [bottom, bottom, top, top], alpha=0.3, linewidth=0, **style)

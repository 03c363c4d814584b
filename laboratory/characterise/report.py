"""Comparison of measured with published values, and its page, tables and charts.

The charts show measured points, the equations as thin lines, and published values in red.
"""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emulator.report.page import Page, panels, save, write_csv, write_json
from laboratory.characterise.published import PUBLISHED, Published
from laboratory.characterise.stimuli import CURVES, FIGURE, Curve, Point

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
    figure, found = panels(len(names), len(names), 5.4, 5.4, layout="none")  # a legend below must not shrink them
    figure.subplots_adjust(wspace=0.25)
    for (axes,), name in zip(found, names, strict=True):
        _panel(axes, CURVES[name], [point for point in points if point.curve == name])
        _mark(axes, [known for known in PUBLISHED if known.curve == name])
        _legend(axes)
    return save(figure, stem)


def _legend(axes: Any) -> None:
    """Put the legend below its panel: files are cropped to the drawn area, however long the legend is."""
    handles, labels = axes.get_legend_handles_labels()
    texts = ["\n".join(textwrap.wrap(label, _LABEL)) for label in labels]
    axes.legend(handles, texts, fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(0, -0.11))


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
    """Draw one series: marks only, with bars where each point has a spread and the curve is of times."""
    x, y = [p.x for p in row], [p.y for p in row]
    axes.plot(x, y, linestyle="none", marker="o", markersize=4, color=colour, label=name)
    if row and row[0].curve == _BARS:
        below, above = [p.y - p.low for p in row], [p.high - p.y for p in row]
        axes.errorbar(x, y, yerr=[below, above], fmt="none", ecolor=colour, elinewidth=1, capsize=2)


def _mark(axes: Any, known: Sequence[Published]) -> None:
    """Draw published values: a star where position and value are known, else a line or a band across."""
    low, high = axes.get_ylim()
    for k, figure in enumerate(known):
        dashes = _DASHES[k % len(_DASHES)]
        style: dict[str, Any] = {
            "color": _RED,
            "label": f"{figure.description} ({figure.source.split(',')[0]}; {figure.how})",
        }
        if not figure.y:
            axes.axvline(figure.x[0], linestyle=dashes, linewidth=1.2, **style)
        elif not figure.x and len(figure.y) == 2:
            axes.axhspan(*figure.y, alpha=0.2, linewidth=0, **style)
        elif not figure.x:
            axes.axhline(figure.y[0], linestyle=dashes, linewidth=1.2, **style)
        else:
            _place(axes, figure, _STARS[k % len(_STARS)], style)
        values = [value for value in figure.y if value > 0]
        low, high = min([low, *(value / 2 for value in values)]), max([high, *(value * 2 for value in values)])
    if axes.get_yscale() == "log":
        axes.set_ylim(low, high)


def _place(axes: Any, figure: Published, star: str, style: dict[str, Any]) -> None:
    """Draw a published value at one position, or a box where both position and value are ranges."""
    if len(figure.x) == 1:
        axes.plot(figure.x, figure.y, linestyle="none", marker=star, markersize=12, zorder=5, **style)
    else:
        (left, right), (bottom, top) = figure.x, figure.y
        axes.fill([left, right, right, left], [bottom, bottom, top, top], alpha=0.3, linewidth=0, **style)


_TITLES = {
    "s_curve": "How high the thresholds are",
    "spread": "How much pixels differ",
    "leak": "Leak",
    "noise": "Temporal noise",
    "latency": "Latency, bandwidth, and the wait at the read-out",
    "flicker": "Flicker and dead time",
}


@dataclass(frozen=True, slots=True)
class Comparison:
    """A published value beside ours.

    Attributes
    ----------
    published : the published value.
    low, high : our values at its position: least and largest of the lines and points compared with it; NaN: none.
    verdict : "agrees", "as preset" (agrees with the source of the presets), "differs", or "not compared".
    """

    published: Published
    low: float
    high: float
    verdict: str

    def row(self) -> dict[str, object]:
        """Return it as a row of a table."""
        known = self.published
        return {
            "published": known.description,
            "here": _span(self.low, self.high),
            "verdict": self.verdict,
            "within a factor": known.tolerance or None,
            "of": CURVES[known.curve].title if known.curve in CURVES else known.series,
            "source": known.source,
            "how": known.how,
            "remark": known.remark,
        }


def comparisons(points: Sequence[Point]) -> list[Comparison]:
    """Compare every published value with the points."""
    return [_compare(known, points) for known in PUBLISHED]


def _compare(known: Published, points: Sequence[Point]) -> Comparison:
    own = [p for p in points if p.curve == known.curve and known.series in ("", p.series)]
    here = _at(known, own)
    if not here or known.tolerance == 0:
        return Comparison(known, *_ends(here), "not compared")
    agrees = max(here) * known.tolerance >= min(known.y) and min(here) <= max(known.y) * known.tolerance
    good = "as preset" if known.own else "agrees"
    return Comparison(known, *_ends(here), good if agrees else "differs")


def _ends(values: Sequence[float]) -> tuple[float, float]:
    return (min(values), max(values)) if values else (math.nan, math.nan)


def _at(known: Published, own: Sequence[Point]) -> list[float]:
    """Return our values at the published position: of each line at its x, of all points where it has none."""
    if not known.y:
        return []
    if not known.x:
        return [p.y for p in own]
    found = []
    for series in dict.fromkeys(p.series for p in own):
        line = sorted((p.x, p.y) for p in own if p.series == series and p.y > 0)
        if line and all(line[0][0] <= x <= line[-1][0] for x in known.x):
            found += _interpolated(line, known.x, CURVES[known.curve].log_x)
    return found


def _interpolated(line: Sequence[tuple[float, float]], x: Sequence[float], log_x: bool) -> list[float]:
    """Return a line's values at places x, straight between points in the axes of its curve (y: log)."""
    along, logs, places = np.array([a for a, _ in line]), np.log([b for _, b in line]), np.array(x)
    if log_x:
        along, places = np.log(along), np.log(places)
    return [float(value) for value in np.exp(np.interp(places, along, logs))]


def reading(points: Sequence[Point], name: str) -> list[str]:
    """Return the findings, in sentences; the first one explains the charts."""
    found = comparisons(points)
    lines = [
        f"A bench of 64 x 48 pixels of {name}, each with its own lamp, in the measurements of a laboratory. Marks are "
        "measured on the simulated sensor; thin lines are the equations of a pixel with thresholds, leak, low-pass "
        "and dead time alone, so that other effects show as a distance; red marks are published values of real "
        "sensors. Published values are of other chips, biases and lights than this one; agreement shows that the "
        "simulated sensor is of their kind, and a difference shows a point to check."
    ]
    lines += [_worst(chart, points) for chart in _TITLES if _modelled(chart, points)]
    for verdict, words in _VERDICTS.items():
        items = [
            f"{c.published.description} (here {_span(c.low, c.high)}; {c.published.how})"
            for c in found
            if c.verdict == verdict
        ]
        lines.append(f"{words}: {'; '.join(items) or 'none'}.")
    return lines


_VERDICTS = {
    "as preset": "Agree with the sources of the presets",
    "agrees": "Agree with other published values",
    "differs": "Differ from published values",
}
_BOUNDED = ("flicker_events", "flicker_rate", "burst")
_LEAST_SHARE = 0.02


def _modelled(chart: str, points: Sequence[Point]) -> list[Point]:
    """Return a chart's points that have a closed form, except bounds and values near zero."""
    own = [p for p in points if p.curve in CURVES and CURVES[p.curve].chart == chart and p.curve not in _BOUNDED]
    largest = {p.curve: max(abs(q.model) for q in own if q.curve == p.curve) for p in own}
    return [p for p in own if abs(p.model) > _LEAST_SHARE * largest[p.curve] and p.y > 0]


def _worst(chart: str, points: Sequence[Point]) -> str:
    """Return a sentence on the largest distance of a chart's points from their closed forms."""
    own = _modelled(chart, points)
    if CURVES[own[0].curve].log_y or CURVES[own[0].curve].chart == "leak":
        off = [abs(p.y / p.model - 1) for p in own]
        middle = f"{np.median(off):.1%} off the equations in the middle"
        return f"{_TITLES[chart]}: {middle}, {max(off):.1%} at most ({len(off)} points)."
    most = max(abs(p.y - p.model) for p in own)
    return f"{_TITLES[chart]}: {most:.1%} of the pixels off the expected distribution at most ({len(own)} points)."


def _span(low: float, high: float) -> str:
    if math.isnan(low):
        return "–"
    return f"{low:.3g}" if f"{low:.3g}" == f"{high:.3g}" else f"{low:.3g} to {high:.3g}"


def write(points: Sequence[Point], name: str, out: Path) -> list[Path]:
    """Write the report on sensor `name` into folder `out`; return the files, the page first."""
    lines, found = reading(points, name), comparisons(points)
    rows = [dataclasses.asdict(point) for point in points]
    charts = draw(points, out)
    single = [{"figure": p.series, "measured": p.y, "as configured": p.model} for p in points if p.curve == FIGURE]
    page = Page(f"{name}, characterised").findings(lines)
    for chart, drawn in charts.items():
        page.heading(_TITLES[chart]).drawn(drawn)
    if single:
        page.heading("Single figures").records(single)
    page.heading("Published figures").records([c.row() for c in found])
    files = [
        write_csv(rows, out / "points.csv"),
        write_csv([c.row() for c in found], out / "published.csv"),
        write_json(
            {"sensor": name, "reading": lines, "published": [c.row() for c in found], "points": rows},
            out / "characterise.json",
        ),
    ]
    return [page.write(out / "characterise.html"), *files, *(path for drawn in charts.values() for path in drawn)]

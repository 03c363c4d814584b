"""Pages of reports that need no network, their charts, and the tables beside them as CSV and JSON.

A report is a `Page`: sections are added in their order, and `write` writes one HTML file, charts included. Charts are
drawn by matplotlib (the extra `report`) without a screen.
"""

from __future__ import annotations

import base64
import csv
import html
import importlib
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from transports.needs import install_command

__all__ = [
    "BLUE",
    "INK",
    "RED",
    "ChartsLacking",
    "Page",
    "check_charts",
    "figure_legend",
    "image",
    "panels",
    "pyplot",
    "save",
    "svg",
    "write_csv",
    "write_json",
]


Row = Mapping[str, Any]

_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:1200px;margin:2em auto;padding:0 1em;color:#222}"
    "svg{width:100%;height:auto}img{max-width:100%}table{border-collapse:collapse;font-size:12px}"
    "td,th{padding:2px 8px;text-align:right;border-bottom:1px solid #ddd}"
    "td:first-child,th:first-child{text-align:left}"
)


class Page:
    """One page of HTML, from top to bottom. All texts are escaped, except charts."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._sections: list[str] = []

    def heading(self, text: str, level: int = 2) -> Self:
        """Add a heading: 2 for a section, 3 for a part of it."""
        return self._add(f"<h{level}>{html.escape(text)}</h{level}>")

    def text(self, text: str, *, strong: str = "", code: str = "") -> Self:
        """Add a paragraph: the `strong` words, the text, the code; nothing where all are empty."""
        pieces = [f"<b>{html.escape(strong)}</b>" if strong else "", html.escape(text)]
        pieces.append(f"<code>{html.escape(code)}</code>" if code else "")
        content = " ".join(piece for piece in pieces if piece)
        return self._add(f"<p>{content}</p>") if content else self

    def findings(self, lines: Sequence[str]) -> Self:
        """Add the first line as a paragraph, the others as a list."""
        self.text(lines[0])
        return self._add(f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines[1:])}</ul>")

    def table(self, rows: Sequence[Row]) -> Self:
        """Add rows of equal keys, None and NaN as a dash; nothing without rows."""
        if not rows:
            return self
        head = "".join(f"<th>{html.escape(name.replace('_', ' '))}</th>" for name in rows[0])
        body = "".join("<tr>" + "".join(f"<td>{_cell(v)}</td>" for v in row.values()) + "</tr>" for row in rows)
        return self._add(f"<table><tr>{head}</tr>{body}</table>")

    def facts(self, facts: Mapping[str, Any]) -> Self:
        """Add names and values as a table of two columns."""
        return self.table([{"what": name, "value": value} for name, value in facts.items()])

    def chart(self, chart: str | Sequence[Path]) -> Self:
        """Add a chart: an element, or the files of `save`, of which the SVG is shown."""
        return self._add(chart if isinstance(chart, str) else _element(chart[0]))

    def write(self, path: Path) -> Path:
        """Write the page; return its path."""
        title = html.escape(self._title)
        head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
        path.write_text(f"{head}<h1>{title}</h1>{''.join(self._sections)}</html>\n")
        return path

    def _add(self, section: str) -> Self:
        self._sections.append(section)
        return self


def _element(svg: Path) -> str:
    text = svg.read_text()
    return text[text.index("<svg") :]


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))


def write_csv(rows: Sequence[Row], path: Path) -> Path:
    """Write rows of equal keys; return the path."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_json(value: object, path: Path) -> Path:
    """Write a value, null for NaN and infinity; return the path."""
    path.write_text(json.dumps(_finite(value), indent=1, allow_nan=False) + "\n")
    return path


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


BLUE, RED, INK = "#0072b2", "#d55e00", "#333333"
"""Colours that are distinct for colour-blind people too."""


class ChartsLacking(Exception):
    """matplotlib is not installed; the message contains the command that installs it."""


def pyplot() -> Any:
    """Return matplotlib's figure maker; raise ChartsLacking."""
    try:
        importlib.import_module("matplotlib").use("agg")
        return importlib.import_module("matplotlib.pyplot")
    except ImportError as error:
        raise ChartsLacking(f"charts need matplotlib:  {install_command('report')}") from error


def check_charts() -> None:
    """Raise ChartsLacking where matplotlib is missing, before a long computation."""
    pyplot()


def panels(
    count: int, columns: int, size: tuple[float, float], *, high: int = 1, layout: str = "constrained"
) -> tuple[Any, list[list[Any]]]:
    """Return a figure and the axes of its `count` panels, from left to right, at most `columns` in a row.

    `size` is the width and height of one axes, inches. A panel has `high` axes, one below the other. `layout` is an
    engine of matplotlib, or "none".
    """
    columns = min(columns, count)
    bands = math.ceil(count / columns)
    width, height = size
    figure, grid = pyplot().subplots(
        high * bands, columns, figsize=(width * columns, height * bands), squeeze=False, layout=layout
    )
    every = [[grid[high * band + row][k] for row in range(high)] for band in range(bands) for k in range(columns)]
    for unused in every[count:]:
        for axes in unused:
            axes.set_visible(False)
    return figure, every[:count]


def figure_legend(figure: Any, **style: Any) -> None:
    """Put one legend above all panels: a line for each label, as it is drawn first."""
    shown: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        for label, handle in zip(labels, handles, strict=True):
            shown.setdefault(label, handle)
    style = {"ncols": max(1, len(shown)), "frameon": False, **style}
    figure.legend(shown.values(), shown, loc="outside upper center", **style)


def svg(figure: Any) -> str:
    """Return a figure as an <svg> element, and close it."""
    text = io.StringIO()
    figure.savefig(text, format="svg", bbox_inches="tight")
    pyplot().close(figure)
    return text.getvalue()[text.getvalue().index("<svg") :]


def image(figure: Any, description: str) -> str:
    """Return a figure as an <img> element that holds its own data, and close it: for charts of many points."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100, bbox_inches="tight")
    pyplot().close(figure)
    text = base64.b64encode(data.getvalue()).decode()
    return f'<img alt="{html.escape(description)}" src="data:image/png;base64,{text}">'


def save(figure: Any, stem: Path) -> list[Path]:
    """Write a figure as SVG and PNG and close it; return both files, SVG first."""
    paths = [stem.with_suffix(".svg"), stem.with_suffix(".png")]
    for path in paths:
        figure.savefig(path, dpi=110, bbox_inches="tight")
    pyplot().close(figure)
    return paths

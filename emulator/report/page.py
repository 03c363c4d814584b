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

from emulator.report.charts import escaped
from emulator.report.document import Document, Section
from transports.needs import install_command

Row = Mapping[str, Any]


class Page(Section):
    """A report of one section, from top to bottom."""

    def __init__(self, title: str) -> None:
        super().__init__()
        self._title = title

    def findings(self, lines: Sequence[str]) -> Self:
        """Add the first line as a paragraph, the others as a list."""
        items = "".join(f"<li>{escaped(line)}</li>" for line in lines[1:])
        return self.element(f"<p>{escaped(lines[0])}</p><ul>{items}</ul>" if items else f"<p>{escaped(lines[0])}</p>")

    def records(self, rows: Sequence[Row], caption: str = "") -> Self:
        """Add all rows, with words in the place of their keys."""
        return super().records([{key.replace("_", " "): row[key] for key in row} for row in rows], caption)

    def drawn(self, files: Sequence[Path]) -> Self:
        """Add a chart by the files of `save`, of which the SVG is shown; nothing without files."""
        return self.chart(_element(files[0].read_text())) if files else self

    def write(self, path: Path) -> Path:
        """Write the page; return its path."""
        return Document(self._title).add(self).write(path)


def _element(svg: str) -> str:
    return svg[svg.index("<svg") :]


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


BLUE = "#0072b2"
RED = "#d55e00"
INK = "#333333"
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


def panels(
    count: int, columns: int, width_in: float, height_in: float, *, high: int = 1, layout: str = "constrained"
) -> tuple[Any, list[list[Any]]]:
    """Return a figure and the axes of its `count` panels, from left to right, at most `columns` in a row.

    `width_in` and `height_in` are those of one axes, inches. A panel has `high` axes, one below the other. `layout` is
    an engine of matplotlib, or "none".
    """
    columns = min(columns, count)
    bands = math.ceil(count / columns)
    figure, grid = pyplot().subplots(
        high * bands, columns, figsize=(width_in * columns, height_in * high * bands), squeeze=False, layout=layout
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
    return _element(text.getvalue())


def image(figure: Any, description: str) -> str:
    """Return a figure as an <img> element that holds its own data, and close it: for charts of many points."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100, bbox_inches="tight")
    pyplot().close(figure)
    text = base64.b64encode(data.getvalue()).decode()
    return f'<img class="chart" alt="{html.escape(description)}" src="data:image/png;base64,{text}">'


def save(figure: Any, stem: Path) -> list[Path]:
    """Write a figure as SVG and PNG and close it; return both files, SVG first."""
    paths = [stem.with_suffix(".svg"), stem.with_suffix(".png")]
    for path in paths:
        figure.savefig(path, dpi=110, bbox_inches="tight")
    pyplot().close(figure)
    return paths

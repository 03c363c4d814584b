"""Charts of reports, drawn by matplotlib (the extra `report`) without a screen."""

from __future__ import annotations

import base64
import html
import importlib
import io
import math
from pathlib import Path
from typing import Any

from transports.needs import install_command

__all__ = ["BLUE", "INK", "RED", "ChartsLacking", "check", "figure_legend", "image", "panels", "pyplot", "save", "svg"]

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


def check() -> None:
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

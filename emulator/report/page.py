"""Reports for people and programs: a page that needs no network, CSV, JSON, and charts in files.

Charts are drawn by matplotlib (the extra `report`), without a screen.
"""

from __future__ import annotations

import csv
import html
import importlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from transports.needs import install_command

__all__ = [
    "ChartsLacking",
    "check",
    "inline",
    "pyplot",
    "save",
    "sentences",
    "table",
    "write_csv",
    "write_json",
    "write_page",
]


_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:1200px;margin:2em auto;padding:0 1em;color:#222}"
    "svg{width:100%;height:auto}table{border-collapse:collapse;font-size:12px}"
    "td,th{padding:2px 8px;text-align:right;border-bottom:1px solid #ddd}"
    "td:first-child,th:first-child{text-align:left}"
)


def write_page(title: str, sections: Sequence[str], path: Path) -> Path:
    """Write sections of HTML as one page; return its path."""
    text = html.escape(title)
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{text}</title><style>{_STYLE}</style>'
    path.write_text(f"{head}<h1>{text}</h1>{''.join(sections)}</html>\n")
    return path


def sentences(lines: Sequence[str]) -> str:
    """Return the first line as a paragraph, the others as a list."""
    first, *rest = (html.escape(line) for line in lines)
    return f"<p>{first}</p><ul>{''.join(f'<li>{line}</li>' for line in rest)}</ul>"


def inline(svg: Path) -> str:
    """Return an SVG file's <svg> element, for use in the page itself."""
    text = svg.read_text()
    return text[text.index("<svg") :]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows of equal keys as a table, None and NaN as a dash; at least one row."""
    head = "".join(f"<th>{html.escape(name.replace('_', ' '))}</th>" for name in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{_cell(v)}</td>" for v in row.values()) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))


def write_csv(rows: Sequence[Mapping[str, Any]], path: Path) -> Path:
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


def save(figure: Any, stem: Path) -> list[Path]:
    """Write a figure as SVG and PNG and close it; return both files, SVG first."""
    paths = [stem.with_suffix(".svg"), stem.with_suffix(".png")]
    for path in paths:
        figure.savefig(path, dpi=110, bbox_inches="tight")
    pyplot().close(figure)
    return paths

"""Pages of reports that need no network, and the tables beside them as CSV and JSON.

A report is a `Page`: sections are added in their order, and `write` writes one HTML file, charts included.
"""

from __future__ import annotations

import csv
import html
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

__all__ = ["Page", "write_csv", "write_json"]

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
        """Add a chart of `charts`: an element, or the files of `charts.save`, of which the SVG is shown."""
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

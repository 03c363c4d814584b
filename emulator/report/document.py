"""Documents that a reviewer reads, prints and signs: one HTML file that needs no network and no script.

The style is `report_page.css`, part of the file: for narrow and wide, light and dark screens, and for A4 paper. All
texts are escaped. Tables have a caption and headers for screen readers, and a bounded number of rows.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from emulator.report.charts import escaped, number_text

MOST_ROWS = 100
"""Rows of a table on a page; further ones are counted."""

_MOST_CHARACTERS = 400  # of a cell
_MOST_SHORT = 20  # rows of a table that stays on one page of paper
_MOST_NARROW = 3  # columns that stand beside each other on a narrow screen
_STYLE = Path(__file__).with_name("report_page.css")
_SYMBOLS = {"good": "\u2714", "bad": "\u2718", "unfinished": "\u25cc"}


@dataclass(frozen=True)
class Column:
    """A column of a table: its key in the rows, its heading with the unit, and the kind of its values."""

    key: str
    heading: str
    kind: Literal["text", "number", "code", "verdict"] = "text"


class Section:
    """A section with a heading, from top to bottom; `kind` is a class of the style."""

    def __init__(self, heading: str = "", kind: str = "") -> None:
        self._kind = kind
        self._parts = [f"<h2>{_text(heading)}</h2>"] if heading else []

    def heading(self, text: str) -> Self:
        """Add the heading of a part."""
        return self.element(f"<h3>{_text(text)}</h3>")

    def text(self, text: str, kind: str = "") -> Self:
        """Add a paragraph; nothing without text."""
        name = f' class="{kind}"' if kind else ""
        return self.element(f"<p{name}>{_text(text)}</p>") if text else self

    def listed(self, lines: Sequence[str]) -> Self:
        """Add a list; nothing without lines."""
        return self.element(f"<ul>{''.join(f'<li>{_text(line)}</li>' for line in lines)}</ul>") if lines else self

    def records(self, rows: Sequence[Mapping[str, Any]], caption: str = "") -> Self:
        """Add all rows, which have the same keys: the headings of the columns."""
        texts = {name for row in rows for name, value in row.items() if isinstance(value, str)}
        names = rows[0] if rows else ()
        columns = [Column(name, name, "text" if name in texts else "number") for name in names]
        return self.table(caption, columns, rows, len(rows))

    def table(
        self, caption: str, columns: Sequence[Column], rows: Sequence[Mapping[str, Any]], limit: int = MOST_ROWS
    ) -> Self:
        """Add the first rows, at most a hundred unless given, and the number of the others; nothing without rows.

        None and NaN are a dash. The first column has the headers of the rows.
        """
        if not rows:
            return self
        cells = ((_class(column), _text(column.heading)) for column in columns)
        head = "".join(f'<th scope="col" role="columnheader"{kind}>{text}</th>' for kind, text in cells)
        body = "".join(f'<tr role="row">{_row(columns, row)}</tr>' for row in rows[:limit])
        kind = "stacked" if len(columns) > _MOST_NARROW else "facts"
        table = f'<table class="{kind}" role="table"><caption>{_text(caption)}</caption>'
        table += f'<thead role="rowgroup"><tr role="row">{head}</tr></thead>'
        table += f'<tbody role="rowgroup">{body}</tbody></table>'
        scroll = "scroll short" if len(rows) <= _MOST_SHORT else "scroll"
        self.element(f'<div class="{scroll}" role="region" tabindex="0" aria-label="{_text(caption)}">{table}</div>')
        hidden = len(rows) - limit
        return self.text(f"and {hidden} more, listed in report.json" if hidden > 0 else "", "note")

    def facts(self, caption: str, facts: Mapping[str, Any]) -> Self:
        """Add names and values as a table of two columns."""
        rows = [{"name": name, "value": value} for name, value in facts.items()]
        return self.table(caption, [Column("name", "item"), Column("value", "value")], rows)

    def chart(self, element: str, caption: str = "") -> Self:
        """Add a chart as a figure; nothing without an element."""
        below = f"<figcaption>{_text(caption)}</figcaption>" if caption else ""
        return self.element(f"<figure>{element}{below}</figure>") if element else self

    def code(self, text: str) -> Self:
        """Add the text of a file."""
        return self.element(f"<pre>{html.escape(text)}</pre>")

    def element(self, element: str) -> Self:
        """Add an element that is HTML already."""
        self._parts.append(element)
        return self

    def html(self) -> str:
        """Return the section."""
        return f'<section class="{self._kind}">{"".join(self._parts)}</section>'


def signature(subject: Sequence[str]) -> Section:
    """Return the section that a reviewer signs: what is signed, a line each, boxes for the decision, and fields."""
    section = Section("Review", "signature whole")
    for line in subject:
        section.text(line)
    choices = ("accepted", "accepted with remarks", "rejected")
    boxes = "".join(f'<span class="choice"><span class="box"></span>{choice}</span>' for choice in choices)
    labels = ("Name and role", "Organisation", "Date", "Signature")
    fields = "".join(f"<div><small>{label}</small></div>" for label in labels)
    return section.element(
        f'<div class="sign"><div class="wide"><small>Decision</small>{boxes}</div>'
        f'<div class="wide"><small>Remarks</small></div>{fields}</div>'
    )


class Document:
    """A document: a heading and the line below it, a verdict in colour and words, then sections.

    `verdict` is the kind of the verdict, and `words` are its words; "": the document has none.
    """

    def __init__(self, title: str, subtitle: str = "", verdict: str = "", words: str = "") -> None:
        self._title = title
        self._subtitle = subtitle
        self._verdict = verdict
        self._words = words
        self._sections: list[Section] = []

    def add(self, section: Section) -> Self:
        """Add a section at the end."""
        self._sections.append(section)
        return self

    def html(self) -> str:
        """Return the whole file."""
        title, verdict = _text(self._title), ""
        if kind := self._verdict:
            title = f"{title}: {kind}"
            verdict = f'<div class="verdict {kind}" role="status"><strong>{_SYMBOLS[kind]} {kind.upper()}</strong>'
            verdict += f"{_text(self._words)}</div>"
        head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        head += f"<title>{title}</title><style>{_STYLE.read_text(encoding='utf-8')}</style>"
        header = f'<h1>{_text(self._title)}</h1><p class="subtitle">{_text(self._subtitle)}</p>'
        sections = "".join(section.html() for section in self._sections)
        return (
            f'<!doctype html>\n<html lang="en"><head>{head}</head>\n'
            f"<body><header>{header}{verdict}</header>\n{sections}</body></html>\n"
        )

    def write(self, path: Path) -> Path:
        """Write the file at once, so that no reader meets a part of it; return its path. Raises OSError."""
        part = path.with_name(path.name + ".part")
        part.write_text(self.html(), encoding="utf-8")
        return part.replace(path)


def swatch_legend(entries: Sequence[tuple[str, str]]) -> str:
    """Return a legend of (class, text) as a list."""
    items = "".join(f'<li><span class="swatch {kind}"></span>{_text(text)}</li>' for kind, text in entries)
    return f'<ul class="legend">{items}</ul>'


def _row(columns: Sequence[Column], row: Mapping[str, Any]) -> str:
    return "".join(_cell(column, row.get(column.key), header=k == 0) for k, column in enumerate(columns))


def _cell(column: Column, value: object, *, header: bool) -> str:
    """Return a cell; its roles stay where a narrow screen stacks the cells of a row."""
    shown = f' data-name="{_text(column.heading)}"'
    if column.kind == "verdict":
        kind = "good" if value else "bad"
        return f'<td role="cell" class="{kind}"{shown}>{_SYMBOLS[kind]} {"kept" if value else "BROKEN"}</td>'
    name, role = ("th", 'scope="row" role="rowheader"') if header else ("td", 'role="cell"')
    return f"<{name} {role}{_class(column)}{shown}>{_value(value)}</{name}>"


def _class(column: Column) -> str:
    return f' class="{column.kind}"' if column.kind in ("number", "code") else ""


def _value(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "\u2013"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | int):
        return number_text(value) if math.isfinite(value) else "no bound"
    return _text(str(value))


def _text(text: str) -> str:
    """Return a text escaped and of bounded length."""
    return escaped(text[:_MOST_CHARACTERS] + ("\u2026" if len(text) > _MOST_CHARACTERS else ""))

"""The page of a validation: Markdown, with pictures, CSV and JSON beside it. Disagreement stands first."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from emulator.report.page import write_csv, write_json
from laboratory.validation.findings import Datum, Findings

_INTRODUCTION = """# Validation

How much the simulated sensors are like real cameras: public measurements, repeated by `evstim validate --out docs`.
What disagrees stands first. All values and their distances are in [validation.csv](validation/validation.csv) and
[validation.json](validation/validation.json). In a table of light and biases a cell is real/ours; bold: they
disagree; in brackets: not judged.
"""

_MOST_ROWS = 12
"""Data beyond which those of a full grid of conditions are shown as one."""


def write(found: Sequence[Findings], out: Path) -> list[Path]:
    """Write `validation.md` into folder `out`, pictures and tables into `out/validation`; return the files."""
    folder = out / "validation"
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {one.name: one.draw(folder / one.name) for one in found if one.draw is not None}
    page = out / "validation.md"
    page.write_text("\n".join(_lines(found, pictures)) + "\n")
    rows = [_row(one, datum) for one in found for datum in one.data]
    tables = [write_csv(rows, folder / "validation.csv"), write_json(_document(found), folder / "validation.json")]
    return [page, *tables, *(path for paths in pictures.values() for path in paths)]


def _lines(found: Sequence[Findings], pictures: dict[str, list[Path]]) -> Iterable[str]:
    yield _INTRODUCTION
    yield from _summary(found)
    yield from _disagreement(found)
    printed: dict[str, str] = {}
    for one in found:
        yield from _section(one, pictures.get(one.name, []), printed)


def _summary(found: Sequence[Findings]) -> Iterable[str]:
    yield "| measurement | sensor | alike | of |"
    yield "|---|---|---|---|"
    for one in found:
        alike = sum(datum.alike for datum in one.judged)
        yield f"| {one.title} | {one.sensor} | {alike} | {len(one.judged)} |"
    yield ""


def _disagreement(found: Sequence[Findings]) -> Iterable[str]:
    apart = [(one, datum) for one in found for datum in one.judged if not datum.alike]
    apart.sort(key=lambda pair: -pair[1].excess)
    yield "## What disagrees"
    yield ""
    if not apart:
        yield "Nothing: every value lies within its bound."
        yield ""
        return
    yield "| measurement | condition | real | ours | distance | bound |"
    yield "|---|---|---|---|---|---|"
    for one, datum in apart:
        yield f"|{one.title}|{datum.what}|{_values(datum)}|"
    yield ""


def _section(one: Findings, picture: list[Path], printed: dict[str, str]) -> Iterable[str]:
    """Yield the lines of an experiment; texts that an earlier one has, by `printed`, are named by its title."""
    yield f"## {one.title}"
    yield ""
    yield _once(one.protocol, one.title, printed)
    yield ""
    for path in picture:
        if path.suffix == ".png":
            yield f"![{one.title}](validation/{path.name})"
            yield ""
    yield from _grid(one.data) or _list(one.data)
    yield ""
    remarks = [remark for remark in one.remarks if remark not in printed]
    printed.update(dict.fromkeys(remarks, one.title))
    yield from (f"- {remark}" for remark in remarks)
    if remarks:
        yield ""
    for source in one.sources:
        text = f"{source.title}, {source.address}; {source.obtained}. {source.licence}"
        yield f"Source: {_once(text, one.title, printed)}"
        yield ""


def _once(text: str, title: str, printed: dict[str, str]) -> str:
    """Return a text, or where it or its beginning was printed, the title of that section and what is new."""
    for earlier, place in printed.items():
        if text.startswith(earlier):
            return f'As in "{place}".{text.removeprefix(earlier)}'
    printed[text] = title
    return text


def _grid(data: Sequence[Datum]) -> list[str]:
    """Return a table of conditions "row, column"; none where they make no full grid, or few rows in a list."""
    split = [datum.what.partition(", ") for datum in data]
    rows = list(dict.fromkeys(row for row, _, _ in split))
    columns = list(dict.fromkeys(column for _, _, column in split))
    if len(data) <= _MOST_ROWS or len(rows) * len(columns) != len(set(split)) or len(columns) == 1:
        return []
    cells = {(row, column): _cell(datum) for (row, _, column), datum in zip(split, data, strict=True)}
    remarks = dict.fromkeys(datum.remark for datum in data if datum.remark)
    bounds = dict.fromkeys(_bound(datum) for datum in data if datum.judged)
    told = [f"Unit: {data[0].unit}."] if data[0].unit else []
    told += [f"Bound: {', '.join(bounds)}."] if bounds else []
    told += [f"Not judged: {'; '.join(remarks)}."] if remarks else []
    return [
        f"|condition|{'|'.join(columns)}|",
        "|---|" + "---|" * len(columns),
        *(f"|{row}|{'|'.join(cells[row, column] for column in columns)}|" for row in rows),
        "",
        " ".join(told),
    ]


def _cell(datum: Datum) -> str:
    text = f"{_number(datum.real)}/{_number(datum.ours)}"
    if not datum.judged:
        return f"({text})"
    return text if datum.alike else f"**{text}**"


def _list(data: Sequence[Datum]) -> Iterable[str]:
    """Yield a table of one row a datum; remarks of several stand below it by their number."""
    remarks = [datum.remark for datum in data if datum.remark]
    numbers = {remark: str(n) for n, remark in enumerate(dict.fromkeys(r for r in remarks if remarks.count(r) > 1), 1)}
    yield "|condition|real|ours|distance|bound|remark|"
    yield "|---|---|---|---|---|---|"
    for datum in data:
        yield f"|{datum.what}|{_values(datum)}|{numbers.get(datum.remark, datum.remark)}|"
    if numbers:
        yield ""
        yield "Remarks: " + "; ".join(f"{number}: {remark}" for remark, number in numbers.items()) + "."


def _values(datum: Datum) -> str:
    unit = f" {datum.unit}" if datum.unit else ""
    return f"{_number(datum.real)}{unit}|{_number(datum.ours)}{unit}|{_distance(datum)}|{_bound(datum)}"


def _number(value: float) -> str:
    """Return a value to three digits, without an exponent where it is large."""
    return "–" if math.isnan(value) else f"{float(f'{value:.3g}'):g}" if abs(value) < 1e6 else f"{value:.3g}"


def _distance(datum: Datum) -> str:
    return _measure(datum, datum.distance)


def _bound(datum: Datum) -> str:
    return _measure(datum, datum.bound) if datum.judged else "–"


def _measure(datum: Datum, value: float) -> str:
    """Return a distance or a bound in the words of its kind."""
    if not math.isfinite(value):
        return "–"
    if datum.kind == "relative":
        return f"{100 * value:.1f} %"
    if datum.kind == "factor":
        return f"x {value:.2f}"
    return f"{value:.3g} {datum.unit}".strip()


def _row(one: Findings, datum: Datum) -> dict[str, object]:
    named = {"measurement": one.name, "sensor": one.sensor, **dataclasses.asdict(datum)}
    return {**named, "distance": datum.distance, "alike": datum.alike if datum.judged else None}


def _document(found: Sequence[Findings]) -> list[dict[str, object]]:
    return [
        {
            "name": one.name,
            "title": one.title,
            "sensor": one.sensor,
            "protocol": one.protocol,
            "sources": [dataclasses.asdict(source) for source in one.sources],
            "remarks": list(one.remarks),
            "data": [_row(one, datum) for datum in one.data],
        }
        for one in found
    ]

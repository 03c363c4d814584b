"""The pages of a validation, in Markdown: what the sensors are worth, and every value; pictures, CSV, JSON beside."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

from emulator.report.page import write_csv, write_json
from laboratory.validation.findings import Datum, Findings

_TEXTS = Path(__file__).with_name("data")
"""Folder of `worth.md` and `introduction.md`, with which the pages begin, and `missing.md`."""
_MOST_ROWS = 12  # data beyond which those of a full grid of conditions are shown as one


def write(found: Sequence[Findings], out: Path) -> list[Path]:
    """Write `worth.md` and `validation.md` into folder `out`, pictures and tables into `out/validation`."""
    folder = out / "validation"
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {one.name: one.draw(folder / one.name) for one in found if one.draw is not None}
    pages = out / "worth.md", out / "validation.md"
    for page, lines in zip(pages, (_worth(found), _lines(found, pictures)), strict=True):
        page.write_text("\n".join(lines).rstrip() + "\n")
    rows = [_row(one, datum) for one in found for datum in one.data]
    tables = [write_csv(rows, folder / "validation.csv"), write_json(_document(found), folder / "validation.json")]
    return [*pages, *tables, *(path for paths in pictures.values() for path in paths)]


def _worth(found: Sequence[Findings]) -> Iterable[str]:
    yield (_TEXTS / "worth.md").read_text()
    for title, fitted in (("Predicted", False), ("Fitted", True)):
        yield from (f"## {title}", "", "| measurement | sensor | within the bound | of | median distance | largest |")
        yield "|---|---|---|---|---|---|"
        for one in found:
            if data := one.rows(fitted):
                yield f"| {one.title} | {one.sensor} | {within(data)} | {len(data)} | {_middle(data)} |"
        yield ""


def within(data: Sequence[Datum]) -> str:
    """Return how many data are within their bounds: with the worst seed and with the best."""
    counts = [
        sum(distance <= datum.bound for distance, datum in zip(distances, data, strict=True))
        for distances in zip(*(datum.distances for datum in data), strict=True)
    ]
    return _from_to(min(counts), max(counts))


def _middle(data: Sequence[Datum]) -> str:
    """Return the cells of the median and the largest distance, where all are of one kind and unit."""
    if len({(datum.kind, datum.unit) for datum in data}) > 1:
        return "–|–"
    typical = median(median(datum.distances) for datum in data)
    return "|".join(_measure(data[0], value) for value in (typical, max(datum.distance for datum in data)))


def _disagreement(found: Sequence[Findings], fitted: bool) -> Iterable[str]:
    apart = [(one, datum) for one in found for datum in one.rows(fitted) if not datum.alike]
    apart.sort(key=lambda pair: -pair[1].excess)
    yield from (f"## What disagrees, {'fitted' if fitted else 'predicted'}", "")
    if not apart:
        return (yield from ("Nothing: every value lies within its bound.", ""))
    yield "| measurement | condition | real | ours | distance | bound | apart |"
    yield "|---|---|---|---|---|---|---|"
    for one, datum in apart:
        yield f"|{one.title}|{datum.what}|{_real(datum)}|{_ours(datum)}|{_distances(datum)}|"
    yield ""


def _lines(found: Sequence[Findings], pictures: dict[str, list[Path]]) -> Iterable[str]:
    yield (_TEXTS / "introduction.md").read_text()
    yield from (*_disagreement(found, False), *_disagreement(found, True), (_TEXTS / "missing.md").read_text())
    titles: dict[str, str] = {}
    for one in found:
        yield from _section(one, pictures.get(one.name, []), titles)


def _section(one: Findings, picture: list[Path], titles: dict[str, str]) -> Iterable[str]:
    """Yield the lines of an experiment; `titles` has the section of each text so far."""
    yield from (f"## {one.title}", "", _once(one.protocol, one.title, titles), "")
    for path in picture:
        if path.suffix == ".png":
            yield from (f"![{one.title}](validation/{path.name})", "")
    yield from (*(_grid(one.data) or _list(one.data)), "")
    remarks = [remark for remark in one.remarks if remark not in titles]
    titles.update(dict.fromkeys(remarks, one.title))
    yield from (f"- {remark}" for remark in remarks)
    yield from [""] * bool(remarks)
    for source in one.sources:
        text = f"{source.title}, {source.address}; {source.obtained}. {source.licence}"
        yield from (f"Source: {_once(text, one.title, titles)}", "")


def _once(text: str, title: str, titles: dict[str, str]) -> str:
    """Return a text; one that begins as an earlier text begins with the title of that section instead."""
    for earlier, place in titles.items():
        if text.startswith(earlier):
            return f'As in "{place}".{text.removeprefix(earlier)}'
    titles[text] = title
    return text


def _grid(data: Sequence[Datum]) -> list[str]:
    """Return a table of conditions "row, column"; none where they make no full grid, or few rows in a list."""
    split = [datum.what.partition(", ") for datum in data]
    rows = list(dict.fromkeys(row for row, _, _ in split))
    columns = list(dict.fromkeys(column for _, _, column in split))
    if len(data) <= _MOST_ROWS or len(rows) * len(columns) != len(set(split)) or len(columns) == 1:
        return []
    cells = {(row, column): _cell(datum) for (row, _, column), datum in zip(split, data, strict=True)}
    apart = [datum.apart for datum in data if not math.isnan(datum.apart)]
    notes = [f"Unit: {data[0].unit}."] if data[0].unit else []
    bounds = [_measure(datum, datum.bound) for datum in data]
    for bound in dict.fromkeys(bounds):
        remarks = dict.fromkeys(
            one.remark for one, same in zip(data, bounds, strict=True) if one.remark and same == bound
        )
        notes.append(f"Bound: {bound}{' where ' if remarks else ''}{'; '.join(remarks)}.")
    notes += [
        f"Apart: {_measure(data[0], median(apart))} in the median, {_measure(data[0], max(apart))} at most."
    ] * bool(apart)
    return [
        f"|condition|{'|'.join(columns)}|",
        "|---|" + "---|" * len(columns),
        *(f"|{row}|{'|'.join(cells[row, column] for column in columns)}|" for row in rows),
        "",
        " ".join(notes),
    ]


def _cell(datum: Datum) -> str:
    mark = "*" * (datum.fitted + 2 * (not datum.alike))
    return f"{mark}{_number(datum.real)}/{_from_to(*_range(datum))}{mark}"


def _list(data: Sequence[Datum]) -> Iterable[str]:
    """Yield a table of one row a datum; remarks of several stand below it by their number."""
    remarks = [datum.remark for datum in data if datum.remark]
    numbers = {remark: str(n) for n, remark in enumerate(dict.fromkeys(r for r in remarks if remarks.count(r) > 1), 1)}
    yield "|condition|real|fitted|predicted|distance|bound|apart|remark|"
    yield "|---|---|---|---|---|---|---|---|"
    for datum in data:
        ours = f"{_ours(datum)}|" if datum.fitted else f"|{_ours(datum)}"
        remark = numbers.get(datum.remark, datum.remark)
        yield f"|{datum.what}|{_real(datum)}|{ours}|{_distances(datum)}|{remark}|"
    if numbers:
        yield ""
        yield "Remarks: " + "; ".join(f"{number}: {remark}" for remark, number in numbers.items()) + "."


def _real(datum: Datum) -> str:
    return f"{_number(datum.real)} {datum.unit}".strip()


def _ours(datum: Datum) -> str:
    """Return the median over the seeds, and their range."""
    low, high = _range(datum)
    return f"{_number(datum.ours)} {datum.unit}".strip() + (f" ({_from_to(low, high)})" if low != high else "")


def _range(datum: Datum) -> tuple[float, float]:
    seeds = datum.seeds or (datum.ours,)
    return min(seeds), max(seeds)


def _from_to(low: float, high: float) -> str:
    first, last = _number(low), _number(high)
    return first if first == last else f"{first} to {last}"


def _number(value: float) -> str:
    """Return a value to three digits, without an exponent where it is large."""
    return "–" if math.isnan(value) else f"{float(f'{value:.3g}'):g}" if abs(value) < 1e6 else f"{value:.3g}"


def _distances(datum: Datum) -> str:
    """Return the cells of distance, bound, and the distance of two real ones."""
    return "|".join(_measure(datum, value) for value in (datum.distance, datum.bound, datum.apart))


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
    """Return a row of the tables: ours in the column of its kind, fitted or predicted, and its range over the seeds."""
    low, high = _range(datum)
    values = {"what": datum.what, "real": datum.real, "fitted": None, "predicted": None}
    values["fitted" if datum.fitted else "predicted"] = datum.ours
    rest = {name: getattr(datum, name) for name in ("unit", "kind", "distance", "bound", "apart", "alike", "remark")}
    return {"measurement": one.name, "sensor": one.sensor, **values, "least": low, "largest": high, **rest}


def _document(found: Sequence[Findings]) -> list[dict[str, object]]:
    return [
        {
            **{name: getattr(one, name) for name in ("name", "title", "sensor", "protocol", "remarks")},
            "sources": [dataclasses.asdict(source) for source in one.sources],
            "data": [_row(one, datum) for datum in one.data],
        }
        for one in found
    ]

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
Each real value stands beside ours with the distance between them; what disagrees stands first. All values are in
[validation.csv](validation/validation.csv) and [validation.json](validation/validation.json).
"""


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
    for one in found:
        yield from _section(one, pictures.get(one.name, []))


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
        yield f"| {one.title} | {datum.what} | {_values(datum)} |"
    yield ""


def _section(one: Findings, picture: list[Path]) -> Iterable[str]:
    yield f"## {one.title}"
    yield ""
    yield one.protocol
    yield ""
    for path in picture:
        if path.suffix == ".png":
            yield f"![{one.title}](validation/{path.name})"
            yield ""
    yield "| condition | real | ours | distance | bound | remark |"
    yield "|---|---|---|---|---|---|"
    for datum in one.data:
        yield f"| {datum.what} | {_values(datum)} | {datum.remark} |"
    yield ""
    for remark in one.remarks:
        yield f"- {remark}"
    yield ""
    for source in one.sources:
        yield f"Source: {source.title}, {source.address}; {source.obtained}. {source.licence}"
        yield ""


def _values(datum: Datum) -> str:
    unit = f" {datum.unit}" if datum.unit else ""
    return f"{_number(datum.real)}{unit} | {_number(datum.ours)}{unit} | {_distance(datum)} | {_bound(datum)}"


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"


def _distance(datum: Datum) -> str:
    return _measure(datum, datum.distance)


def _bound(datum: Datum) -> str:
    return _measure(datum, datum.bound) if datum.judged else "–"


def _measure(datum: Datum, value: float) -> str:
    """Return a distance or a bound in the words of its kind."""
    if math.isnan(value):
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

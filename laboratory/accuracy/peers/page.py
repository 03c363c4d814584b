"""Tables, chart and page of the scores of simulators: one row a simulator and frame rate, cost against error.

A folder of results has a `results/NAME.json` for each simulator, so that simulators with interpreters of their own, or
from other people, come together in one table. The cost is the time of a frame on 346 x 260 pixels whose light changes
everywhere, at that frame rate, times the frames a second: processor seconds for a second of stream.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from emulator.report.page import Page, figure_legend, panels, save, write_csv, write_json
from laboratory.accuracy.peers.scoring import Report, Summary, read_report
from laboratory.accuracy.peers.sequences import SCENES, TIMING

BEGIN, END = "<!-- measured by evstim accuracy peers: begin -->", "<!-- measured by evstim accuracy peers: end -->"

_TITLE = "Simulators of event cameras on scenes in closed form"
_SORTED_AT = 1000
_MARKERS = "os^Dv<>pXP*h"
_FLOOR_US, _FLOOR_PERCENT = 1e-3, 1e-2
_READING = (
    "Shares are means over the scenes, times medians. Right sequences: pixels whose whole sequence of polarities is "
    "that of an ideal pixel; t50 and t95: time errors over the events of these pixels; false and missed: events over "
    "the true ones; Mpx/s: pixels in a microsecond of processor time, all of them active, at that frame rate."
)

Row = dict[str, Any]


def read_results(folder: Path) -> list[Report]:
    """Return the reports in `folder/results`, least median time error at 1000 images a second first.

    Raises ValueError where a file is of another form.
    """
    return sorted((read_report(file) for file in (folder / "results").glob("*.json")), key=_rank)


def _rank(report: Report) -> tuple[float, str]:
    at = [one.t50_us for one in report.summaries() if one.images_per_s == _SORTED_AT and one.t50_us is not None]
    return (at or [float("inf")])[0], report.name


def table(reports: Sequence[Report]) -> list[Row]:
    """Return the table of scores, a row a simulator and frame rate."""
    return [
        {
            "simulator": report.name,
            "version": report.about.get("version", ""),
            "date": report.about.get("date", ""),
            "images_per_s": one.images_per_s,
            "right": one.right,
            "t50_us": one.t50_us,
            "t95_us": one.t95_us,
            "false": one.false,
            "missed": one.missed,
            "scenes": f"{one.scenes} of {one.of}",
            "mpx_per_s": _mpx_per_s(report, _busy(one)),
        }
        for report in reports
        for one in report.summaries()
    ]


def _busy(one: Summary) -> str:
    """Return the name of the timing sequence at a summary's frame rate."""
    return f"busy-{one.images_per_s:g}"


def _mpx_per_s(report: Report, which: str) -> float | None:
    us = report.frame_us(which)
    return report.frame_times[which].pixels / us if us else None


def _simulators(reports: Sequence[Report]) -> list[Row]:
    """Return the table of simulators: version, input, speed."""
    rows = []
    for report in reports:
        busy, us = report.frame_times.get("busy-1000"), report.frame_us("busy-1000")
        rows.append(
            {
                "simulator": report.name,
                "version": report.about.get("version", ""),
                "date": report.about.get("date", ""),
                "gets light as": report.about.get("takes", ""),
                "Mpx/s, all active": _mpx_per_s(report, "busy-1000"),
                "Mev/s": busy.events / us if busy and us else None,
                "Mpx/s, an edge": _mpx_per_s(report, "quiet-1000"),
                "Mpx/s, with all that it models": _mpx_per_s(report, "whole-1000"),
            }
        )
    return rows


def _remarks(report: Report) -> str:
    """Return the remarks on a simulator as one sentence each, or ""."""
    failed = [
        f"no scores for {'all' if len(names) == len(report.scores) else ', '.join(names)}: {reason}"
        for reason, names in report.failures().items()
    ]
    whole = report.about.get("whole", "")
    parts = [report.about.get("notes", ""), *report.remarks, *failed, f"all that it models: {whole}" if whole else ""]
    return "; ".join(part for part in parts if part)


def markdown(reports: Sequence[Report], chart: str | None) -> str:
    """Return the section of the docs: tables, remarks, and the chart at the path `chart`."""
    days, machines = (sorted({getattr(report, name) for report in reports}) for name in ("day", "machine"))
    facts = f"Measured {', '.join(days)} on {'; '.join(machines)}. {_READING}\n\n"
    is_partial = any(summary.scenes < summary.of for report in reports for summary in report.summaries())
    names = [*_COLUMNS, *(["scenes"] if is_partial else []), "Mpx/s"]
    scores = _markdown_table(("simulator", *names), [(report.name, *_score_cells(report, names)) for report in reports])
    rows = _simulators(reports)
    speeds = _markdown_table(tuple(rows[0]), [tuple(_cell(value) for value in row.values()) for row in rows])
    remarks = "".join(f"- **{report.name}**: {text}.\n" for report in reports if (text := _remarks(report)))
    shown = f"![Time error and wrong events against processor seconds for a second of stream]({chart})\n\n"
    return f"{facts}{scores}\n{shown if chart else ''}{speeds}\n{remarks}"


def _markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"|{'|'.join(cell.replace('|', '/') for cell in line)}|\n" for line in lines)


_COLUMNS = ("images/s", "right sequences, %", "t50, us", "t95, us", "false, %", "missed, %")


def _score_cells(report: Report, names: Sequence[str]) -> Iterable[str]:
    """Return a cell for each named column, with the values at each frame rate."""
    rows = [
        (
            *(f"{summary.images_per_s:g}", _percent(summary.right), _cell(summary.t50_us), _cell(summary.t95_us)),
            *(_percent(summary.false), _percent(summary.missed)),
            *([f"{summary.scenes} of {summary.of}"] if "scenes" in names else []),
            _cell(_mpx_per_s(report, _busy(summary))),
        )
        for summary in report.summaries()
    ]
    return (" / ".join(values) for values in zip(*rows, strict=True))


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.3g}"


def _cell(value: object) -> str:
    """Return a value for people, a number to two digits and without an exponent."""
    if value is None or value == "":
        return "–"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"
    return str(value)


def write_page(reports: Sequence[Report], out: Path) -> list[Path]:
    """Write page, chart, table as CSV and all as JSON into folder `out`; return the files, the page first."""
    drawn = _draw(reports, out / "simulators")
    scenes = {name: one.description for name, one in (SCENES | TIMING).items()}
    page = Page(_TITLE).facts("Scenes", scenes).text(_READING).records(table(reports))
    page.drawn(drawn).records(_simulators(reports))
    for report in reports:
        page.heading(report.name).findings([_remarks(report)])
    each = [
        {"simulator": report.name, **{name: getattr(one, name) for name in _OF_A_SEQUENCE}}
        for report in reports
        for one in report.scores
    ]
    page.heading("Each sequence").records(each)
    data = [
        write_csv(table(reports), out / "simulators.csv"),
        write_csv(each, out / "sequences.csv"),
        write_json({"table": table(reports), "sequences": each}, out / "simulators.json"),
    ]
    return [page.write(out / "simulators.html"), *data, *drawn]


_OF_A_SEQUENCE = (
    *("scene", "images_per_s", "events", "true_events"),
    *("right", "t50_us", "t95_us", "false", "missed", "failure"),
)


def _draw(reports: Sequence[Report], stem: Path) -> list[Path]:
    """Draw median time error and wrong events against the cost, or nothing where no cost is known.

    A simulator is a line, a frame rate a point.
    """
    if not any(report.frame_us(_busy(one)) for report in reports for one in report.summaries()):
        return []
    figure, found = panels(2, 2, 5.2, 4.4)
    for (axes,), label in zip(found, ("median time error, us", "false + missed events, %"), strict=True):
        for k, report in enumerate(reports):
            _line(axes, report, k, label)
        _name(axes, label)
    figure_legend(figure, ncols=4, fontsize=8)
    return save(figure, stem)


def _line(axes: Any, report: Report, k: int, label: str) -> None:
    """Draw a simulator; hollow marks where fewer than 90 % of the sequences are right."""
    points = []
    for one in report.summaries():
        us = report.frame_us(_busy(one))
        value = one.t50_us if "error" in label else _wrong_percent(one)
        if us and value is not None:
            floor = _FLOOR_US if "error" in label else _FLOOR_PERCENT
            points.append((us * 1e-6 * one.images_per_s, max(value, floor), (one.right or 0) >= 0.9))
    if not points:
        return
    style = {"color": f"C{k % 10}", "marker": _MARKERS[k % len(_MARKERS)], "markersize": 6}
    axes.plot([p[0] for p in points], [p[1] for p in points], markerfacecolor="none", label=report.name, **style)
    good = [p for p in points if p[2]]
    axes.plot([p[0] for p in good], [p[1] for p in good], linestyle="none", **style)


def _wrong_percent(one: Summary) -> float | None:
    return None if one.false is None or one.missed is None else 100 * (one.false + one.missed)


def _name(axes: Any, label: str) -> None:
    if axes.lines:
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.xaxis.set_major_locator(importlib.import_module("matplotlib.ticker").LogLocator(numticks=12))
    axes.set_xlabel("processor seconds for a second of stream, 346 x 260", fontsize=9)
    axes.set_ylabel(label, fontsize=9)
    axes.grid(True, which="major", alpha=0.3)
    axes.tick_params(labelsize=8)
    axes.axvline(1, color="black", linewidth=0.6, linestyle=":")

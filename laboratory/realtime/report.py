"""Reports of real-time factors beside wrong events: table, charts, HTML page, and a section of a page of the docs.

The section lies between two lines of comment, and is replaced as a whole.
"""

from __future__ import annotations

import math
import os
import platform
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from emulator.report.page import Page, figure_legend, panels, save, write_csv, write_json
from laboratory.realtime.variants import SHIPPED, SIZES

Row = Mapping[str, Any]
"""A variant's names and values, as `Measurements.rows` returns them."""

BEGIN, END = "<!-- measured by evstim bench realtime: begin -->", "<!-- measured by evstim bench realtime: end -->"

_TITLE = "Real-time factor beside wrong events"
_COLUMNS = 3
_FLOOR_PERCENT, _TOP_PERCENT = 0.01, 100  # of the chart's logarithmic axis; at its foot no event is wrong
_MARKERS = "os^Dv<>pXP*h"


def machine() -> str:
    """Return a line on this machine: processor, cores, Python."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{cores} cores, {models[0] if models else platform.machine()}; Python {platform.python_version()}"


def line_of(row: Row) -> str:
    """Return a row as one line for people."""
    wrong = "wrong events not measured" if row["wrong"] is None else f"{100 * row['wrong']:.2g} % wrong"
    cores = ", ".join(_number(row[name]) for name in ("session_cores", "link_cores", "receiver_cores"))
    first = "-" if row["first_event_s"] is None else f"{row['first_event_s']:.1f} s"
    return (
        f"{row['rig']:14} {row['size']:9} {row['setting']:18} {row['factor']:7.2f} x real time   cores {cores:16} "
        f"{row['memory_mib']:5.0f} MiB   first event {first:>7}   {row['received_share']:.0%} received   {wrong}"
    )


def write_report(rows: Sequence[Row], about: Mapping[str, Any], out: Path) -> list[Path]:
    """Write the page, the chart, the table as CSV and all as JSON into folder `out`; return the files, page first."""
    page = Page(_TITLE).facts("Machine and runs", about)
    drawn = draw(rows, out / "realtime")
    page.drawn(drawn).records(rows)
    data = [write_csv(rows, out / "realtime.csv"), write_json({**about, "rows": rows}, out / "realtime.json")]
    return [page.write(out / "realtime.html"), *data, *drawn]


def draw(rows: Sequence[Row], stem: Path) -> list[Path]:
    """Draw a panel for each rig that has a truth, wrong events against factor; return no file where none has one."""
    judged = [row for row in rows if row["wrong"] is not None]
    if not judged:
        return []
    rigs, settings = (list(dict.fromkeys(row[name] for row in judged)) for name in ("rig", "setting"))
    figure, found = panels(len(rigs), _COLUMNS, 4.0, 3.6)
    for (axes,), rig in zip(found, rigs, strict=True):
        for row in (row for row in judged if row["rig"] == rig):
            _mark(axes, row, settings.index(row["setting"]))
        _name(axes, rig)
    figure_legend(figure, ncols=min(4, len(settings)), fontsize=8)
    return save(figure, stem)


def _mark(axes: Any, row: Row, k: int) -> None:
    """Draw one variant; full marks are of the smaller size, hollow ones of the larger."""
    is_small = row["size"] == SIZES[0].name
    style = {"marker": _MARKERS[k % len(_MARKERS)], "color": f"C{k % 10}", "linestyle": ""}
    percent = max(100 * row["wrong"], _FLOOR_PERCENT)
    label = row["setting"] if is_small else f"_{row['setting']}"  # a label that begins with _ is not in the legend
    axes.plot(row["factor"], percent, fillstyle="full" if is_small else "none", label=label, **style)


def _name(axes: Any, rig: str) -> None:
    axes.set_title(rig, fontsize=10)
    axes.set(xscale="log", yscale="log", ylim=(0.8 * _FLOOR_PERCENT, _TOP_PERCENT))
    axes.xaxis.get_major_locator().set_params(subs=(1.0, 3.0))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.axvline(1, color="black", linewidth=0.6, linestyle=":")
    axes.set_xlabel("times real time", fontsize=9)
    axes.set_ylabel("false + missed events, %", fontsize=9)
    axes.grid(True, which="both", alpha=0.3)
    axes.tick_params(labelsize=8, which="both")


_HEAD = (
    "|rig|size|times real time|cores: session, link, receiver|memory, MiB|first event, s|events received, %"
    "|false + missed, %|t50, t95, ms|middle, %|\n|---|---|---|---|---|---|---|---|---|---|\n"
)


def markdown(rows: Sequence[Row], about: Mapping[str, Any], chart: str | None) -> str:
    """Return the section of the docs: the rigs as shipped as a table, and the chart at the path `chart`."""
    facts = "; ".join(f"{name}: {value}" for name, value in about.items() if value not in ("", [], {}))
    table = _HEAD + "".join(_table_row(row) for row in rows if row["setting"] == SHIPPED.name)
    shown = "" if chart is None else f"\n![Wrong events against the real-time factor, a panel for each rig]({chart})\n"
    return f"{facts}.\n\n{table}{shown}"


def _table_row(row: Row) -> str:
    cores = ", ".join(_number(row[name]) for name in ("session_cores", "link_cores", "receiver_cores"))
    cells = (row["rig"], row["size"], f"{row['factor']:.2g}", cores, f"{row['memory_mib']:.0f}")
    received = _number(row["first_event_s"]), f"{row['received_share']:.0%}".strip("%")
    return f"|{'|'.join((*cells, *received, *_errors(row)))}|\n"


def _errors(row: Row) -> tuple[str, str, str]:
    if row["wrong"] is None:
        return "–", "–", "–"
    false, missed = 100 * row["false"], 100 * row["missed"]
    times = ", ".join(_number(row[name]) for name in ("t50_ms", "t95_ms"))
    middle = "–" if row["middle"] is None else f"{100 * row['middle']:.2g}"
    return f"{false:.2g} + {missed:.2g}", times, middle


def _number(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.2f}"


def copied_charts(files: Sequence[Path], page: Path) -> str | None:
    """Copy the charts among the files to `pictures` beside a page; return the first one's path from there."""
    charts = [file for file in files if file.suffix == ".png"]
    for chart in charts:
        (page.parent / "pictures").mkdir(exist_ok=True)
        shutil.copy(chart, page.parent / "pictures" / chart.name)
    return f"pictures/{charts[0].name}" if charts else None


def put_section(page: Path, text: str, marks: tuple[str, str] = (BEGIN, END)) -> None:
    """Replace the section of a page between two lines; raises OSError, and ValueError where the page lacks them."""
    before, begin, rest = page.read_text().partition(marks[0])
    _, end, after = rest.partition(marks[1])
    if not begin or not end:
        raise ValueError(f"{page} has no lines {marks[0]} and {marks[1]}")
    page.write_text(f"{before}{begin}\n\n{text}\n{end}{after}")

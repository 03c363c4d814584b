"""The report of a campaign: one page that needs no network."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emulator.campaign.campaign import Campaign
from emulator.campaign.columns import Row
from emulator.campaign.proportion import proportion
from emulator.campaign.report.charts import histograms, scatter, success_by_parameter
from emulator.campaign.report.sensitivity import numbers, sensitivity
from emulator.report.figures import ChartsLacking
from emulator.report.html import table, write_page

__all__ = ["quantiles", "worst_runs", "write_report"]

_MOST_COLUMNS = 6
_MOST_WORST = 10
_MOST_TEXT = 120


def write_report(campaign: Campaign, rows: Sequence[Row], folder: Path) -> Path:
    """Write report.html into a folder, which is made, and return its path; at least one row. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    sections = [*_share(campaign, rows), *_plots(campaign, rows), *_sensitivities(campaign, rows)]
    sections += [*_worst(campaign, rows), *_told(campaign, rows)]
    return write_page(campaign.settings.title or campaign.name, sections, folder / "report.html")


def _share(campaign: Campaign, rows: Sequence[Row]) -> Iterator[str]:
    known = proportion(sum(bool(row["success"]) for row in rows), len(rows))
    whole = "" if len(rows) == campaign.runs else f" {campaign.runs - len(rows)} of {campaign.runs} runs are missing."
    yield f"<p><b>Success: {html.escape(str(known))}.</b> The interval is Wilson's.{whole}</p>"
    rules = [rule.told for rule in campaign.settings.success] or ["verdict"]
    kept = [{"rule": one.told, "kept": _kept(one, rows)} for one in campaign.settings.success]
    yield table(kept) if kept else f"<p>A run is a success when its {rules[0]} is good.</p>"
    outcomes = Counter(str(row["outcome"]) for row in rows)
    if set(outcomes) != {"ok"}:
        yield table([{"outcome": outcome, "runs": count} for outcome, count in outcomes.most_common()])


def _kept(rule: Any, rows: Sequence[Row]) -> str:
    return str(proportion(sum(row["outcome"] == "ok" and rule.kept_by(row) for row in rows), len(rows)))


def _shown(campaign: Campaign, rows: Sequence[Row]) -> list[str]:
    """Return the columns that the report is about; those without a number are left out."""
    asked = list(campaign.settings.report.columns)
    given = [name for name in dict.fromkeys(name for row in rows for name in row) if name.startswith("result.")]
    wanted = asked or ["margin", "events.rate_hz", *given]
    return [name for name in wanted if np.isfinite(numbers(rows, name)).any()][:_MOST_COLUMNS]


def _plots(campaign: Campaign, rows: Sequence[Row]) -> Iterator[str]:
    settings, shown = campaign.settings, _shown(campaign, rows)
    laws, labels = settings.parameters, settings.report.labels
    if shown:
        yield "<h2>Distributions</h2>"
        yield table([{"column": labels.get(name, name), **quantiles(rows, name)} for name in shown])
    try:
        if shown:
            yield histograms(rows, shown, labels, settings.success)
        if laws:
            yield "<h2>Success by parameter</h2>"
            yield success_by_parameter(rows, laws, labels)
        for column in shown if laws else ():
            yield f"<h3>{_name(campaign, column)}</h3>"
            yield scatter(rows, laws, column, labels)
    except ChartsLacking as error:
        yield f"<p>No charts: {html.escape(str(error))}</p>"


def quantiles(rows: Sequence[Row], column: str) -> Row:
    """Return how the numbers of a column are distributed."""
    values = numbers(rows, column)
    found = np.quantile(values[np.isfinite(values)], [0.0, 0.1, 0.5, 0.9, 1.0]).tolist()
    return dict(zip(("least", "10 %", "median", "90 %", "most"), found, strict=True))


def _name(campaign: Campaign, column: str) -> str:
    return html.escape(campaign.settings.report.labels.get(column, column))


def _sensitivities(campaign: Campaign, rows: Sequence[Row]) -> Iterator[str]:
    settings = campaign.settings
    if not settings.parameters:
        return
    yield "<h2>Sensitivity</h2>"
    designed = settings.sampling == "saltelli" and settings.repeats == 1
    for column in ["success", *_shown(campaign, rows)]:
        found = sensitivity(rows, settings.parameters, column, settings.count if designed else 0)
        yield f"<h3>{_name(campaign, column)}</h3><p>{html.escape(found.method)}</p>"
        if found.rows:
            labels = settings.report.labels
            yield table([row | {"parameter": labels.get(row["parameter"], row["parameter"])} for row in found.rows])


def worst_runs(campaign: Campaign, rows: Sequence[Row]) -> list[Row]:
    """Return the ten worst runs: first those that did not go to their end, then by the column that the report names."""
    shown = campaign.settings.report
    sign = 1.0 if shown.worst_is == "lowest" else -1.0

    def badness(row: Row) -> tuple[bool, bool, bool, float, int]:
        value = row.get(shown.worst)
        known = isinstance(value, int | float)
        return (row["outcome"] == "ok", bool(row["success"]), not known, sign * float(value or 0.0), int(row["index"]))

    return sorted(rows, key=badness)[:_MOST_WORST]


def _worst(campaign: Campaign, rows: Sequence[Row]) -> Iterator[str]:
    file = Path(campaign.source.file).name
    yield "<h2>Worst runs</h2>"
    command = html.escape(f"evstim campaign again {file} INDEX --record run.npz")
    yield f"<p>One of them again, recorded: <code>{command}</code></p>"
    keys = [law.key for law in campaign.settings.parameters]
    names = ["index", "outcome", "success", "margin", *keys, *_shown(campaign, rows), "broken", "error"]
    names = list(dict.fromkeys([*names, campaign.settings.report.worst]))
    worst = worst_runs(campaign, rows)
    names = [name for name in names if any(row.get(name) not in (None, "") for row in worst)]
    labels = campaign.settings.report.labels
    yield table([{labels.get(name, name): _short(row.get(name)) for name in names} for row in worst])


def _short(value: Any) -> Any:
    return value if not isinstance(value, str) or len(value) <= _MOST_TEXT else f"{value[:_MOST_TEXT]} ..."


def _told(campaign: Campaign, rows: Sequence[Row]) -> Iterator[str]:
    yield "<h2>Campaign</h2>"
    settings = campaign.settings
    wall_s = numbers(rows, "machine.wall_s")
    told = {
        "file": Path(campaign.source.file).name,
        "rig": Path(campaign.source.rig_file).name,
        "id": campaign.id,
        "sampling": settings.sampling,
        "runs": f"{len(rows)} of {campaign.runs}",
        "time of all runs": f"{np.nansum(wall_s):.1f} s",
        "time of a run": f"{np.nanmedian(wall_s):.3f} s (median)" if np.isfinite(wall_s).any() else None,
        "hosts": ", ".join(sorted({str(row["machine.host"]) for row in rows if row.get("machine.host")})),
        "evstim": ", ".join(sorted({str(row["machine.version"]) for row in rows if row.get("machine.version")})),
    }
    yield table([{"what": key, "value": value} for key, value in told.items()])

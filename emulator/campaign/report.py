"""The report of a campaign: one page that needs no network.

The PAWN index measures the influence of a parameter on a column, from any sample. The runs are cut into slices of like
values of the parameter. In each the column has a distribution; the index is the median over the slices of the greatest
distance between its cumulative distribution and that of all runs (the statistic of Kolmogorov and Smirnov): 0 when the
parameter has no influence, towards 1 when it determines the column.

Pianosi and Wagener, "Distribution-based sensitivity analysis from a generic input-output sample", 2018.

Methods for the dependence of a column on the parameters:

    Sobol indices      from a Saltelli design (sampling = "saltelli"): shares of the column's variance
    PAWN               from any sample: how much the column's distribution changes when the parameter is known
    rank correlation   from any sample, Spearman's: direction and strength of a monotone dependence

Sobol indices are computed by SALib, PAWN by `pawn`.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import spearmanr

from emulator.campaign.campaign import Campaign, Row
from emulator.campaign.loading import SuccessRule, proportion
from emulator.campaign.sampling import Law
from emulator.report.document import Document, Section
from emulator.report.page import BLUE, INK, RED, ChartsLacking, image, panels, svg
from firmware_protocol.events import Floats

_MOST_SLICES = 10
_FEWEST_IN_SLICE = 10
_DRAWS = 40
_Slices = Sequence[npt.NDArray[np.intp]]


def slices_of(x: Floats) -> _Slices:
    """Return the indices of the runs of each slice of a parameter: of each value where there are few, else of ranks."""
    values, group = np.unique(x, return_inverse=True)
    if len(values) <= _MOST_SLICES:
        return [np.flatnonzero(group == k) for k in range(len(values))]
    count = min(_MOST_SLICES, max(2, len(x) // _FEWEST_IN_SLICE))
    return np.array_split(np.argsort(x, kind="stable"), count)


def pawn(y: Floats, slices: _Slices) -> float:
    """Return the index of a parameter with these slices for the values `y` (n,) of a column."""
    ordered = np.sort(y)
    return _index(y, ordered, _cumulative(ordered, ordered), slices)


def pawn_of_chance(y: Floats, slices: _Slices) -> float:
    """Return the 95 % quantile of the index of a parameter without influence, in samples like this one."""
    draw, ordered = np.random.default_rng(1), np.sort(y)
    of_all = _cumulative(ordered, ordered)
    indices = [_index(draw.permutation(y), ordered, of_all, slices) for _ in range(_DRAWS)]
    return float(np.quantile(indices, 0.95))


def _index(y: Floats, ordered: Floats, of_all: Floats, slices: _Slices) -> float:
    distances = [np.abs(_cumulative(np.sort(y[rows]), ordered) - of_all).max() for rows in slices]
    return float(np.median(distances))


def _cumulative(values: Floats, at: Floats) -> Floats:
    """Return the share of sorted values that are not above each of `at`."""
    return np.searchsorted(values, at, side="right") / len(values)


_FEWEST = 20  # rows below which no index is meaningful


@dataclass(frozen=True)
class Sensitivity:
    """Dependence of one column on the parameters.

    Attributes
    ----------
    method : computed indices and their rows; or the reason why there are none.
    rows : a row of indices for each parameter.
    """

    column: str
    method: str
    rows: list[dict[str, Any]]


def numbers(rows: Sequence[Row], column: str) -> Floats:
    """Return a column as floats (n,): true is 1, a missing value or no number is NaN."""
    values = [row.get(column) for row in rows]
    return np.array([float(v) if isinstance(v, int | float) else math.nan for v in values])


def parameter_numbers(rows: Sequence[Row], law: Law) -> Floats:
    """Return a parameter as floats (n,): texts and tables as their place in the list of values."""
    values = numbers(rows, law.key)
    if not np.isnan(values).any():
        return values
    codes: dict[Any, int] = {}
    return np.array([float(codes.setdefault(row.get(law.key), len(codes))) for row in rows])


def sensitivity(rows: Sequence[Row], laws: Sequence[Law], column: str, base_points: int) -> Sensitivity:
    """Return the dependence of a column on the parameters; `base_points` is that of a Saltelli design, else 0."""
    y = numbers(rows, column)
    has_value = ~np.isnan(y)
    y_there = y[has_value]
    if len(y_there) < _FEWEST or np.ptp(y_there) == 0:
        reason = f"fewer than {_FEWEST} runs have a value" if len(y_there) < _FEWEST else "all runs have the same value"
        return Sensitivity(column, f"no sensitivity: {reason}", [])
    if base_points and find_spec("SALib") and has_value.all() and len(y) == base_points * (len(laws) + 2):
        return Sensitivity(column, _SOBOL.format(base_points), _sobol(y, laws))
    x = np.stack([parameter_numbers(rows, law)[has_value] for law in laws], axis=1)
    shares = [{"parameter": law.key, **_dependence(values, y_there)} for law, values in zip(laws, x.T, strict=True)]
    method = f"PAWN index and rank correlation of {len(y_there)} runs as sampled"
    if base_points:
        method += "; no Sobol indices, because the design is not whole, or SALib is not installed"
    return Sensitivity(column, method, shares)


_SOBOL = "Sobol indices (Saltelli's design, {} base points) with 95 % confidence: share of the variance"


def _sobol(y: Floats, laws: Sequence[Law]) -> list[dict[str, Any]]:
    analyze, count = importlib.import_module("SALib.analyze.sobol").analyze, len(laws)
    problem = {"num_vars": count, "names": [str(k) for k in range(count)], "bounds": [[0.0, 1.0]] * count}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        indices = analyze(problem, y, calc_second_order=False, seed=1)
    names = {"alone (S1)": "S1", "± S1": "S1_conf", "with all others (ST)": "ST", "± ST": "ST_conf"}
    columns = {name: indices[key].tolist() for name, key in names.items()}
    return [{"parameter": law.key, **{n: c[k] for n, c in columns.items()}} for k, law in enumerate(laws)]


def _dependence(x: Floats, y: Floats) -> dict[str, float]:
    slices = slices_of(x)
    indices = {"PAWN": pawn(y, slices), "PAWN, 95 % of chance": pawn_of_chance(y, slices)}
    rank, p = spearmanr(x, y) if np.ptp(x) > 0 else (math.nan, math.nan)
    return {**indices, "rank correlation": float(rank), "p": float(p)}


_BINS = 8
_ACROSS = 4  # charts of a row, 12 inches together
_HEIGHT = 2.8
_FEW = 8  # values that get a tick each
_FAR = 2.0  # from the values, in their span: a limit that is farther off is not drawn

_UNITS = {
    **{"_px_s": "px/s", "_m_s": "m/s", "_rad_s": "rad/s", "_deg_s": "deg/s", "_hz": "Hz", "_px": "px", "_deg": "deg"},
    **{"_ns": "ns", "_us": "us", "_ms": "ms", "_um": "um", "_mm": "mm", "_km": "km", "_m": "m", "_s": "s"},
}


class _Labels(dict[str, str]):
    """Names of columns for people: those of the campaign's file, else the column's own with its unit apart."""

    def __missing__(self, name: str) -> str:
        suffix = next((suffix for suffix in _UNITS if name.endswith(suffix)), "")
        return f"{name.removesuffix(suffix)}, {_UNITS[suffix]}" if suffix else name


def success_by_parameter(rows: Sequence[Row], laws: Sequence[Law], labels: _Labels) -> str:
    """Return the share of successes over the values of each parameter, with Wilson intervals."""
    figure, charts = _panels(len(laws))
    success = numbers(rows, "success")
    for axes, law in zip(charts, laws, strict=True):
        x = parameter_numbers(rows, law)
        centres, shares, low, high = _binned(x, success)
        axes.errorbar(centres, shares, yerr=[shares - low, high - shares], fmt="o", color=INK, capsize=3)
        axes.set(ylim=(-0.03, 1.03))
        _scale(axes, law, rows, labels)
    charts[0].set_ylabel("share of successes, 95 %")
    return svg(figure)


def _binned(x: Floats, success: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return for bins of about equal counts: mean of x, share, and the ends of its interval."""
    values = np.unique(x)
    edges = np.quantile(x, np.linspace(0, 1, _BINS + 1))
    bin_of_row = (
        np.searchsorted(values, x) if len(values) <= _BINS else np.clip(np.searchsorted(edges, x) - 1, 0, _BINS - 1)
    )
    bars = []
    for k in np.unique(bin_of_row):
        in_bin = bin_of_row == k
        estimate = proportion(int(success[in_bin].sum()), int(in_bin.sum()))
        bars.append((float(x[in_bin].mean()), estimate.share, estimate.low, estimate.high))
    return tuple(np.array(column) for column in zip(*bars, strict=True))  # type: ignore[return-value]


def scatter(rows: Sequence[Row], laws: Sequence[Law], column: str, labels: _Labels) -> str:
    """Return a column over each parameter, a point for each run, as an image."""
    figure, charts = _panels(len(laws))
    y, success = numbers(rows, column), numbers(rows, "success") > 0
    for axes, law in zip(charts, laws, strict=True):
        x = parameter_numbers(rows, law)
        for rows_shown, colour, name in ((success, BLUE, "success"), (~success, RED, "no success")):
            if rows_shown.any():
                axes.plot(x[rows_shown], y[rows_shown], ".", markersize=5, alpha=0.6, color=colour, label=name)
        _scale(axes, law, rows, labels)
    charts[0].set_ylabel(labels[column])
    if not success.all():
        charts[-1].legend(fontsize=8)
    return image(figure, f"{labels[column]} over the parameters")


def histograms(rows: Sequence[Row], columns: Sequence[str], labels: _Labels, rules: Sequence[SuccessRule]) -> str:
    """Return the distribution of some columns, with the limits of the rules; each column has numbers."""
    figure, charts = _panels(len(columns))
    for axes, column in zip(charts, columns, strict=True):
        values = _finite(rows, column)
        axes.hist(values, bins=min(40, max(5, int(np.sqrt(len(values))))), color=INK, histtype="step")
        axes.set(xlabel=labels[column])
        axes.yaxis.get_major_locator().set_params(integer=True)
        for limit in _limits(rules, column, values):
            axes.axvline(limit, color=RED, linestyle="--")
    charts[0].set_ylabel("runs")
    return svg(figure)


def _limits(rules: Sequence[SuccessRule], column: str, values: Floats) -> list[float]:
    """Return the limits of a column that are not far from its values."""
    span = float(np.ptp(values))
    numbers = [float(rule.value) for rule in rules if rule.column == column and not isinstance(rule.value, str)]
    return [number for number in numbers if values.min() - _FAR * span <= number <= values.max() + _FAR * span]


def _scale(axes: Any, law: Law, rows: Sequence[Row], labels: _Labels) -> None:
    """Name the axis of a parameter; a logarithmic law has a logarithmic one, few values a tick each, texts names."""
    axes.set(xlabel=labels[law.key])
    if law.kind == "log-uniform":
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(lambda *_: "")
    texts = list(dict.fromkeys(str(row[law.key]) for row in rows if isinstance(row.get(law.key), str)))
    values = np.unique(parameter_numbers(rows, law))
    if texts:
        axes.set_xticks(range(len(texts)), [text[:16] for text in texts], fontsize=8)
    elif law.kind in ("list", "integers") and len(values) <= _FEW:
        axes.set_xticks(values)


def _panels(count: int) -> tuple[Any, list[Any]]:
    across = math.ceil(count / math.ceil(count / _ACROSS))
    figure, grid = panels(count, across, 12 / across, _HEIGHT)
    return figure, [axes for (axes,) in grid]


_MOST_COLUMNS = 6
_MOST_WORST = 10


def write_report(campaign: Campaign, rows: Sequence[Row], folder: Path) -> Path:
    """Write report.html into a folder, which is made, and return its path; at least one row. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    page = Document(f"{campaign.name}: report of a campaign", campaign.settings.title, *_verdict(campaign, rows))
    labels = _Labels(campaign.settings.report.labels)
    for section in (_success, _distributions, _sensitivities, _worst):
        page.add(section(campaign, rows, labels))
    return page.add(_facts(campaign, rows)).write(folder / "report.html")


def _verdict(campaign: Campaign, rows: Sequence[Row]) -> tuple[str, str]:
    """Return the verdict as the command's exit code has it: by the least share of successes, once all runs are done."""
    success = proportion(sum(bool(row["success"]) for row in rows), len(rows))
    least = campaign.settings.min_success
    if len(rows) < campaign.runs:
        are = "run is" if campaign.runs == 1 else "runs are"
        return "unfinished", f"Success: {success}. {campaign.runs - len(rows)} of {campaign.runs} {are} missing."
    requirement = f"At least {least:.1%} are required" if least else "No least share is required"
    return "good" if success.share >= least else "bad", f"Success: {success}. {requirement} (min_success)."


def _success(campaign: Campaign, rows: Sequence[Row], labels: _Labels) -> Section:
    section = Section("Success")
    rules = campaign.settings.success
    section.text("" if rules else "A run is a success when its verdict is good.")
    ended = [row for row in rows if row["outcome"] == "ok"]
    kept = {rule.text: proportion(sum(map(rule.kept_by, ended)), len(rows)) for rule in rules}
    section.facts("Runs that keep each rule", kept)
    outcomes = Counter(str(row["outcome"]) for row in rows)
    if set(outcomes) != {"ok"}:
        section.records([{"outcome": name, "runs": n} for name, n in outcomes.most_common()], "Ends of the runs")
    if laws := campaign.settings.parameters:
        section.heading("Success by parameter")
        _add_chart(section, lambda: success_by_parameter(rows, laws, labels))
    return section.text("Intervals are Wilson's, 95 %.", "note")


def _add_chart(section: Section, draw: Callable[[], str]) -> None:
    try:
        section.chart(draw())
    except ChartsLacking as error:
        section.text(f"No chart: {error}", "note")


def _shown(campaign: Campaign, rows: Sequence[Row]) -> list[str]:
    """Return the columns of the report; those without a number are left out."""
    chosen = list(campaign.settings.report.columns)
    results = dict.fromkeys(name for row in rows for name in row if name.startswith("result."))
    columns = chosen or ["margin", "events.rate_hz", *results]
    shown = [name for name in columns if len(_finite(rows, name))]
    return shown if chosen else shown[:_MOST_COLUMNS]


def _finite(rows: Sequence[Row], column: str) -> Floats:
    values = numbers(rows, column)
    return values[np.isfinite(values)]


def _distributions(campaign: Campaign, rows: Sequence[Row], labels: _Labels) -> Section:
    section = Section("Distributions")
    settings = campaign.settings
    shown = _shown(campaign, rows)
    if not shown:
        return section.text("No column of the report has a number.")
    section.records([{"column": labels[name], **quantiles(rows, name)} for name in shown], "Quantiles over all runs")
    _add_chart(section, lambda: histograms(rows, shown, labels, settings.success))
    for column in shown if settings.parameters else ():
        section.heading(labels[column])
        _add_chart(section, partial(scatter, rows, settings.parameters, column, labels))
    return section


def quantiles(rows: Sequence[Row], column: str) -> Row:
    """Return quantiles of the numbers of a column."""
    values = np.quantile(_finite(rows, column), [0.0, 0.1, 0.5, 0.9, 1.0]).tolist()
    return dict(zip(("least", "10 %", "median", "90 %", "most"), values, strict=True))


def _sensitivities(campaign: Campaign, rows: Sequence[Row], labels: _Labels) -> Section:
    section = Section("Sensitivity")
    settings = campaign.settings
    designed = settings.sampling == "saltelli" and settings.repeats == 1
    for column in ["success", *_shown(campaign, rows)] if settings.parameters else ():
        effects = sensitivity(rows, settings.parameters, column, settings.count if designed else 0)
        section.heading(labels[column]).text(effects.method)
        named = [row | {"parameter": labels[row["parameter"]]} for row in effects.rows]
        section.records(named, f"Influence of each parameter on {labels[column]}")
    return section if settings.parameters else section.text("No parameter varies: runs differ by their seed.")


def worst_runs(campaign: Campaign, rows: Sequence[Row]) -> list[Row]:
    """Return the ten worst runs: first those that did not end normally, then by the column that the report names."""
    shown = campaign.settings.report
    sign = 1.0 if shown.worst_is == "lowest" else -1.0

    def badness(row: Row) -> tuple[bool, bool, bool, float, int]:
        value = row.get(shown.worst)
        is_number = isinstance(value, int | float)
        rank = sign * float(value or 0.0)
        return row["outcome"] == "ok", bool(row["success"]), not is_number, rank, int(row["index"])

    return sorted(rows, key=badness)[:_MOST_WORST]


def _worst(campaign: Campaign, rows: Sequence[Row], labels: _Labels) -> Section:
    file = Path(campaign.source.file).name
    keys = [law.key for law in campaign.settings.parameters]
    names = ["index", "outcome", "success", "margin", *keys, *_shown(campaign, rows), "broken", "error"]
    names = list(dict.fromkeys([*names, campaign.settings.report.worst]))
    worst = worst_runs(campaign, rows)
    names = [name for name in names if any(row.get(name) not in (None, "") for row in worst)]
    section = Section("Worst runs").text("One of them again, recorded:")
    section.code(f"evstim campaign again {file} INDEX --record run.npz")
    section.records([{labels[name]: row.get(name) for name in names} for row in worst], "The worst first")
    return section


def _facts(campaign: Campaign, rows: Sequence[Row]) -> Section:
    settings = campaign.settings
    wall_s = numbers(rows, "machine.wall_s")
    facts = {
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
    return Section("Campaign").facts("Its file, its runs and its machines", facts)

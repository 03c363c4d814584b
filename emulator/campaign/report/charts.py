"""The charts of a campaign's report, as <svg> and <img> elements that hold their own data."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.campaign.columns import Row
from emulator.campaign.laws import Law
from emulator.campaign.proportion import proportion
from emulator.campaign.report.sensitivity import numbers, parameter_numbers
from emulator.campaign.success import SuccessRule
from emulator.report.figures import pyplot

__all__ = ["histograms", "scatter", "success_by_parameter"]

_GOOD, _BAD, _INK = "#0072b2", "#d55e00", "#333333"  # told apart by colour-blind people too
_BINS = 8
_ACROSS = 4
_FEW = 8  # values that get a tick each
_FAR = 2.0  # from the values, in their span: a limit that is farther off is not drawn
_Floats = npt.NDArray[np.float64]
_Labels = Mapping[str, str]


def success_by_parameter(rows: Sequence[Row], laws: Sequence[Law], labels: _Labels) -> str:
    """Return the share of successes over the values of each parameter, with Wilson intervals."""
    figure, panels = _panels(len(laws))
    success = numbers(rows, "success")
    for axes, law in zip(panels, laws, strict=True):
        x = parameter_numbers(rows, law)
        centres, shares, low, high = _binned(x, success)
        axes.errorbar(centres, shares, yerr=[shares - low, high - shares], fmt="o", color=_INK, capsize=3)
        axes.set(ylim=(-0.03, 1.03))
        _scale(axes, law, rows, labels)
    panels[0].set_ylabel("share of successes, 95 %")
    return _svg(figure)


def _binned(x: _Floats, success: _Floats) -> tuple[_Floats, _Floats, _Floats, _Floats]:
    """Return for bins of about equal counts: mean of x, share, and the ends of its interval."""
    values = np.unique(x)
    edges = np.quantile(x, np.linspace(0, 1, _BINS + 1))
    which = np.searchsorted(values, x) if len(values) <= _BINS else np.clip(np.searchsorted(edges, x) - 1, 0, _BINS - 1)
    found = []
    for k in np.unique(which):
        mine = which == k
        known = proportion(int(success[mine].sum()), int(mine.sum()))
        found.append((float(x[mine].mean()), known.share, known.low, known.high))
    return tuple(np.array(column) for column in zip(*found, strict=True))  # type: ignore[return-value]


def scatter(rows: Sequence[Row], laws: Sequence[Law], column: str, labels: _Labels) -> str:
    """Return a column over each parameter, a point for each run, as an image."""
    figure, panels = _panels(len(laws))
    y, success = numbers(rows, column), numbers(rows, "success") > 0
    for axes, law in zip(panels, laws, strict=True):
        x = parameter_numbers(rows, law)
        for which, colour, name in ((success, _GOOD, "success"), (~success, _BAD, "no success")):
            if which.any():
                axes.plot(x[which], y[which], ".", markersize=5, alpha=0.6, color=colour, label=name)
        _scale(axes, law, rows, labels)
    panels[0].set_ylabel(labels.get(column, column))
    if not success.all():
        panels[-1].legend(fontsize=8)
    return _image(figure, f"{column} over the parameters")


def histograms(rows: Sequence[Row], columns: Sequence[str], labels: _Labels, rules: Sequence[SuccessRule]) -> str:
    """Return the distribution of some columns, with the limits of the rules; at least one column has numbers."""
    shown = [(column, values) for column in columns if len(values := _there(numbers(rows, column)))]
    figure, panels = _panels(len(shown))
    for axes, (column, values) in zip(panels, shown, strict=True):
        axes.hist(values, bins=min(40, max(5, int(np.sqrt(len(values))))), color=_INK, histtype="step")
        axes.set(xlabel=labels.get(column, column))
        axes.yaxis.get_major_locator().set_params(integer=True)
        for limit in _limits(rules, column, values):
            axes.axvline(limit, color=_BAD, linestyle="--")
    panels[0].set_ylabel("runs")
    return _svg(figure)


def _limits(rules: Sequence[SuccessRule], column: str, values: _Floats) -> list[float]:
    """Return the limits of a column that are not far from its values."""
    span = float(np.ptp(values))
    numbers = [float(rule.value) for rule in rules if rule.column == column and not isinstance(rule.value, str)]
    return [one for one in numbers if values.min() - _FAR * span <= one <= values.max() + _FAR * span]


def _there(values: _Floats) -> _Floats:
    return values[np.isfinite(values)]


def _scale(axes: Any, law: Law, rows: Sequence[Row], labels: _Labels) -> None:
    """Name the axis of a parameter; a logarithmic law has a logarithmic one, few values a tick each, texts names."""
    axes.set(xlabel=labels.get(law.key, law.key))
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
    down = -(-count // _ACROSS)
    across = -(-count // down)
    figure, axes = pyplot().subplots(down, across, figsize=(12, 2.8 * down), squeeze=False, layout="constrained")
    every = list(axes.flat)
    for unused in every[count:]:
        unused.set_visible(False)
    return figure, every[:count]


def _svg(figure: Any) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg")
    pyplot().close(figure)
    return text.getvalue()[text.getvalue().index("<svg") :]


def _image(figure: Any, told: str) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100)
    pyplot().close(figure)
    text = base64.b64encode(data.getvalue()).decode()
    return f'<img alt="{told}" style="width:100%" src="data:image/png;base64,{text}">'

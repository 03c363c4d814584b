"""The charts of a campaign's report, as <svg> and <img> elements that hold their own data."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.campaign.columns import Row
from emulator.campaign.laws import Law
from emulator.campaign.proportion import proportion
from emulator.campaign.report.sensitivity import numbers, parameter_numbers
from emulator.report.figures import pyplot

__all__ = ["histograms", "scatter", "success_by_parameter"]

_GOOD, _BAD, _INK = "#0072b2", "#d55e00", "#333333"  # told apart by colour-blind people too
_BINS = 8
_ACROSS = 3
_Floats = npt.NDArray[np.float64]


def success_by_parameter(rows: Sequence[Row], laws: Sequence[Law]) -> str:
    """Return the share of successes over the values of each parameter, with Wilson intervals."""
    figure, panels = _panels(len(laws))
    success = numbers(rows, "success")
    for axes, law in zip(panels, laws, strict=True):
        x = parameter_numbers(rows, law)
        centres, shares, low, high = _binned(x, success)
        axes.errorbar(centres, shares, yerr=[shares - low, high - shares], fmt="o", color=_INK, capsize=3)
        axes.set(xlabel=law.key, ylim=(-0.03, 1.03))
        _scale(axes, law, rows)
    panels[0].set_ylabel("share of successes")
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


def scatter(rows: Sequence[Row], laws: Sequence[Law], column: str) -> str:
    """Return a column over each parameter, a point for each run, as an image."""
    figure, panels = _panels(len(laws))
    y, success = numbers(rows, column), numbers(rows, "success") > 0
    for axes, law in zip(panels, laws, strict=True):
        x = parameter_numbers(rows, law)
        for which, colour, name in ((success, _GOOD, "success"), (~success, _BAD, "no success")):
            axes.plot(x[which], y[which], ".", markersize=4, alpha=0.6, color=colour, label=name)
        axes.set(xlabel=law.key)
        _scale(axes, law, rows)
    panels[0].set_ylabel(column)
    panels[-1].legend(frameon=False, fontsize=8)
    return _image(figure, f"{column} over the parameters")


def histograms(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """Return the distribution of some columns; at least one of them has numbers."""
    shown = [(column, values) for column in columns if len(values := _there(numbers(rows, column)))]
    figure, panels = _panels(len(shown))
    for axes, (column, values) in zip(panels, shown, strict=True):
        axes.hist(values, bins=min(40, max(5, int(np.sqrt(len(values))))), color=_INK, histtype="step")
        axes.set(xlabel=column)
    panels[0].set_ylabel("runs")
    return _svg(figure)


def _there(values: _Floats) -> _Floats:
    return values[np.isfinite(values)]


def _scale(axes: Any, law: Law, rows: Sequence[Row]) -> None:
    """Give a logarithmic axis to a logarithmic law, and names to values that are texts."""
    if law.kind == "log-uniform":
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(lambda *_: "")
    texts = list(dict.fromkeys(str(row[law.key]) for row in rows if isinstance(row.get(law.key), str)))
    if texts:
        axes.set_xticks(range(len(texts)), [text[:16] for text in texts], fontsize=8)


def _panels(count: int) -> tuple[Any, list[Any]]:
    across = min(count, _ACROSS)
    down = -(-count // across)
    figure, axes = pyplot().subplots(down, across, figsize=(10, 2.8 * down), squeeze=False, layout="constrained")
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

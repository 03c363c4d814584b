"""Which parameters a column of the table depends on.

    Sobol indices      from a Saltelli design (sampling = "saltelli"): shares of the column's variance
    PAWN               from any sample: how much the column's distribution changes when the parameter is known
    rank correlation   from any sample, Spearman's: direction and strength of what only rises or only falls

Sobol indices are computed by SALib, PAWN by `pawn`.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import spearmanr

from emulator.campaign.columns import Row
from emulator.campaign.laws import Law
from emulator.campaign.report.pawn import pawn, pawn_of_chance, slices_of

__all__ = ["Sensitivity", "numbers", "parameter_numbers", "sensitivity"]

_Floats = npt.NDArray[np.float64]
_FEWEST = 20  # rows below which no figure says anything


@dataclass(frozen=True)
class Sensitivity:
    """How one column depends on the parameters.

    Attributes
    ----------
    method : what was computed, and of which rows; or why nothing was.
    rows : a row of figures for each parameter.
    """

    column: str
    method: str
    rows: list[dict[str, Any]]


def numbers(rows: Sequence[Row], column: str) -> _Floats:
    """Return a column as floats (n,): true is 1, and what is missing or no number is NaN."""
    values = [row.get(column) for row in rows]
    return np.array([float(v) if isinstance(v, int | float) else math.nan for v in values])


def parameter_numbers(rows: Sequence[Row], law: Law) -> _Floats:
    """Return a parameter as floats (n,): texts and tables as their place in the list of values."""
    found = numbers(rows, law.key)
    if not np.isnan(found).any():
        return found
    known: dict[Any, int] = {}
    return np.array([float(known.setdefault(row.get(law.key), len(known))) for row in rows])


def sensitivity(rows: Sequence[Row], laws: Sequence[Law], column: str, base_points: int) -> Sensitivity:
    """Return how a column depends on the parameters; `base_points` is that of a Saltelli design, else 0."""
    y = numbers(rows, column)
    there = ~np.isnan(y)
    y_there = y[there]
    if len(y_there) < _FEWEST or np.ptp(y_there) == 0:
        why = f"fewer than {_FEWEST} runs have a value" if len(y_there) < _FEWEST else "all runs have the same value"
        return Sensitivity(column, f"nothing can be told: {why}", [])
    if base_points and _salib() and there.all() and len(y) == base_points * (len(laws) + 2):
        return Sensitivity(column, _SOBOL.format(base_points), _sobol(y, laws))
    x = np.stack([parameter_numbers(rows, law)[there] for law in laws], axis=1)
    found = [
        {"parameter": law.key, **_influence(one, y_there), **_rank(one, y_there)}
        for law, one in zip(laws, x.T, strict=True)
    ]
    method = f"PAWN index and rank correlation of {len(y_there)} runs as sampled"
    if base_points:
        method += "; no Sobol indices, because the design is not whole, or SALib is not installed"
    return Sensitivity(column, method, found)


_SOBOL = "Sobol indices (Saltelli's design, {} base points) with 95 % confidence: share of the variance"


def _salib() -> bool:
    try:
        importlib.import_module("SALib.analyze.pawn")
    except ImportError:
        return False
    return True


def _problem(dimensions: int) -> dict[str, Any]:
    names = [str(k) for k in range(dimensions)]
    return {"num_vars": dimensions, "names": names, "bounds": [[0.0, 1.0]] * dimensions}


def _sobol(y: _Floats, laws: Sequence[Law]) -> list[dict[str, Any]]:
    analyze = importlib.import_module("SALib.analyze.sobol").analyze
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = analyze(_problem(len(laws)), y, calc_second_order=False, seed=1)
    return [
        {
            "parameter": law.key,
            "alone (S1)": float(found["S1"][k]),
            "± S1": float(found["S1_conf"][k]),
            "with all others (ST)": float(found["ST"][k]),
            "± ST": float(found["ST_conf"][k]),
        }
        for k, law in enumerate(laws)
    ]


def _rank(x: _Floats, y: _Floats) -> dict[str, float]:
    rho = spearmanr(x, y) if np.ptp(x) > 0 else None
    return {"rank correlation": float(rho.statistic) if rho else math.nan, "p": float(rho.pvalue) if rho else math.nan}


def _influence(x: _Floats, y: _Floats) -> dict[str, float]:
    slices = slices_of(x)
    return {"PAWN": pawn(y, slices), "PAWN, 95 % of chance": pawn_of_chance(y, slices)}

"""Which parameters a column of the table depends on.

    Sobol indices      from a Saltelli design (sampling = "saltelli"): shares of the column's variance
    PAWN               from any sample: how much the column's distribution changes when the parameter is known
    rank correlation   from any sample, Spearman's: direction and strength of what only rises or only falls

Sobol indices and PAWN are computed by SALib.
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

__all__ = ["Sensitivity", "numbers", "parameter_numbers", "sensitivity"]

_Floats = npt.NDArray[np.float64]
_FEWEST = 20  # rows below which no figure says anything
_SLICES = (10, 8, 5, 4, 2)  # of PAWN; for others SALib 1.6 asks for quantiles above 1
_FEWEST_IN_SLICE = 10


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
    salib = _salib()
    if base_points and salib and there.all() and len(y) == base_points * (len(laws) + 2):
        return Sensitivity(column, _SOBOL.format(base_points), _sobol(y, laws))
    x = np.stack([parameter_numbers(rows, law)[there] for law in laws], axis=1)
    found = _ranks(x, y_there, laws)
    method = f"rank correlation of {len(y_there)} runs (PAWN needs SALib: pip install 'evstim[campaign]')"
    if salib:
        found = [{**one, **pawn} for one, pawn in zip(found, _pawn(x, y_there, laws), strict=True)]
        method = f"PAWN index and rank correlation of {len(y_there)} runs as sampled"
    if base_points:
        method += "; no Sobol indices, because the design is not whole"
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


def _ranks(x: _Floats, y: _Floats, laws: Sequence[Law]) -> list[dict[str, Any]]:
    found = []
    for k, law in enumerate(laws):
        varies = np.ptp(x[:, k]) > 0
        rho = spearmanr(x[:, k], y) if varies else None
        found.append(
            {
                "parameter": law.key,
                "rank correlation": float(rho.statistic) if rho else math.nan,
                "p": float(rho.pvalue) if rho else math.nan,
            }
        )
    return found


def _pawn(x: _Floats, y: _Floats, laws: Sequence[Law]) -> list[dict[str, Any]]:
    """Return PAWN indices, 0 (no influence) to 1, beside that of a parameter that has none: what chance alone gives."""
    analyze = importlib.import_module("SALib.analyze.pawn").analyze
    slices = next(n for n in _SLICES if n * _FEWEST_IN_SLICE <= len(y))
    chance = np.random.default_rng(1).random((len(y), 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = analyze(_problem(len(laws)), x, y, S=slices, seed=1)["median"]
        by_chance = float(analyze(_problem(1), chance, y, S=slices, seed=1)["median"][0])
    return [{"PAWN": float(one), "PAWN by chance": by_chance} for one in found]

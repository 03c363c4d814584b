"""The PAWN index: how much a parameter matters for a column, from any sample.

The runs are cut into slices of like values of the parameter. In each the column has a distribution; the index is the
median over the slices of the greatest distance between its cumulative distribution and that of all runs (the statistic
of Kolmogorov and Smirnov): 0 when the parameter says nothing, towards 1 when it says all.

Pianosi and Wagener, "Distribution-based sensitivity analysis from a generic input-output sample", 2018.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

__all__ = ["pawn", "pawn_of_chance", "slices_of"]

_MOST_SLICES = 10
_FEWEST_IN_SLICE = 10
_DRAWS = 40
_Floats = npt.NDArray[np.float64]
_Slices = Sequence[npt.NDArray[np.intp]]


def slices_of(x: _Floats) -> _Slices:
    """Return the indices of the runs of each slice of a parameter: of each value where there are few, else of ranks."""
    values, which = np.unique(x, return_inverse=True)
    if len(values) <= _MOST_SLICES:
        return [np.flatnonzero(which == k) for k in range(len(values))]
    count = min(_MOST_SLICES, max(2, len(x) // _FEWEST_IN_SLICE))
    return np.array_split(np.argsort(x, kind="stable"), count)


def pawn(y: _Floats, slices: _Slices) -> float:
    """Return the index of a parameter with these slices for the values `y` (n,) of a column."""
    whole = np.sort(y)
    return _index(y, whole, _cumulative(whole, whole), slices)


def pawn_of_chance(y: _Floats, slices: _Slices) -> float:
    """Return what the index of a parameter without any influence stays below in 95 % of samples like this one."""
    draw, whole = np.random.default_rng(1), np.sort(y)
    of_all = _cumulative(whole, whole)
    found = [_index(draw.permutation(y), whole, of_all, slices) for _ in range(_DRAWS)]
    return float(np.quantile(found, 0.95))


def _index(y: _Floats, whole: _Floats, of_all: _Floats, slices: _Slices) -> float:
    distances = [np.abs(_cumulative(np.sort(y[one]), whole) - of_all).max() for one in slices]
    return float(np.median(distances))


def _cumulative(values: _Floats, at: _Floats) -> _Floats:
    """Return the share of sorted values that are not above each of `at`."""
    return np.searchsorted(values, at, side="right") / len(values)

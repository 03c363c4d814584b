"""Where in the unit cube the runs of a campaign lie.

sobol             a scrambled Sobol sequence: even in all projections; best with a power of two
latin-hypercube   each parameter's range in as many equal parts as there are runs, one run in each
random            independent points
saltelli          a design for Sobol indices (Saltelli 2010): base points times (parameters + 2)
grid              every combination of the parameters' values
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.stats import qmc

__all__ = ["Sampling", "grid_digits", "unit_points"]

Sampling = Literal["sobol", "latin-hypercube", "random", "saltelli", "grid"]
_Points = npt.NDArray[np.float64]


def unit_points(sampling: Sampling, count: int, dimensions: int, seed: int) -> _Points:
    """Return (runs, dimensions) points of the unit cube; as many as `count`, for saltelli times (dimensions + 2)."""
    if not dimensions:
        return np.zeros((count, 0))
    if sampling == "saltelli":
        return _saltelli(count, dimensions, seed)
    if sampling == "sobol":
        return _sobol(count, dimensions, seed)
    if sampling == "latin-hypercube":
        return np.asarray(qmc.LatinHypercube(dimensions, seed=seed).random(count))
    return np.random.default_rng(seed).random((count, dimensions))


def _sobol(count: int, dimensions: int, seed: int) -> _Points:
    """Return the first points of a sequence whose whole length is a power of two."""
    sequence = qmc.Sobol(dimensions, scramble=True, seed=seed)
    return np.asarray(sequence.random_base2(max(count - 1, 0).bit_length()))[:count]


def _saltelli(count: int, dimensions: int, seed: int) -> _Points:
    """Return for each base point: A, A with one column after the other of B, B (the order that SALib reads)."""
    both = _sobol(count, 2 * dimensions, seed)
    a, b = both[:, :dimensions], both[:, dimensions:]
    rows = np.repeat(a[:, None, :], dimensions + 2, axis=1)
    for k in range(dimensions):
        rows[:, k + 1, k] = b[:, k]
    rows[:, -1, :] = b
    return rows.reshape(-1, dimensions)


def grid_digits(index: int, lengths: list[int]) -> list[int]:
    """Return which value of each parameter grid point `index` has; the last parameter changes fastest."""
    digits: list[int] = []
    for length in reversed(lengths):
        index, digit = divmod(index, length)
        digits.append(digit)
    if index:
        raise IndexError(f"a grid of {math.prod(lengths)} points")
    return digits[::-1]

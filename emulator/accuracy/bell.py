"""The normal distribution, to the last digits of float64, without a dependency."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

__all__ = ["bell", "normal_distribution"]

_Float64s = npt.NDArray[np.float64]


def bell(x: _Float64s) -> _Float64s:
    """Return the normal density at x, any shape."""
    return np.asarray(np.exp(-0.5 * x * x) / math.sqrt(2 * math.pi))


@njit(cache=True)
def _below(x: _Float64s, out: _Float64s) -> None:
    for k in range(x.size):
        out[k] = 0.5 * math.erfc(-x[k] / math.sqrt(2))


def normal_distribution(x: _Float64s) -> _Float64s:
    """Return the share of a normal distribution that lies below x, any shape."""
    out = np.empty(x.size)
    _below(np.ascontiguousarray(x, np.float64).reshape(-1), out)
    return out.reshape(x.shape)

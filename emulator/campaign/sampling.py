"""Sampling of a campaign's parameters: points of the unit cube, and laws that turn them into values.

sobol             a scrambled Sobol sequence: even in all projections; best with a power of two
latin-hypercube   each parameter's range in as many equal parts as there are runs, one run in each
random            independent points
saltelli          a design for Sobol indices (Saltelli 2010): base points times (parameters + 2)
grid              every combination of the parameters' values

A law turns a number of the unit interval into a value of a parameter:

uniform       low to high
log-uniform   low to high, the logarithm is uniform
normal        mean and deviation, cut at low and high
integers      low to high, both may be drawn
list          any values, each as often
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

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
    points = _sobol(count, 2 * dimensions, seed)
    a, b = points[:, :dimensions], points[:, dimensions:]
    rows = np.repeat(a[:, None, :], dimensions + 2, axis=1)
    for k in range(dimensions):
        rows[:, k + 1, k] = b[:, k]
    rows[:, -1, :] = b
    return rows.reshape(-1, dimensions)


def grid_digits(index: int, lengths: list[int]) -> list[int]:
    """Return the index of each parameter's value at grid point `index`; the last parameter changes fastest."""
    digits: list[int] = []
    for length in reversed(lengths):
        index, digit = divmod(index, length)
        digits.append(digit)
    if index:
        raise IndexError(f"a grid of {math.prod(lengths)} points")
    return digits[::-1]


_MOST_VALUES = 10_000


@dataclass(frozen=True)
class Law(ABC):
    """A parameter, and the distribution of its values.

    Attributes
    ----------
    key : Destination of the value: a key of the rig such as "camera.sensor.threshold_on" or "faults[0].rate", or
        "program.NAME" for a value that the program under test alone receives.
    also : other keys of the rig that have the same value.
    """

    kind: ClassVar[str]

    key: str
    also: tuple[str, ...] = ()

    @abstractmethod
    def at(self, share: float) -> Any:
        """Return the value below which `share` of all values are, 0 <= share < 1."""

    @abstractmethod
    def grid(self) -> list[Any]:
        """Return the values for a grid; raises ValueError where the law has no number of them."""


@dataclass(frozen=True)
class _Range(Law):
    """A range, with the number of its values in a grid."""

    low: float = math.nan
    high: float = math.nan
    steps: int = 0

    def __post_init__(self) -> None:
        _require_order(self.low, self.high)
        if not 0 <= self.steps <= _MOST_VALUES:
            raise ValueError(f"steps must be 0 (no grid) to {_MOST_VALUES}, got {self.steps}")

    def grid(self) -> list[float]:
        """Return `steps` values from low to high, at equal shares."""
        if not self.steps:
            raise ValueError('steps is missing: a grid needs the number of values, or kind = "list"')
        return [self.at(k / (self.steps - 1) if self.steps > 1 else 0.5) for k in range(self.steps)]


@dataclass(frozen=True)
class Uniform(_Range):
    """Any value from `low` to `high`, each as likely; `steps` values of it in a grid."""

    kind = "uniform"

    def at(self, share: float) -> float:
        """Return low + share (high - low)."""
        return float(self.low + share * (self.high - self.low))


@dataclass(frozen=True)
class LogUniform(_Range):
    """Any value from `low` to `high`, each factor as likely; `steps` values of it in a grid."""

    kind = "log-uniform"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.low > 0:
            raise ValueError(f"low must be above 0 for a logarithm, got {self.low}")

    def at(self, share: float) -> float:
        """Return low (high / low)^share."""
        value = math.exp(math.log(self.low) + share * (math.log(self.high) - math.log(self.low)))
        return min(max(value, self.low), self.high)


@dataclass(frozen=True)
class Normal(Law):
    """A normal distribution of `mean` and `deviation`, cut at `low` and `high`.

    By default it is cut three deviations from the mean.
    """

    kind = "normal"

    mean: float = math.nan
    deviation: float = math.nan
    low: float = math.nan
    high: float = math.nan

    def __post_init__(self) -> None:
        if not math.isfinite(self.mean):
            raise ValueError("mean is missing or no number")
        if not 0 < self.deviation < math.inf:
            raise ValueError(f"deviation must be above 0, got {self.deviation}")
        _require_order(*self.bounds)

    @property
    def bounds(self) -> tuple[float, float]:
        """(low, high), the bounds of the values."""
        low = self.mean - 3 * self.deviation if math.isnan(self.low) else self.low
        high = self.mean + 3 * self.deviation if math.isnan(self.high) else self.high
        return low, high

    def at(self, share: float) -> float:
        """Return the quantile of the cut distribution."""
        low, high = self.bounds
        below, upto = ndtr((low - self.mean) / self.deviation), ndtr((high - self.mean) / self.deviation)
        value = self.mean + self.deviation * float(ndtri(below + share * (upto - below)))
        return min(max(value, low), high)

    def grid(self) -> list[float]:
        """Raise ValueError: a grid would not show the distribution."""
        raise ValueError('kind "normal" has no grid; give kind = "list", or another sampling')


@dataclass(frozen=True)
class Integers(Law):
    """A whole number from `low` to `high`, each as likely; all of them in a grid."""

    kind = "integers"

    low: int = 0
    high: int = 0

    def __post_init__(self) -> None:
        _require_order(self.low, self.high)

    def at(self, share: float) -> int:
        """Return a whole number; each has an equal part of the unit interval."""
        return min(self.low + math.floor(share * (self.high - self.low + 1)), self.high)

    def grid(self) -> list[int]:
        """Return all of them."""
        if self.high - self.low >= _MOST_VALUES:
            raise ValueError(f"high - low must be below {_MOST_VALUES} in a grid")
        return list(range(self.low, self.high + 1))


@dataclass(frozen=True)
class OneOf(Law):
    """One of `values`, each as likely; all of them in a grid. A value may be any that the key allows, also a table."""

    kind = "list"

    values: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        if not 0 < len(self.values) <= _MOST_VALUES:
            raise ValueError(f"values must be a list of 1 to {_MOST_VALUES}, got {len(self.values)}")

    def at(self, share: float) -> Any:
        """Return a value; each has an equal part of the unit interval."""
        return self.values[min(math.floor(share * len(self.values)), len(self.values) - 1)]

    def grid(self) -> list[Any]:
        """Return all of them."""
        return list(self.values)


def _require_order(low: float, high: float) -> None:
    if not (np.isfinite(low) and np.isfinite(high)):
        raise ValueError("low and high are both needed, as finite numbers")
    if not low < high:
        raise ValueError(f"low must be below high, got {low} and {high}")


LAWS: dict[str, type[Law]] = {law.kind: law for law in (Uniform, LogUniform, Normal, Integers, OneOf)}
"""All laws by kind."""

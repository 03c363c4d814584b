"""Latency of events: a histogram with a fixed size, whatever the length of the run and of the latencies.

Below 0.2 s a bin is 10 us wide, above that each is 1 % wider than the one before, up to a year.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["LatencyHistogram", "LatencySummary"]

_BIN_US = 10
_EVEN_BINS = 20_000
_EVEN_US = float(_BIN_US * _EVEN_BINS)
_RATIO = 1.01
_YEAR_US = 3.2e13  # the longest run
_BINS = _EVEN_BINS + math.ceil(math.log(_YEAR_US / _EVEN_US, _RATIO))


@dataclass(frozen=True)
class LatencySummary:
    """Latency from an event's own time to its bytes leaving, us; None where nothing was measured."""

    p50: float | None = None
    p99: float | None = None
    max: float | None = None


class LatencyHistogram:
    """Latencies in bins of 10 us up to 0.2 s, and of 1 % above; the largest is kept exactly."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self._max_us: float | None = None

    def add(self, latency_us: npt.NDArray[np.floating[Any]]) -> None:
        """Count latencies, shape (n,), us; an event that leaves before its own time counts as 0."""
        if not len(latency_us):
            return
        bins = _bins(latency_us)
        first = int(bins.min())
        counts = np.bincount(bins - first)
        self._counts[first : first + len(counts)] += counts
        self._max_us = max(self._max_us or 0.0, float(latency_us.max()))

    def summary(self) -> LatencySummary:
        """Return median, 99th percentile (upper edge of the bin, never above the maximum) and maximum."""
        if self._max_us is None:
            return LatencySummary()
        return LatencySummary(self._quantile_us(0.5), self._quantile_us(0.99), self._max_us)

    def _quantile_us(self, share: float) -> float:
        cumulative = np.cumsum(self._counts)
        index = int(np.searchsorted(cumulative, share * cumulative[-1]))
        return min(_upper_edge_us(index), self._max_us or 0.0)


def _bins(latency_us: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.int64]:
    """Return the bin of each latency."""
    bins = np.clip(latency_us / _BIN_US, 0, _EVEN_BINS - 1).astype(np.int64)
    long = latency_us >= _EVEN_US
    if long.any():
        above = np.log(latency_us[long] / _EVEN_US) / math.log(_RATIO)
        bins[long] = np.minimum(_EVEN_BINS + above.astype(np.int64), _BINS - 1)
    return bins


def _upper_edge_us(index: int) -> float:
    if index < _EVEN_BINS:
        return float((index + 1) * _BIN_US)
    return math.inf if index == _BINS - 1 else _EVEN_US * _RATIO ** (index + 1 - _EVEN_BINS)

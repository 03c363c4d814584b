"""How late events leave: a histogram with a fixed size, whatever the length of the run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["LONGEST_US", "LatencyHistogram", "LatencySummary"]

_BIN_US = 10
_BINS = 20_000
LONGEST_US = float(_BIN_US * _BINS)
"""Longest latency that is measured; a quantile that says this is that long or longer."""


@dataclass(frozen=True)
class LatencySummary:
    """Latency from an event's own time to its bytes leaving, us; None where nothing was measured."""

    p50: float | None = None
    p99: float | None = None
    max: float | None = None


class LatencyHistogram:
    """Latencies in bins of 10 us up to 0.2 s; later ones share the last bin, the largest is kept exactly."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self._max_us: float | None = None

    def add(self, latency_us: npt.NDArray[np.floating[Any]]) -> None:
        """Count latencies, shape (n,), us; an event that leaves before its own time counts as 0."""
        if not len(latency_us):
            return
        bins = np.clip(latency_us / _BIN_US, 0, _BINS - 1).astype(np.int64)
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
        return min(float((index + 1) * _BIN_US), self._max_us or 0.0)

"""Compiled loops over the events of each pixel, for the scores; streams as in `scores.Stream`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import entry_of

__all__ = ["PixelEvents", "common_subsequences", "moved_us", "van_rossum_products"]

_Float64s = npt.NDArray[np.float64]
_Int64s = npt.NDArray[np.int64]
_Bools = npt.NDArray[np.bool_]


class PixelEvents(NamedTuple):
    """A stream's arrays, as in `scores.Stream`."""

    t_us: _Float64s
    on: _Bools
    first: _Int64s


compiled: Callable[[Callable[..., Any]], Callable[..., Any]] = entry_of(__name__, error_model="python")


@compiled
def _longest_common(a: _Bools, b: _Bools) -> int:
    """Return the length of the longest common subsequence, after the common head and tail."""
    head = 0
    while head < min(a.size, b.size) and a[head] == b[head]:
        head += 1
    tail = 0
    while tail < min(a.size, b.size) - head and a[a.size - 1 - tail] == b[b.size - 1 - tail]:
        tail += 1
    n, m = a.size - head - tail, b.size - head - tail
    row = np.zeros(m + 1, np.int64)
    for i in range(n):
        corner = 0
        for j in range(m):
            above = row[j + 1]
            row[j + 1] = corner + 1 if a[head + i] == b[head + j] else max(above, row[j])
            corner = above
    return head + tail + int(row[m])


@compiled
def common_subsequences(a: PixelEvents, b: PixelEvents) -> _Int64s:
    """Return for each pixel the length of the longest common subsequence of polarities, (pixels,)."""
    common = np.empty(a.first.size - 1, np.int64)
    for p in range(common.size):
        common[p] = _longest_common(a.on[a.first[p] : a.first[p + 1]], b.on[b.first[p] : b.first[p + 1]])
    return common


@compiled
def _train(events: PixelEvents, p: int, up: bool) -> _Float64s:
    """Return the times of one pixel's events of one polarity."""
    low, high = events.first[p], events.first[p + 1]
    out = np.empty(high - low)
    n = 0
    for k in range(low, high):
        if events.on[k] == up:
            out[n] = events.t_us[k]
            n += 1
    return out[:n]


@compiled
def _square(a: _Float64s, b: _Float64s, tau: float) -> float:
    """Return sum over all pairs of sign sign' exp(-|t - t'| / tau), in one pass over both trains by time."""
    i = j = 0
    total = trace = last = 0.0
    while i < a.size or j < b.size:
        from_a = j == b.size or (i < a.size and a[i] <= b[j])
        t = a[i] if from_a else b[j]
        sign = 1.0 if from_a else -1.0
        trace = trace * math.exp(-(t - last) / tau) if i + j else 0.0
        total += 1.0 + 2.0 * sign * trace
        trace += sign
        last = t
        if from_a:
            i += 1
        else:
            j += 1
    return total


@compiled
def van_rossum_products(a: PixelEvents, b: PixelEvents, tau_us: float) -> tuple[float, float]:
    """Return the squared distance and the squared norms of both, summed over pixels and polarities."""
    apart = whole = 0.0
    nothing = np.empty(0)
    for p in range(a.first.size - 1):
        for up in (False, True):
            x, y = _train(a, p, up), _train(b, p, up)
            apart += max(_square(x, y, tau_us), 0.0)
            whole += _square(x, nothing, tau_us) + _square(nothing, y, tau_us)
    return apart, whole


@compiled
def _moved(a: _Float64s, b: _Float64s) -> float:
    """Return the integral of the difference of two distributions of mass one, us."""
    i = j = 0
    moved = 0.0
    last = min(a[0], b[0])
    while i < a.size or j < b.size:
        from_a = j == b.size or (i < a.size and a[i] <= b[j])
        t = a[i] if from_a else b[j]
        moved += abs(i / a.size - j / b.size) * (t - last)
        last = t
        if from_a:
            i += 1
        else:
            j += 1
    return moved


@compiled
def moved_us(a: PixelEvents, b: PixelEvents) -> tuple[float, int]:
    """Return the earth mover's distance summed over the events of b that count, and their number."""
    total = 0.0
    weight = 0
    for p in range(a.first.size - 1):
        for up in (False, True):
            x, y = _train(a, p, up), _train(b, p, up)
            if x.size and y.size:
                total += y.size * _moved(x, y)
                weight += y.size
    return total, weight

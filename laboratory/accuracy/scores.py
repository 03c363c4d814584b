"""Measures of agreement between two event streams.

    right               share of the active pixels (those with events in either stream) whose whole sequence of
                        polarities is the true one; hard: one error in a hundred events fails a pixel
    t50, t95            quantiles of |timestamp error| over all events of the right pixels, us
    count               events over true events
    wrong events        events that must be deleted or inserted to make each pixel's sequence of polarities the true
                        one, over the true events: 0 is perfect, a silent sensor has 1, an invented event adds to it
    earth mover         mean distance by which events must be moved in time, each pixel and polarity for itself as a
                        distribution of mass one, weighted by its true events; trains that are empty on either side
                        count in the wrong events only, us
    same time           share of the events whose timestamp another event of the stream has too ("timestamp batching")

With noise two streams have no event in common, and are compared as samples of one distribution (`compare_samples`):

    right               1 - total variation distance of the sequences of four polarities of a pixel
    t50, t95            quantiles of the difference between the quantile functions of the intervals of a pixel's events,
                        over levels from 0.5 to 99.5 %; earth mover: their mean, us
    wrong events        difference of the numbers of ON events, and that of OFF events, over the true events

A `Stream` is an event stream for comparison: times of any resolution, sorted by pixel and then by time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Events, Floats, Int64s, Mask

_Bools = Mask


class PixelEvents(NamedTuple):
    """The arrays of a `Stream`, for compiled loops."""

    t_us: Floats
    on: _Bools
    first: Int64s


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
def common_subsequences(a: PixelEvents, b: PixelEvents) -> Int64s:
    """Return for each pixel the length of the longest common subsequence of polarities, (pixels,)."""
    common = np.empty(a.first.size - 1, np.int64)
    for p in range(common.size):
        common[p] = _longest_common(a.on[a.first[p] : a.first[p + 1]], b.on[b.first[p] : b.first[p + 1]])
    return common


@compiled
def _train(events: PixelEvents, p: int, up: bool) -> Floats:
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
def _moved(a: Floats, b: Floats) -> float:
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


@dataclass(frozen=True, slots=True)
class Stream:
    """Events of `pixels` pixels, those of pixel k from `first[k]` to `first[k + 1]`, in the order of their times.

    Attributes
    ----------
    t_us : (n,) float64, times.
    on : (n,) bool, True where the light increased.
    first : (pixels + 1,) int64, index of each pixel's first event.
    """

    t_us: Floats
    on: Mask
    first: Int64s

    def __len__(self) -> int:
        return self.t_us.size

    @property
    def pixels(self) -> int:
        """Number of pixels, silent ones included."""
        return self.first.size - 1

    @property
    def counts(self) -> Int64s:
        """Events of each pixel, (pixels,)."""
        return np.diff(self.first)

    @property
    def pixel(self) -> Int64s:
        """Pixel of each event, (n,)."""
        return np.repeat(np.arange(self.pixels), self.counts)

    def where(self, chosen: Mask) -> Stream:
        """Return the chosen events, by a mask of all, (n,)."""
        return Stream.of(self.t_us[chosen], self.pixel[chosen], self.on[chosen], self.pixels)

    def intervals_us(self) -> Floats:
        """Return the times between successive events of a pixel, (m,), of all pixels, sorted."""
        return np.sort(np.diff(self.t_us)[np.diff(self.pixel) == 0])

    def words(self, length: int = 4) -> Floats:
        """Return the share of each sequence of so many polarities of a pixel, (2^length,), ON as 1, the first highest.

        All are NaN where no pixel has as many events.
        """
        n = max(len(self) - length + 1, 0)
        code = sum((self.on[k : k + n].astype(np.int64) << (length - 1 - k) for k in range(length)), np.zeros(n, int))
        pixel = self.pixel
        code = code[pixel[:n] == pixel[length - 1 :][:n]]
        return np.bincount(code, minlength=1 << length) / np.float64(code.size or np.nan)

    @classmethod
    def of(cls, t_us: npt.ArrayLike, pixel: npt.ArrayLike, on: npt.ArrayLike, pixels: int) -> Stream:
        """Sort events, (n,) each, by pixel and time; those of one pixel and time keep their order.

        Raises ValueError where the lengths differ, a time is not finite, or a pixel is not in [0, pixels).
        """
        t, where, up = np.asarray(t_us, np.float64), np.asarray(pixel, np.int64), np.asarray(on, np.bool_)
        if not t.shape == where.shape == up.shape or t.ndim != 1:
            raise ValueError(f"t_us {t.shape}, pixel {where.shape}, on {up.shape}: must be of one length")
        if not np.isfinite(t).all():
            raise ValueError("t_us: times must be finite")
        if where.size and (where.min() < 0 or where.max() >= pixels):
            raise ValueError(f"pixel from {where.min()} to {where.max()}: must lie in [0, {pixels})")
        order = np.lexsort((t, where))
        first = np.concatenate([[0], np.cumsum(np.bincount(where, minlength=pixels))])
        return cls(t[order], up[order], first.astype(np.int64))

    @classmethod
    def from_events(cls, events: Events, width: int, height: int) -> Stream:
        """Return the stream of an EVENT array, (n,), of a sensor of that size."""
        pixel = events["y"].astype(np.int64) * width + events["x"]
        return cls.of(events["t"].astype(np.float64), pixel, events["on"], width * height)


@dataclass(frozen=True, slots=True)
class Scores:
    """Comparison of a stream with the truth, as defined in the module docstring; NaN where nothing can be compared.

    Attributes
    ----------
    right, wrong_events, count, same_time : ratios.
    t50_us, t95_us, earth_mover_us : times, us.
    events, true_events : numbers of events.
    """

    right: float
    t50_us: float
    t95_us: float
    count: float
    wrong_events: float
    earth_mover_us: float
    same_time: float
    events: int
    true_events: int


def compare(stream: Stream, truth: Stream) -> Scores:
    """Compare a stream with the truth; raises ValueError where they have different numbers of pixels."""
    _check_pixels(stream, truth)
    ours, known = (PixelEvents(s.t_us, s.on, s.first) for s in (stream, truth))
    common = common_subsequences(ours, known)
    active = (stream.counts > 0) | (truth.counts > 0)
    right = active & (common == stream.counts) & (common == truth.counts)
    errors = np.abs(stream.t_us[right[stream.pixel]] - truth.t_us[right[truth.pixel]])
    t50, t95 = np.quantile(errors, [0.5, 0.95]) if errors.size else (np.nan, np.nan)
    n, m = len(stream), len(truth)
    moved, trains = moved_us(ours, known)
    return Scores(
        right=_ratio(right.sum(), active.sum()),
        t50_us=float(t50),
        t95_us=float(t95),
        count=_ratio(n, m),
        wrong_events=_ratio(n + m - 2 * common.sum(), m),
        earth_mover_us=_ratio(moved, trains),
        same_time=same_time_share(stream.t_us),
        events=n,
        true_events=m,
    )


def wrong_share(events: Events, truth: Events, width: int, height: int) -> float:
    """Return the wrong events of EVENT arrays of a sensor of that size, over the true ones."""
    return compare(*(Stream.from_events(part, width, height) for part in (events, truth))).wrong_events


def _check_pixels(stream: Stream, truth: Stream) -> None:
    if stream.pixels != truth.pixels:
        raise ValueError(f"{stream.pixels} pixels against {truth.pixels}: streams must be of the same pixels")


_LEVELS = np.linspace(0.005, 0.995, 199)


def compare_samples(stream: Stream, truth: Stream) -> Scores:
    """Compare a stream with another sample of the true distribution; raises ValueError as `compare` does."""
    _check_pixels(stream, truth)
    samples, n = [one.intervals_us() for one in (stream, truth)], len(truth)
    moved = np.full(1, np.nan)
    if samples[0].size and samples[1].size:
        moved = np.abs(np.quantile(samples[0], _LEVELS) - np.quantile(samples[1], _LEVELS))
    ons = int(stream.on.sum()) - int(truth.on.sum())
    return Scores(
        right=float(1 - np.abs(stream.words() - truth.words()).sum() / 2),
        t50_us=float(np.quantile(moved, 0.5)),
        t95_us=float(np.quantile(moved, 0.95)),
        count=_ratio(len(stream), n),
        wrong_events=_ratio(abs(ons) + abs(len(stream) - n - ons), n),
        earth_mover_us=float(moved.mean()),
        same_time=same_time_share(stream.t_us),
        events=len(stream),
        true_events=n,
    )


def same_time_share(t: npt.ArrayLike) -> float:
    """Return the share of times, (n,), that another one equals."""
    times = np.asarray(t)
    _, counts = np.unique(times, return_counts=True)
    return _ratio(counts[counts > 1].sum(), times.size)


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else float("nan")

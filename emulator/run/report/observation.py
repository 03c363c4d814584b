"""What a run shows from outside, in memory that does not grow with its events.

per pixel   ON and OFF events
per bin     events and ON events in each tenth of a second of stream time, later in longer bins
intervals   between two events of the same pixel, of one pixel in eight, in bins of a tenth of a decade
links       delivered and dropped, at each status of the run
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.run.outcome import RunStatus
from firmware_protocol.events import Events

__all__ = ["INTERVAL_EDGES_US", "Observation", "RateSeries"]

_BIN_US = 100_000
_MOST_BINS = 2000
_SAMPLED = 8  # one pixel in so many
INTERVAL_EDGES_US = np.logspace(0, 8, 81)
"""Edges of the bins of intervals, us."""


class RateSeries:
    """Events in bins of stream time: when there are too many bins, each two become one.

    Attributes
    ----------
    bin_us : length of a bin now.
    """

    def __init__(self) -> None:
        self.bin_us = _BIN_US
        self._events = np.zeros(_MOST_BINS, np.int64)
        self._on = np.zeros(_MOST_BINS, np.int64)
        self._used = 0

    def add(self, events: Events) -> None:
        """Count events (n,) EVENT, n > 0, sorted by time."""
        while int(events["t"][-1]) // self.bin_us >= _MOST_BINS:
            self._halve()
        bins = (events["t"] // self.bin_us).astype(np.int64)
        first = int(bins[0])
        counts = np.bincount(bins - first)
        self._events[first : first + len(counts)] += counts
        self._on[first : first + len(counts)] += np.bincount(bins - first, events["on"]).astype(np.int64)
        self._used = max(self._used, first + len(counts))

    @property
    def events(self) -> npt.NDArray[np.int64]:
        """Events in each bin, (n,)."""
        return self._events[: self._used]

    @property
    def on(self) -> npt.NDArray[np.int64]:
        """ON events in each bin, (n,)."""
        return self._on[: self._used]

    def _halve(self) -> None:
        for counts in (self._events, self._on):
            counts[: _MOST_BINS // 2] = counts.reshape(-1, 2).sum(axis=1)
            counts[_MOST_BINS // 2 :] = 0
        self._used = (self._used + 1) // 2
        self.bin_us *= 2


class Observation:
    """Takes the events and the statuses of a run.

    Parameters
    ----------
    size : (width, height) of the sensor, pixels.

    Attributes
    ----------
    on, off : events of each pixel, (height, width) int64.
    rates : events over time.
    intervals : how many intervals lie in each bin of INTERVAL_EDGES_US.
    worst_late_us : at each status, (stream time in s, worst lateness so far in us).
    """

    def __init__(self, size: tuple[int, int]) -> None:
        width, height = size
        self.on = np.zeros((height, width), np.int64)
        self.off = np.zeros((height, width), np.int64)
        self.rates = RateSeries()
        self.intervals = np.zeros(len(INTERVAL_EDGES_US) - 1, np.int64)
        self.worst_late_us = 0.0
        self._last_us = np.full(width * height, -1, np.int64)
        self._width = width

    def take(self, events: Events) -> None:
        """Count the events (n,) EVENT of a step, sorted by time."""
        if not len(events):
            return
        self.rates.add(events)
        pixel = events["y"].astype(np.int64) * self._width + events["x"]
        for counts, chosen in ((self.on, events["on"]), (self.off, ~events["on"])):
            counts.ravel()[:] += np.bincount(pixel[chosen], minlength=counts.size)
        sampled = (events["x"] + events["y"]) % _SAMPLED == 0
        self._measure(pixel[sampled], events["t"][sampled].astype(np.int64))

    def renew(self, status: RunStatus) -> None:
        """Take note of how things stand."""
        self.worst_late_us = max(self.worst_late_us, status.lateness.worst_gap_us)

    def _measure(self, pixel: npt.NDArray[np.int64], t_us: npt.NDArray[np.int64]) -> None:
        """Add the intervals that end with these events."""
        if not len(pixel):
            return
        order = np.argsort(pixel, kind="stable")
        pixel, t_us = pixel[order], t_us[order]
        before = np.empty_like(t_us)
        before[1:] = t_us[:-1]
        first = np.concatenate([[True], pixel[1:] != pixel[:-1]])
        before[first] = self._last_us[pixel[first]]
        last = np.concatenate([first[1:], [True]])
        self._last_us[pixel[last]] = t_us[last]
        known = before >= 0
        self.intervals += np.histogram(np.maximum(t_us - before, 1)[known], INTERVAL_EDGES_US)[0]

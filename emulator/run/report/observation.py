"""Observation of a run for its report, in memory that does not grow with its events.

per pixel   ON and OFF events
per bin     events and ON events in each tenth of a second of stream time, later in longer bins; in bins of their own
            late steps and edges of the external input, as the statuses of the run count them
intervals   between two events of the same pixel, of one pixel in eight, in bins of a tenth of a decade
pictures    some light frames with the events before them, spread over the run
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.light import Light
from emulator.run.outcome import RunStatus
from firmware_protocol.events import Events

Counts = npt.NDArray[np.int64]

_BIN_US = 100_000
_MOST_BINS = 2000
_SAMPLED = 8  # one pixel in so many
_FEW = 20  # pixels for each event, above which events are few
INTERVAL_EDGES_US = np.logspace(0, 8, 81)
"""Edges of the bins of intervals, us."""


class BinnedCounts:
    """Counts in bins of stream time, `columns` in each; when there are too many bins, each two become one.

    Attributes
    ----------
    bin_us : length of a bin now.
    """

    def __init__(self, columns: int) -> None:
        self.bin_us = _BIN_US
        self._counts = np.zeros((columns, _MOST_BINS), np.int64)
        self._used = 0

    def reach(self, t_us: int) -> None:
        """Make the bins long enough for this time."""
        while t_us // self.bin_us >= _MOST_BINS:  # each two bins become one
            self._counts[:, : _MOST_BINS // 2] = self._counts.reshape(len(self._counts), -1, 2).sum(axis=2)
            self._counts[:, _MOST_BINS // 2 :] = 0
            self._used = (self._used + 1) // 2
            self.bin_us *= 2

    def add_bins(self, column: int, first: int, counts: Counts) -> None:
        """Add counts (n,) to the bins from `first` on."""
        self._counts[column, first : first + len(counts)] += counts
        self._used = max(self._used, first + len(counts))

    def add(self, column: int, t_us: int, count: int) -> None:
        """Add a count at a time."""
        self.reach(t_us)
        self.add_bins(column, t_us // self.bin_us, np.array([count]))

    def column(self, column: int) -> Counts:
        """Return the counts of a column in each bin, (n,)."""
        counts: Counts = self._counts[column, : self._used]
        return counts


_WINDOW_US = 40_000  # of the events over a picture
_SPACING_US = 50_000  # of pictures at first
_MOST_PICTURES = 12  # then every second one goes, and the spacing doubles
_PICTURE_PX = 320


@dataclass(frozen=True)
class TakenPicture:
    """Light (height, width), reduced to at most 320 pixels of width, and the polarity of the last events there."""

    t_us: int
    light: Light
    polarity: npt.NDArray[np.int8]


class PictureStrip:
    """Pictures spread over a run of unknown length, at most twelve at a time.

    Light is reduced by taking one pixel of each block; an event of any pixel marks its block.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        width, height = size
        self._block = max(1, math.ceil(width / _PICTURE_PX))
        self._polarity = np.zeros((-(-height // self._block), -(-width // self._block)), np.int8)
        self._spacing_us, self._next_us = _SPACING_US, _SPACING_US
        self._taken: list[TakenPicture] = []

    def take(self, events: Events, light: Light, t_us: int) -> None:
        """Take a step that ends at `t_us` with its light (height, width) and its events (n,) EVENT."""
        if t_us < self._next_us - _WINDOW_US:
            return
        recent = events[events["t"] + _WINDOW_US >= max(self._next_us, t_us)]
        rows, columns = recent["y"] // self._block, recent["x"] // self._block
        self._polarity[rows, columns] = np.where(recent["on"], 1, -1)
        if t_us >= self._next_us:
            self._keep(TakenPicture(t_us, light[:: self._block, :: self._block].copy(), self._polarity.copy()))
            self._polarity.fill(0)
            self._next_us = (t_us // self._spacing_us + 1) * self._spacing_us

    def _keep(self, picture: TakenPicture) -> None:
        self._taken.append(picture)
        if len(self._taken) > _MOST_PICTURES:
            self._taken = self._taken[1::2]
            self._spacing_us *= 2

    def chosen(self, count: int) -> Sequence[TakenPicture]:
        """Return at most `count` pictures at about even distances, the first and the last among them."""
        if len(self._taken) <= count:
            return tuple(self._taken)
        places = np.rint(np.linspace(0, len(self._taken) - 1, count)).astype(int)
        return tuple(self._taken[k] for k in places)


class Observation:
    """Statistics of the events and the statuses of a run, with a sensor of `size` = (width, height) pixels.

    Attributes
    ----------
    on, off : events of each pixel, (height, width) int64.
    rates : events (column 0) and ON events (1) over time.
    counts : late steps (column 0) and edges that the cameras took (1) over time, from one status to the next.
    intervals : how many intervals lie in each bin of INTERVAL_EDGES_US.
    pictures : pictures of the run.
    """

    EVENTS, ON = 0, 1
    LATE, EDGES = 0, 1

    def __init__(self, size: tuple[int, int]) -> None:
        width, height = size
        self.on = np.zeros((height, width), np.int64)
        self.off = np.zeros((height, width), np.int64)
        self.rates = BinnedCounts(2)
        self.counts = BinnedCounts(2)
        self.intervals = np.zeros(len(INTERVAL_EDGES_US) - 1, np.int64)
        self.pictures = PictureStrip(size)
        self._last_us = np.full(width * height, -1, np.int64)
        self._width = width
        self._before = (0, 0)

    def take(self, events: Events, light: Light | None = None, t_us: int = 0) -> None:
        """Count the events (n,) EVENT of a step, sorted by time; `light` is that of its end, at `t_us`."""
        if light is not None:
            self.pictures.take(events, light, t_us)
        if not len(events):
            return
        self.rates.reach(int(events["t"][-1]))
        bins = (events["t"] // self.rates.bin_us).astype(np.int64)
        first = int(bins[0])
        self.rates.add_bins(self.EVENTS, first, np.bincount(bins - first))
        self.rates.add_bins(self.ON, first, np.bincount(bins - first, events["on"]).astype(np.int64))
        pixel = events["y"].astype(np.int64) * self._width + events["x"]
        for counts, chosen in ((self.on, events["on"]), (self.off, ~events["on"])):
            _count(counts.reshape(-1), pixel[chosen])
        sampled = (events["x"] + events["y"]) % _SAMPLED == 0
        self._measure(pixel[sampled], events["t"][sampled].astype(np.int64))

    def renew(self, status: RunStatus) -> None:
        """Count the late steps and edges since the last status."""
        now = status.lateness.frames_late, sum(link.edges.taken for link in status.links.values())
        for column, (count, before) in enumerate(zip(now, self._before, strict=True)):
            if count > before:
                self.counts.add(column, round(status.sim_seconds * 1e6), count - before)
        self._before = now

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
        is_interval = before >= 0
        self.intervals += np.histogram(np.maximum(t_us - before, 1)[is_interval], INTERVAL_EDGES_US)[0]


def _count(counts: Counts, pixels: Counts) -> None:
    """Count pixels (n,) in counts (pixels,): a bincount touches each pixel, so few events are added one by one."""
    if len(pixels) * _FEW < counts.size:
        np.add.at(counts, pixels, 1)
    else:
        counts += np.bincount(pixels, minlength=counts.size)

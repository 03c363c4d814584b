"""The filters of the DVS module between the run gate and the encoder, in the order of the published logic.

    events -> polarity -> region of interest -> hot pixels -> background activity, refractory -> skip -> encoder

    register  filter      rule
    61        polarity    1: all events become OFF
    62, 63    polarity    1: those of one polarity are suppressed, ON where 63 is 1; by the polarity of the pixel
    41..44    region      start column, start row, end column, end row; both ends belong to it
    11..26    hot pixels  eight pairs of row and column
    31..34    see `activity_filter`, in a camera that has it
    51, 52    skip        1: N events pass, the next one is skipped, and so on; N is register 52

Coordinates are the user's in both layouts: the logic swaps them itself. The count of the skip filter goes on through
everything but power-on. Events that are filtered are counted as not selected, but those of background activity and
refractory period have fates of their own; and those of these two and of hot pixels are counted in the statistics of the
module, which has no counter for polarity, region and skip.

Source: DVSAERFilters of the published logic (DAVIS FX3), libcaer 3.3.15 (davis.h).

The counter registers of a DAVIS346: what has happened since power-on, by the counters of its parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.registers import Module, RegisterFile, Statistic
from firmware_protocol.davis346.stream import EventStream
from firmware_protocol.events import Events

if TYPE_CHECKING:
    from firmware_protocol.davis346.activity_filter import ActivityFilter, Judged

__all__ = ["DvsFilters", "FilterSettings", "Passed", "Statistics"]


_HOT_PIXELS = 8

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class FilterSettings:
    """What the registers ask of the filters.

    Attributes
    ----------
    suppressed
        Polarity that does not pass; None: both do.
    region
        (first column, first row, last column, last row).
    hot
        (column, row) of each pixel that does not pass; those outside the array are left out.
    every
        Events that pass before one is skipped; None: all pass.
    """

    flatten: bool
    suppressed: bool | None
    region: tuple[int, int, int, int]
    hot: tuple[tuple[int, int], ...]
    every: int | None

    @classmethod
    def of(cls, registers: RegisterFile, size: tuple[int, int]) -> FilterSettings:
        """Return what the registers of a camera of `size` (width, height) say."""

        def value(address: int) -> int:
            return registers.read(Module.DVS, address)

        pairs = [(value(12 + 2 * k), value(11 + 2 * k)) for k in range(_HOT_PIXELS)]
        return cls(
            flatten=bool(value(61) & 1),
            suppressed=bool(value(63) & 1) if value(62) & 1 else None,
            region=(value(41), value(42), value(43), value(44)),
            hot=tuple((x, y) for x, y in pairs if x < size[0] and y < size[1]),
            every=value(52) if value(51) & 1 else None,
        )


@dataclass(frozen=True)
class Passed:
    """Events that pass, and what to count of the others; the fields are what `DvsFilters.take` adds up.

    Attributes
    ----------
    filtered, hot
        How many were not selected, and how many of those were hot pixels'.
    counted
        How many came to the skip filter.
    judged
        What the activity filter made of them; None: it is off.
    """

    events: Events
    filtered: int = 0
    hot: int = 0
    counted: int = 0
    judged: Judged | None = None


class DvsFilters:
    """The filters of one camera, with what they have counted since it was made.

    Attributes
    ----------
    filtered, hot
        Events that were not selected, and those of them at hot pixels.
    """

    def __init__(self, size: tuple[int, int], *, has_activity: bool = False) -> None:
        self._size = size
        self._whole = (0, 0, size[0] - 1, size[1] - 1)
        self._skip_count = 0
        self.filtered = self.hot = 0
        self._activity = _activity_filter(size) if has_activity else None

    @property
    def isolated(self) -> int:
        """Events that the filter of background activity dropped."""
        return 0 if self._activity is None else self._activity.isolated

    @property
    def too_soon(self) -> int:
        """Events that the filter of the refractory period dropped."""
        return 0 if self._activity is None else self._activity.too_soon

    def power_on(self) -> None:
        """Set the count of the skip filter to zero, and forget what was heard."""
        self._skip_count = 0
        if self._activity is not None:
            self._activity.power_on()

    def follow(self, registers: RegisterFile, now_us: int) -> None:
        """Take notice that registers were written at `now_us`."""
        if self._activity is not None:
            self._activity.follow(registers, now_us)

    def passed(self, events: Events, registers: RegisterFile) -> Passed:
        """Return what passes of `events`, (n,) EVENT, which may be changed; it counts when `take` hears of it."""
        asked = FilterSettings.of(registers, self._size)
        good = _of_polarity(events, asked) & self._in_region(events, asked)
        cold = _cold(events, asked)
        hot = int(np.count_nonzero(good & ~cold))
        good &= cold
        judged = None if self._activity is None else self._activity.judged(events[good], registers)
        if judged is not None:
            good[good] = judged.passes
        counted = 0 if asked.every is None else int(np.count_nonzero(good))
        if asked.every is not None:
            places = self._skip_count + np.arange(counted)
            good[np.flatnonzero(good)[places % (asked.every + 1) == asked.every]] = False
        if asked.flatten:
            events["on"] = False
        kept = events if good.all() else events[good]
        dropped = 0 if judged is None else judged.isolated + judged.too_soon
        return Passed(kept, len(events) - len(kept) - dropped, hot, counted, judged)

    def take(self, passed: Passed) -> None:
        """Count what did not pass."""
        if self._activity is not None and passed.judged is not None:
            self._activity.take(passed.judged)
        self.filtered += passed.filtered
        self.hot += passed.hot
        self._skip_count += passed.counted

    def _in_region(self, events: Events, asked: FilterSettings) -> Mask:
        if asked.region == self._whole:  # so that events outside the array are still refused, and not filtered
            return np.ones(len(events), np.bool_)
        left, top, right, bottom = asked.region
        x, y = events["x"], events["y"]
        inside: Mask = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        return inside


def _of_polarity(events: Events, asked: FilterSettings) -> Mask:
    if asked.suppressed is None:
        return np.ones(len(events), np.bool_)
    others: Mask = events["on"] != asked.suppressed
    return others


def _cold(events: Events, asked: FilterSettings) -> Mask:
    cold = np.ones(len(events), np.bool_)
    for x, y in asked.hot:
        cold &= (events["x"] != x) | (events["y"] != y)
    return cold


def _activity_filter(size: tuple[int, int]) -> ActivityFilter:
    from firmware_protocol.davis346.activity_filter import ActivityFilter

    return ActivityFilter(size)


class Statistics:
    """Brings the counter registers up to date when they are read.

    One FIFO stands in this model for the DVS module's and the USB buffers', so both dropped counters show its drops.
    """

    def __init__(self, stream: EventStream, filters: DvsFilters) -> None:
        self._stream = stream
        self._filters = filters
        self.power_on()

    def power_on(self) -> None:
        """Count from here."""
        self._before = self._counted()

    def refresh(self, registers: RegisterFile) -> None:
        """Write the counts since power-on into the registers."""
        for statistic, count in self._counted().items():
            registers.count(statistic, count - self._before[statistic])

    def _counted(self) -> dict[Statistic, int]:
        """Return what the parts have counted since they were made."""
        events, filters = self._stream.counters, self._filters
        return {
            Statistic.DVS_ROWS: events.rows,
            Statistic.DVS_COLUMNS: events.accepted,
            Statistic.DVS_DROPPED: events.dropped_fifo,
            Statistic.DVS_FILTERED_PIXELS: filters.hot,
            Statistic.DVS_FILTERED_BACKGROUND_ACTIVITY: filters.isolated,
            Statistic.DVS_FILTERED_REFRACTORY: filters.too_soon,
            Statistic.MUX_DVS_DROPPED: events.dropped_fifo,
            Statistic.MUX_EXTINPUT_DROPPED: self._stream.mark_counters.dropped_fifo,
        }

"""Selection of events by what several sensors have alike: event rate control, and its result.

The first events of each period of the sensor's clock leave it, the others do not. How a sensor spreads the losses over
a period is not public.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Selected:
    """Events (n,) EVENT that pass, and the numbers of the others, by reason."""

    events: Events
    outside: int
    beyond_rate: int


class RateControl:
    """Limit of the events in each period of the device's clock."""

    def __init__(self, period_us: int) -> None:
        self._period_us, self._most = period_us, 0
        self._period, self._seen = -1, 0
        self.on = False

    def turn(self, on: int) -> None:
        """Switch it on or off."""
        self.on = bool(on)

    def set_period_us(self, period_us: int) -> None:
        """Set the length of a period."""
        self._period_us = period_us

    def set_most(self, events: int) -> None:
        """Set the number of events that pass in a period."""
        self._most = events

    def selected(self, events: Events, wanted: Events, epoch_us: int) -> Selected:
        """Return the part that passes of the `wanted` ones of `events`, both sorted; the clock was 0 at `epoch_us`."""
        passing = wanted[self._passing(wanted, epoch_us)] if self.on else wanted
        return Selected(passing, len(events) - len(wanted), len(wanted) - len(passing))

    def _passing(self, events: Events, epoch_us: int) -> Mask:
        """Return a mask of the events (n,) EVENT, sorted, that pass, (n,) bool: the first ones of each period."""
        if not len(events):
            return np.zeros(0, np.bool_)
        periods = (events["t"].astype(np.int64) - epoch_us) // self._period_us
        ranks = np.arange(len(periods)) - np.searchsorted(periods, periods)
        if periods[0] == self._period:
            ranks[periods == self._period] += self._seen
        self._period, self._seen = int(periods[-1]), int(ranks[-1]) + 1
        return ranks < self._most


def unpacked(words: npt.NDArray[np.uint32], pixels: int) -> Mask:
    """Return a bit for each of `pixels` pixels, (pixels,) bool: bit k of word i is pixel 32 i + k."""
    return np.unpackbits(words.astype("<u4").view(np.uint8), count=pixels, bitorder="little").astype(np.bool_)

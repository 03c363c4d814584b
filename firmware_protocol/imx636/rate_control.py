"""Event rate control: the first events of each period of the sensor's clock leave it, the others do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events

__all__ = ["RateControl", "Selected"]

_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Selected:
    """Events (n,) EVENT that pass, and how many others did not, by the reason."""

    events: Events
    outside: int
    beyond_rate: int


class RateControl:
    """Lets so many events by in each period of the device's clock, and no more."""

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
        """Set how many events a period lets by."""
        self._most = events

    def passing(self, events: Events, epoch_us: int) -> _Mask:
        """Return which events (n,) EVENT, sorted, are let by, (n,) bool: the first ones of each period."""
        if not len(events):
            return np.zeros(0, np.bool_)
        periods = (events["t"].astype(np.int64) - epoch_us) // self._period_us
        ranks = np.arange(len(periods)) - np.searchsorted(periods, periods)
        if periods[0] == self._period:
            ranks[periods == self._period] += self._seen
        self._period, self._seen = int(periods[-1]), int(ranks[-1]) + 1
        return ranks < self._most

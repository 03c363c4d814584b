"""The ring of readings of one kind from the session to one link, and the way back for what the device's host asks.

    session --records--> ring --> link process: device.offer_readings
            <--numbers-- cells <-- link process: device.reading_settings

Nothing blocks: what finds no room is counted as refused. The numbers are written between two versions of a counter,
so that a reader that comes in between keeps what it had before.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from firmware_protocol.readings import ReadingKind, Readings
from transports.link.shared_ring import SharedRing

__all__ = ["MOST_NUMBERS", "ReadingRing"]

MOST_NUMBERS = 16
"""Numbers that a device can tell of a kind."""

_VERSION, _COUNT, _NUMBERS = range(3)


class ReadingRing:
    """Records in shared memory; pass it to a process started by the spawn method.

    Parameters
    ----------
    record
        The records' dtype, with a field `t`, us.
    """

    def __init__(self, kind: ReadingKind, record: np.dtype[Any], capacity: int) -> None:
        self.kind = kind
        self._ring = SharedRing(record, capacity, _NUMBERS + MOST_NUMBERS)
        self._told: tuple[int, ...] = ()

    @property
    def waiting(self) -> int:
        """Records written and not yet taken."""
        return self._ring.waiting

    @property
    def room(self) -> int:
        """Records that can be written now."""
        return self._ring.room

    @property
    def written(self) -> int:
        """Records written since the start."""
        return self._ring.written

    @property
    def refused(self) -> int:
        """Records that found no room, counted by the writer."""
        return self._ring.refused

    def push(self, records: Readings) -> int:
        """Write what fits of `records`, in order, and return how many that were; the rest is counted as refused."""
        return self._ring.push(records)

    def take(self, until_us: int) -> Readings:
        """Take the records up to `until_us`, (n,); a copy."""
        return self._ring.take(until_us)

    def time_of(self, index: int) -> int | None:
        """Return the time of the record that waits at `index`, us; None where there is none."""
        return self._ring.time_of(index)

    @property
    def settings(self) -> tuple[int, ...]:
        """What the link told last, as `EventDevice.reading_settings` gives it; empty before."""
        cells = self._ring.cells
        for _ in range(100):
            version = int(cells[_VERSION])
            told = tuple(int(n) for n in cells[_NUMBERS : _NUMBERS + int(cells[_COUNT])])
            if version % 2 == 0 and int(cells[_VERSION]) == version:
                self._told = told
                break
        return self._told

    def tell(self, settings: tuple[int, ...]) -> None:
        """Say what the device's host asks; for the link process alone."""
        if settings == self._told:
            return
        cells = self._ring.cells
        cells[_VERSION] += 1
        cells[_COUNT] = len(settings)
        cells[_NUMBERS : _NUMBERS + len(settings)] = settings
        cells[_VERSION] += 1
        self._told = settings

"""The ring of readings of one kind from the session to one link, and the way back for what the device's host asks.

    session --records--> ring --> link process: device.offer_readings
            <--numbers-- cells <-- link process: device.reading_settings

Nothing blocks: what finds no room is counted as refused, and of a frame either all or nothing: its start is refused
where the whole frame might find no room, and its lines with it. The numbers are written between two versions of a
counter, so that a reader that comes in between keeps what it had before.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from firmware_protocol.frame_lines import LineKind
from firmware_protocol.readings import ReadingKind, Readings
from transports.link.shared_ring import SharedRing

__all__ = ["MOST_NUMBERS", "ReadingRing"]

MOST_NUMBERS = 16
"""Numbers that a device can tell of a kind."""

_VERSION, _COUNT, _NUMBERS = range(3)
_MOMENTS = 4  # of a frame, beside the two reads of each line


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
        self._longest = 2 * record["samples"].shape[0] + _MOMENTS if kind is ReadingKind.FRAMES else 0
        if capacity < self._longest:
            raise ValueError(f"a ring of frames holds at least one, {self._longest} records, got capacity {capacity}")
        self._refusing = False

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

    def fits(self, records: Readings) -> bool:
        """Say whether all of `records` can be written now."""
        starts = self._starts(records)
        return max(len(records), starts[-1] + self._longest if starts else 0) <= self.room

    def push(self, records: Readings) -> int:
        """Write what fits of `records`, in order, and return how many that were; the rest is counted as refused."""
        return sum(self._push_part(part) for part in np.split(records, self._starts(records)) if len(part))

    def _push_part(self, part: Readings) -> int:
        """Write records of which only the first may be the start of a frame."""
        if self._starts(part):
            self._refusing = self.room < self._longest
        if self._refusing:
            self._ring.refuse(len(part))
            return 0
        return self._ring.push(part)

    def _starts(self, records: Readings) -> list[int]:
        """Return where frames start."""
        return np.flatnonzero(records["kind"] == LineKind.START).tolist() if self._longest else []

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
        """Write what the device's host asks; for the link process alone, and for who makes the ring."""
        if settings == self._told:
            return
        cells = self._ring.cells
        cells[_VERSION] += 1
        cells[_COUNT] = len(settings)
        cells[_NUMBERS : _NUMBERS + len(settings)] = settings
        cells[_VERSION] += 1
        self._told = settings

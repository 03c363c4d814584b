"""Count of the events that a link delivered, in memory that outlives its process.

A process that is killed sends no last report. This count is written after every tick, so the ledger of a run knows what
had left the camera before its link died.
"""

from __future__ import annotations

import multiprocessing
from typing import Any

__all__ = ["DeliveryTally"]


class DeliveryTally:
    """Events delivered so far by one link process: one writer, any number of readers.

    Pass it as an argument to a process started by the spawn method.
    """

    def __init__(self) -> None:
        # One aligned 8-byte store is atomic; a lock could stay taken for ever by a process that was killed.
        self._value: Any = multiprocessing.get_context("spawn").RawValue("q", 0)

    @property
    def delivered(self) -> int:
        """Events that left the camera and were not lost on the link."""
        return int(self._value.value)

    @delivered.setter
    def delivered(self, count: int) -> None:
        self._value.value = count

"""The events and readings of one step of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_protocol.events import Events
from firmware_protocol.readings import ReadingKind, Readings

__all__ = ["StepOutput"]


@dataclass(frozen=True)
class StepOutput:
    """Events (n,) EVENT, and readings by their kind, each sorted by time, us of stream time."""

    events: Events
    readings: Sequence[tuple[ReadingKind, Readings]] = ()

    def cut(self, until_us: int) -> tuple[StepOutput, StepOutput]:
        """Return what is up to `until_us`, and the rest."""
        parts = [(kind, records, _up_to(records, until_us)) for kind, records in self.readings]
        n = _up_to(self.events, until_us)
        first = StepOutput(self.events[:n], [(kind, records[:k]) for kind, records, k in parts])
        return first, StepOutput(self.events[n:], [(kind, records[k:]) for kind, records, k in parts])


def _up_to(records: Events | Readings, until_us: int) -> int:
    return int(np.searchsorted(records["t"], np.uint64(until_us), "right"))

"""Readings of a run's camera beside events, on their way to the links: frames, samples of an inertial unit.

    ReadingSource --records--> a ReadingRing for each link --> device
                  <--settings-- of the first link whose host has switched this kind on

There is one chip: where the hosts of several links request different exposures, the first link decides, and the others
receive its frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from emulator.light import LightFrame
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import Events
from transports.link.process import LinkSetup
from transports.link.rings import ReadingRing

_CAPACITY = {ReadingKind.FRAMES: 4096, ReadingKind.IMU: 16384}


class ReadingSource(Protocol):
    """Source of readings of one kind, from light and time.

    Attributes
    ----------
    kind, record
        Of its readings; the dtype has a field `t`, us of stream time.
    """

    kind: ReadingKind
    record: np.dtype[Any]

    def reset(self, frame: LightFrame) -> None:
        """Start at the time of `frame`."""

    def read(self, frame: LightFrame, settings: tuple[int, ...]) -> Readings:
        """Move to the time of `frame` and return the readings until then, sorted.

        `settings` are the numbers in the camera's registers; empty before a host has written any.
        """
        ...


class ReadingSources:
    """The sources of a run, and the rings to its links.

    Parameters
    ----------
    setups
        Of the run's links; each with the rings that `new_rings` made for it.
    """

    def __init__(self, sources: Sequence[ReadingSource], setups: Sequence[LinkSetup[Any]]) -> None:
        self._sources = sources
        self._rings = {
            source.kind: [ring for setup in setups for ring in setup.readings if ring.kind == source.kind]
            for source in sources
        }

    @staticmethod
    def new_rings(sources: Sequence[ReadingSource]) -> tuple[ReadingRing, ...]:
        """Return new rings for one link, one for each source."""
        return tuple(ReadingRing(source.kind, source.record, _CAPACITY[source.kind]) for source in sources)

    def reset(self, frame: LightFrame) -> None:
        """Start all at the time of `frame`."""
        for source in self._sources:
            source.reset(frame)

    def read(self, frame: LightFrame) -> list[tuple[ReadingKind, Readings]]:
        """Move all to the time of `frame` and return the readings of each until then."""
        return [(one.kind, one.read(frame, self._settings(self._rings[one.kind]))) for one in self._sources]

    def _settings(self, rings: Sequence[ReadingRing]) -> tuple[int, ...]:
        """Return the settings of the first link whose first number, `run`, is not zero."""
        return next((settings for ring in rings if (settings := ring.settings) and settings[0]), ())


@dataclass(frozen=True)
class StepOutput:
    """Events (n,) EVENT, and readings by their kind, each sorted by time, us of stream time."""

    events: Events
    readings: Sequence[tuple[ReadingKind, Readings]] = ()

    def cut(self, until_us: int) -> tuple[StepOutput, StepOutput]:
        """Return the part up to `until_us`, and the rest."""
        parts = [(kind, records, _up_to(records, until_us)) for kind, records in self.readings]
        n = _up_to(self.events, until_us)
        first = StepOutput(self.events[:n], [(kind, records[:k]) for kind, records, k in parts])
        return first, StepOutput(self.events[n:], [(kind, records[k:]) for kind, records, k in parts])


def _up_to(records: Events | Readings, until_us: int) -> int:
    return int(np.searchsorted(records["t"], np.uint64(until_us), "right"))

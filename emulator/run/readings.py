"""What a run's camera reads beside events, on its way to the links: frames, samples of an inertial unit.

    ReadingSource --records--> a ReadingRing for each link --> device
                  <--settings-- of the first link whose host has switched this kind on

There is one chip and one picture: where several links' hosts ask for different exposures, the first link decides, and
the others get the frames that it asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from emulator.light import Light
from firmware_protocol.readings import ReadingKind, Readings
from transports.link.process import LinkSetup
from transports.link.reading_ring import ReadingRing

__all__ = ["ReadingSource", "ReadingSources"]

_CAPACITY = {ReadingKind.FRAMES: 4096, ReadingKind.IMU: 16384}


class ReadingSource(Protocol):
    """Light and time in, readings of one kind out.

    Attributes
    ----------
    kind, record
        Of its readings; the dtype has a field `t`, us of stream time.
    """

    kind: ReadingKind
    record: np.dtype[Any]

    def reset(self, light: Light, t_ns: int) -> None:
        """Start at `t_ns` on `light`, (height, width) float32."""

    def read(self, light: Light, t_ns: int, settings: tuple[int, ...]) -> Readings:
        """Move to `t_ns`, when the light is `light`, and return what was read until then, sorted.

        `settings` are the numbers that the camera's registers ask for; empty: nobody has asked for anything yet.
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

    def reset(self, light: Light, t_ns: int) -> None:
        """Start all at `t_ns` on `light`."""
        for source in self._sources:
            source.reset(light, t_ns)

    def read(self, light: Light, t_ns: int) -> list[tuple[ReadingKind, Readings]]:
        """Move all to `t_ns` and return what each has read."""
        return [(one.kind, one.read(light, t_ns, self._asked(self._rings[one.kind]))) for one in self._sources]

    def _asked(self, rings: Sequence[ReadingRing]) -> tuple[int, ...]:
        """Return the settings of the first link whose first number, `run`, is not zero."""
        return next((told for ring in rings if (told := ring.settings) and told[0]), ())

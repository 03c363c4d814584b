"""Stream time in short moments: an instrument that is given a second of events at once would find them all too old."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from firmware_protocol.events import Events

__all__ = ["moments"]

_MOMENT_US = 1000


def moments(events: Events, from_us: int, until_us: int | None) -> Iterator[tuple[Events, int]]:
    """Yield (events of a moment, its end in us), a millisecond each while there are events, then up to `until_us`.

    `until_us` None means the time of the last event.
    """
    last_us = int(events["t"][-1]) if len(events) else from_us
    end_us = max(from_us, last_us, until_us or 0)
    cuts = np.flatnonzero(np.diff(events["t"] // _MOMENT_US)) + 1
    for part in np.split(events, cuts) if len(events) else ():
        yield part, int(part["t"][-1])
    yield events[:0], end_us

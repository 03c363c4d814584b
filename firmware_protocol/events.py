"""The event record that every room shares.

    t   u64   microseconds since the start of the stream
    x   u16   column, 0 on the left
    y   u16   row, 0 on top
    on  bool  True: it got brighter (ON), False: darker (OFF)

The layout is packed (13 bytes) and is the one of `faery` and `neuromorphic_drivers`, so arrays pass between
without a copy.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["EVENT", "Events", "empty_events"]

EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])

Events = npt.NDArray[np.void]
"""An array of EVENT records, shape (n,), sorted by t."""


def empty_events(n: int = 0) -> Events:
    """Return an array of `n` zeroed events."""
    return np.zeros(n, EVENT)

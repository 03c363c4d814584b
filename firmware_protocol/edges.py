"""The record of an edge on a camera's external input, beside the event record.

    t        u64   microseconds since the start of the stream
    kind     u8    EdgeKind, numbered as the special events of libcaer (libcaer 3.3.15, events/special.h)
    channel  u8    which input; the DAVIS346 has one, 0
    seq      u16   number of the edge at its source (the SYNC counter of a CAN bus), 0 where the source counts none

The layout is packed (12 bytes), as that of the events.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

__all__ = ["EDGE", "EdgeKind", "Edges", "empty_edges"]

EDGE = np.dtype([("t", "<u8"), ("kind", "u1"), ("channel", "u1"), ("seq", "<u2")])

Edges = npt.NDArray[np.void]
"""An array of EDGE records, shape (n,), sorted by t."""


class EdgeKind(IntEnum):
    """What happened on the input."""

    RISING = 2
    FALLING = 3
    PULSE = 4


def empty_edges(n: int = 0) -> Edges:
    """Return an array of `n` zeroed edges."""
    return np.zeros(n, EDGE)

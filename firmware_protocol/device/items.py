"""Items: everything that moves through a camera in time order.

    item      record                                           at one time
    edge      (m,) EDGE: a change on the external input        first
    reading   one record of its kind: part of a frame, sample  second
    event     (n,) EVENT                                       last

A reading is one record of a structured array that has a field `t`, u64 microseconds of stream time. Its kind determines
the record: `frames.line_record` for frames, `imu_samples.IMU_SAMPLE` for samples.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy.typing as npt

from firmware_protocol.events import Edges, Events, empty_edges, empty_events

__all__ = ["Items", "Reading", "ReadingKind", "Readings"]


Readings = npt.NDArray[Any]
"""Records of one kind, shape (n,), sorted by `t`."""


class ReadingKind(StrEnum):
    """Kind of a reading."""

    FRAMES = "frames"
    IMU = "imu"


@dataclass(frozen=True)
class Reading:
    """One record of a kind, (1,) of its dtype."""

    kind: ReadingKind
    record: Readings


@dataclass(frozen=True)
class Items:
    """Items that leave a device together; nothing that leaves later is earlier.

    Attributes
    ----------
    events, edges, readings
        (n,) EVENT, (m,) EDGE, and readings, in stream time: microseconds since the start of the run.
    epoch_us
        Stream time at which the device's own clock was last zero: device time is `t - epoch_us`. Negative if that clock
        was set ahead.
    """

    events: Events = field(default_factory=empty_events)
    edges: Edges = field(default_factory=empty_edges)
    epoch_us: int = 0
    readings: tuple[Reading, ...] = ()

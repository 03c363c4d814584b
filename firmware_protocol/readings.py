"""What a camera reads beside events: lines of a frame, samples of an inertial unit; and what became of each.

A reading is one record of a structured array that has a field `t`, u64 microseconds of stream time. Its kind says
which record that is: `frame_lines.line_record` for frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy.typing as npt

__all__ = ["Reading", "ReadingCounters", "ReadingKind", "Readings"]

Readings = npt.NDArray[Any]
"""Records of one kind, shape (n,), sorted by `t`."""


class ReadingKind(StrEnum):
    """What was read."""

    FRAMES = "frames"
    IMU = "imu"


@dataclass(frozen=True)
class Reading:
    """One record of a kind, (1,) of its dtype."""

    kind: ReadingKind
    record: Readings


@dataclass(frozen=True)
class ReadingCounters:
    """Readings of one kind offered to a device since it was made, and their fates; `offered` is the sum of the others.

    Attributes
    ----------
    not_running
        Came while the host had not switched this kind on, or in the middle of a frame whose start it did not get.
    dropped
        Found no room.
    flushed
        Waited when the buffer was emptied.
    lost_on_link
        Had left the camera when the link lost them.
    queued
        Still wait.
    """

    offered: int = 0
    not_running: int = 0
    dropped: int = 0
    flushed: int = 0
    delivered: int = 0
    lost_on_link: int = 0
    queued: int = 0

    @property
    def accounted(self) -> int:
        """Readings with a fate: as many as were offered, or something is wrong."""
        return self.not_running + self.dropped + self.flushed + self.delivered + self.lost_on_link + self.queued

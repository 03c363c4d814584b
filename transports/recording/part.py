"""What recordings hold, piece by piece: events, edges, frames and samples of an inertial unit; facts of the whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from firmware_protocol.recordings.part import IMU, Frame, Part

__all__ = ["IMU", "Facts", "Frame", "Part", "Reader", "RecordingError", "Writer", "counts_of"]


class RecordingError(Exception):
    """A recording cannot be read or written; the message says why, without the file's name."""


def counts_of(part: Part) -> Counter[str]:
    """Return how much of each stream a part has: "events", "edges", "imu", "frames"; none of an empty one."""
    counts = Counter(events=len(part.events), edges=len(part.edges), imu=len(part.imu), frames=len(part.frames))
    return +counts


@dataclass(frozen=True)
class Facts:
    """What is true of a whole recording.

    Attributes
    ----------
    size
        (width, height) of the sensor, pixels; None: it is not known.
    camera
        Name of the camera.
    unix_us
        Unix time of t = 0, us; 0: it is not known.
    streams
        What it holds besides events: "edges", "imu", "frames".
    imu_unit
        Type of the inertial unit: 1 MPU-6050, 2 MPU-9250.
    """

    size: tuple[int, int] | None = None
    camera: str = "evstim"
    unix_us: int = 0
    streams: frozenset[str] = frozenset({"edges"})
    imu_unit: int = 2


class Writer(Protocol):
    """Writes one file. Times go on and begin near zero: see `Facts.unix_us`."""

    def write(self, part: Part) -> None:
        """Append what the format holds; raises OSError, RecordingError, or what its library raises."""
        ...

    def close(self) -> None:
        """Finish the file."""
        ...


class Reader(Protocol):
    """Reads one file."""

    @property
    def facts(self) -> Facts:
        """What is known before the first event."""
        ...

    def parts(self) -> Iterator[Part]:
        """Yield pieces of bounded size; raises RecordingError, OSError, or what its library raises."""
        ...

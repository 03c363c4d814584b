"""What recordings hold, piece by piece: events, edges, frames and samples of an inertial unit; facts of the whole."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.events import Events, empty_events

__all__ = ["IMU", "Facts", "Frame", "Part", "Reader", "RecordingError", "Writer"]

_AXES = [f"{what}_{axis}" for what in ("accelerometer", "gyroscope", "magnetometer") for axis in "xyz"]
IMU = np.dtype([("t", "<u8"), ("temperature", "<f4"), *((name, "<f4") for name in _AXES)])
"""A sample of an inertial unit: us, degrees Celsius, g, degrees per second, microtesla; the layout of faery."""


class RecordingError(Exception):
    """A recording cannot be read or written; the message says why, without the file's name."""


@dataclass(frozen=True)
class Frame:
    """A picture of the camera.

    Attributes
    ----------
    t_us, exposure_begin_us, exposure_end_us
        Its time, and those of its exposure.
    pixels
        (height, width) uint8 or uint16, row 0 on top.
    origin
        Column and row of the array at which it begins.
    """

    t_us: int
    exposure_begin_us: int
    exposure_end_us: int
    pixels: npt.NDArray[Any]
    origin: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Part:
    """A piece of a recording: events (n,) EVENT, edges (m,) EDGE, IMU samples (k,) IMU, each sorted, and frames."""

    events: Events = field(default_factory=empty_events)
    edges: Edges = field(default_factory=empty_edges)
    imu: npt.NDArray[np.void] = field(default_factory=lambda: np.zeros(0, IMU))
    frames: tuple[Frame, ...] = ()


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

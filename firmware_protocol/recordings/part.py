"""A piece of a recording: events, edges, frames and samples of an inertial unit; facts and summary of a whole one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Edges, Events, Kept, empty_edges, empty_events

_AXES = [f"{unit}_{axis}" for unit in ("accelerometer", "gyroscope", "magnetometer") for axis in "xyz"]
IMU = np.dtype([("t", "<u8"), ("temperature", "<f4"), *((name, "<f4") for name in _AXES)])
"""A sample of an inertial unit: us, degrees Celsius, g, degrees per second, microtesla; the layout of faery."""

ImuRecords = npt.NDArray[np.void]
"""An array of IMU records, shape (n,), sorted by t."""


@dataclass(frozen=True, repr=False)
class Frame(Kept):
    """An image of the camera.

    Attributes
    ----------
    t_us, exposure_begin_us, exposure_end_us : its time, and those of its exposure.
    pixels : (height, width), row 0 on top: uint8, or uint16 with 10 bits as a DAVIS has them.
    origin : column and row of its first pixel in the array.
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
    imu: ImuRecords = field(default_factory=lambda: np.zeros(0, IMU))
    frames: tuple[Frame, ...] = ()


def ten_bits(frame: Frame) -> npt.NDArray[np.uint16]:
    """Return the brightness of a frame, (height, width) uint16, 0 to 1023; grey if it has colours."""
    pixels = frame.pixels if frame.pixels.ndim == 2 else frame.pixels.mean(axis=2).astype(frame.pixels.dtype)
    grey: npt.NDArray[np.uint16] = pixels.astype(np.uint16)
    return np.left_shift(grey, 2) if pixels.dtype == np.uint8 else np.minimum(grey, np.uint16(1023))


def counts_of(part: Part) -> Counter[str]:
    """Return the number of records of each stream that a part has: "events", "edges", "imu", "frames"."""
    counts = Counter(events=len(part.events), edges=len(part.edges), imu=len(part.imu), frames=len(part.frames))
    return +counts


@dataclass(frozen=True)
class Facts:
    """Facts of a whole recording.

    Attributes
    ----------
    size : (width, height) of the sensor, pixels; None: not known.
    camera : name of the camera.
    unix_us : unix time of t = 0, us; 0: not known.
    streams : its contents besides events: "edges", "imu", "frames".
    imu_unit : type of the inertial unit: 1 MPU-6050, 2 MPU-9250.
    header : further lines of text of its file, by their names.
    topics : number of messages of each topic with events, where the format has topics; `camera` is that of the events.
    remarks : assumptions about what the file does not state.
    """

    size: tuple[int, int] | None = None
    camera: str = "evstim"
    unix_us: int = 0
    streams: frozenset[str] = frozenset({"edges"})
    imu_unit: int = 2
    header: Mapping[str, str] = field(default_factory=dict)
    topics: Mapping[str, int] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


_NAMES = {"events": "events", "edges": "triggers", "imu": "IMU samples", "frames": "frames"}


@dataclass(frozen=True)
class RecordingSummary:
    """Summary of a file that a run wrote.

    Attributes
    ----------
    title : its format, for people.
    paths : the file, and those that began at restarts of the camera's clock.
    written, left_out : Number of records of each stream in it, and of those that its format cannot hold: "events",
        "edges", "imu", "frames". Both are empty until it is closed.
    trouble : reason for an incomplete file, for people; empty if it is complete.
    closed : True if it was finished; False if the process of its link died.
    """

    title: str
    paths: tuple[str, ...]
    written: Mapping[str, int] = field(default_factory=dict)
    left_out: Mapping[str, int] = field(default_factory=dict)
    trouble: str = ""
    closed: bool = False

    @property
    def lines(self) -> list[str]:
        """Sentences for people."""
        content = (named(self.written) or "nothing") if self.closed else "not closed, as its link died"
        lines = [f"{', '.join(self.paths)}: {self.title}, {content}"]
        if left_out := named(self.left_out):
            lines.append(f"left out, as {self.title} cannot hold them: {left_out}")
        return lines


def named(counts: Mapping[str, int]) -> str:
    """Return "3 events, 2 triggers" of counts by stream."""
    return ", ".join(f"{counts[name]} {text}" for name, text in _NAMES.items() if counts.get(name))

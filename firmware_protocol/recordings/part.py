"""A piece of a recording: events, edges, frames and samples of an inertial unit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Edges, Events, empty_edges, empty_events

_AXES = [f"{unit}_{axis}" for unit in ("accelerometer", "gyroscope", "magnetometer") for axis in "xyz"]
IMU = np.dtype([("t", "<u8"), ("temperature", "<f4"), *((name, "<f4") for name in _AXES)])
"""A sample of an inertial unit: us, degrees Celsius, g, degrees per second, microtesla; the layout of faery."""

ImuRecords = npt.NDArray[np.void]
"""An array of IMU records, shape (n,), sorted by t."""


@dataclass(frozen=True)
class Frame:
    """An image of the camera.

    Attributes
    ----------
    t_us, exposure_begin_us, exposure_end_us
        Its time, and those of its exposure.
    pixels
        (height, width), row 0 on top: uint8, or uint16 with 10 bits as a DAVIS has them.
    origin
        Column and row of its first pixel in the array.
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

"""The geometry of a camera without distortion, the geometry of a scene beside its light, and exact phases.

A `Pinhole` maps directions to pixels:

    column = centre_x + focal_px * x / z        row = centre_y + focal_px * y / z

with camera axes x right, y down, z out along the boresight, and pixel k covering k to k + 1, so that the centre of a
light frame of `width` pixels is width / 2.

A `SceneGeometry` gives, for a scene that has it, quantities at each pixel beside the light:

    depth     along the boresight, m; infinite for the sky
    flow      of the point at the pixel's middle, px/s: columns to the right, rows down
    labels    0 for the sky, k for the k-th of `SceneGeometry.names`

A lens with distortion requests one along its own rays (`Rays`).

A `Cycle` gives the phase of periodic motion, exact for as long as the stream lasts. A phase computed from seconds in
floating point becomes coarser with the number of turns; here the whole turns are subtracted in integers before anything
is rounded, so that the phase after a month is as good as in the first second.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np

from firmware_protocol.events import Float32s, Floats, UInt16s


@dataclass(frozen=True)
class Pinhole:
    """Size and scale of a light frame, the boresight in its middle.

    Attributes
    ----------
    width, height : pixels.
    focal_px : focal length over pixel pitch.
    """

    width: int
    height: int
    focal_px: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a light frame needs at least one pixel, got {self.width} x {self.height}")
        if not 0 < self.focal_px < math.inf:
            raise ValueError(f"focal_px must be above 0 and finite, got {self.focal_px:g}")

    @classmethod
    def of_field(cls, size: tuple[int, int], field_of_view_deg: float) -> Pinhole:
        """Return the camera whose frame of `size` = (width, height) is `field_of_view_deg` wide, edge to edge."""
        if not 0 < field_of_view_deg < 180:
            raise ValueError(f"field_of_view_deg is {field_of_view_deg:g}: it must be between 0 and 180")
        return cls(*size, size[0] / 2 / math.tan(math.radians(field_of_view_deg) / 2))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.width, self.height

    @property
    def zoom(self) -> tuple[float, float]:
        """Focal length over half the frame's width and height, for GL's projection."""
        return 2 * self.focal_px / self.width, 2 * self.focal_px / self.height

    @property
    def widest_rad(self) -> float:
        """From the boresight to a corner."""
        return math.atan(math.hypot(self.width, self.height) / 2 / self.focal_px)


Given = Literal["poses", "depth", "flow", "labels"]


@dataclass(frozen=True, eq=False)
class Rays:
    """Viewing rays of pixels: the positions of their middles in the frame of a camera without distortion.

    Attributes
    ----------
    columns, rows : (height, width) float64, px.
    bend : (height, width, 3), motion on the chip over motion in that frame: dx'/dx, dx'/dy = dy'/dx, dy'/dy; None
        without distortion.
    """

    columns: Floats
    rows: Floats
    bend: Floats | None = None

    @classmethod
    def straight(cls, camera: Pinhole) -> Rays:
        """Return the middles of the pixels of a camera without distortion."""
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        return cls(columns, rows)


@dataclass(frozen=True, eq=False)
class Seen:
    """Arrays for the geometry at one instant.

    Attributes
    ----------
    depth : (height, width) float32, m.
    flow : (height, width, 2) float32, px/s.
    labels : (height, width) uint16.
    """

    depth: Float32s
    flow: Float32s
    labels: UInt16s

    @classmethod
    def of(cls, width: int, height: int) -> Seen:
        """Return room for a picture."""
        depth, flow = np.full((height, width), np.inf, np.float32), np.zeros((height, width, 2), np.float32)
        return cls(depth, flow, np.zeros((height, width), np.uint16))


@dataclass(frozen=True, eq=False)
class ScenePoses:
    """The poses of camera and bodies in the world.

    Attributes
    ----------
    camera_m, q_world_from_camera : (3,) m and (4,) unit quaternion, scalar first.
    bodies_m, q_world_from_bodies : (bodies, 3) and (bodies, 4).
    """

    camera_m: Floats
    q_world_from_camera: Floats
    bodies_m: Floats
    q_world_from_bodies: Floats


class SceneGeometry(ABC):
    """Geometry of a scene beside its light.

    Attributes
    ----------
    names : of the objects; label k is names[k - 1].
    gives : the available quantities: "poses", "depth", "flow", "labels".
    """

    names: tuple[str, ...]
    gives: frozenset[Given]

    @abstractmethod
    def look(self, t_ns: int, out: Seen) -> None:
        """Write the geometry at stream time `t_ns`; only the arrays that `gives` names are written."""

    def places(self, t_ns: int) -> ScenePoses | None:
        """Return the poses at stream time `t_ns`; None where there are none."""
        return None


_NS_PER_S = 1_000_000_000


class Cycle:
    """Turns made since time zero at a constant rate; the attribute `rate_hz` is the exact one.

    Parameters
    ----------
    rate_hz : turns per second, of either sign; 0 stands still. A `Fraction` is taken exactly.
    start_turns : phase at time zero.
    """

    def __init__(self, rate_hz: Fraction | float, start_turns: Fraction | float = 0.0) -> None:
        rate, start = _as_written(rate_hz), _as_written(start_turns)
        self._turn = rate.denominator * start.denominator * _NS_PER_S
        self._per_ns = rate.numerator * start.denominator
        self._start = start.numerator * rate.denominator * _NS_PER_S
        self.rate_hz = rate

    def turns(self, t_ns: int) -> float:
        """Return the fraction of a turn reached at `t_ns`, 0 <= turns <= 1, correctly rounded."""
        return ((self._start + int(t_ns) * self._per_ns) % self._turn) / self._turn


def _as_written(number: Fraction | float) -> Fraction:
    """Read a float as the decimal that a person wrote: 0.1 is one tenth, so a period of 0.1 s is exactly 1e8 ns."""
    return number if isinstance(number, Fraction) else Fraction(repr(float(number)))

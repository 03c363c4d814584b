"""Columns of the arrays that kernels share, and the input of the renderer at one instant.

A vertex (n, 8) float64: screen place and velocity in px and px/s, w = 1 / depth in 1/m and its rate in 1/m/s, validity.
A facet (m, 16) float64: planes p(x, y) = p0 + px x + py y of radiance L, of its rate at a fixed point G and of w; the
range of w and of the screen box; and the sign of its winding, +1 seen from outside, -1 seen from inside.

The renderer's loops are `lane` too where they are called at one place or two: a call that is left passes the seven
arrays of `Data` as some sixty numbers, which took 8 to 20 % of the time of a light frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Bytes, Float32s, Floats, Int32s

entry = entry_of("emulator.raster", "emulator.sensor.numerics")
"""Compile a function for calls from Python; it releases the GIL."""

BAND = 16
"""Rows of a band: its accumulators stay in the second-level cache."""

VERTEX_FIELDS, FACET_FIELDS = 8, 16
Valid = 6  # a vertex's x, y, vx, vy, w, dw/dt are 0 to 5
L, G, W = range(0, 9, 3)  # three numbers each
WLowest, WHighest, XLow, XHigh, YLow, YHigh, Sign = range(9, FACET_FIELDS)

CULLED, SHOWABLE, FLAT = range(3)
"""Kinds of facets: skipped; drawn; drawn with constant radiance because it is too thin for a gradient."""


class Data(NamedTuple):
    """Surfaces on the screen.

    Attributes
    ----------
    vertices, facets : see the module.
    faces, across, smooth, over : of `Topology`.
    kinds : (m,) uint8, of each facet.
    """

    vertices: Floats
    faces: Int32s
    across: Int32s
    smooth: Bytes
    facets: Floats
    kinds: Bytes
    over: Int32s


class Lists(NamedTuple):
    """The facets that may touch each band: those of band b are listed[starts[b]:starts[b + 1]], in ascending order."""

    starts: Int32s
    listed: Int32s


class Band(NamedTuple):
    """A band of rows: its number, its first row, and the row after its last."""

    number: int
    first_row: int
    end_row: int


class Plane(NamedTuple):
    """A linear function of the place on the screen: its value at the origin, and its growth a pixel right and down."""

    origin: float
    right: float
    down: float


class Owners(NamedTuple):
    """The nearest facet at the middle of each pixel, for light that is not linear over facets.

    Attributes
    ----------
    facets : (height, width) int32, the row of `Renderer.facets`; -1 for none.
    coverage : (height, width) float32: 1 where one surface covers the pixel, less where an outline passes, 0 near its
        middle.
    """

    facets: Int32s
    coverage: Float32s

    @classmethod
    def of(cls, width: int, height: int) -> Owners:
        """Return room for a picture."""
        return cls(np.full((height, width), -1, np.int32), np.ones((height, width), np.float32))


class Scratch(NamedTuple):
    """Memory of one thread, for one band at a time.

    Attributes
    ----------
    acc : (BAND, width + 1, 8), accumulators of pixels, see `rows`.
    depth, nearest : (BAND + 2, width + 2), 1 / depth and facet at samples, see `depth`.
    held, shows : (m,), the last band in which a facet held a sample, and in which it may show.
    slots : (BAND, width), the number of each pixel that is computed one by one; -1 for others.
    places : (pixels, 2), row and column of these pixels.
    masks : (width,), a bit for each row of the band that has such a pixel in this column.
    answers : (pixels, 2), their light and rate.
    ends : (pixels,), the end of each pixel's facets in `grouped`.
    pairs : (n, 2), number of a pixel and a facet that touches it.
    grouped : (n,), facets of `pairs` by pixel.
    keys : (n,), nearness by which facets are sorted.
    sides : (n, SIDE_FIELDS) of `lines`, sides and planes of the facets that touch a pixel, in its frame.
    lines : (n, LINE_FIELDS) of `lines`, intervals of these facets on a line through the pixel.
    """

    acc: Floats
    depth: Floats
    nearest: Int32s
    held: Int32s
    shows: Int32s
    slots: Int32s
    places: Int32s
    masks: Int32s
    answers: Floats
    ends: Int32s
    pairs: Int32s
    grouped: Int32s
    keys: Floats
    sides: Floats
    lines: Floats


@dataclass(frozen=True)
class Screen:
    """A pinhole camera's frame: pixel (column i, row j) covers [i, i + 1) x [j, j + 1).

    Attributes
    ----------
    width, height : pixels.
    focal_px : focal length over pixel pitch.
    centre_px : column and row of the boresight.
    nearest_m : facets are cut at this depth.
    """

    width: int
    height: int
    focal_px: float
    centre_px: tuple[float, float]
    nearest_m: float = 1e-3


@dataclass(frozen=True, eq=False)
class View:
    """Surfaces at one instant, camera axes: x right, y down, z forward.

    Attributes
    ----------
    positions_m, velocities_m_s : (n, 3) float64.
    radiance, radiance_rate : (s,) float64, W m-2 sr-1 and its rate for the material point, a second; non-negative.
    """

    positions_m: Floats
    velocities_m_s: Floats
    radiance: Floats
    radiance_rate: Floats

    def __post_init__(self) -> None:
        for name in ("positions_m", "velocities_m_s", "radiance", "radiance_rate"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.float64))
        if self.positions_m.ndim != 2 or self.positions_m.shape[1] != 3:
            raise ValueError(f"positions_m have the shape {self.positions_m.shape}, not (n, 3)")
        if self.velocities_m_s.shape != self.positions_m.shape or self.radiance.shape != self.radiance_rate.shape:
            raise ValueError("velocities and rates need the shapes of positions and radiance")

"""Columns of the arrays that kernels share, and the input of the renderer at one instant.

A vertex (n, 8) float64: screen place and velocity in px and px/s, w = 1 / depth in 1/m and its rate in 1/m/s, validity.
A facet (m, 16) float64: planes p(x, y) = p0 + px x + py y of radiance L, of its rate at a fixed point G and of w; the
range of w and of the screen box; and the sign of its winding, +1 seen from outside, -1 seen from inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Bytes = npt.NDArray[np.uint8]
Float32s = npt.NDArray[np.float32]

Data = tuple[Any, ...]
"""Arrays that kernels pass on: vertices, faces, across, smooth, facets, kinds, over."""

Plane = tuple[float, float, float]
Sides = tuple[float, float, float, float, float]

BAND = 16
"""Rows of a band: its accumulators stay in the second-level cache."""

VERTEX_FIELDS, FACET_FIELDS = 8, 16
Valid = 6  # a vertex's x, y, vx, vy, w, dw/dt are 0 to 5
L, G, W = 0, 3, 6
WLowest, WHighest, XLow, XHigh, YLow, YHigh, Sign = 9, 10, 11, 12, 13, 14, 15

CULLED, SHOWABLE, FLAT = 0, 1, 2
"""Kinds of facets: skipped; drawn; drawn with constant radiance because it is too thin for a gradient."""


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


@dataclass(frozen=True)
class Box:
    """Rows and columns of a part of a light frame, the last ones not included; empty where `first >= last`."""

    first_row: int = 0
    last_row: int = 0
    first_column: int = 0
    last_column: int = 0

    @property
    def empty(self) -> bool:
        """True: the box contains no pixel."""
        return self.first_row >= self.last_row or self.first_column >= self.last_column

    def union(self, other: Box) -> Box:
        """Return the smallest box that holds both."""
        if self.empty or other.empty:
            return other if self.empty else self
        return Box(
            min(self.first_row, other.first_row),
            max(self.last_row, other.last_row),
            min(self.first_column, other.first_column),
            max(self.last_column, other.last_column),
        )

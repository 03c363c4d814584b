"""What the camera sees at one instant: vertices, their velocities and their radiance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.raster.layout import Floats

__all__ = ["Box", "Screen", "View"]


@dataclass(frozen=True)
class Screen:
    """A pinhole camera's picture: pixel (column i, row j) covers [i, i + 1) x [j, j + 1).

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
    """Rows and columns of a part of a picture, the last ones not included; empty where `first >= last`."""

    first_row: int = 0
    last_row: int = 0
    first_column: int = 0
    last_column: int = 0

    @property
    def empty(self) -> bool:
        """Whether it holds no pixel."""
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

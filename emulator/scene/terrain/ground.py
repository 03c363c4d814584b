"""Heights of a piece of ground: a nest of square grids around one site, the finest inmost.

    grid 0    posts 1 unit apart        on the lattice of the finest grid, whose post (0, 0) is the site
    grid 1    posts 2 units apart       twice as wide, in every direction
    grid j    posts 2^j units apart     ...

Where a finer grid lies in a coarser one, its posts and the coarser one's agree to the last bit: so the same place has
one height on all grids, and meshes over them fit together. A map from a file is one grid. Rows go north (+y), columns
east (+x); the site's height is 0.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Ground", "nested"]

Heights = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Ground:
    """A nest of grids.

    Attributes
    ----------
    unit_m : distance of the finest grid's posts.
    heights_m : (grids, rows, columns) float32; rows - 1 and columns - 1 are multiples of 4 if there are several grids.
    notes : what a user should know of it, a sentence each.
    albedo : as `heights_m`, of each post relative to the ground's law of reflection; None: 1 everywhere.
    """

    unit_m: float
    heights_m: Heights
    notes: tuple[str, ...] = ()
    albedo: Heights | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of each grid."""
        return self.heights_m.shape[1], self.heights_m.shape[2]

    @property
    def grids(self) -> int:
        """How many there are."""
        return len(self.heights_m)

    def post_m(self, grid: int) -> float:
        """Return the distance of a grid's posts."""
        return self.unit_m * (1 << grid)

    def first(self, grid: int) -> tuple[int, int]:
        """Return the lattice place (x, y) of a grid's first post."""
        rows, columns = self.shape
        return -((columns - 1) // 2) << grid, -((rows - 1) // 2) << grid

    @property
    def half_m(self) -> float:
        """From the site to the nearest edge of the largest grid."""
        return self.post_m(self.grids - 1) * ((min(self.shape) - 1) // 2)

    def curved(self, radius_m: float) -> Ground:
        """Return the same on a sphere of `radius_m` that touches the map at the site: lower by r^2 / 2 R."""
        heights = self.heights_m.copy()
        for grid, z in enumerate(heights):
            x0, y0 = self.first(grid)
            x = (x0 + (np.arange(z.shape[1]) << grid)) * self.unit_m
            y = (y0 + (np.arange(z.shape[0]) << grid)) * self.unit_m
            z -= ((x * x + (y * y)[:, None]) / (2 * radius_m)).astype(np.float32)
        return dataclasses.replace(self, heights_m=heights)

    def height_m(self, x_m: float, y_m: float) -> float | None:
        """Return the ground's height at a place, linear between the finest posts there are; None off the map."""
        for grid in range(self.grids):
            at = [c / self.unit_m - first for c, first in zip((x_m, y_m), self.first(grid), strict=True)]
            column, row = (a / (1 << grid) for a in at)
            if 0 <= column <= self.shape[1] - 1 and 0 <= row <= self.shape[0] - 1:
                return _between(self.heights_m[grid], row, column)
        return None


def _between(heights: Heights, row: float, column: float) -> float:
    i, j = min(int(row), len(heights) - 2), min(int(column), heights.shape[1] - 2)
    down, across = row - i, column - j
    low, high = (heights[k, j] * (1 - across) + heights[k, j + 1] * across for k in (i, i + 1))
    return float(low * (1 - down) + high * down)


def nested(
    unit_m: float, grids: list[npt.NDArray[np.float64]], notes: tuple[str, ...] = (), *, level: bool = True
) -> Ground:
    """Return a ground of `grids`, (rows, columns) each, finest first: coarser ones take the finer ones' heights.

    `level` brings the site's height to 0.
    """
    heights = np.stack(grids).astype(np.float32)
    rows, columns = heights.shape[1:]
    if level:
        heights -= heights[0, (rows - 1) // 2, (columns - 1) // 2]
    for finer, coarser in itertools.pairwise(heights):
        inner = finer[::2, ::2]
        top, left = (rows - 1) // 4, (columns - 1) // 4
        coarser[top : top + len(inner), left : left + inner.shape[1]] = inner
    return Ground(unit_m, heights, notes)

"""Where the Sun shines: the height of the horizon towards it, at every post of a ground.

A sweep along the Sun's azimuth: lines parallel to it, one post apart, are walked from the sunward edge of the map. The
profile walked so far is kept as its upper convex hull, on which the horizon of the next point is the tangent: points
below it are dropped for good, so the work is a few steps a post. A line through a fine grid begins on the coarser ones
around it, so the shadow of a far mountain falls on near detail too. Heights are taken linearly between posts, and
horizons between lines.

The Sun's disc is half a degree wide. The share of it above a straight horizon is, with x the height of its middle above
the horizon in its radii,

    1/2 + (x sqrt(1 - x^2) + asin x) / pi        -1 <= x <= 1

which is the penumbra: behind a 10 m rock under a Sun 2 degrees high it is some 80 m wide.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.scene.terrain.compiled import map_entry
from emulator.scene.terrain.ground import Ground

__all__ = ["horizon_slopes", "sunlit_share"]

Slopes = npt.NDArray[np.float32]


def horizon_slopes(ground: Ground, azimuth_deg: float) -> Slopes:
    """Return the tangent of the horizon's elevation at every post, (grids, rows, columns) float32.

    The azimuth is 0 along +y and 90 along +x. Where nothing lies towards the Sun it is -1000.
    """
    azimuth = math.radians(azimuth_deg)
    east, north = math.sin(azimuth), math.cos(azimuth)
    swapped = abs(east) > abs(north)
    heights = ground.heights_m.transpose(0, 2, 1) if swapped else ground.heights_m
    across, along = (north, east) if swapped else (east, north)
    if along < 0:  # walk down the rows in any case
        heights = heights[:, ::-1]
    walked = np.ascontiguousarray(heights)
    length_m = ground.unit_m * math.hypot(across, along) / abs(along)
    out = np.stack([_sweep(walked, grid, across / abs(along), length_m) for grid in range(len(walked))])
    if along < 0:
        out = out[:, ::-1]
    return np.ascontiguousarray(out.transpose(0, 2, 1) if swapped else out)


def sunlit_share(slopes: Slopes, elevation_rad: float, radius_rad: float) -> Slopes:
    """Return the share of the Sun's disc, of `radius_rad`, above horizons of the given slopes."""
    x = np.clip((np.float32(elevation_rad) - np.arctan(slopes)) / np.float32(radius_rad), -1, 1)
    return np.asarray(0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.float32(math.pi), np.float32)


@map_entry
def _sweep(heights: npt.NDArray[np.float32], grid: int, drift: float, length_m: float) -> Slopes:
    """Return the horizons' slopes on one grid, (rows, columns); the Sun is towards higher rows.

    Parameters
    ----------
    drift : columns by which lines move towards the Sun, a row.
    length_m : of a line between two lattice rows.
    """
    rows, columns = heights.shape[1], heights.shape[2]
    spread = abs(drift) * (rows - 1)
    before = math.ceil(spread) if drift > 0 else 0  # lines that enter by a side
    lines = columns + math.ceil(spread) + 1
    sheared = np.empty((rows, lines), np.float32)
    room = len(heights) * rows + 2
    place, height = np.empty(room), np.empty(room)
    for line in range(lines):
        _walk(heights, grid, (line - before, drift, length_m), (place, height), sheared[:, line])
    out = np.empty((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            at = j - drift * i + before
            low = min(int(at), lines - 2)
            part = np.float32(at - low)
            out[i, j] = sheared[i, low] * (1 - part) + sheared[i, low + 1] * part
    return out


@map_entry
def _walk(
    heights: npt.NDArray[np.float32],
    grid: int,
    line: tuple[float, float, float],
    profile_room: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]],
    out: Slopes,
) -> None:
    """Walk one line towards lower rows, and write the horizons at the rows of `grid`, (rows,).

    Parameters
    ----------
    line : its column at row 0 of the grid, columns a row, metres a lattice row.
    profile_room : for the hull's points, places along the line and heights.
    """
    rows, columns = heights.shape[1], heights.shape[2]
    column, drift, length_m = line
    place, height = profile_room
    kept = 0
    k = len(heights) - 1
    middle_row, middle_column = (rows - 1) // 2, (columns - 1) // 2
    y0, x0 = -(middle_row << grid), (column - middle_column) * (1 << grid)
    y = (rows - 1 - middle_row) << k
    while y >= y0:
        x = x0 + drift * (y - y0)
        while (
            k > grid and y <= (rows - 1 - middle_row) << (k - 1) and _is_on(x / (1 << (k - 1)) + middle_column, columns)
        ):
            k -= 1
        at = x / (1 << k) + middle_column
        if _is_on(at, columns):
            t, z = -y * length_m, _height(heights, k, x, y)
            slope = -1e3
            while kept:
                slope = (height[kept - 1] - z) / (t - place[kept - 1])
                if kept == 1 or (height[kept - 2] - z) / (t - place[kept - 2]) < slope:
                    break
                kept -= 1
            place[kept], height[kept] = t, z
            kept += 1
            if k == grid:
                out[(y >> k) + middle_row] = slope
        elif k == grid:
            out[(y >> k) + middle_row] = -1e3
        y -= 1 << k


@map_entry
def _height(heights: npt.NDArray[np.float32], grid: int, x: float, y: int) -> float:
    """Return the height at a lattice place on a grid, or from a coarser one where it lies beside it."""
    rows, columns = heights.shape[1], heights.shape[2]
    at = x / (1 << grid) + (columns - 1) // 2
    while grid + 1 < len(heights) and not 0.0 <= at <= columns - 1.0:
        grid += 1
        at = x / (1 << grid) + (columns - 1) // 2
    at, up = min(max(at, 0.0), columns - 1.0), y / (1 << grid) + (rows - 1) // 2
    row, column = min(int(up), rows - 2), min(int(at), columns - 2)
    part, above = at - column, up - row
    low = heights[grid, row, column] * (1 - part) + heights[grid, row, column + 1] * part
    high = heights[grid, row + 1, column] * (1 - part) + heights[grid, row + 1, column + 1] * part
    return float(low * (1 - above) + high * above)


@map_entry
def _is_on(at: float, columns: int) -> bool:
    """Return whether a column lies on a grid, or so near that a line there must have been walked at the next row.

    One column beyond the border is needed to interpolate between lines, and a line moves by at most two columns from
    one row of a coarser grid to the next.
    """
    return -3.0 <= at <= columns + 2.0

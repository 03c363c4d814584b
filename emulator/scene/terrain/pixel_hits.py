"""Places on the fine map behind the corners of pixels.

The renderer gives the facet at the middle of each pixel. A corner belongs to the pixel right of it and below. With d
the corner's direction, d = 1 along the boresight, and n . X = 1 the facet's plane from the camera, the corner's ray
meets the plane at X = s d, s = 1 / (n . d). The map's height z above X moves it along d to the point on the plane
lifted by z - X_z; a secant from there, as the ground under the moved point has another height.

This finds an intersection near the facet, which need not be the first one; that is found by `first_hits`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.raster.layout import W, WHighest, WLowest
from emulator.scene.terrain import tile as t
from emulator.scene.terrain.ground import Halves
from emulator.scene.terrain.tile import TILE, set_triple
from emulator.sensor.numerics.compiled import Real, lane, vector_kernel
from firmware_protocol.events import Float32s, Floats, Int32s, Int64s

Table = Int64s


class Projection(NamedTuple):
    """A pinhole camera: focal length in pixels, column and row of the boresight."""

    focal_px: float
    column: float
    row: float


class Sight(NamedTuple):
    """The facets that a camera sees, and the camera.

    Attributes
    ----------
    owner : of `raster.Owners`.
    facets : of `Renderer.facets`.
    place : of the camera in the world (3,).
    turn : camera_from_world (3, 3).
    """

    owner: Int32s
    facets: Floats
    projection: Projection
    place: Floats
    turn: Floats


class Grids(NamedTuple):
    """Nested grids: metres a unit, how many they are, posts from their middle to their side."""

    unit_m: float
    grids: int
    half: float


class Posts(NamedTuple):
    """The fine map: heights, moments, table and shadows of a `Pyramid`, and its grids."""

    heights: Float32s
    moments: Halves
    levels: Table
    grids: Grids
    shadows: Halves


class Fields(NamedTuple):
    """Numbers of the fields that hold places, and of that with their sizes."""

    x: int
    y: int
    size: int


_TINY = np.float32(1e-12)
_LEAST, _MOST = np.float32(0.5), np.float32(2.0)  # slope of a secant
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
MARGIN = 16.0  # posts between a level's border and the last place for which it is taken


@lane
def clamp(number: Real, low: Real, high: Real) -> Real:
    """Return a number within bounds; `low` for NaN, so that the number may be a place in an array."""
    raised = number if number > low else low
    return raised if raised < high else high


@lane
def level_for(size: float, level: int, lowest: int, top: int) -> int:
    """Return the finest level, lowest to top, whose 2^level is not below `size`; the search begins at `level`."""
    level = min(max(level, lowest), max(top, lowest))
    while level < top and size > (1 << level):
        level += 1
    while level > lowest and size <= (1 << (level - 1)):
        level -= 1
    return level


@lane
def lowest_level(x: float, y: float, level: int, grids: Grids) -> int:
    """Return the finest grid at a place; the search begins at `level`."""
    inner = (grids.half - MARGIN) * grids.unit_m
    return level_for(max(abs(x), abs(y)) / inner, level, 0, grids.grids - 1) if inner > 0.0 else grids.grids - 1


@vector_kernel
def keep_row(s: Float32s) -> None:
    """Make the row of corners the one above, and its planes those of the pixels between."""
    for k in range(3 * TILE):  # three fields each
        s[t.OWN_W * TILE + k] = s[t.MIDDLE_W * TILE + k]
        s[t.ABOVE_X * TILE + k] = s[t.X * TILE + k]
    for k in range(TILE):
        s[t.ABOVE_W * TILE + k] = s[t.CORNER_W * TILE + k]


@vector_kernel
def corner_hits(row: int, first: int, sight: Sight, posts: Posts, s: Float32s, places: Int32s) -> None:
    """Write the hits of a row of corners, relative to the camera, and the planes of the pixels right of them and below.

    `first` is the first column.
    """
    _planes(row, first, sight, s)
    _on_facets(row, first, sight.projection, sight.turn, posts.grids.unit_m, s)
    write_levels(TILE, posts, len(posts.levels) - 2, sight.place, Fields(t.X, t.Y, t.SIZE), s, places)
    meet_map(posts.heights, np.float32(sight.place[2]), s, places)


@vector_kernel
def _planes(row: int, first: int, sight: Sight, s: Float32s) -> None:
    """Write w and its change of each pixel's facet, and the height of its normal; no change without a facet."""
    facets, turn = sight.facets, sight.turn
    focal, middle_column, middle_row = sight.projection
    height, width = sight.owner.shape
    owner_row = min(row, height - 1)
    for k in range(TILE):
        column = min(first + k, width - 1)
        f = sight.owner[owner_row, column]
        if f < 0:
            s[t.CORNER_W * TILE + k] = s[t.MIDDLE_W * TILE + k] = 1.0
            s[t.W_ACROSS * TILE + k] = s[t.W_DOWN * TILE + k] = s[t.NORMAL_Z * TILE + k] = 0.0
            continue
        w0, wx, wy = facets[f, W], facets[f, W + 1], facets[f, W + 2]
        # At the corner, which may lie beyond the facet, 1 / depth stays within the range of the facet's corners.
        corner = w0 + wx * (first + k) + wy * row
        s[t.CORNER_W * TILE + k] = min(max(corner, facets[f, WLowest]), facets[f, WHighest])
        s[t.MIDDLE_W * TILE + k] = w0 + wx * (column + 0.5) + wy * (owner_row + 0.5)
        s[t.W_ACROSS * TILE + k] = wx
        s[t.W_DOWN * TILE + k] = wy
        # n . X = 1 on the facet: n's part along the boresight is w there; the world's z of n follows.
        level = w0 + wx * middle_column + wy * middle_row
        s[t.NORMAL_Z * TILE + k] = focal * (turn[0, 2] * wx + turn[1, 2] * wy) + turn[2, 2] * level


@vector_kernel
def _on_facets(row: int, first: int, projection: Projection, turn: Floats, unit_m: float, s: Float32s) -> None:
    """Write where the corners' rays meet their facets, the change for lifting these, and the size of half a pixel."""
    focal = projection.focal_px
    per_focal = np.float32(1.0 / focal)
    y = (row - projection.row) / focal
    x_first = np.float32((first - projection.column) / focal)
    # A direction in the world is linear in the column: a x + b along the row.
    ax, ay, az = np.float32(turn[0, 0]), np.float32(turn[0, 1]), np.float32(turn[0, 2])
    bx = np.float32(turn[1, 0] * y + turn[2, 0])
    by = np.float32(turn[1, 1] * y + turn[2, 1])
    bz = np.float32(turn[1, 2] * y + turn[2, 2])
    half_px = np.float32(0.5 / (focal * unit_m))
    for k in range(TILE):
        x = x_first + np.float32(np.int32(k)) * per_focal
        dx, dy, dz = ax * x + bx, ay * x + by, az * x + bz
        depth = _ONE / max(s[t.CORNER_W * TILE + k], _TINY)
        lift = depth * s[t.NORMAL_Z * TILE + k]
        set_triple(s, t.X, k, depth * dx, depth * dy, depth * dz)
        set_triple(s, t.LIFT_X, k, lift * dx, lift * dy, lift * dz)
        s[t.SIZE * TILE + k] = depth * half_px


@vector_kernel
def write_levels(
    count: int, posts: Posts, top: int, place: Floats, fields: Fields, s: Float32s, places: Int32s
) -> None:
    """Write the level of each place: the finest one there whose 2^level is not below the size.

    `top` is the coarsest level, `place` the camera's place.
    """
    levels, unit = posts.levels, posts.grids.unit_m
    level, lowest, last = 0, 0, -1  # a place's level is nearly always that of its neighbour
    per_m = first_x = first_y = 0.0
    for k in range(count):
        x, y = place[0] + s[fields.x * TILE + k], place[1] + s[fields.y * TILE + k]
        lowest = lowest_level(x, y, lowest, posts.grids)
        level = level_for(s[fields.size * TILE + k], level, lowest, top)
        if level != last:
            # From metres east and north of the camera to posts of the level: FIRST + PER_M x metres.
            last, per_unit = level, 1.0 / (1 << level)
            per_m = per_unit / unit
            first_x = (place[0] / unit - levels[level, 3]) * per_unit
            first_y = (place[1] / unit - levels[level, 4]) * per_unit
        s[t.PER_M * TILE + k] = per_m
        s[t.FIRST_X * TILE + k] = first_x
        s[t.FIRST_Y * TILE + k] = first_y
        s[t.LAST_X * TILE + k] = levels[level, 2] - 1.001
        s[t.LAST_Y * TILE + k] = levels[level, 1] - 1.001
        places[t.LEVEL * TILE + k] = level
        places[t.LEVEL_FIRST * TILE + k] = levels[level, 0]
        places[t.LEVEL_ROWS * TILE + k] = levels[level, 1]
        places[t.LEVEL_COLUMNS * TILE + k] = levels[level, 2]


@vector_kernel
def meet_map(heights: Float32s, up: float, s: Float32s, places: Int32s) -> None:
    """Move places from their facets to the map along their rays; `up` is the camera's height."""
    _heights(heights, s, places)
    for k in range(TILE):
        # As if the ground under the moved place had the same height.
        lifted = _above(up, k, s)
        s[t.LIFTED * TILE + k] = lifted
        _move(lifted, k, s)
    _heights(heights, s, places)
    for k in range(TILE):
        # By a secant through the height above the place before this move, and that now.
        lifted, height = s[t.LIFTED * TILE + k], _above(up, k, s)
        apart = lifted - height
        slope = lifted / (apart if apart != _ZERO else _TINY)
        _move(height * min(max(slope, _LEAST), _MOST), k, s)


@vector_kernel
def _heights(heights: Float32s, s: Float32s, places: Int32s) -> None:
    """Write the heights of the four posts around each place."""
    find_posts(s, places)
    for k in range(TILE):
        low = np.uint64(places[t.POST * TILE + k])
        high = low + np.uint64(places[t.LEVEL_COLUMNS * TILE + k])
        s[t.POST_00 * TILE + k], s[t.POST_01 * TILE + k] = heights[low], heights[low + np.uint64(1)]
        s[t.POST_10 * TILE + k], s[t.POST_11 * TILE + k] = heights[high], heights[high + np.uint64(1)]


@vector_kernel
def find_posts(s: Float32s, places: Int32s) -> None:
    """Write the post left of and below each place, and the place from there in posts."""
    for k in range(TILE):
        u = s[t.FIRST_X * TILE + k] + s[t.X * TILE + k] * s[t.PER_M * TILE + k]
        v = s[t.FIRST_Y * TILE + k] + s[t.Y * TILE + k] * s[t.PER_M * TILE + k]
        u, v = clamp(u, _ZERO, s[t.LAST_X * TILE + k]), clamp(v, _ZERO, s[t.LAST_Y * TILE + k])
        column, row = np.int32(u), np.int32(v)
        s[t.WITHIN_X * TILE + k], s[t.WITHIN_Y * TILE + k] = u - np.float32(column), v - np.float32(row)
        columns = places[t.LEVEL_COLUMNS * TILE + k]
        places[t.POST * TILE + k] = places[t.LEVEL_FIRST * TILE + k] + row * columns + column


@lane
def _above(up: float, k: int, s: Float32s) -> Real:
    """Return the map's height above a place, linear between posts; `up` is the camera's."""
    u, v = s[t.WITHIN_X * TILE + k], s[t.WITHIN_Y * TILE + k]
    low = s[t.POST_00 * TILE + k] + u * (s[t.POST_01 * TILE + k] - s[t.POST_00 * TILE + k])
    high = s[t.POST_10 * TILE + k] + u * (s[t.POST_11 * TILE + k] - s[t.POST_10 * TILE + k])
    return low + v * (high - low) - up - s[t.Z * TILE + k]


@lane
def _move(by: float, k: int, s: Float32s) -> None:
    """Move a place along its ray, as if its facet were lifted by `by` metres."""
    s[t.X * TILE + k] += by * s[t.LIFT_X * TILE + k]
    s[t.Y * TILE + k] += by * s[t.LIFT_Y * TILE + k]
    s[t.Z * TILE + k] += by * s[t.LIFT_Z * TILE + k]

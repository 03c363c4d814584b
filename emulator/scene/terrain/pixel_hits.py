"""Places on the fine map behind the corners of pixels.

The renderer gives the facet at the middle of each pixel. A corner belongs to the pixel right of it and below. With d
the corner's direction, d = 1 along the boresight, and n . X = 1 the facet's plane from the camera, the corner's ray
meets the plane at X = s d, s = 1 / (n . d). The map's height z above X moves it along d to the point on the plane
lifted by z - X_z; a secant from there, as the ground under the moved point has another height.

This finds an intersection near the facet, which need not be the first one. For rays near the ground `meet_first` looks
at places along the ray, as many metres above the facet as below, in equal steps from the camera, and takes the first
step that ends below ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.raster.layout import Floats, Ints, W, WHighest, WLowest
from emulator.scene.terrain.ground import Halves
from emulator.scene.terrain.tile import (
    ABOVE,
    ABOVE_W,
    ABOVE_X,
    ABOVE_Y,
    ABOVE_Z,
    BELOW,
    CORNER_W,
    FIRST_X,
    FIRST_Y,
    LAST,
    LAST_X,
    LAST_Y,
    LEVEL,
    LEVEL_COLUMNS,
    LEVEL_FIRST,
    LEVEL_ROWS,
    LIFT_X,
    LIFT_Y,
    LIFT_Z,
    LIFTED,
    MIDDLE_W,
    NORMAL_Z,
    OWN_ACROSS,
    OWN_DOWN,
    OWN_W,
    PAST,
    PER_M,
    POST,
    POST_00,
    POST_01,
    POST_10,
    POST_11,
    REACH,
    SIZE,
    TILE,
    W_ACROSS,
    W_DOWN,
    WITHIN_X,
    WITHIN_Y,
    Floats32,
    Ints32,
    X,
    Y,
    Z,
)
from emulator.sensor.numerics.compiled import Real, lane, vector_kernel

Table = npt.NDArray[np.int64]
Screen = tuple[float, float, float]
"""Focal length in pixels, column and row of the boresight."""


class Sight(NamedTuple):
    """The facets that a camera sees, and the camera.

    Attributes
    ----------
    owner : of `raster.Owners`.
    facets : of `Renderer.facets`.
    place : of the camera in the world (3,).
    turn : camera_from_world (3, 3).
    """

    owner: Ints
    facets: Floats
    screen: Screen
    place: Floats
    turn: Floats


class Posts(NamedTuple):
    """The fine map: heights, moments and table of a `Pyramid`.

    Attributes
    ----------
    ground : unit in metres, how many grids, posts from their middle to their side.
    """

    heights: Floats32
    moments: Halves
    levels: Table
    ground: tuple[float, int, float]


_TINY = np.float32(1e-12)
_LEAST, _MOST = np.float32(0.5), np.float32(2.0)  # slope of a secant
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_NO_HIT = np.float32(-2.0)
_STEPS = 16
_STEP = np.float32(2.0 / _STEPS)
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
def lowest_level(x: float, y: float, level: int, ground: tuple[float, int, float]) -> int:
    """Return the finest grid at a place; the search begins at `level`."""
    unit, grids, half = ground
    inner = (half - MARGIN) * unit
    return level_for(max(abs(x), abs(y)) / inner, level, 0, grids - 1) if inner > 0.0 else grids - 1


@vector_kernel
def keep_row(s: Floats32) -> None:
    """Make the row of corners the one above, and its planes those of the pixels between."""
    for k in range(TILE):
        s[OWN_W * TILE + k] = s[MIDDLE_W * TILE + k]
        s[OWN_ACROSS * TILE + k] = s[W_ACROSS * TILE + k]
        s[OWN_DOWN * TILE + k] = s[W_DOWN * TILE + k]
        s[ABOVE_W * TILE + k] = s[CORNER_W * TILE + k]
        s[ABOVE_X * TILE + k] = s[X * TILE + k]
        s[ABOVE_Y * TILE + k] = s[Y * TILE + k]
        s[ABOVE_Z * TILE + k] = s[Z * TILE + k]


@vector_kernel
def corner_hits(at: tuple[int, int], sight: Sight, posts: Posts, s: Floats32, places: Ints32) -> None:
    """Write the hits of a row of corners, relative to the camera, and the planes of the pixels right of them and below.

    Parameters
    ----------
    at : row and first column.
    """
    _planes(at, sight, s)
    _on_facets(at, sight.screen, sight.turn, posts.ground[0], s)
    table = posts.levels, posts.ground, len(posts.levels) - 2
    write_levels(TILE, table, sight.place, (X, Y, SIZE), s, places)
    meet_map(posts.heights, np.float32(sight.place[2]), s, places)


@vector_kernel
def _planes(at: tuple[int, int], sight: Sight, s: Floats32) -> None:
    """Write w and its change of each pixel's facet, and the height of its normal; no change without a facet."""
    owner, facets, (focal, cx, cy), _, turn = sight
    height, width = owner.shape
    row = min(at[0], height - 1)
    for k in range(TILE):
        column = min(at[1] + k, width - 1)
        f = owner[row, column]
        if f < 0:
            s[CORNER_W * TILE + k] = s[MIDDLE_W * TILE + k] = 1.0
            s[W_ACROSS * TILE + k] = s[W_DOWN * TILE + k] = s[NORMAL_Z * TILE + k] = 0.0
            continue
        w0, wx, wy = facets[f, W], facets[f, W + 1], facets[f, W + 2]
        corner = w0 + wx * (at[1] + k) + wy * at[0]
        s[CORNER_W * TILE + k] = min(max(corner, facets[f, WLowest]), facets[f, WHighest])
        s[MIDDLE_W * TILE + k] = w0 + wx * (column + 0.5) + wy * (row + 0.5)
        s[W_ACROSS * TILE + k], s[W_DOWN * TILE + k] = wx, wy
        level = w0 + wx * cx + wy * cy
        s[NORMAL_Z * TILE + k] = focal * (turn[0, 2] * wx + turn[1, 2] * wy) + turn[2, 2] * level


@vector_kernel
def _on_facets(at: tuple[int, int], screen: Screen, turn: Floats, unit: float, s: Floats32) -> None:
    """Write where the corners' rays meet their facets, the change for lifting these, and the size of half a pixel."""
    per_focal = np.float32(1.0 / screen[0])
    y = (at[0] - screen[2]) / screen[0]
    first = np.float32((at[1] - screen[1]) / screen[0])
    ax, ay, az = np.float32(turn[0, 0]), np.float32(turn[0, 1]), np.float32(turn[0, 2])
    bx = np.float32(turn[1, 0] * y + turn[2, 0])
    by = np.float32(turn[1, 1] * y + turn[2, 1])
    bz = np.float32(turn[1, 2] * y + turn[2, 2])
    half_px = np.float32(0.5 / (screen[0] * unit))
    one = np.float32(1.0)
    for k in range(TILE):
        x = first + np.float32(np.int32(k)) * per_focal
        dx, dy, dz = ax * x + bx, ay * x + by, az * x + bz
        far = one / max(s[CORNER_W * TILE + k], _TINY)
        lift = far * s[NORMAL_Z * TILE + k]
        s[X * TILE + k], s[Y * TILE + k], s[Z * TILE + k] = far * dx, far * dy, far * dz
        s[LIFT_X * TILE + k], s[LIFT_Y * TILE + k], s[LIFT_Z * TILE + k] = lift * dx, lift * dy, lift * dz
        s[SIZE * TILE + k] = far * half_px


@vector_kernel
def write_levels(
    count: int,
    posts: tuple[Table, tuple[float, int, float], int],
    place: Floats,
    fields: tuple[int, int, int],
    s: Floats32,
    places: Ints32,
) -> None:
    """Write the level of each place: the finest one there whose 2^level is not below the size.

    Parameters
    ----------
    posts : table of a `Pyramid`; unit in metres, how many grids, posts from their middle to their side; coarsest level.
    place : of the camera.
    fields : of the places' x and y, and of the sizes.
    """
    levels, ground, top = posts
    unit = ground[0]
    level, lowest = 0, 0
    for k in range(count):
        lowest = lowest_level(place[0] + s[fields[0] * TILE + k], place[1] + s[fields[1] * TILE + k], lowest, ground)
        level = level_for(s[fields[2] * TILE + k], level, lowest, top)
        per_unit = 1.0 / (1 << level)
        s[PER_M * TILE + k] = per_unit / unit
        s[FIRST_X * TILE + k] = (place[0] / unit - levels[level, 3]) * per_unit
        s[FIRST_Y * TILE + k] = (place[1] / unit - levels[level, 4]) * per_unit
        s[LAST_X * TILE + k], s[LAST_Y * TILE + k] = levels[level, 2] - 1.001, levels[level, 1] - 1.001
        places[LEVEL * TILE + k], places[LEVEL_FIRST * TILE + k] = level, levels[level, 0]
        places[LEVEL_ROWS * TILE + k], places[LEVEL_COLUMNS * TILE + k] = levels[level, 1], levels[level, 2]


@vector_kernel
def meet_map(heights: Floats32, up: float, s: Floats32, places: Ints32) -> None:
    """Move places from their facets to the map along their rays; `up` is the camera's height."""
    _heights(heights, s, places)
    _first_guess(up, s)
    _heights(heights, s, places)
    _secant(up, s)


@vector_kernel
def meet_first(heights: Floats32, up: float, s: Floats32, places: Ints32) -> None:
    """Move places to where their rays first meet the map, within REACH of their facets; else as `meet_map` does."""
    for k in range(TILE):
        s[PAST * TILE + k], s[LAST * TILE + k] = _NO_HIT, _ONE
        _move(s[REACH * TILE + k], k, s)
    for step in range(_STEPS + 1):
        _heights(heights, s, places)
        _search(_ONE - np.float32(step) * _STEP, up, s)
    for k in range(TILE):
        _move((_ONE + _STEP) * s[REACH * TILE + k], k, s)
        s[LIFTED * TILE + k] = _ZERO
        if s[PAST * TILE + k] > _NO_HIT:
            s[LIFTED * TILE + k] = _within(k, s)
        _move(s[LIFTED * TILE + k], k, s)
    _heights(heights, s, places)
    _narrow(up, s)
    _heights(heights, s, places)
    _finish(up, s)


@vector_kernel
def _search(lift: float, up: float, s: Floats32) -> None:
    """Write the step in which each ray first meets the map, if it ends here at `lift`; move on."""
    for k in range(TILE):
        above, before = _above(up, k, s), s[LAST * TILE + k]
        met = (above >= _ZERO) & (before < _ZERO) & (s[PAST * TILE + k] <= _NO_HIT)
        s[PAST * TILE + k] = lift if met else s[PAST * TILE + k]
        s[ABOVE * TILE + k] = above if met else s[ABOVE * TILE + k]
        s[BELOW * TILE + k] = before if met else s[BELOW * TILE + k]
        s[LAST * TILE + k] = above
        _move(-_STEP * s[REACH * TILE + k], k, s)


@lane
def _within(k: int, s: Floats32) -> Real:
    """Return the lift at which a ray meets ground that is linear over the step of its first hit."""
    share = s[ABOVE * TILE + k] / (s[ABOVE * TILE + k] - s[BELOW * TILE + k])
    return s[REACH * TILE + k] * (s[PAST * TILE + k] + share * _STEP)


@vector_kernel
def _narrow(up: float, s: Floats32) -> None:
    """Move to the hit in the part of the step in which the ground is met; a first guess where there was no hit."""
    for k in range(TILE):
        above, high, low = _above(up, k, s), s[ABOVE * TILE + k], s[BELOW * TILE + k]
        share = high / (high - low)  # of the step, from its end to the place
        back = share * above / (above - high if above < _ZERO else _TINY)
        ahead = (_ONE - share) * above / (above - low if above >= _ZERO else _ONE)
        by = _STEP * s[REACH * TILE + k] * (ahead if above >= _ZERO else back)
        found = s[PAST * TILE + k] > _NO_HIT
        s[LIFTED * TILE + k] = above
        _move(by if found else above, k, s)


@vector_kernel
def _finish(up: float, s: Floats32) -> None:
    """Move by a secant where there was no hit."""
    for k in range(TILE):
        lifted, more = s[LIFTED * TILE + k], _above(up, k, s)
        apart = lifted - more
        slope = lifted / (apart if apart != _ZERO else _TINY)
        by = more * min(max(slope, _LEAST), _MOST)
        _move(_ZERO if s[PAST * TILE + k] > _NO_HIT else by, k, s)


@vector_kernel
def _heights(heights: Floats32, s: Floats32, places: Ints32) -> None:
    """Write the heights of the four posts around each place."""
    _posts(s, places)
    for k in range(TILE):
        low = np.uint64(places[POST * TILE + k])
        high = low + np.uint64(places[LEVEL_COLUMNS * TILE + k])
        s[POST_00 * TILE + k], s[POST_01 * TILE + k] = heights[low], heights[low + np.uint64(1)]
        s[POST_10 * TILE + k], s[POST_11 * TILE + k] = heights[high], heights[high + np.uint64(1)]


@vector_kernel
def _posts(s: Floats32, places: Ints32) -> None:
    """Write the post left of and below each place, and the place from there in posts."""
    for k in range(TILE):
        u = s[FIRST_X * TILE + k] + s[X * TILE + k] * s[PER_M * TILE + k]
        v = s[FIRST_Y * TILE + k] + s[Y * TILE + k] * s[PER_M * TILE + k]
        u, v = clamp(u, _ZERO, s[LAST_X * TILE + k]), clamp(v, _ZERO, s[LAST_Y * TILE + k])
        column, row = np.int32(u), np.int32(v)
        s[WITHIN_X * TILE + k], s[WITHIN_Y * TILE + k] = u - np.float32(column), v - np.float32(row)
        columns = places[LEVEL_COLUMNS * TILE + k]
        places[POST * TILE + k] = places[LEVEL_FIRST * TILE + k] + row * columns + column


@lane
def _above(up: float, k: int, s: Floats32) -> Real:
    """Return the map's height above a place, linear between posts; `up` is the camera's."""
    u, v = s[WITHIN_X * TILE + k], s[WITHIN_Y * TILE + k]
    low = s[POST_00 * TILE + k] + u * (s[POST_01 * TILE + k] - s[POST_00 * TILE + k])
    high = s[POST_10 * TILE + k] + u * (s[POST_11 * TILE + k] - s[POST_10 * TILE + k])
    return low + v * (high - low) - up - s[Z * TILE + k]


@lane
def _move(by: float, k: int, s: Floats32) -> None:
    s[X * TILE + k] += by * s[LIFT_X * TILE + k]
    s[Y * TILE + k] += by * s[LIFT_Y * TILE + k]
    s[Z * TILE + k] += by * s[LIFT_Z * TILE + k]


@vector_kernel
def _first_guess(up: float, s: Floats32) -> None:
    for k in range(TILE):
        lifted = _above(up, k, s)
        s[LIFTED * TILE + k] = lifted
        _move(lifted, k, s)


@vector_kernel
def _secant(up: float, s: Floats32) -> None:
    for k in range(TILE):
        lifted, more = s[LIFTED * TILE + k], _above(up, k, s)
        apart = lifted - more
        slope = lifted / (apart if apart != _ZERO else _TINY)
        _move(more * min(max(slope, _LEAST), _MOST), k, s)

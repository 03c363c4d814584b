"""Blocks of a ground to draw, their detail and their vertices: a quadtree over its nested grids.

A block of level l is a square of 8 x 8 quads, 2^l lattice units wide each. It is drawn where it lies no nearer than
the level's range, else its four quarters are tested:

    range of level l       reach x 2^l units          reach: distance within which a quad is split, in its own width
    distance of a place    max(from the camera, crowd x from the site)    no finer than the ground's grids are there

So the level is a function of the place's distance alone, whatever block it falls into: in the last part of a level's
range its vertices slide together into those of the next coarser one (`block_vertices`), neighbours always fit, and
nothing jumps when blocks change. Source: Strugar 2010, Continuous distance-dependent level of detail for rendering
heightmaps.

A vertex is a post of its block's level. In the last third of the level's range it slides along its facet's side to the
neighbour that the next coarser level has too, so the change of levels is continuous. With `away` the vertex's distance,

    slid = (away / range - 0.7) / 0.29, 0 to 1        d slid / dt from the camera's motion, where `away` changes

and the slide's share of the velocity is exact. A block's posts lie in a few lines of memory, and positions come row by
row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emulator.scene.terrain.ground import Ground, Heights, entry, map_entry
from firmware_protocol.events import Floats, Int32s, Int64s

BLOCK = 8
LEAST_REACH = 80.0
"""Below it a block is larger than the part of the range in which levels meet."""

SIDE = BLOCK + 1
CORNERS = SIDE * SIDE
_FIRST, _SPAN = 0.7, 0.29  # of a level's range: where the slide begins, and how long it is
_MOST_BLOCKS = 1 << 16


class _Split(NamedTuple):
    """Rules for the division of blocks, see the module docstring; the ground's grids, and rows and columns of each."""

    unit_m: float
    reach_m: float
    crowd: float
    grids: int
    rows: int
    columns: int


class _Box(NamedTuple):
    """The box around a block, m: its low corner, its side, and its lowest and highest post."""

    x: float
    y: float
    size: float
    low: float
    high: float


class Quadtree:
    """The blocks of `ground`, split within `reach` widths of a quad.

    Attributes
    ----------
    crowd : see the module docstring; 0 for a single grid.
    highest : height of the highest post of each block, level by level, row by row.
    levels
        A row for each grid, and for each level above the last one until a block holds all: rows, columns, first x and
        y, number of the first block.
    """

    def __init__(self, ground: Ground, reach: float) -> None:
        half = (min(ground.shape) - 1) // 2
        self.crowd = 1.002 * reach / half if ground.grids > 1 else 0.0
        self._split = _Split(ground.unit_m, reach * ground.unit_m, self.crowd, ground.grids, *ground.shape)
        lowest, highest = (_of_blocks(ground, extreme) for extreme in (np.minimum, np.maximum))
        self._low, self.highest = (np.concatenate([level.ravel() for level in of]) for of in (lowest, highest))
        shapes = np.array([level.shape for level in lowest])
        firsts = [ground.first(min(level, ground.grids - 1)) for level in range(len(shapes))]
        blocks_before = np.cumsum([0, *shapes.prod(axis=1)[:-1]])
        self.levels: Int64s = np.column_stack([shapes, firsts, blocks_before])

    def blocks(self, camera_m: Floats, planes: Floats) -> list[Int32s]:
        """Return the blocks to draw of each grid: (n, 3) first column and row, posts from vertex to vertex; near first.

        `camera_m`, (3,), is its place in the world; `planes`, (n, 3), are the inward normals, in the world, of the
        planes through the camera that bound the view.
        """
        chosen = self._chosen(camera_m, planes)
        return [np.ascontiguousarray(chosen[chosen[:, 3] == k, 4:]) for k in range(self._split.grids)]

    def by_level(self, camera_m: Floats, planes: Floats) -> Int64s:
        """Return the same blocks, (n, 3): level, first column and row in posts of the level's own array; near first.

        See `Pyramid.levels` for these arrays.
        """
        return np.ascontiguousarray(self._chosen(camera_m, planes)[:, :3], np.int64)

    def _chosen(self, camera_m: Floats, planes: Floats) -> Int32s:
        """Return the blocks, (n, 7) as `_select` does; near first."""
        blocks, distance = _select(self.levels, self._low, self.highest, self._split, camera_m, planes)
        return blocks[np.argsort(distance, kind="stable")]


def block_facets() -> tuple[Int32s, Int32s]:
    """Return a block's corners, (n, 2) column and row, and its facets, (m, 3), counter-clockwise from above."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    corners = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.int32)
    low = (rows[:-1, :-1] * SIDE + columns[:-1, :-1]).ravel()
    a, b, c, d = low, low + 1, low + SIDE, low + SIDE + 1
    return corners, np.stack([a, b, d, a, d, c], axis=-1).reshape(-1, 3).astype(np.int32)


def _of_blocks(ground: Ground, extreme: np.ufunc) -> list[Floats]:
    """Return the extreme of the posts of each block, level by level, with that of finer levels within."""
    levels: list[Floats] = []
    for heights in ground.heights_m:
        level = _of_grid(heights, extreme)
        if levels:
            finer = _quarters(levels[-1], extreme)
            top, left = ((n - 1) // 4 // BLOCK for n in ground.shape)
            inner = level[top : top + len(finer), left : left + finer.shape[1]]
            extreme(inner, finer, out=inner)
        levels.append(level)
    while max(levels[-1].shape) > 1:
        levels.append(_quarters(levels[-1], extreme))
    return levels


def _of_grid(heights: Heights, extreme: np.ufunc) -> Floats:
    """Return the extreme of the posts of each block of a grid, its last row and column with it."""
    rows, columns = (max(n - 1, 1) for n in heights.shape)
    shared = extreme(heights[:rows, :columns], heights[1:, :columns])
    shared = extreme(shared, extreme(heights[:rows, 1:], heights[1:, 1:]))
    by_rows = extreme.reduceat(shared, np.arange(0, rows, BLOCK), axis=0)
    return np.asarray(extreme.reduceat(by_rows, np.arange(0, columns, BLOCK), axis=1), np.float64)


def _quarters(values: Floats, extreme: np.ufunc) -> Floats:
    """Return the extreme of two by two."""
    rows, columns = values.shape
    even = np.pad(values, ((0, rows % 2), (0, columns % 2)), mode="edge")
    by_rows = extreme(even[::2], even[1::2])
    return np.asarray(extreme(by_rows[:, ::2], by_rows[:, 1::2]))


@map_entry
def _select(
    levels: Int64s, low: Floats, high: Floats, split: _Split, camera: Floats, planes: Floats
) -> tuple[Int32s, Floats]:
    """Return blocks and their distances.

    Blocks are (n, 7): level, first column and row of the level; grid, first column and row of that, posts from vertex
    to vertex.
    """
    blocks, distances = np.empty((_MOST_BLOCKS, 7), np.int32), np.empty(_MOST_BLOCKS)
    stack = np.empty((4 * len(levels) + 4, 3), np.int64)
    stack[0] = len(levels) - 1, 0, 0
    waiting, count = 1, 0
    while waiting and count < _MOST_BLOCKS:
        waiting -= 1
        level, i, j = stack[waiting]
        size = BLOCK << level
        x, y = levels[level, 2] + j * size, levels[level, 3] + i * size
        at = levels[level, 4] + i * levels[level, 1] + j
        box = _Box(x * split.unit_m, y * split.unit_m, size * split.unit_m, low[at], high[at])
        if _is_outside(box, camera, planes):
            continue
        from_site = max(box.x, -box.x - box.size, box.y, -box.y - box.size, 0.0)  # on the axis where it is larger
        distance = max(_distance(box, camera), split.crowd * from_site)
        if level == 0 or distance > split.reach_m * (1 << (level - 1)):
            grid = _finest_around(x, y, size, min(level, split.grids - 1), (split.rows, split.columns))
            column, row = (x >> grid) + (split.columns - 1) // 2, (y >> grid) + (split.rows - 1) // 2
            blocks[count] = level, j * BLOCK, i * BLOCK, grid, column, row, 1 << (level - grid)
            distances[count] = distance
            count += 1
            continue
        half, below = size // 2, level - 1
        for k in range(4):
            ci = (y + (k // 2) * half - levels[below, 3]) // half
            cj = (x + (k % 2) * half - levels[below, 2]) // half
            if 0 <= ci < levels[below, 0] and 0 <= cj < levels[below, 1]:
                stack[waiting] = below, ci, cj
                waiting += 1
    return blocks[:count].copy(), distances[:count].copy()


@map_entry
def _is_outside(box: _Box, camera: Floats, planes: Floats) -> bool:
    x, y, size, low, high = box
    for k in range(len(planes)):
        a, b, c = planes[k, 0], planes[k, 1], planes[k, 2]
        ahead = a * ((x + size if a > 0 else x) - camera[0]) + b * ((y + size if b > 0 else y) - camera[1])
        if ahead + c * ((high if c > 0 else low) - camera[2]) < 0:
            return True
    return False


@map_entry
def _distance(box: _Box, camera: Floats) -> float:
    x, y, size, low, high = box
    dx = max(x - camera[0], 0.0, camera[0] - x - size)
    dy = max(y - camera[1], 0.0, camera[1] - y - size)
    dz = max(low - camera[2], 0.0, camera[2] - high)
    return float(np.sqrt(dx * dx + dy * dy + dz * dz))


@map_entry
def _finest_around(x: int, y: int, size: int, grid: int, shape: tuple[int, int]) -> int:
    """Return the finest grid that contains a block completely; `grid` is one that does."""
    while grid > 0:
        half_x, half_y = ((shape[1] - 1) // 2) << (grid - 1), ((shape[0] - 1) // 2) << (grid - 1)
        if x < -half_x or y < -half_y or x + size > half_x or y + size > half_y:
            return grid
        grid -= 1
    return grid


class Camera(NamedTuple):
    """A camera: place (3,) and velocity (3,) in the world, camera_from_world (3, 3) and its rate, a second."""

    place: Floats
    velocity: Floats
    turn: Floats
    turning: Floats


class Vertices(NamedTuple):
    """Vertices of blocks: positions (n, 3) in camera axes, and velocities (n, 3)."""

    positions: Floats
    velocities: Floats


@entry
def block_vertices(  # noqa: PLR0913, PLR0917
    blocks: Int64s, begin: int, end: int, heights: Heights, levels: Int64s, unit_m: float, reach_m: float, crowd: float,
    camera: Camera, out: Vertices,
) -> None:  # fmt: skip
    """Write the vertices of blocks `begin` to `end`, 81 each.

    Parameters
    ----------
    blocks : (n, 3), level, first column, first row.
    heights, levels : of a `Pyramid`.
    reach_m, crowd : of the module docstring.
    """
    place, moving, turn, turning = camera
    for k in range(begin, end):
        level = blocks[k, 0]
        offset, rows, columns = levels[level, 0], levels[level, 1], levels[level, 2]
        x0, y0 = levels[level, 3], levels[level, 4]
        x_span, y_span = levels[level, 5], levels[level, 6]
        down, right = levels[level, 7], levels[level, 8]
        next_offset, next_columns = levels[level + 1, 0], levels[level + 1, 2]
        per_range = 1.0 / (reach_m * (1 << level) * _SPAN)
        for i in range(SIDE):
            # Rows and columns beyond the map fall together with the last ones. A post with odd numbers slides to the
            # even ones before it, which are posts of the next level.
            row = min(blocks[k, 2] + i, rows - 1)
            even_row = min(blocks[k, 2] + (i & ~1), rows - 1)
            y = (y0 + min(row << level, y_span)) * unit_m
            next_y = (y0 + min(even_row << level, y_span)) * unit_m
            for j in range(SIDE):
                column = min(blocks[k, 1] + j, columns - 1)
                even_column = min(blocks[k, 1] + (j & ~1), columns - 1)
                post = offset + row * columns + column
                next_post = next_offset + ((even_row + 1) // 2 + down) * next_columns + (even_column + 1) // 2 + right
                x = (x0 + min(column << level, x_span)) * unit_m
                # How far the post has slid, and the rate of that as the camera moves.
                fx, fy, fz = x - place[0], y - place[1], heights[post] - place[2]
                distance = math.sqrt(fx * fx + fy * fy + fz * fz)
                around_site = crowd * max(abs(x), abs(y))
                slid = (max(distance, around_site) - _FIRST * reach_m * (1 << level)) * per_range
                sliding = 0.0
                if slid <= 0.0:
                    slid = 0.0
                elif slid >= 1.0:
                    slid = 1.0
                elif distance > around_site:
                    sliding = -(fx * moving[0] + fy * moving[1] + fz * moving[2]) / distance * per_range
                # The vertex from the camera in the world, its velocity, and both in camera axes, which turn.
                gx = (x0 + min(even_column << level, x_span)) * unit_m - x
                gy, gz = next_y - y, heights[next_post] - heights[post]
                rx, ry, rz = fx + slid * gx, fy + slid * gy, fz + slid * gz
                vx, vy, vz = sliding * gx - moving[0], sliding * gy - moving[1], sliding * gz - moving[2]
                at = k * CORNERS + i * SIDE + j
                for a in range(3):
                    out.positions[at, a] = turn[a, 0] * rx + turn[a, 1] * ry + turn[a, 2] * rz
                    out.velocities[at, a] = (
                        turn[a, 0] * vx
                        + turn[a, 1] * vy
                        + turn[a, 2] * vz
                        + turning[a, 0] * rx
                        + turning[a, 1] * ry
                        + turning[a, 2] * rz
                    )

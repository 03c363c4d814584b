"""Vertices of chosen blocks in camera axes, with their velocities.

A vertex is a post of its block's level. In the last third of the level's range it slides along its facet's side to the
neighbour that the next coarser level has too, so the change of levels is continuous. With `away` the vertex's distance
(see `quadtree`),

    slid = (away / range - 0.7) / 0.29, 0 to 1        d slid / dt from the camera's motion, where `away` changes

and the slide's share of the velocity is exact. A block's posts lie in a few lines of memory, and positions come row by
row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.terrain.ground import entry
from emulator.scene.terrain.quadtree import BLOCK

SIDE = BLOCK + 1
CORNERS = SIDE * SIDE
_FIRST, _SPAN = 0.7, 0.29  # of a level's range: where the slide begins, and how long it is

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]


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
def block_vertices(
    blocks: Ints, begin: int, end: int, heights: Float32s, levels: Ints, unit_m: float, reach_m: float, crowd: float,
    camera: Camera, out: Vertices,
) -> None:  # fmt: skip
    """Write the vertices of blocks `begin` to `end`, 81 each.

    Parameters
    ----------
    blocks : (n, 3), level, first column, first row.
    heights, levels : of a `Pyramid`.
    reach_m, crowd : see `quadtree`.
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

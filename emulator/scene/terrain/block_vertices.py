"""Vertices of chosen blocks in camera axes, with their velocities and their light, and its rate.

A vertex is a post of its block's level. In the last third of the level's range it slides along its facet's side to the
neighbour that the next coarser level has too, with its normal and light, so the change of levels is continuous. With
`away` the vertex's distance (see `quadtree`),

    slid = (away / range - 0.7) / 0.29, 0 to 1        d slid / dt from the camera's motion, where `away` changes

and the slide's share of the velocity, and of the rate of light, is exact. The radiance is

    L = E_sun r(mu0, mu, g) b / mu0 + ambient r(u, u, 0)

with the mean normal's mu0 and mu, and the height u of the eye's direction over level ground: light from all around
does not depend on slopes. Its rate at the vertex comes from its value an instant later.

Three measures make it fast: a block's posts lie in a few lines of memory, positions come row by row, and the law of
reflection is evaluated over a block's vertices in one loop.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from emulator.photometry.reflection_kernels import reflect
from emulator.scene.terrain.box_moments import half_at
from emulator.scene.terrain.ground import BP, BQ, MOMENTS, B, Halves, entry
from emulator.scene.terrain.quadtree import BLOCK

SIDE = BLOCK + 1
CORNERS = SIDE * SIDE
_FIRST, _SPAN = 0.7, 0.29  # of a level's range: where the slide begins, and how long it is
LATER_S = 1e-4
GRAZING = 0.02
"""Least cosine of emission: the laws of reflection are not valid for smaller ones."""

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]


class Camera(NamedTuple):
    """A camera: place (3,) and velocity (3,) in the world, camera_from_world (3, 3) and its rate, a second."""

    place: Floats
    velocity: Floats
    turn: Floats
    turning: Floats


class Sunlight(NamedTuple):
    """Light on the ground.

    Attributes
    ----------
    towards : the Sun, (3,) unit.
    irradiance_w_m2 : on a surface that faces it.
    law, law_parameters : a `reflection_kernels.Law`.
    ambient : radiance of the ambient light by the height of the eye's direction.
    """

    towards: Floats
    irradiance_w_m2: float
    law: int
    law_parameters: Floats
    ambient: Floats


class Vertices(NamedTuple):
    """Vertices of blocks: positions (n, 3) in camera axes, velocities (n, 3), radiance (n,) and its rate (n,)."""

    positions: Floats
    velocities: Floats
    radiance: Floats
    rates: Floats


@numba.njit(inline="always", error_model="numpy")
def grazing(mu: float) -> float:
    """Return the cosine of emission, at least GRAZING, because the laws of reflection are not valid near 0."""
    return max(mu, GRAZING)


@numba.njit(inline="always", error_model="numpy")
def around(table: Floats, height: float) -> float:
    """Return the radiance of the ambient light from a table by the height of the eye's direction."""
    at = min(max(height, GRAZING), 1.0) * (len(table) - 1)
    low = min(int(at), len(table) - 2)
    return float(table[low] + (table[low + 1] - table[low]) * (at - low))


@numba.njit(inline="always", error_model="numpy")
def _light_of(moments: Halves, post: int) -> tuple[float, float, float]:
    """Return b, b p and b q of a post."""
    at = post * MOMENTS
    return half_at(moments, at + B), half_at(moments, at + BP), half_at(moments, at + BQ)


@entry
def block_vertices(
    blocks: Ints,
    begin: int,
    end: int,
    heights: Float32s,
    moments: Halves,
    levels: Ints,
    unit_m: float,
    reach_m: float,
    crowd: float,
    camera: Camera,
    sun: Sunlight,
    scratch: Floats,
    out: Vertices,
) -> None:
    """Write the vertices of blocks `begin` to `end`, 81 each.

    Parameters
    ----------
    blocks : (n, 3), level, first column, first row.
    heights, moments, levels : of a `Pyramid`.
    reach_m, crowd : see `quadtree`.
    scratch : (10, 81).
    """
    place, moving, turn, turning = camera
    sun_x, sun_y, sun_z = sun.towards[0], sun.towards[1], sun.towards[2]
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
                # Inputs of the law of reflection, now and an instant later.
                lit_here, east_here, north_here = _light_of(moments, post)
                lit_next, east_next, north_next = _light_of(moments, next_post)
                de, dn, db = east_next - east_here, north_next - north_here, lit_next - lit_here
                n = i * SIDE + j
                for instant in range(2):
                    s = slid + instant * sliding * LATER_S
                    t = instant * LATER_S
                    # b and the slopes p, q from b, b p and b q; the normal (-p, -q, 1) as a unit vector.
                    b = lit_here + s * db
                    per_b = 1.0 / max(b, 1e-9)
                    p = min(max((east_here + s * de) * per_b, -10.0), 10.0)
                    q = min(max((north_here + s * dn) * per_b, -10.0), 10.0)
                    up = 1.0 / math.sqrt(1.0 + p * p + q * q)
                    east, north = -p * up, -q * up
                    up = math.sqrt(max(1.0 - east * east - north * north, 0.0))
                    # Cosines of incidence and emission, and the squared chord between Sun and eye.
                    to_x, to_y, to_z = rx + t * vx, ry + t * vy, rz + t * vz
                    per_m = -1.0 / math.sqrt(to_x * to_x + to_y * to_y + to_z * to_z)
                    eye_x, eye_y, eye_z = to_x * per_m, to_y * per_m, to_z * per_m
                    cx, cy, cz = eye_x - sun_x, eye_y - sun_y, eye_z - sun_z
                    b = max(b, 0.0)
                    mu0 = max(east * sun_x + north * sun_y + up * sun_z, b, 1e-6)
                    scratch[5 * instant, n] = mu0
                    scratch[5 * instant + 1, n] = grazing(east * eye_x + north * eye_y + up * eye_z)
                    scratch[5 * instant + 2, n] = cx * cx + cy * cy + cz * cz
                    scratch[5 * instant + 3, n] = b / mu0 * sun.irradiance_w_m2
                    scratch[5 * instant + 4, n] = around(sun.ambient, eye_z)
        # The law over all vertices of the block; the rate is the difference of both instants.
        first = k * CORNERS
        now, later = out.radiance[first : first + CORNERS], out.rates[first : first + CORNERS]
        reflect(sun.law, sun.law_parameters, scratch[0], scratch[1], scratch[2], CORNERS, now)
        reflect(sun.law, sun.law_parameters, scratch[5], scratch[6], scratch[7], CORNERS, later)
        for n in range(CORNERS):
            now[n] = now[n] * scratch[3, n] + scratch[4, n]
            later[n] = (later[n] * scratch[8, n] + scratch[9, n] - now[n]) / LATER_S

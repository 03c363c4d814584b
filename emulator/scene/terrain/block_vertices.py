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

import numba
import numpy as np
import numpy.typing as npt

from emulator.photometry.reflection_kernels import reflect
from emulator.scene.terrain.box_moments import half_at
from emulator.scene.terrain.compiled import entry
from emulator.scene.terrain.ground import BP, BQ, MOMENTS, B, Halves
from emulator.scene.terrain.quadtree import BLOCK

SIDE = BLOCK + 1
CORNERS = SIDE * SIDE
_FIRST, _SPAN = 0.7, 0.29  # of a level's range: where the slide begins, and how long it is
LATER_S = 1e-4
GRAZING = 0.02
"""Least cosine of emission: the laws of reflection are not valid for smaller ones."""

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Posts = npt.NDArray[np.float32]


@numba.njit(inline="always", error_model="numpy")
def grazing(mu: float) -> float:
    """Return the cosine of emission, at least GRAZING, because the laws of reflection are not valid near 0."""
    return max(mu, GRAZING)


@numba.njit(inline="always", error_model="numpy")
def _angles(
    ray: tuple[float, float, float], east: float, north: float, sun: Floats
) -> tuple[float, float, float, float]:
    """Return mu0, mu, squared chord between Sun and eye, and the height of the eye's direction."""
    x, y, z = ray
    per_m = -1.0 / math.sqrt(x * x + y * y + z * z)
    ex, ey, ez = x * per_m, y * per_m, z * per_m
    up = math.sqrt(max(1.0 - east * east - north * north, 0.0))
    mu0 = east * sun[0] + north * sun[1] + up * sun[2]
    mu = east * ex + north * ey + up * ez
    cx, cy, cz = ex - sun[0], ey - sun[1], ez - sun[2]
    return mu0, grazing(mu), cx * cx + cy * cy + cz * cz, ez


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
    posts: tuple[Posts, Halves],
    levels: Ints,
    scalars: tuple[float, float, float],
    camera: tuple[Floats, Floats, Floats, Floats],
    sun: tuple[Floats, float, int, Floats, Floats],
    scratch: Floats,
    out: tuple[Floats, Floats, Floats, Floats],
) -> None:
    """Write the vertices of blocks `begin` to `end`, 81 each.

    Parameters
    ----------
    blocks : (n, 3), level, first column, first row.
    posts, levels : heights and moments, and the table of a `Pyramid`.
    scalars : unit in metres, reach in metres, crowd: see `quadtree`.
    camera : place and velocity in the world (3,), camera_from_world (3, 3) and its rate, a second.
    sun : direction (3,), irradiance, law and its parameters, and radiance of the ambient light by the eye's height.
    scratch : (10, 81).
    out : positions (81 n, 3), velocities, radiance (81 n,), rate.
    """
    heights, moments = posts
    unit, reach, crowd = scalars
    place, moving, turn, turning = camera
    towards, irradiance, kind, law, ambient = sun
    positions, velocities, radiance, rates = out
    for k in range(begin, end):
        level = blocks[k, 0]
        offset, rows, columns = levels[level, 0], levels[level, 1], levels[level, 2]
        x0, y0, x_span, y_span = levels[level, 3], levels[level, 4], levels[level, 5], levels[level, 6]
        down, right = levels[level, 7], levels[level, 8]
        next_offset, next_columns = levels[level + 1, 0], levels[level + 1, 2]
        per_range = 1.0 / (reach * (1 << level) * _SPAN)
        for i in range(SIDE):
            row = min(blocks[k, 2] + i, rows - 1)
            even_row = min(blocks[k, 2] + (i & ~1), rows - 1)
            y = (y0 + min(row << level, y_span)) * unit
            next_y = (y0 + min(even_row << level, y_span)) * unit
            for j in range(SIDE):
                column = min(blocks[k, 1] + j, columns - 1)
                even_column = min(blocks[k, 1] + (j & ~1), columns - 1)
                own = offset + row * columns + column
                nxt = next_offset + ((even_row + 1) // 2 + down) * next_columns + (even_column + 1) // 2 + right
                x = (x0 + min(column << level, x_span)) * unit
                fx, fy, fz = x - place[0], y - place[1], heights[own] - place[2]
                far = math.sqrt(fx * fx + fy * fy + fz * fz)
                around_site = crowd * max(abs(x), abs(y))
                slid = (max(far, around_site) - _FIRST * reach * (1 << level)) * per_range
                sliding = 0.0
                if slid <= 0.0:
                    slid = 0.0
                elif slid >= 1.0:
                    slid = 1.0
                elif far > around_site:
                    sliding = -(fx * moving[0] + fy * moving[1] + fz * moving[2]) / far * per_range
                gx = (x0 + min(even_column << level, x_span)) * unit - x
                gy, gz = next_y - y, heights[nxt] - heights[own]
                rx, ry, rz = fx + slid * gx, fy + slid * gy, fz + slid * gz
                vx, vy, vz = sliding * gx - moving[0], sliding * gy - moving[1], sliding * gz - moving[2]
                at = k * CORNERS + i * SIDE + j
                for a in range(3):
                    positions[at, a] = turn[a, 0] * rx + turn[a, 1] * ry + turn[a, 2] * rz
                    velocities[at, a] = (
                        turn[a, 0] * vx
                        + turn[a, 1] * vy
                        + turn[a, 2] * vz
                        + turning[a, 0] * rx
                        + turning[a, 1] * ry
                        + turning[a, 2] * rz
                    )
                lit_own, east_own, north_own = _light_of(moments, own)
                lit_next, east_next, north_next = _light_of(moments, nxt)
                de, dn, db = east_next - east_own, north_next - north_own, lit_next - lit_own
                n = i * SIDE + j
                for when in range(2):
                    s = slid + when * sliding * LATER_S
                    t = when * LATER_S
                    east, north, lit = east_own + s * de, north_own + s * dn, lit_own + s * db
                    per_b = 1.0 / max(lit, 1e-9)
                    p, q = min(max(east * per_b, -10.0), 10.0), min(max(north * per_b, -10.0), 10.0)
                    up = 1.0 / math.sqrt(1.0 + p * p + q * q)
                    east, north = -p * up, -q * up
                    mu0, mu, chord2, height = _angles((rx + t * vx, ry + t * vy, rz + t * vz), east, north, towards)
                    lit = max(lit, 0.0)
                    mu0 = max(mu0, lit, 1e-6)
                    scratch[5 * when, n], scratch[5 * when + 1, n], scratch[5 * when + 2, n] = mu0, mu, chord2
                    scratch[5 * when + 3, n] = lit / mu0 * irradiance
                    scratch[5 * when + 4, n] = around(ambient, height)
        first = k * CORNERS
        now, later = radiance[first : first + CORNERS], rates[first : first + CORNERS]
        reflect(kind, law, scratch[0], scratch[1], scratch[2], CORNERS, now)
        reflect(kind, law, scratch[5], scratch[6], scratch[7], CORNERS, later)
        for n in range(CORNERS):
            now[n] = now[n] * scratch[3, n] + scratch[4, n]
            later[n] = (later[n] * scratch[8, n] + scratch[9, n] - now[n]) / LATER_S

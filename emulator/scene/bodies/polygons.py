"""Polygons in a plane whose corners move: cut by lines that move, and cut around others, with exact velocities.

The cutting is that of Sutherland and Hodgman 1974 (Reentrant polygon clipping, CACM 17 (1)), with derivatives: where a
side crosses a line, the new corner has the velocity of the crossing.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

__all__ = ["MOST_PIECES", "ROOM", "Pieces", "cut", "cut_around", "double_area", "side_of", "without_short_sides"]

ROOM = 24
"""Corners of a polygon; a cut adds one."""
MOST_PIECES = 64

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]
Six = tuple[float, float, float, float, float, float]
Cutter = tuple[float, float, float, float, float, float, float, float]
Pieces = tuple[Floats, Numbers, Numbers]
"""Twice (MOST_PIECES, ROOM, 6) corners and velocities, twice their numbers of corners, and rows of earlier polygons."""


@numba.njit(error_model="numpy")
def cut(polygon: Floats, n: int, cutter: Cutter, out: Floats) -> int:
    """Write the part of a polygon where a.x >= d, with velocities; return its corners.

    Parameters
    ----------
    polygon, out : (ROOM, 6), place and velocity.
    cutter : a and d, and their rates.
    """
    ax, ay, az, d, bx, by, bz, e = cutter
    count = 0
    for k in range(n):
        m = k + 1 if k + 1 < n else 0
        px, py, pz = polygon[k, 0], polygon[k, 1], polygon[k, 2]
        qx, qy, qz = polygon[m, 0], polygon[m, 1], polygon[m, 2]
        high0, high1 = ax * px + ay * py + az * pz - d, ax * qx + ay * qy + az * qz - d
        if high0 >= 0.0 and count < ROOM:
            for j in range(6):
                out[count, j] = polygon[k, j]
            count += 1
        if (high0 >= 0.0) != (high1 >= 0.0) and count < ROOM:
            rate0 = ax * polygon[k, 3] + ay * polygon[k, 4] + az * polygon[k, 5] + bx * px + by * py + bz * pz - e
            rate1 = ax * polygon[m, 3] + ay * polygon[m, 4] + az * polygon[m, 5] + bx * qx + by * qy + bz * qz - e
            fall = high0 - high1
            t = high0 / fall
            dt = (rate0 - t * (rate0 - rate1)) / fall
            for j in range(3):
                way = polygon[m, j] - polygon[k, j]
                out[count, j] = polygon[k, j] + t * way
                out[count, 3 + j] = polygon[k, 3 + j] + t * (polygon[m, 3 + j] - polygon[k, 3 + j]) + dt * way
            count += 1
    return count


@numba.njit(error_model="numpy")
def side_of(plane: Floats, ends: Six, moving: Six) -> Cutter:
    """Return the cutter through a side that keeps what is left of it, seen from outside.

    Parameters
    ----------
    plane : unit normal of the polygon's plane.
    ends : the side's first end and the way to the other; `moving`: the rates of both.
    """
    nx, ny, nz = plane[0], plane[1], plane[2]
    x, y, z, ex, ey, ez = ends
    vx, vy, vz, fx, fy, fz = moving
    ax, ay, az = ny * ez - nz * ey, nz * ex - nx * ez, nx * ey - ny * ex
    bx, by, bz = ny * fz - nz * fy, nz * fx - nx * fz, nx * fy - ny * fx
    d = ax * x + ay * y + az * z
    return ax, ay, az, d, bx, by, bz, bx * x + by * y + bz * z + ax * vx + ay * vy + az * vz


@numba.njit(error_model="numpy")
def without_short_sides(polygon: Floats, n: int, shortest_m: float) -> int:
    """Leave out corners that are so near the one before; return how many are left.

    The direction of a side between two corners that only rounding tells apart means nothing: it would part what
    overlaps.
    """
    count = 0
    for k in range(n):
        last = count - 1 if k < n - 1 or count < 2 else 0
        near = False
        for m in (count - 1, last):
            if m >= 0:
                x, y, z = polygon[k, 0] - polygon[m, 0], polygon[k, 1] - polygon[m, 1], polygon[k, 2] - polygon[m, 2]
                near = near or abs(x) + abs(y) + abs(z) <= shortest_m
        if not near:
            if count < k:
                polygon[count, :] = polygon[k, :]
            count += 1
    return count


@numba.njit(error_model="numpy")
def double_area(polygon: Floats, n: int, plane: Floats) -> float:
    """Return twice the area of a polygon, counter-clockwise as seen from outside."""
    area = 0.0
    x, y, z = polygon[0, 0], polygon[0, 1], polygon[0, 2]
    for k in range(1, n - 1):
        ux, uy, uz = polygon[k, 0] - x, polygon[k, 1] - y, polygon[k, 2] - z
        vx, vy, vz = polygon[k + 1, 0] - x, polygon[k + 1, 1] - y, polygon[k + 1, 2] - z
        area += plane[0] * (uy * vz - uz * vy) + plane[1] * (uz * vx - ux * vz) + plane[2] * (ux * vy - uy * vx)
    return area


@numba.njit(error_model="numpy")
def _side(polygon: Floats, first: int, n: int, k: int, plane: Floats) -> Cutter:
    """Return the cutter through side k of the polygon in rows first to first + n - 1, with places and velocities."""
    i, j = first + k, first + (k + 1 if k + 1 < n else 0)
    x, y, z, vx, vy, vz = polygon[i, 0], polygon[i, 1], polygon[i, 2], polygon[i, 3], polygon[i, 4], polygon[i, 5]
    way = (x, y, z, polygon[j, 0] - x, polygon[j, 1] - y, polygon[j, 2] - z)
    return side_of(plane, way, (vx, vy, vz, polygon[j, 3] - vx, polygon[j, 4] - vy, polygon[j, 5] - vz))


@numba.njit(error_model="numpy")
def _beside(
    p: Floats, p_first: int, p_n: int, q: Floats, q_first: int, q_n: int, plane: Floats, slack_m: float
) -> bool:
    """Return whether a side of polygon q has all of polygon p outside, or within `slack_m` of it."""
    for k in range(q_n):
        ax, ay, az, d, _, _, _, _ = _side(q, q_first, q_n, k, plane)
        slack = slack_m * (abs(ax) + abs(ay) + abs(az))
        outside = True
        for i in range(p_first, p_first + p_n):
            if ax * p[i, 0] + ay * p[i, 1] + az * p[i, 2] - d > slack:
                outside = False
                break
        if outside:
            return True
    return False


@numba.njit(error_model="numpy")
def cut_around(
    room: Pieces, earlier: int, places: Floats, plane: Floats, bounds: tuple[float, float]
) -> tuple[int, int]:
    """Cut the convex polygon in pieces[0, 0] around earlier convex ones; return how many pieces, and in which half.

    Parameters
    ----------
    room : pieces, numbers of their corners, and rows (first, count) of earlier polygons in `places`.
    bounds : overlaps as narrow as the first, m, do not count; pieces of at most the second, twice their area in m2, are
        left out.
    """
    pieces, counts, rows = room
    slack_m, least = bounds
    found, at = 1, 0
    for e in range(earlier):
        first, n = rows[e, 0], rows[e, 1]
        into, kept = 1 - at, 0
        for i in range(found):
            piece, m = pieces[at, i], counts[at, i]
            clear = _beside(piece, 0, m, places, first, n, plane, slack_m)
            clear = clear or _beside(places, first, n, piece, 0, m, plane, slack_m)
            if clear and kept < MOST_PIECES - 1:
                pieces[into, kept, :m] = piece[:m]
                counts[into, kept] = m
                kept += 1
            for k in range(0 if clear else n):
                ax, ay, az, d, bx, by, bz, rate = _side(places, first, n, k, plane)
                if kept < MOST_PIECES - 1:
                    outside = cut(piece, m, (-ax, -ay, -az, -d, -bx, -by, -bz, -rate), pieces[into, kept])
                    outside = without_short_sides(pieces[into, kept], outside, slack_m)
                    if outside >= 3 and double_area(pieces[into, kept], outside, plane) > least:
                        counts[into, kept] = outside
                        kept += 1
                m = cut(piece, m, (ax, ay, az, d, bx, by, bz, rate), pieces[into, MOST_PIECES - 1])
                if m < 3:
                    break
                piece[:m] = pieces[into, MOST_PIECES - 1, :m]
        found, at = kept, into
    return found, at

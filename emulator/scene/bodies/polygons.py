"""Polygons in a plane whose corners move: clipped by moving lines, cut around other polygons, with exact velocities.

The clipping is that of Sutherland and Hodgman 1974 (Reentrant polygon clipping, CACM 17 (1)), with derivatives: where a
side crosses a line, the new corner has the velocity of the crossing.

The module also selects the triangles that may cover a part of a facet, as seen from the Sun, or from all directions
near the Sun's.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import Arrays, Frame, after
from emulator.scene.bodies.compiled import kernel

ROOM = 24
"""Corners of a polygon; a cut adds one."""
MOST_PIECES = 64

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]
Six = tuple[float, float, float, float, float, float]
Cutter = tuple[float, float, float, float, float, float, float, float]
Pieces = tuple[Floats, Numbers, Numbers]
"""Twice (MOST_PIECES, ROOM, 6) corners and velocities, twice their numbers of corners, and rows of earlier polygons."""


@kernel
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


@kernel
def copy_corners(polygon: Floats, n: int, out: Floats) -> None:
    """Copy n corners."""
    for k in range(n):
        for j in range(6):
            out[k, j] = polygon[k, j]


@kernel
def side_of(plane: Floats, ends: Six, moving: Six) -> Cutter:
    """Return the cutter through a side that keeps the part to its left, seen from outside.

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


@kernel
def without_short_sides(polygon: Floats, n: int, shortest_m: float) -> int:
    """Remove corners that are within `shortest_m` of the one before; return the number left.

    A side between two corners that differ by rounding only has a random direction: as a cutter it would separate
    polygons that overlap.
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
                for j in range(6):
                    polygon[count, j] = polygon[k, j]
            count += 1
    return count


@kernel
def double_area(polygon: Floats, n: int, plane: Floats) -> float:
    """Return twice the area of a polygon, counter-clockwise as seen from outside."""
    area = 0.0
    x, y, z = polygon[0, 0], polygon[0, 1], polygon[0, 2]
    for k in range(1, n - 1):
        ux, uy, uz = polygon[k, 0] - x, polygon[k, 1] - y, polygon[k, 2] - z
        vx, vy, vz = polygon[k + 1, 0] - x, polygon[k + 1, 1] - y, polygon[k + 1, 2] - z
        area += plane[0] * (uy * vz - uz * vy) + plane[1] * (uz * vx - ux * vz) + plane[2] * (ux * vy - uy * vx)
    return area


@kernel
def _side(polygon: Floats, first: int, n: int, k: int, plane: Floats) -> Cutter:
    """Return the cutter through side k of the polygon in rows first to first + n - 1, with places and velocities."""
    i, j = first + k, first + (k + 1 if k + 1 < n else 0)
    x, y, z, vx, vy, vz = polygon[i, 0], polygon[i, 1], polygon[i, 2], polygon[i, 3], polygon[i, 4], polygon[i, 5]
    way = (x, y, z, polygon[j, 0] - x, polygon[j, 1] - y, polygon[j, 2] - z)
    return side_of(plane, way, (vx, vy, vz, polygon[j, 3] - vx, polygon[j, 4] - vy, polygon[j, 5] - vz))


@kernel
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


@kernel
def cut_around(
    room: Pieces, earlier: int, places: Floats, plane: Floats, bounds: tuple[float, float]
) -> tuple[int, int]:
    """Cut the convex polygon in pieces[0, 0] around earlier convex ones; return the number of pieces, and their half.

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
        into, count = 1 - at, 0
        for i in range(found):
            piece, m = pieces[at, i], counts[at, i]
            clear = _beside(piece, 0, m, places, first, n, plane, slack_m)
            clear = clear or _beside(places, first, n, piece, 0, m, plane, slack_m)
            if clear and count < MOST_PIECES - 1:
                copy_corners(piece, m, pieces[into, count])
                counts[into, count] = m
                count += 1
            for k in range(0 if clear else n):
                ax, ay, az, d, bx, by, bz, rate = _side(places, first, n, k, plane)
                if count < MOST_PIECES - 1:
                    outside = cut(piece, m, (-ax, -ay, -az, -d, -bx, -by, -bz, -rate), pieces[into, count])
                    outside = without_short_sides(pieces[into, count], outside, slack_m)
                    if outside >= 3 and double_area(pieces[into, count], outside, plane) > least:
                        counts[into, count] = outside
                        count += 1
                m = cut(piece, m, (ax, ay, az, d, bx, by, bz, rate), pieces[into, MOST_PIECES - 1])
                if m < 3:
                    break
                copy_corners(pieces[into, MOST_PIECES - 1], m, piece)
        found, at = count, into
    return found, at


_EMPTY = 1e300


Extent = tuple[float, float, float, float, float]
"""A facet's box as seen from the Sun, and how far towards the Sun it begins, m."""
Wide = tuple[float, float]
"""Tangent and sine of an angle by which the Sun may turn."""


@kernel
def extent_of(corners: Floats, axes: Frame) -> Extent:
    """Return the box of a facet as seen from the Sun, and how far towards the Sun it begins."""
    low_u = low_v = low_w = _EMPTY
    high_u = high_v = -_EMPTY
    for k in range(3):
        x, y, z = corners[3 * k], corners[3 * k + 1], corners[3 * k + 2]
        u, v = x * axes[0] + y * axes[1] + z * axes[2], x * axes[3] + y * axes[4] + z * axes[5]
        low_u, high_u, low_v, high_v = min(low_u, u), max(high_u, u), min(low_v, v), max(high_v, v)
        low_w = min(low_w, x * axes[6] + y * axes[7] + z * axes[8])
    return low_u, high_u, low_v, high_v, low_w


@kernel
def may_cover(
    boxes: Floats, node: int, plane: Floats, above: float, seen: tuple[Frame, Extent], tangent: float
) -> bool:
    """Return whether a box reaches above a facet's plane and, seen from the Sun, meets the facet's box.

    With a tangent above 0: or from a direction that is so far from the Sun's.
    """
    axes, extent = seen
    x, y, z, hx, hy, hz = boxes[node, 0], boxes[node, 1], boxes[node, 2], boxes[node, 3], boxes[node, 4], boxes[node, 5]
    high = plane[0] * x + plane[1] * y + plane[2] * z + abs(plane[0]) * hx + abs(plane[1]) * hy + abs(plane[2]) * hz
    if not high > above:
        return False
    u, v = x * axes[0] + y * axes[1] + z * axes[2], x * axes[3] + y * axes[4] + z * axes[5]
    half_u = hx * abs(axes[0]) + hy * abs(axes[1]) + hz * abs(axes[2])
    half_v = hx * abs(axes[3]) + hy * abs(axes[4]) + hz * abs(axes[5])
    if tangent > 0.0:
        half_w = hx * abs(axes[6]) + hy * abs(axes[7]) + hz * abs(axes[8])
        far = x * axes[6] + y * axes[7] + z * axes[8] + half_w - extent[4]
        half_u, half_v = half_u + max(far, 0.0) * tangent, half_v + max(far, 0.0) * tangent
    beside_u = u + half_u < extent[0] or u - half_u > extent[1]
    return not (beside_u or v + half_v < extent[2] or v - half_v > extent[3])


@kernel
def _nears(
    corners: Floats, outside: Floats, plane: Floats, near_m: float, seen: tuple[Frame, Extent], wide: Wide
) -> bool:
    """Return whether a triangle may cover a part of a facet while the Sun turns by at most so much."""
    axes, extent = seen
    tangent, sine = wide
    if outside[0] * axes[6] + outside[1] * axes[7] + outside[2] * axes[8] >= sine:
        return False
    high = far = -_EMPTY
    for k in range(3):
        x, y, z = corners[3 * k], corners[3 * k + 1], corners[3 * k + 2]
        high = max(high, plane[0] * x + plane[1] * y + plane[2] * z)
        far = max(far, x * axes[6] + y * axes[7] + z * axes[8])
    if not high > plane[3] + near_m:
        return False
    low_u, high_u, low_v, high_v, _ = extent_of(corners, axes)
    wider = max(far - extent[4], 0.0) * tangent
    beside = high_u + wider < extent[0] or low_u - wider > extent[1]
    return not (beside or high_v + wider < extent[2] or low_v - wider > extent[3])


@kernel
def list_near(
    tree: Arrays, plane: Floats, near_m: float, seen: tuple[Frame, Extent], wide: Wide, listed: Numbers
) -> int:
    """Write the triangles that may cover a part of a facet, as many as there is room for; return their number."""
    boxes, starts, triangles, planes = tree
    leaves, node, count = len(starts) - 1, 1, 0
    while True:
        if may_cover(boxes, node, plane, plane[3] + near_m, seen, wide[0]):
            if node < leaves:
                node *= 2
                continue
            for k in range(starts[node - leaves], starts[node - leaves + 1]):
                if _nears(triangles[k], planes[k], plane, near_m, seen, wide):
                    if count < len(listed):
                        listed[count] = k
                    count += 1
        node = after(node)
        if node == 1:
            return count


@kernel
def covers(triangle: Floats, outside: Floats, plane: Floats, above: float, seen: tuple[Frame, Extent]) -> bool:
    """Return whether a triangle that shows the Sun its inside may cover a part of a facet."""
    axes, extent = seen
    if outside[0] * axes[6] + outside[1] * axes[7] + outside[2] * axes[8] >= 0.0:
        return False
    high = -_EMPTY
    for k in range(3):
        x, y, z = triangle[3 * k], triangle[3 * k + 1], triangle[3 * k + 2]
        high = max(high, plane[0] * x + plane[1] * y + plane[2] * z)
    low_u, high_u, low_v, high_v, _ = extent_of(triangle, axes)
    beside = high_u < extent[0] or low_u > extent[1] or high_v < extent[2] or low_v > extent[3]
    return high > above and not beside

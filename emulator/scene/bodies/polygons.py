"""Polygons in a plane whose corners move: clipped by moving lines, cut around other polygons, with exact velocities.

The clipping is that of Sutherland and Hodgman 1974 (Reentrant polygon clipping, CACM 17 (1)), with derivatives: where a
side crosses a line, the new corner has the velocity of the crossing.

The module also selects the triangles that may cover a part of a facet, as seen from the Sun, or from all directions
near the Sun's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import Frame, TriangleTree, after, outward_of
from emulator.scene.bodies.compiled import dot, kernel

ROOM = 24
"""Corners of a polygon; a cut adds one."""
MOST_PIECES = 64

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]


class Cutter(NamedTuple):
    """A moving line in a plane: a polygon's part where a.x >= d is kept; the rates of a and d."""

    ax: float
    ay: float
    az: float
    d: float
    ax_rate: float
    ay_rate: float
    az_rate: float
    d_rate: float


class Segment(NamedTuple):
    """A side's first end and the way to the other, or the rates of both."""

    x: float
    y: float
    z: float
    along_x: float
    along_y: float
    along_z: float


class Pieces(NamedTuple):
    """Room for the pieces of a polygon.

    Attributes
    ----------
    corners : (2, MOST_PIECES, ROOM, 6), places and velocities; a half is read while the other one is written.
    counts : (2, MOST_PIECES), numbers of corners.
    earlier : (n, 2), first row and number of rows of earlier polygons.
    """

    corners: Floats
    counts: Numbers
    earlier: Numbers


class Extent(NamedTuple):
    """A facet's box as seen from the Sun, and how far towards the Sun it begins, m."""

    low_u: float
    high_u: float
    low_v: float
    high_v: float
    low_w: float


class Seen(NamedTuple):
    """A facet as seen from the Sun: the axes around its direction, and the box."""

    axes: Frame
    extent: Extent


class Wide(NamedTuple):
    """Tangent and sine of an angle by which the Sun may turn."""

    tangent: float
    sine: float


@kernel
def cut(polygon: Floats, n: int, cutter: Cutter, out: Floats) -> int:
    """Write the part of a polygon that a cutter keeps; return its corners.

    `polygon` and `out` are (ROOM, 6), place and velocity.
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
        # Where a side crosses: at the share t of it, which changes as both heights do.
        if (high0 >= 0.0) != (high1 >= 0.0) and count < ROOM:
            rate0 = ax * polygon[k, 3] + ay * polygon[k, 4] + az * polygon[k, 5] + bx * px + by * py + bz * pz - e
            rate1 = ax * polygon[m, 3] + ay * polygon[m, 4] + az * polygon[m, 5] + bx * qx + by * qy + bz * qz - e
            fall = high0 - high1
            t = high0 / fall
            dt = (rate0 - t * (rate0 - rate1)) / fall
            for j in range(3):
                along = polygon[m, j] - polygon[k, j]
                out[count, j] = polygon[k, j] + t * along
                out[count, 3 + j] = polygon[k, 3 + j] + t * (polygon[m, 3 + j] - polygon[k, 3 + j]) + dt * along
            count += 1
    return count


@kernel
def copy_corners(polygon: Floats, n: int, out: Floats) -> None:
    """Copy n corners."""
    for k in range(n):
        for j in range(6):
            out[k, j] = polygon[k, j]


@kernel
def side_of(plane: Floats, side: Segment, rates: Segment) -> Cutter:
    """Return the cutter through a side that keeps the part to its left, seen from outside.

    `plane` is the unit normal of the polygon's plane.
    """
    nx, ny, nz = plane[0], plane[1], plane[2]
    x, y, z, ex, ey, ez = side
    vx, vy, vz, fx, fy, fz = rates
    # a = n x side, and its rate.
    ax, ay, az = ny * ez - nz * ey, nz * ex - nx * ez, nx * ey - ny * ex
    bx, by, bz = ny * fz - nz * fy, nz * fx - nx * fz, nx * fy - ny * fx
    d = ax * x + ay * y + az * z
    return Cutter(ax, ay, az, d, bx, by, bz, bx * x + by * y + bz * z + ax * vx + ay * vy + az * vz)


@kernel
def without_short_sides(polygon: Floats, n: int, shortest_m: float) -> int:
    """Remove corners that are within `shortest_m` of the one before; return the number left.

    A side between two corners that differ by rounding only has a random direction: as a cutter it would separate
    polygons that overlap.
    """
    count = 0
    for k in range(n):
        last = count - 1 if k < n - 1 or count < 2 else 0
        is_near = False
        for m in (count - 1, last):
            if m >= 0:
                x, y, z = polygon[k, 0] - polygon[m, 0], polygon[k, 1] - polygon[m, 1], polygon[k, 2] - polygon[m, 2]
                is_near = is_near or abs(x) + abs(y) + abs(z) <= shortest_m
        if not is_near:
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
    x, y, z = polygon[i, 0], polygon[i, 1], polygon[i, 2]
    vx, vy, vz = polygon[i, 3], polygon[i, 4], polygon[i, 5]
    side = Segment(x, y, z, polygon[j, 0] - x, polygon[j, 1] - y, polygon[j, 2] - z)
    rates = Segment(vx, vy, vz, polygon[j, 3] - vx, polygon[j, 4] - vy, polygon[j, 5] - vz)
    return side_of(plane, side, rates)


@kernel
def _beside(
    p: Floats, p_first: int, p_n: int, q: Floats, q_first: int, q_n: int, plane: Floats, slack_m: float
) -> bool:
    """Return whether a side of polygon q has all of polygon p outside, or within `slack_m` of it."""
    for k in range(q_n):
        side = _side(q, q_first, q_n, k, plane)
        ax, ay, az, d = side.ax, side.ay, side.az, side.d
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
    room: Pieces, earlier: int, places: Floats, plane: Floats, slack_m: float, least_m2: float
) -> tuple[int, int]:
    """Cut the convex polygon in pieces[0, 0] around earlier convex ones; return the number of pieces, and their half.

    Parameters
    ----------
    places : in which `room.earlier` are rows.
    slack_m : overlaps as narrow as this do not count.
    least_m2 : pieces of at most this, twice their area, are left out.
    """
    pieces, counts, rows = room
    pieces_now, at = 1, 0
    for e in range(earlier):
        first, n = rows[e, 0], rows[e, 1]
        into, count = 1 - at, 0
        for i in range(pieces_now):
            # A piece beside the earlier polygon stays. Of others, what is outside of one side after another is cut off
            # as a piece of its own; what is left at the end is within.
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
                    outside = cut(piece, m, Cutter(-ax, -ay, -az, -d, -bx, -by, -bz, -rate), pieces[into, count])
                    outside = without_short_sides(pieces[into, count], outside, slack_m)
                    if outside >= 3 and double_area(pieces[into, count], outside, plane) > least_m2:
                        counts[into, count] = outside
                        count += 1
                m = cut(piece, m, Cutter(ax, ay, az, d, bx, by, bz, rate), pieces[into, MOST_PIECES - 1])
                if m < 3:
                    break
                copy_corners(pieces[into, MOST_PIECES - 1], m, piece)
        pieces_now, at = count, into
    return pieces_now, at


_EMPTY = 1e300


@kernel
def extent_of(corners: Floats, axes: Frame) -> Extent:
    """Return the box of a facet as seen from the Sun, and how far towards the Sun it begins."""
    low_u = low_v = low_w = _EMPTY
    high_u = high_v = -_EMPTY
    for k in range(3):
        x, y, z = corners[3 * k], corners[3 * k + 1], corners[3 * k + 2]
        u, v = x * axes.ux + y * axes.uy + z * axes.uz, x * axes.vx + y * axes.vy + z * axes.vz
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
        low_w = min(low_w, x * axes.wx + y * axes.wy + z * axes.wz)
    return Extent(low_u, high_u, low_v, high_v, low_w)


@kernel
def may_cover(boxes: Floats, node: int, plane: Floats, above: float, seen: Seen, tangent: float) -> bool:
    """Return whether a box reaches above a facet's plane and, seen from the Sun, meets the facet's box.

    With a tangent above 0: or from a direction that is so far from the Sun's.
    """
    axes, extent = seen
    x, y, z = boxes[node, 0], boxes[node, 1], boxes[node, 2]
    hx, hy, hz = boxes[node, 3], boxes[node, 4], boxes[node, 5]
    high = plane[0] * x + plane[1] * y + plane[2] * z + abs(plane[0]) * hx + abs(plane[1]) * hy + abs(plane[2]) * hz
    if not high > above:
        return False
    u, v = x * axes.ux + y * axes.uy + z * axes.uz, x * axes.vx + y * axes.vy + z * axes.vz
    half_u = hx * abs(axes.ux) + hy * abs(axes.uy) + hz * abs(axes.uz)
    half_v = hx * abs(axes.vx) + hy * abs(axes.vy) + hz * abs(axes.vz)
    if tangent > 0.0:
        half_w = hx * abs(axes.wx) + hy * abs(axes.wy) + hz * abs(axes.wz)
        distance = x * axes.wx + y * axes.wy + z * axes.wz + half_w - extent.low_w
        half_u, half_v = half_u + max(distance, 0.0) * tangent, half_v + max(distance, 0.0) * tangent
    beside_u = u + half_u < extent.low_u or u - half_u > extent.high_u
    return not (beside_u or v + half_v < extent.low_v or v - half_v > extent.high_v)


@kernel
def _nears(corners: Floats, plane: Floats, near_m: float, seen: Seen, wide: Wide) -> bool:
    """Return whether a triangle may cover a part of a facet while the Sun turns by at most so much."""
    axes, extent = seen
    outward = outward_of(corners)
    if dot(outward, (axes.wx, axes.wy, axes.wz)) >= wide.sine * math.sqrt(dot(outward, outward)):
        return False
    high = high_w = -_EMPTY
    for k in range(3):
        x, y, z = corners[3 * k], corners[3 * k + 1], corners[3 * k + 2]
        high = max(high, plane[0] * x + plane[1] * y + plane[2] * z)
        high_w = max(high_w, x * axes.wx + y * axes.wy + z * axes.wz)
    if not high > plane[3] + near_m:
        return False
    box = extent_of(corners, axes)
    wider = max(high_w - extent.low_w, 0.0) * wide.tangent
    beside_u = box.high_u + wider < extent.low_u or box.low_u - wider > extent.high_u
    return not (beside_u or box.high_v + wider < extent.low_v or box.low_v - wider > extent.high_v)


@kernel
def list_near(tree: TriangleTree, plane: Floats, near_m: float, seen: Seen, wide: Wide, listed: Numbers) -> int:
    """Write the triangles that may cover a part of a facet, as many as there is room for; return their number."""
    boxes, sizes, triangles = tree
    leaves, node, count = len(sizes), 1, 0
    while True:
        if may_cover(boxes, node, plane, plane[3] + near_m, seen, wide.tangent):
            if node < leaves:
                node *= 2
                continue
            leaf = node - leaves
            for j in range(sizes[leaf]):
                if _nears(triangles[leaf, :, j], plane, near_m, seen, wide):
                    if count < len(listed):
                        listed[count] = triangles.shape[2] * leaf + j
                    count += 1
        node = after(node)
        if node == 1:
            return count


@kernel
def covers(triangle: Floats, plane: Floats, above: float, seen: Seen) -> bool:
    """Return whether a triangle that shows the Sun its inside may cover a part of a facet."""
    axes, extent = seen
    if dot(outward_of(triangle), (axes.wx, axes.wy, axes.wz)) >= 0.0:
        return False
    high = -_EMPTY
    for k in range(3):
        x, y, z = triangle[3 * k], triangle[3 * k + 1], triangle[3 * k + 2]
        high = max(high, plane[0] * x + plane[1] * y + plane[2] * z)
    box = extent_of(triangle, axes)
    beside_u = box.high_u < extent.low_u or box.low_u > extent.high_u
    return high > above and not (beside_u or box.high_v < extent.low_v or box.low_v > extent.high_v)

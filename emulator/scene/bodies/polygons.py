"""Polygons in a plane whose corners move: clipped by moving lines, cut around other polygons, with exact velocities.

The clipping is that of Sutherland and Hodgman 1974 (Reentrant polygon clipping, CACM 17 (1)), with derivatives: where a
side crosses a line, the new corner has the velocity of the crossing.

The module also selects the triangles that may cover a part of a facet, as seen from the Sun, or from all directions
near the Sun's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from emulator.scene.bodies.cast_shadow import Frame, TriangleTree, after, half_of, middle_of, outward_of
from emulator.scene.bodies.compiled import ZERO, Numbers, Point, cross, dot, kernel, minus, row, vertex
from firmware_protocol.events import Floats

ROOM = 24
"""Corners of a polygon; a cut adds one."""
MOST_PIECES = 64


class Cutter(NamedTuple):
    """A moving line in a plane: a polygon's part where a.x >= d is kept; the rates of a and d."""

    a: Point
    d: float
    a_rate: Point
    d_rate: float


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


@kernel
def _velocity(polygon: Floats, k: int) -> Point:
    """Return the velocity of corner k."""
    return polygon[k, 3], polygon[k, 4], polygon[k, 5]


@kernel
def cut(polygon: Floats, n: int, cutter: Cutter, out: Floats) -> int:
    """Write the part of a polygon that a cutter keeps; return its corners.

    `polygon` and `out` are (ROOM, 6), place and velocity.
    """
    count = 0
    for k in range(n):
        m = k + 1 if k + 1 < n else 0
        p, q = row(polygon, k), row(polygon, m)
        high0, high1 = dot(cutter.a, p) - cutter.d, dot(cutter.a, q) - cutter.d
        if high0 >= 0.0 and count < ROOM:
            for j in range(6):
                out[count, j] = polygon[k, j]
            count += 1
        # Where a side crosses: at the share t of it, which changes as both heights do.
        if (high0 >= 0.0) != (high1 >= 0.0) and count < ROOM:
            rate0 = dot(cutter.a, _velocity(polygon, k)) + dot(cutter.a_rate, p) - cutter.d_rate
            rate1 = dot(cutter.a, _velocity(polygon, m)) + dot(cutter.a_rate, q) - cutter.d_rate
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
def side_of(plane: Floats, first: Point, along: Point, velocity: Point, along_rate: Point) -> Cutter:
    """Return the cutter through a side that keeps the part to its left, seen from outside.

    `plane` begins with the unit normal of the polygon's plane; `first` is an end, `along` the vector to the other one.
    """
    normal = plane[0], plane[1], plane[2]
    a, a_rate = cross(normal, along), cross(normal, along_rate)
    return Cutter(a, dot(a, first), a_rate, dot(a_rate, first) + dot(a, velocity))


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
    normal, first = (plane[0], plane[1], plane[2]), row(polygon, 0)
    for k in range(1, n - 1):
        area += dot(normal, cross(minus(row(polygon, k), first), minus(row(polygon, k + 1), first)))
    return area


@kernel
def _side(polygon: Floats, first: int, n: int, k: int, plane: Floats) -> Cutter:
    """Return the cutter through side k of the polygon in rows first to first + n - 1, with places and velocities."""
    i, j = first + k, first + (k + 1 if k + 1 < n else 0)
    place, velocity = row(polygon, i), _velocity(polygon, i)
    return side_of(plane, place, minus(row(polygon, j), place), velocity, minus(_velocity(polygon, j), velocity))


@kernel
def _beside(
    p: Floats, p_first: int, p_n: int, q: Floats, q_first: int, q_n: int, plane: Floats, slack_m: float
) -> bool:
    """Return whether a side of polygon q has all of polygon p outside, or within `slack_m` of it."""
    for k in range(q_n):
        side = _side(q, q_first, q_n, k, plane)
        slack = slack_m * (abs(side.a[0]) + abs(side.a[1]) + abs(side.a[2]))
        outside = True
        for i in range(p_first, p_first + p_n):
            if dot(side.a, row(p, i)) - side.d > slack:
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
                side = _side(places, first, n, k, plane)
                if count < MOST_PIECES - 1:
                    a, a_rate = minus(ZERO, side.a), minus(ZERO, side.a_rate)
                    outside = cut(piece, m, Cutter(a, -side.d, a_rate, -side.d_rate), pieces[into, count])
                    outside = without_short_sides(pieces[into, count], outside, slack_m)
                    if outside >= 3 and double_area(pieces[into, count], outside, plane) > least_m2:
                        counts[into, count] = outside
                        count += 1
                m = cut(piece, m, side, pieces[into, MOST_PIECES - 1])
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
        corner = vertex(corners, k)
        u, v = dot(corner, axes.u), dot(corner, axes.v)
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
        low_w = min(low_w, dot(corner, axes.w))
    return Extent(low_u, high_u, low_v, high_v, low_w)


@kernel
def may_cover(boxes: Floats, node: int, plane: Floats, above: float, seen: Seen, tangent: float) -> bool:
    """Return whether a box reaches above a facet's plane and, seen from the Sun, meets the facet's box.

    With a tangent above 0: or from a direction that is so far from the Sun's.
    """
    axes, extent = seen
    middle = middle_of(boxes, node)
    normal = plane[0], plane[1], plane[2]
    if not dot(normal, middle) + _half(boxes, node, normal) > above:
        return False
    u, v = dot(middle, axes.u), dot(middle, axes.v)
    half_u, half_v = _half(boxes, node, axes.u), _half(boxes, node, axes.v)
    if tangent > 0.0:
        distance = dot(middle, axes.w) + _half(boxes, node, axes.w) - extent.low_w
        half_u, half_v = half_u + max(distance, 0.0) * tangent, half_v + max(distance, 0.0) * tangent
    return not _is_beside(Extent(u - half_u, u + half_u, v - half_v, v + half_v, 0.0), 0.0, extent)


@kernel
def _half(boxes: Floats, node: int, axis: Point) -> float:
    """Return half the extent of a box along an axis."""
    return float(dot(half_of(boxes, node), (abs(axis[0]), abs(axis[1]), abs(axis[2]))))


@kernel
def _is_beside(box: Extent, wider: float, extent: Extent) -> bool:
    """Return whether a box, wider on each side, does not meet the other one as seen from the Sun."""
    beside_u = box.high_u + wider < extent.low_u or box.low_u - wider > extent.high_u
    return beside_u or box.high_v + wider < extent.low_v or box.low_v - wider > extent.high_v


@kernel
def _height(triangle: Floats, axis: Point) -> float:
    """Return how far a triangle reaches along an axis."""
    return float(max(dot(vertex(triangle, 0), axis), dot(vertex(triangle, 1), axis), dot(vertex(triangle, 2), axis)))


@kernel
def covers(triangle: Floats, plane: Floats, above: float, seen: Seen, sine: float, tangent: float) -> bool:
    """Return whether a triangle may show the Sun its inside and cover a part of a facet.

    `sine` and `tangent` are those of the angle by which the Sun may turn.
    """
    axes, extent = seen
    outward = outward_of(triangle)
    if dot(outward, axes.w) >= sine * math.sqrt(dot(outward, outward)):
        return False
    if not _height(triangle, (plane[0], plane[1], plane[2])) > above:
        return False
    wider = max(_height(triangle, axes.w) - extent.low_w, 0.0) * tangent
    return not _is_beside(extent_of(triangle, axes), wider, extent)


@kernel
def list_near(tree: TriangleTree, plane: Floats, above: float, seen: Seen, wide_rad: float, listed: Numbers) -> int:
    """Write the triangles that may cover a part of a facet, as many as there is room for; return their number."""
    boxes, sizes, triangles, _ = tree
    sine, tangent = math.sin(wide_rad), math.tan(wide_rad)
    leaves, node, count = len(sizes), 1, 0
    while True:
        if may_cover(boxes, node, plane, above, seen, tangent):
            if node < leaves:
                node *= 2
                continue
            leaf = node - leaves
            for j in range(sizes[leaf]):
                if covers(triangles[leaf, :, j], plane, above, seen, sine, tangent):
                    if count < len(listed):
                        listed[count] = triangles.shape[2] * leaf + j
                    count += 1
        node = after(node)
        if node == 1:
            return count

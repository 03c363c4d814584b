"""Cast shadows: the share of the Sun's disc that triangles cover, seen from points, without a shadow map or samples.

From a point the Sun is a disc. Each triangle that shows its outside to the point and reaches into the cone of that disc
covers the part of it that lies in the projected triangle. This part has a closed formula: a sum over the edges of the
polygon (Green's theorem), of triangles with the centre where the edge is inside the disc, and of sectors where it is
outside. The triangles of a closed surface tile without gaps. So the sum is exact for one layer, the edges between
triangles leave no trace, and the share changes smoothly in time. Where two layers cover different parts of the disc
their areas are added, at most to the whole disc, although they may overlap: that is too dark by up to the overlap,
inside a penumbra only.

A triangle shows its outside to points that lie above its plane by `near_m`, so a facet and its neighbours in one plane
never hide the Sun from their own points.

A straight edge has its own formula. With a disc of radius 1 and everything below the line y = -x hidden, -1 <= x <= 1:

    visible share       1/2 + (x sqrt(1 - x^2) + asin x) / pi
    mean y of it        2/3 (1 - x^2)^(3/2) / (pi share)

The mean height of the visible part raises the cosine of incidence: a surface that is turned away from the Sun's centre
by less than its radius still receives light, so the terminator has no kink.

The triangles of each rigid body are in a tree of boxes, built once, for rays and cones from any point. It is a complete
binary tree in a heap: node 1 is the root, node i has the children 2 i and 2 i + 1, and the last level holds the leaves.
Triangles are split at the median of their centres along the longest side of their box. The traversal runs from left to
right and needs no stack: after node i comes 2 i, or `after(i)` where i is skipped.

Fast because it skips boxes beside the cone and ends where the disc is covered; 0 and 1 have no second evaluation.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from emulator.scene.bodies.compiled import ZERO, Point, cross, dot, entry, kernel, minus, plus, row, vertex
from firmware_protocol.events import Floats, Int32s, Int64s


@kernel
def seen_above(x: float) -> tuple[float, float]:
    """Return the share of the disc above the line y = -x, and the mean y of that part."""
    if x >= 1.0:
        return 1.0, 0.0
    if not x > -1.0:
        return 0.0, 0.0
    half = math.sqrt(1.0 - x * x)
    share = 0.5 + (x * half + math.asin(x)) / math.pi
    if share < 1e-9:  # a sliver: its mean is its rim
        return 0.0, 1.0
    return share, 2.0 / 3.0 * half * half * half / (math.pi * share)


@kernel
def _sector(ax: float, ay: float, bx: float, by: float) -> float:
    return 0.5 * math.atan2(ax * by - ay * bx, ax * bx + ay * by)


@kernel
def edge_area(ax: float, ay: float, bx: float, by: float) -> float:
    """Return the signed area between the middle of the unit disc and the edge from a to b, inside the disc."""
    dx, dy = bx - ax, by - ay
    length2 = dx * dx + dy * dy
    cross = ax * dy - ay * dx
    room = length2 - cross * cross  # above 0 where the line cuts the circle
    if not room > 0.0:
        return _sector(ax, ay, bx, by)
    root, along = math.sqrt(room), -(ax * dx + ay * dy)
    t0, t1 = (along - root) / length2, (along + root) / length2
    if t1 <= 0.0 or t0 >= 1.0:
        return _sector(ax, ay, bx, by)
    area = 0.0
    # Sectors up to where the edge enters the disc, from p to q a triangle, and sectors from where it leaves.
    px, py = ax, ay
    qx, qy = bx, by
    if t0 > 0.0:
        px, py = ax + t0 * dx, ay + t0 * dy
        area += _sector(ax, ay, px, py)
    if t1 < 1.0:
        qx, qy = ax + t1 * dx, ay + t1 * dy
        area += _sector(qx, qy, bx, by)
    return area + 0.5 * (px * qy - py * qx)


LEAF = 8  # most triangles of a leaf: with 4 boxes take twice the memory, and rays as much time


class TriangleTree(NamedTuple):
    """Triangles in the order of the tree's leaves.

    Attributes
    ----------
    boxes : (2 leaves, 6) float64, m, the middle and half the sides of each node; row 0 is not used.
    sizes : (leaves,) int32, the number of triangles of each leaf.
    corners : (leaves, 9, most) float64, m, the corners of each triangle of a leaf, counter-clockwise as seen from
        outside; 0 where it has fewer than others. Triangle k is the one in column k % most of leaf k // most.
    """

    boxes: Floats
    sizes: Int32s
    corners: Floats

    @property
    def middle_m(self) -> Floats:
        """The middle of the box around all, (3,)."""
        return self.boxes[1, :3]

    @property
    def radius_m(self) -> float:
        """Radius of a sphere around the middle that contains all triangles."""
        return float(np.linalg.norm(self.boxes[1, 3:]))


def build_tree(triangles: Floats) -> TriangleTree:
    """Return the tree of (m, 3, 3) corners, m; at least one."""
    depth = max(0, math.ceil(math.log2(max(len(triangles) / LEAF, 1.0))))
    starts = np.rint(np.arange(2**depth + 1) * (len(triangles) / 2**depth)).astype(np.int32)
    order = np.arange(len(triangles))
    sort_by_leaves(triangles.mean(axis=1), starts, depth, order)
    sizes = np.diff(starts)
    boxes, corners = np.zeros((2 * len(sizes), 6)), np.zeros((len(sizes), 9, int(sizes.max())))
    _fill(triangles, starts, order, boxes, corners)
    return TriangleTree(boxes, sizes, corners)


@kernel
def _select(places: Floats, axis: int, order: Int64s, low: int, high: int, middle: int) -> None:
    """Reorder entries low to high - 1 so that the lowest along an axis come before `middle`: Hoare's selection."""
    last = high - 1
    while low < last:
        pivot = places[order[(low + last) // 2], axis]
        i, j = low, last
        while i <= j:
            while places[order[i], axis] < pivot:
                i += 1
            while places[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            last = j
        elif middle >= i:
            low = i
        else:
            return


@entry
def sort_by_leaves(middles: Floats, starts: Int32s, depth: int, order: Int64s) -> None:
    """Sort triangles by the leaves of their tree: at each node the lower half along the longest side comes first.

    Parameters
    ----------
    middles : (m, 3), of the triangles.
    starts, depth : of the leaves, see `TriangleTree`; levels of nodes above them.
    order : (m,), the triangles, sorted in place.
    """
    for level in range(depth):
        step = 1 << (depth - level)
        for first in range(0, 1 << depth, step):
            low: Any = np.int64(starts[first])
            split: Any = np.int64(starts[first + step // 2])
            high: Any = np.int64(starts[first + step])
            widest, axis = -1.0, 0
            for k in range(3):
                first_m = last_m = middles[order[low], k]
                for i in range(low + 1, high):
                    first_m = min(first_m, middles[order[i], k])
                    last_m = max(last_m, middles[order[i], k])
                if last_m - first_m > widest:
                    widest, axis = last_m - first_m, k
            if low < split < high:
                _select(middles, axis, order, low, high, split)


@entry
def _fill(triangles: Floats, starts: Int32s, order: Int64s, boxes: Floats, corners: Floats) -> None:
    """Write `boxes` and `corners` of a `TriangleTree`, from the leaves upwards."""
    leaves = len(corners)
    for node in range(2 * leaves - 1, 0, -1):
        box = boxes[node]  # the least coordinates and the greatest ones
        box[:3], box[3:] = np.inf, -np.inf
        if node >= leaves:
            first = starts[node - leaves]
            for k in range(first, starts[node - leaves + 1]):
                for i in range(9):
                    x = triangles[order[k], i // 3, i % 3]
                    corners[node - leaves, i, k - first] = x
                    box[i % 3], box[3 + i % 3] = min(box[i % 3], x), max(box[3 + i % 3], x)
        else:
            for child in (2 * node, 2 * node + 1):
                for i in range(3):
                    box[i], box[3 + i] = min(box[i], boxes[child, i]), max(box[3 + i], boxes[child, 3 + i])
    for node in range(1, 2 * leaves):
        box = boxes[node]
        for i in range(3):
            low, high = box[i], box[3 + i]
            box[i], box[3 + i] = (low + high) / 2, (high - low) / 2


@kernel
def outward_of(triangle: Floats) -> Point:
    """Return the normal of a triangle, twice its area long: 0 for one without area, which has no outside."""
    first = vertex(triangle, 0)
    return cross(minus(vertex(triangle, 1), first), minus(vertex(triangle, 2), first))


@kernel
def after(node: int) -> int:
    """Return the node that follows `node` and all nodes below it; 1 at the end of the traversal."""
    node += 1
    while node % 2 == 0:
        node >>= 1
    return node


class Frame(NamedTuple):
    """Three axes: u and v across a direction w, and it."""

    u: Point
    v: Point
    w: Point


DUST = 1e-9  # shares below that are rounding
_NEAREST = 1e-4  # of a triangle's distance: the parts nearer along the axis are cut off


@kernel
def axes_around(direction: Point) -> Frame:
    """Return the frame of a unit direction.

    Source: Duff et al. 2017, Building an orthonormal basis, revisited, JCGT 6 (1).
    """
    sx, sy, sz = direction
    sign = math.copysign(1.0, sz)
    a = -1.0 / (sign + sz)
    b = sx * sy * a
    return Frame((1.0 + sign * sx * sx * a, sign * b, -sign * sx), (b, sign + sy * sy * a, -sy), direction)


@kernel
def _cut_area(corners: tuple[float, ...], nearest: float) -> float:
    """Return the area in the disc of a triangle, three times (x, y, depth), of which a part lies behind the point."""
    area, count = 0.0, 0
    first_x = first_y = last_x = last_y = 0.0
    # Around the triangle: where a side crosses the nearest depth, then its end, if they are ahead.
    px, py, pw = corners[6], corners[7], corners[8]
    for k in range(3):
        x, y, w = corners[3 * k], corners[3 * k + 1], corners[3 * k + 2]
        for passing in range(2):
            if passing == 0:
                if (pw < nearest) == (w < nearest):
                    continue
                t = (nearest - pw) / (w - pw)
                qx, qy = (px + t * (x - px)) / nearest, (py + t * (y - py)) / nearest
            else:
                if w < nearest:
                    continue
                qx, qy = x / w, y / w
            if count:
                area += edge_area(last_x, last_y, qx, qy)
            else:
                first_x, first_y = qx, qy
            last_x, last_y = qx, qy
            count += 1
        px, py, pw = x, y, w
    if count:
        area += edge_area(last_x, last_y, first_x, first_y)
    return area


@kernel
def triangle_area(triangle: Floats, point: Point, axes: Frame) -> float:
    """Return the area of the unit disc that a triangle covers; the axes across the Sun are longer by 1 / tan radius."""
    p, q, r = minus(vertex(triangle, 0), point), minus(vertex(triangle, 1), point), minus(vertex(triangle, 2), point)
    # Depths along the axis, and places across it that are at most the depth within the disc. A triangle behind the
    # point covers nothing, nor one with all corners beyond the disc on one side.
    w0, w1, w2 = dot(p, axes.w), dot(q, axes.w), dot(r, axes.w)
    if w0 <= 0.0 and w1 <= 0.0 and w2 <= 0.0:
        return 0.0
    a0, a1, a2 = dot(p, axes.u), dot(q, axes.u), dot(r, axes.u)
    if (a0 > w0 and a1 > w1 and a2 > w2) or (-a0 > w0 and -a1 > w1 and -a2 > w2):
        return 0.0
    b0, b1, b2 = dot(p, axes.v), dot(q, axes.v), dot(r, axes.v)
    if (b0 > w0 and b1 > w1 and b2 > w2) or (-b0 > w0 and -b1 > w1 and -b2 > w2):
        return 0.0
    reach = abs(p[0]) + abs(p[1]) + abs(p[2]) + abs(q[0]) + abs(q[1]) + abs(q[2]) + abs(r[0]) + abs(r[1]) + abs(r[2])
    nearest = _NEAREST * reach
    if w0 < nearest or w1 < nearest or w2 < nearest:
        return abs(_cut_area((a0, b0, w0, a1, b1, w1, a2, b2, w2), nearest))
    a0, b0 = a0 / w0, b0 / w0
    a1, b1 = a1 / w1, b1 / w1
    a2, b2 = a2 / w2, b2 / w2
    return abs(edge_area(a0, b0, a1, b1) + edge_area(a1, b1, a2, b2) + edge_area(a2, b2, a0, b0))


@kernel
def _box_in_cone(boxes: Floats, node: int, point: Point, sun: Point, inverse: Point, tangent: float) -> bool:
    """Return whether a box may reach into the cone: widened by the cone's radius at its far side, it meets the axis."""
    cx, cy, cz = minus(row(boxes, node), point)
    hx, hy, hz = boxes[node, 3], boxes[node, 4], boxes[node, 5]
    depth = dot((cx, cy, cz), sun) + hx * abs(sun[0]) + hy * abs(sun[1]) + hz * abs(sun[2])
    if depth <= 0.0:  # of the far side
        return False
    wider = depth * tangent
    # The part of the axis within the box's slabs.
    tx, ty, tz = cx * inverse[0], cy * inverse[1], cz * inverse[2]
    rx, ry, rz = (hx + wider) * abs(inverse[0]), (hy + wider) * abs(inverse[1]), (hz + wider) * abs(inverse[2])
    enter = max(tx - rx, ty - ry, tz - rz, 0.0)
    return bool(enter <= min(tx + rx, ty + ry, tz + rz))


@kernel
def inverse_of(x: float) -> float:
    """Return 1 / x, or a number beyond all others for 0."""
    return 1.0 / x if abs(x) > 1e-30 else 1e30


@kernel
def covered(tree: TriangleTree, point: Point, sun: Point, tangent: float, near_m: float, enough: float) -> float:
    """Return the covered share of a disc around a direction, each layer counted: above 1 where there are several.

    Parameters
    ----------
    point, sun : m, and the unit direction of the disc's middle, in the tree's frame.
    tangent : of the disc's angular radius.
    enough : the traversal may end at this share.
    """
    boxes, sizes, corners = tree
    # Axes across the Sun that are longer by 1 / tangent: the disc has the radius 1.
    u, v, _ = axes_around(sun)
    axes = Frame(plus(ZERO, 1.0 / tangent, u), plus(ZERO, 1.0 / tangent, v), sun)
    inverse = (inverse_of(sun[0]), inverse_of(sun[1]), inverse_of(sun[2]))
    leaves, node, area = len(sizes), 1, 0.0
    while True:
        if _box_in_cone(boxes, node, point, sun, inverse, tangent):
            if node < leaves:
                node *= 2
                continue
            leaf = node - leaves
            for j in range(sizes[leaf]):
                triangle = corners[leaf, :, j]
                outward = outward_of(triangle)
                # Only from above its plane does a triangle show its outside.
                height = dot(outward, point) - dot(outward, vertex(triangle, 0))
                if height > near_m * math.sqrt(dot(outward, outward)):
                    area += triangle_area(triangle, point, axes)
            if area >= math.pi * enough:
                return enough
        node = after(node)
        if node == 1:
            return area / math.pi


@kernel
def _hide(tree: TriangleTree, point: Point, moved: Floats, tangent: float, near_m: float) -> float:
    """Return the covered share of the Sun's disc, 0 to 1; `moved` is (3, 5)."""
    x, y, z = dot(row(moved, 0), point), dot(row(moved, 1), point), dot(row(moved, 2), point)
    place = x + moved[0, 3], y + moved[1, 3], z + moved[2, 3]
    hidden = covered(tree, place, (moved[0, 4], moved[1, 4], moved[2, 4]), tangent, near_m, 1.0 - DUST)
    return 0.0 if hidden < DUST else hidden if hidden < 1.0 - DUST else 1.0


@entry
def dim(
    tree: TriangleTree, points: Floats, chosen: Int32s, count: int, moved: Floats, tangent: float,
    near_m: float, shares: Floats
) -> None:  # fmt: skip
    """Multiply the sunlit shares of chosen points by the share of the disc that the tree's triangles do not cover.

    Parameters
    ----------
    points : (n, 3) m, in a frame of their own.
    chosen, count : numbers of points, (count,) used.
    moved : (2, 3, 5), now and an instant later: a rotation and a translation from the points' frame into the tree's,
        and in the last column the Sun's direction in the tree's frame.
    tangent, near_m : of the Sun's radius, and of `covered`.
    shares : (2, count), now and an instant later.
    """
    for i in range(count):
        if shares[0, i] > 0.0 or shares[1, i] > 0.0:
            point = row(points, chosen[i])
            hidden = _hide(tree, point, moved[0], tangent, near_m)
            # Beyond penumbras it is the same later.
            later = _hide(tree, point, moved[1], tangent, near_m) if 0.0 < hidden < 1.0 else hidden
            shares[0, i] *= 1.0 - hidden
            shares[1, i] *= 1.0 - later

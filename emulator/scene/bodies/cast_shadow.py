"""The share of the Sun's disc that triangles cover, seen from points: penumbras of any shape, without a map or samples.

From a point the Sun is a disc. Each triangle that shows its outside to the point and reaches into the cone of that disc
covers the part of it that lies in the projected triangle, which is a closed formula (`solar_disc`). Such triangles of a
closed surface tile without gaps, so the sum is exact for one layer, the edges between triangles leave no trace, and the
share changes smoothly in time. Where two layers cover different parts of the disc their areas are added, at most to the
whole disc, although they may overlap: that is too dark by up to the overlap, inside a penumbra only.

A point sees a triangle's outside where it is above its plane by `near_m`, so a facet and its neighbours in one plane
never hide the Sun from their own points.

What makes it fast: the walk leaves out boxes beside the cone (a box widened by the cone's radius at its far side against
the axis), it ends where the disc is covered, and points with an answer of 0 or 1 have no second evaluation.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.solar_disc import edge_area
from emulator.scene.bodies.triangle_tree import after

__all__ = ["Frame", "axes_around", "covered", "dim"]

Floats = npt.NDArray[np.float64]
Frame = tuple[float, float, float, float, float, float, float, float, float]

_NEAREST = 1e-4  # of a triangle's distance: what is nearer along the axis than that is cut off


@numba.njit(inline="always", error_model="numpy")
def axes_around(sx: float, sy: float, sz: float) -> Frame:
    """Return two axes across a unit direction and the direction itself.

    Source: Duff et al. 2017, Building an orthonormal basis, revisited, JCGT 6 (1).
    """
    sign = math.copysign(1.0, sz)
    a = -1.0 / (sign + sz)
    b = sx * sy * a
    return 1.0 + sign * sx * sx * a, sign * b, -sign * sx, b, sign + sy * sy * a, -sy, sx, sy, sz


@numba.njit(error_model="numpy")
def _cut_area(corners: tuple[float, ...], nearest: float) -> float:
    """Return the area in the disc of a triangle (x, y, depth) three times over, of which a part lies behind the point."""
    area, count = 0.0, 0
    first_x = first_y = last_x = last_y = 0.0
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


@numba.njit(error_model="numpy")
def _triangle_area(corners: Floats, k: int, px: float, py: float, pz: float, axes: Frame) -> float:
    """Return the area of the unit disc that triangle k covers; the axes across the Sun are longer by 1 / tan radius."""
    x0, y0, z0 = corners[k, 0] - px, corners[k, 1] - py, corners[k, 2] - pz
    x1, y1, z1 = corners[k, 3] - px, corners[k, 4] - py, corners[k, 5] - pz
    x2, y2, z2 = corners[k, 6] - px, corners[k, 7] - py, corners[k, 8] - pz
    ux, uy, uz, vx, vy, vz, sx, sy, sz = axes
    w0, w1, w2 = x0 * sx + y0 * sy + z0 * sz, x1 * sx + y1 * sy + z1 * sz, x2 * sx + y2 * sy + z2 * sz
    if w0 <= 0.0 and w1 <= 0.0 and w2 <= 0.0:
        return 0.0
    a0, a1, a2 = x0 * ux + y0 * uy + z0 * uz, x1 * ux + y1 * uy + z1 * uz, x2 * ux + y2 * uy + z2 * uz
    if (a0 > w0 and a1 > w1 and a2 > w2) or (-a0 > w0 and -a1 > w1 and -a2 > w2):
        return 0.0
    b0, b1, b2 = x0 * vx + y0 * vy + z0 * vz, x1 * vx + y1 * vy + z1 * vz, x2 * vx + y2 * vy + z2 * vz
    if (b0 > w0 and b1 > w1 and b2 > w2) or (-b0 > w0 and -b1 > w1 and -b2 > w2):
        return 0.0
    reach = abs(x0) + abs(y0) + abs(z0) + abs(x1) + abs(y1) + abs(z1) + abs(x2) + abs(y2) + abs(z2)
    nearest = _NEAREST * reach
    if w0 < nearest or w1 < nearest or w2 < nearest:
        return abs(_cut_area((a0, b0, w0, a1, b1, w1, a2, b2, w2), nearest))
    a0, b0, a1, b1, a2, b2 = a0 / w0, b0 / w0, a1 / w1, b1 / w1, a2 / w2, b2 / w2
    return abs(edge_area(a0, b0, a1, b1) + edge_area(a1, b1, a2, b2) + edge_area(a2, b2, a0, b0))


@numba.njit(inline="always", error_model="numpy")
def _box_in_cone(
    boxes: Floats, node: int, px: float, py: float, pz: float, sun: tuple[float, float, float],
    inverse: tuple[float, float, float], tangent: float,
) -> bool:
    """Tell whether a box may reach into the cone: widened by the cone's radius at its far side, it meets the axis."""
    cx, cy, cz = boxes[node, 0] - px, boxes[node, 1] - py, boxes[node, 2] - pz
    hx, hy, hz = boxes[node, 3], boxes[node, 4], boxes[node, 5]
    far = cx * sun[0] + cy * sun[1] + cz * sun[2] + hx * abs(sun[0]) + hy * abs(sun[1]) + hz * abs(sun[2])
    if far <= 0.0:
        return False
    wider = far * tangent
    tx, ty, tz = cx * inverse[0], cy * inverse[1], cz * inverse[2]
    rx, ry, rz = (hx + wider) * abs(inverse[0]), (hy + wider) * abs(inverse[1]), (hz + wider) * abs(inverse[2])
    enter = max(tx - rx, ty - ry, tz - rz, 0.0)
    return enter <= min(tx + rx, ty + ry, tz + rz)


@numba.njit(error_model="numpy")
def _inverse(x: float) -> float:
    return 1.0 / x if abs(x) > 1e-30 else 1e30


@numba.njit(error_model="numpy")
def covered(
    tree: tuple[Floats, npt.NDArray[np.int32], Floats, Floats], point: tuple[float, float, float],
    sun: tuple[float, float, float], tangent: float, near_m: float,
) -> float:
    """Return the covered share of the Sun's disc, 0 to 1.

    Parameters
    ----------
    tree : boxes, starts, corners, planes of a `TriangleTree`.
    point, sun : m, and the unit direction of the disc's middle, in the tree's frame.
    tangent : of the disc's angular radius.
    """
    boxes, starts, corners, planes = tree
    px, py, pz = point
    ux, uy, uz, vx, vy, vz, sx, sy, sz = axes_around(sun[0], sun[1], sun[2])
    k = 1.0 / tangent
    axes = (k * ux, k * uy, k * uz, k * vx, k * vy, k * vz, sx, sy, sz)
    inverse = (_inverse(sx), _inverse(sy), _inverse(sz))
    leaves, node, area = len(starts) - 1, 1, 0.0
    while True:
        if _box_in_cone(boxes, node, px, py, pz, sun, inverse, tangent):
            if node < leaves:
                node *= 2
                continue
            for k in range(starts[node - leaves], starts[node - leaves + 1]):
                if planes[k, 0] * px + planes[k, 1] * py + planes[k, 2] * pz > planes[k, 3] + near_m:
                    area += _triangle_area(corners, k, px, py, pz, axes)
            if area >= math.pi * (1.0 - 1e-12):
                return 1.0
        node = after(node)
        if node == 1:
            return area / math.pi


@numba.njit(inline="always")
def _place(moved: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        moved[0, 0] * x + moved[0, 1] * y + moved[0, 2] * z + moved[0, 3],
        moved[1, 0] * x + moved[1, 1] * y + moved[1, 2] * z + moved[1, 3],
        moved[2, 0] * x + moved[2, 1] * y + moved[2, 2] * z + moved[2, 3],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def dim(
    tree: tuple[Floats, npt.NDArray[np.int32], Floats, Floats], points: Floats, chosen: npt.NDArray[np.int32],
    count: int, moved: Floats, reaches: tuple[float, float], shares: Floats,
) -> None:
    """Multiply the sunlit shares of chosen points by what the tree's triangles leave of the disc.

    Parameters
    ----------
    points : (n, 3) m, in a frame of their own.
    chosen, count : numbers of points, (count,) used.
    moved : (2, 3, 5), now and an instant later: a rotation and a translation from the points' frame into the tree's,
        and in the last column the Sun's direction in the tree's frame.
    reaches : the tangent of the Sun's radius, and `near_m` of `covered`.
    shares : (2, count), now and an instant later.
    """
    tangent, near_m = reaches
    now, later = moved[0], moved[1]
    sun = (now[0, 4], now[1, 4], now[2, 4])
    sun_later = (later[0, 4], later[1, 4], later[2, 4])
    for i in range(count):
        if not (shares[0, i] > 0.0 or shares[1, i] > 0.0):
            continue
        k = chosen[i]
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        hidden = covered(tree, _place(now, x, y, z), sun, tangent, near_m)
        hidden_later = hidden
        if 0.0 < hidden < 1.0:
            hidden_later = covered(tree, _place(later, x, y, z), sun_later, tangent, near_m)
        shares[0, i] *= 1.0 - min(hidden, 1.0)
        shares[1, i] *= 1.0 - min(hidden_later, 1.0)

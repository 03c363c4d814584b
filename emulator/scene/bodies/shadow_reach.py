"""Which triangles may cover a part of a facet, as seen from the Sun, or from all directions near the Sun's."""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import Arrays, Frame
from emulator.scene.bodies.triangle_tree import after

__all__ = ["Extent", "covers", "extent_of", "list_near", "may_cover"]

_EMPTY = 1e300

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]
Extent = tuple[float, float, float, float, float]
"""A facet's box as seen from the Sun, and how far towards the Sun it begins, m."""
Wide = tuple[float, float]
"""Tangent and sine of an angle by which the Sun may turn."""


@numba.njit(error_model="numpy")
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


@numba.njit(error_model="numpy")
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


@numba.njit(error_model="numpy")
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


@numba.njit(error_model="numpy")
def list_near(
    tree: Arrays, plane: Floats, near_m: float, seen: tuple[Frame, Extent], wide: Wide, listed: Numbers
) -> int:
    """Write the triangles that may cover a part of a facet, as many as there is room for; return how many there are."""
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


@numba.njit(error_model="numpy")
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

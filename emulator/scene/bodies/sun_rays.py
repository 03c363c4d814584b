"""Rays from the points of a rigid surface to the Sun: does any triangle hide its middle.

A ray ends at the first triangle that it meets, whichever side that shows, so no light leaks where surfaces pass through
each other. The leaf whose triangle hid the Sun in the last light frame is tested first: if one still does, no tree is
searched. A result does not depend on those before it, only the time that it takes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import TriangleTree, inverse_of, seen_above
from emulator.scene.bodies.compiled import Numbers, Point, cross, dot, entry, kernel, minus, plus, row, vertex
from firmware_protocol.events import Floats, Int64s

SUNLIT = -1
_ABOVE = (1 << 56) - 1  # a stack of eight levels without its lowest one
_LOWEST = np.array([(bits & -bits).bit_length() - 1 for bits in range(256)])  # lowest bit that is set in eight


@kernel
def corner(corners: Floats, k: int, number: int) -> Point:
    """Return corner 0, 1 or 2 of triangle k of a `TriangleTree`."""
    return vertex(corners[k // corners.shape[2], :, k % corners.shape[2]], number)


@kernel
def _boxes_met(boxes: Floats, k: int, point: Point, inverse: Point, size: Point) -> Any:
    """Return the boxes of a row that a ray meets, a bit each; `size` is that of `inverse`.

    Their number is read from the array: the compiler unrolls a loop of constant length, and makes no vectors of it.
    """
    met: Any = np.int64(0)
    for j in range(boxes.shape[2]):
        # The part of the ray within the box's slabs: from the middle of each slab by half its length.
        tx = (boxes[k, 0, j] - point[0]) * inverse[0]
        ty = (boxes[k, 1, j] - point[1]) * inverse[1]
        tz = (boxes[k, 2, j] - point[2]) * inverse[2]
        rx = boxes[k, 3, j] * size[0]
        ry = boxes[k, 4, j] * size[1]
        rz = boxes[k, 5, j] * size[2]
        enter = max(tx - rx, ty - ry, tz - rz, 0.0)
        met |= np.int64(enter <= min(tx + rx, ty + ry, tz + rz)) << j
    return met


@kernel
def _triangles_met(corners: Floats, leaf: int, point: Point, sun: Point) -> Any:
    """Return the triangles of a leaf that a ray meets, from either side, a bit each (Moller and Trumbore 1997)."""
    met: Any = np.int64(0)
    for j in range(corners.shape[2]):
        first = corners[leaf, 0, j], corners[leaf, 1, j], corners[leaf, 2, j]
        u = corners[leaf, 3, j] - first[0], corners[leaf, 4, j] - first[1], corners[leaf, 5, j] - first[2]
        v = corners[leaf, 6, j] - first[0], corners[leaf, 7, j] - first[1], corners[leaf, 8, j] - first[2]
        across = cross(sun, v)
        volume = dot(u, across)
        side = math.copysign(1.0, volume)
        volume *= side
        away = minus(point, first)
        around = cross(away, u)
        along_u, along_v = dot(away, across) * side, dot(sun, around) * side
        is_inside = (along_u >= 0.0) & (along_v >= 0.0) & (along_u + along_v <= volume)
        met |= np.int64(is_inside & (dot(v, around) * side > 0.0)) << j
    return met


@kernel
def first_met(tree: TriangleTree, point: Point, sun: Point) -> int:
    """Return the first triangle, in the order of the tree, between a point and the Sun's middle; SUNLIT for none."""
    inverse = inverse_of(sun[0]), inverse_of(sun[1]), inverse_of(sun[2])
    size = abs(inverse[0]), abs(inverse[1]), abs(inverse[2])
    k: Any = np.int64(tree.first >> 3)
    # Boxes that were met, eight bits a level, the present one lowest: a stack in one number.
    met = _boxes_met(tree.boxes, k, point, inverse, size) & ((1 << tree.first) - 1) << (tree.first & 7)
    while met:
        if met & 255 == 0:
            met = met >> 8 & _ABOVE
            k >>= 3
            continue
        node = 8 * k + _LOWEST[met & 255]
        met &= met - 1
        leaf = node - len(tree.sizes)
        if leaf < 0:
            k = node
            met = met << 8 | _boxes_met(tree.boxes, k, point, inverse, size)
            continue
        triangles = _triangles_met(tree.corners, leaf, point, sun)
        if triangles:
            return int(tree.corners.shape[2] * leaf + _LOWEST[triangles])
    return SUNLIT


@kernel
def next_met(tree: TriangleTree, before: int, point: Point, sun: Point) -> int:
    """Return `first_met`, or a triangle of the leaf of triangle `before` that is met, for which no tree is searched."""
    if before >= 0:
        corners = tree.corners
        leaf = before // corners.shape[2]
        triangles = _triangles_met(corners, leaf, point, sun)
        if triangles:
            return int(corners.shape[2] * leaf + _LOWEST[triangles])
    return first_met(tree, point, sun)


class Window(NamedTuple):
    """The part of a group's space that the camera sees.

    Attributes
    ----------
    camera_from_group, eye : (3, 3) and (3,) m, the camera's place in the group's frame.
    half_width, half_height : of the light frame and a margin, over the focal length.
    focal_px : focal length.
    """

    camera_from_group: Floats
    eye: Floats
    half_width: float
    half_height: float
    focal_px: float


@kernel
def depth_in(window: Window, point: Point) -> float:
    """Return the depth of a point that the camera may see, m, else 0."""
    turn = window.camera_from_group
    away = minus(point, (window.eye[0], window.eye[1], window.eye[2]))
    depth = dot(row(turn, 2), away)
    right = abs(dot(row(turn, 0), away))
    down = abs(dot(row(turn, 1), away))
    return depth if depth > 0.0 and right < window.half_width * depth and down < window.half_height * depth else 0.0


@entry
def look_to_sun(  # noqa: PLR0913, PLR0917
    tree: TriangleTree, points: Floats, normals: Floats, chosen: Numbers, part: tuple[int, int], window: Window,
    sun: Floats, radius_rad: float, hiding: Int64s, is_hidden: npt.NDArray[np.int8]
) -> None:  # fmt: skip
    """Write whether the Sun's middle is hidden from the chosen points that the camera may see: 0 or 1, else -1.

    Where a part of the disc is below a point's own horizon, it is the middle of what is above (`seen_above`).

    Parameters
    ----------
    points, normals : (n, 3) m, a little above the surface, in the tree's frame; unit.
    chosen, part : numbers of points, and the first of them to test and the one after the last.
    sun, radius_rad : (3,) unit, and the disc's.
    hiding : (n,), a triangle that hid the Sun in an earlier light frame, or SUNLIT.
    is_hidden : (n,); points of which it is known stay as they are.
    """
    towards = (sun[0], sun[1], sun[2])
    for i in range(part[0], part[1]):
        k: Any = np.int64(chosen[i])
        point = row(points, k)
        if is_hidden[k] >= 0 or depth_in(window, point) == 0.0:
            continue
        normal = row(normals, k)
        height = dot(normal, towards)
        if height < -radius_rad:
            is_hidden[k] = 1
            continue
        if height < radius_rad:
            middle = plus(towards, radius_rad * seen_above(height / radius_rad)[1], normal)
            is_hidden[k] = 1 if first_met(tree, point, middle) >= 0 else 0
            continue
        hiding[k] = next_met(tree, hiding[k], point, towards)
        is_hidden[k] = 1 if hiding[k] >= 0 else 0

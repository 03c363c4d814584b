"""Rays from the points of a rigid surface to the Sun: does any triangle hide its middle, and for how long is that so.

A ray ends at the first triangle that it meets, whichever side that shows, so no light leaks where surfaces pass through
each other. A result is used again while it is certain to be the same:

    hidden     the triangle that hid the Sun is tested first: if it still does, no ray is needed
    sunlit     no triangle reaches into a cone around the Sun's direction, so the Sun may move within that cone

A result does not depend on those before it, only the time that it takes. Most points of an asteroid keep theirs for
minutes; those near a shadow edge get a ray each time.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import (
    DUST,
    Point,
    TriangleTree,
    after,
    box_in_cone,
    disc_axes,
    inverse_of,
    triangle_area,
)
from emulator.scene.bodies.compiled import entry, kernel

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]

SUNLIT, UNKNOWN = -1, -2
_WIDE_RAD, _NARROWER, _CONES = 0.03, 0.1, 3  # half angle of the widest cone, and of each of the next ones over it
_NO_CONE = 2.0  # a cosine that none exceeds
_LASTS = 10  # light frames, at least, for which a cone is worth its search


@kernel
def row(points: Floats, k: int) -> Point:
    """Return row k of an array, (n, 3)."""
    return points[k, 0], points[k, 1], points[k, 2]


@kernel
def corner(corners: Floats, k: int, number: int) -> Point:
    """Return corner 0, 1 or 2 of triangle k."""
    at = 3 * number
    return corners[k, at], corners[k, at + 1], corners[k, at + 2]


@kernel
def minus(a: Point, b: Point) -> Point:
    """Return the vector from b to a."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@kernel
def plus(a: Point, scale: float, b: Point) -> Point:
    """Return a + scale b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


@kernel
def dot(a: Point, b: Point) -> float:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a: Point, b: Point) -> Point:
    """Return the vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def _meets(corners: Floats, k: int, point: Point, sun: Point) -> bool:
    """Return whether a ray meets triangle k, from either side (Moller and Trumbore 1997)."""
    first = corner(corners, k, 0)
    u = minus(corner(corners, k, 1), first)
    v = minus(corner(corners, k, 2), first)
    across = cross(sun, v)
    volume = dot(u, across)
    side = math.copysign(1.0, volume)
    volume *= side
    away = minus(point, first)
    along_u = dot(away, across) * side
    if along_u < 0.0 or along_u > volume:
        return False
    around = cross(away, u)
    along_v = dot(sun, around) * side
    if along_v < 0.0 or along_u + along_v > volume:
        return False
    return bool(dot(v, around) * side > 0.0)


@kernel
def first_met(tree: TriangleTree, point: Point, sun: Point) -> int:
    """Return the first triangle, in the order of the tree, between a point and the Sun's middle; SUNLIT for none."""
    boxes, starts = tree.boxes, tree.starts
    ix = inverse_of(sun[0])
    iy = inverse_of(sun[1])
    iz = inverse_of(sun[2])
    leaves, node = len(starts) - 1, 1
    while True:
        # The part of the ray within the box's slabs: from the middle of each slab by half its length.
        tx = (boxes[node, 0] - point[0]) * ix
        ty = (boxes[node, 1] - point[1]) * iy
        tz = (boxes[node, 2] - point[2]) * iz
        rx = boxes[node, 3] * abs(ix)
        ry = boxes[node, 4] * abs(iy)
        rz = boxes[node, 5] * abs(iz)
        if max(tx - rx, ty - ry, tz - rz, 0.0) <= min(tx + rx, ty + ry, tz + rz):
            if node < leaves:
                node *= 2
                continue
            for k in range(np.int64(starts[node - leaves]), np.int64(starts[node - leaves + 1])):
                if _meets(tree.corners, k, point, sun):
                    return k
        node = after(node)
        if node == 1:
            return SUNLIT


@kernel
def _is_clear(tree: TriangleTree, point: Point, sun: Point, tangent: float) -> bool:
    """Return whether no triangle reaches into a cone around the Sun's direction."""
    starts = tree.starts
    axes = disc_axes(sun, tangent)
    inverse = (inverse_of(sun[0]), inverse_of(sun[1]), inverse_of(sun[2]))
    leaves, node = len(starts) - 1, 1
    while True:
        if box_in_cone(tree.boxes, node, point[0], point[1], point[2], sun, inverse, tangent):
            if node < leaves:
                node *= 2
                continue
            for k in range(starts[node - leaves], starts[node - leaves + 1]):
                if triangle_area(tree.corners, k, point[0], point[1], point[2], axes) > DUST:
                    return False
        node = after(node)
        if node == 1:
            return True


class Verdicts(NamedTuple):
    """Results for the points of a surface, and until when they are certain.

    Attributes
    ----------
    hiding : (n,) int64, a triangle that hides the Sun, SUNLIT, or UNKNOWN where no light frame needed the point yet.
    suns : (n, 4), the Sun's direction at the last ray of a sunlit point, and the cosine up to which it is sunlit.
    """

    hiding: npt.NDArray[np.int64]
    suns: Floats

    @classmethod
    def unknown(cls, points: int) -> Verdicts:
        """Return room for the results of `points` points."""
        suns = np.zeros((points, 4))
        suns[:, 3] = _NO_CONE
        return cls(np.full(points, UNKNOWN, np.int64), suns)


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
    tree: TriangleTree,
    points: Floats,
    chosen: Numbers,
    part: tuple[int, int],
    window: Window,
    sun: Floats,
    moved_rad: float,
    verdicts: Verdicts,
    is_hidden: npt.NDArray[np.int8],
) -> None:
    """Write whether the Sun's middle is hidden from the chosen points that the camera may see: 0 or 1, else -1.

    Parameters
    ----------
    points : (n, 3) m, a little above the surface, in the tree's frame.
    chosen, part : numbers of points, and the first of them to test and the one after the last.
    sun : (3,) unit.
    moved_rad : angle of the Sun since the last light frame.
    is_hidden : (n,).
    """
    hiding, suns = verdicts
    towards = (sun[0], sun[1], sun[2])
    for i in range(part[0], part[1]):
        k: Any = np.int64(chosen[i])
        point = row(points, k)
        if depth_in(window, point) == 0.0:
            is_hidden[k] = -1
            continue
        triangle = hiding[k]
        if triangle >= 0 and _meets(tree.corners, triangle, point, towards):
            is_hidden[k] = 1
            continue
        if triangle == SUNLIT and dot(row(suns, k), towards) > suns[k, 3]:
            is_hidden[k] = 0
            continue
        hiding[k] = first_met(tree, point, towards)
        is_hidden[k] = 1 if hiding[k] >= 0 else 0
        suns[k, 3] = _NO_CONE
        if hiding[k] >= 0:
            continue
        # Another angle for each, so that not all are tested again in the same light frame.
        wide = _WIDE_RAD * (0.5 + 0.5 * ((k * 0.6180339887) % 1.0))
        for _ in range(_CONES):
            if wide < _LASTS * moved_rad:
                break
            if _is_clear(tree, point, towards, math.tan(wide)):
                for j in range(3):
                    suns[k, j] = sun[j]
                suns[k, 3] = math.cos(wide)
                break
            wide *= _NARROWER

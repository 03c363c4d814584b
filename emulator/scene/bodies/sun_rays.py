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
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import (
    DUST,
    Frame,
    Point,
    TriangleTree,
    after,
    axes_around,
    box_in_cone,
    inverse_of,
    triangle_area,
)
from emulator.scene.bodies.compiled import entry, kernel

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]

SUNLIT = -1
UNKNOWN = -2
_WIDE_RAD, _NARROWER, _CONES = 0.03, 0.1, 3  # half angle of the widest cone, and of each of the next ones over it
_NO_CONE = 2.0  # a cosine that none exceeds
_LASTS = 10  # light frames, at least, for which a cone is worth its search


@kernel
def _meets(corners: Floats, k: int, point: Point, sun: Point) -> bool:
    """Return whether a ray meets triangle k, from either side (Moller and Trumbore 1997)."""
    ax, ay, az = corners[k, 0], corners[k, 1], corners[k, 2]
    ux, uy, uz = corners[k, 3] - ax, corners[k, 4] - ay, corners[k, 5] - az
    vx, vy, vz = corners[k, 6] - ax, corners[k, 7] - ay, corners[k, 8] - az
    px, py, pz = sun[1] * vz - sun[2] * vy, sun[2] * vx - sun[0] * vz, sun[0] * vy - sun[1] * vx
    volume = ux * px + uy * py + uz * pz
    side = math.copysign(1.0, volume)
    volume *= side
    tx, ty, tz = point[0] - ax, point[1] - ay, point[2] - az
    u = (tx * px + ty * py + tz * pz) * side
    if u < 0.0 or u > volume:
        return False
    qx, qy, qz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
    v = (sun[0] * qx + sun[1] * qy + sun[2] * qz) * side
    if v < 0.0 or u + v > volume:
        return False
    return bool((vx * qx + vy * qy + vz * qz) * side > 0.0)


@kernel
def first_met(tree: TriangleTree, point: Point, sun: Point) -> int:
    """Return the first triangle, in the order of the tree, between a point and the Sun's middle; SUNLIT for none."""
    boxes, starts, corners = tree.boxes, tree.starts, tree.corners
    ix, iy, iz = inverse_of(sun[0]), inverse_of(sun[1]), inverse_of(sun[2])
    wx, wy, wz = abs(ix), abs(iy), abs(iz)
    leaves, node = len(starts) - 1, 1
    while True:
        # The part of the ray within the box's slabs.
        tx, ty, tz = (boxes[node, 0] - point[0]) * ix, (boxes[node, 1] - point[1]) * iy, (boxes[node, 2] - point[2]) * iz
        rx, ry, rz = boxes[node, 3] * wx, boxes[node, 4] * wy, boxes[node, 5] * wz
        if max(tx - rx, ty - ry, tz - rz, 0.0) <= min(tx + rx, ty + ry, tz + rz):
            if node < leaves:
                node *= 2
                continue
            for k in range(starts[node - leaves], starts[node - leaves + 1]):
                if _meets(corners, k, point, sun):
                    return k
        node = after(node)
        if node == 1:
            return SUNLIT


@kernel
def _is_clear(tree: TriangleTree, point: Point, sun: Point, tangent: float) -> bool:
    """Return whether no triangle reaches into a cone around the Sun's direction."""
    boxes, starts, corners = tree.boxes, tree.starts, tree.corners
    ux, uy, uz, vx, vy, vz, sx, sy, sz = axes_around(sun[0], sun[1], sun[2])
    k = 1.0 / tangent
    axes = Frame(k * ux, k * uy, k * uz, k * vx, k * vy, k * vz, sx, sy, sz)
    inverse = (inverse_of(sx), inverse_of(sy), inverse_of(sz))
    leaves, node = len(starts) - 1, 1
    while True:
        if box_in_cone(boxes, node, point[0], point[1], point[2], sun, inverse, tangent):
            if node < leaves:
                node *= 2
                continue
            for k in range(starts[node - leaves], starts[node - leaves + 1]):
                if triangle_area(corners, k, point[0], point[1], point[2], axes) > DUST:
                    return False
        node = after(node)
        if node == 1:
            return True


class Verdicts(NamedTuple):
    """Results for the points of a surface, and until when they are certain.

    Attributes
    ----------
    hiding : (n,) int32, a triangle that hides the Sun, SUNLIT, or UNKNOWN where no light frame needed the point yet.
    suns : (n, 4), the Sun's direction at the last ray of a sunlit point, and the cosine up to which it is sunlit.
    """

    hiding: Numbers
    suns: Floats

    @classmethod
    def unknown(cls, points: int) -> Verdicts:
        """Return room for the results of `points` points."""
        suns = np.zeros((points, 4))
        suns[:, 3] = _NO_CONE
        return cls(np.full(points, UNKNOWN, np.int32), suns)


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
def depth_in(window: Window, x: float, y: float, z: float) -> float:
    """Return the depth of a point that the camera may see, m, else 0."""
    turn = window.camera_from_group
    dx, dy, dz = x - window.eye[0], y - window.eye[1], z - window.eye[2]
    depth: float = turn[2, 0] * dx + turn[2, 1] * dy + turn[2, 2] * dz
    right = abs(turn[0, 0] * dx + turn[0, 1] * dy + turn[0, 2] * dz)
    down = abs(turn[1, 0] * dx + turn[1, 1] * dy + turn[1, 2] * dz)
    return depth if depth > 0.0 and right < window.half_width * depth and down < window.half_height * depth else 0.0


@entry
def look_to_sun(
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
        k = chosen[i]
        point = (points[k, 0], points[k, 1], points[k, 2])
        if depth_in(window, point[0], point[1], point[2]) == 0.0:
            is_hidden[k] = -1
            continue
        known = hiding[k]
        if known >= 0 and _meets(tree.corners, known, point, towards):
            is_hidden[k] = 1
            continue
        if known == SUNLIT and suns[k, 0] * sun[0] + suns[k, 1] * sun[1] + suns[k, 2] * sun[2] > suns[k, 3]:
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
                suns[k, 0], suns[k, 1], suns[k, 2], suns[k, 3] = sun[0], sun[1], sun[2], math.cos(wide)
                break
            wide *= _NARROWER

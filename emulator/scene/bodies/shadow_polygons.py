"""Shadows with sharp edges on flat facets, as polygons: exact outlines and exact velocities, without a map or samples.

They are the shadows that flat-shaded bodies of a rigid group cast on themselves and on each other. A triangle above a
facet's plane, seen along the Sun's direction s, covers the part of the plane inside its projection
x = p - s (n.p - d) / (n.s). This polygon, clipped at the facet's sides, is drawn over the facet, a little nearer to the
camera, with the light that the facet has without the Sun; the light of the bodies themselves is computed without these
shadows. The polygon's corners move as the Sun does in the surface's frame; where two sides cross, the velocity is that
of the crossing, so the light of pixels at shadow edges has the right rate.

Only triangles that show their outside to the facet are used: those of a closed surface cover its shadow, and a facet's
neighbours in one plane cover nothing. Where layers overlap, the later polygon is cut around the earlier ones
(`polygons`), so none overlaps another.

Source of the projection: Blinn 1988, Me and my (fake) shadow, IEEE CG&A 8 (1).

Two measures make it fast: the traversal of the tree skips boxes below the plane, and those beside the facet as seen
from the Sun. Triangles that can cover a facet before the Sun has turned by _WIDE_RAD are listed, and searched for again
only then.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from emulator.scene.bodies.cast_shadow import TriangleTree, after, axes_around
from emulator.scene.bodies.compiled import ZERO, Point, cross, dot, entry, kernel, minus, plus, row, vertex
from emulator.scene.bodies.lit_surface import Surface
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.polygons import (
    MOST_PIECES,
    ROOM,
    Cutter,
    Pieces,
    Seen,
    copy_corners,
    covers,
    cut,
    cut_around,
    double_area,
    extent_of,
    list_near,
    may_cover,
    side_of,
    without_short_sides,
)
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.bodies.world import rigid_groups
from emulator.threads import ThreadPool
from emulator.trajectory.pose import Pose
from firmware_protocol.events import Floats, Int32s

_LEAST_COSINE = 1e-3  # of incidence: a facet with less is nearly dark, and its shadows would be infinitely long
_LEAST_AREA = 1e-7  # of the facet's area
_WHOLE = 1.0 - 1e-6  # of a facet's area: all of it is covered
_MOST_LISTED = 95  # triangles that may cover a facet; where there are more, all are tested
_MOST_EARLIER = 2048
_WIDE_RAD = 0.05
_NO_CONE = 2.0  # a cosine that none exceeds

Numbers = Int32s


class Receivers(NamedTuple):
    """Facets that receive shadows.

    Attributes
    ----------
    corners : (m, 9).
    planes : (m, 4), unit normal and offset.
    shades : (m, 3), the entry of the light of each corner.
    numbers : (m,), of the facets among those of all bodies.
    """

    corners: Floats
    planes: Floats
    shades: Numbers
    numbers: Numbers


class Triangles(NamedTuple):
    """Shadows cut into triangles.

    Attributes
    ----------
    places : (rows, 6), m and m/s.
    light : (rows, 2), light and its rate, following the corner.
    faces, over : (triangles, 3) rows and (triangles,) the facet below.
    """

    places: Floats
    light: Floats
    faces: Numbers
    over: Numbers


class Surroundings(NamedTuple):
    """The Sun's unit direction, its rate and the camera's place, (3,) each, in the frame of a group."""

    sun: Floats
    turning: Floats
    eye: Floats


class Dark(NamedTuple):
    """Light of the points of a body without the Sun, (e,), and its rate for the material point."""

    light: Floats
    rate: Floats


class Memory(NamedTuple):
    """Results of an earlier search, by facet.

    Attributes
    ----------
    suns : (m, 4), the Sun's direction at the last search and the cosine up to which that is valid.
    listed : (m, 1 + n), the number of triangles that may cover the facet until then, and their numbers.
    """

    suns: Floats
    listed: Numbers


class Room(NamedTuple):
    """Work arrays: pieces of a polygon, and all shadows on a facet, their numbers of corners and their areas."""

    pieces: Pieces
    shadows: Floats
    sizes: Numbers
    areas: Floats


@kernel
def _project(polygon: Floats, n: int, plane: Floats, sun: Floats, turning: Floats) -> None:
    """Move standing corners along the Sun's direction onto a plane, and write their velocities there."""
    normal = plane[0], plane[1], plane[2]
    across = dot(normal, (sun[0], sun[1], sun[2]))
    across_rate = dot(normal, (turning[0], turning[1], turning[2]))
    for k in range(n):
        distance = (dot(normal, row(polygon, k)) - plane[3]) / across
        distance_rate = -distance * across_rate / across
        for j in range(3):
            polygon[k, j] -= distance * sun[j]
            polygon[k, 3 + j] = -distance_rate * sun[j] - distance * turning[j]


@kernel
def _shade(corners: Floats, plane: Floats, triangle: Floats, sun: Floats, turning: Floats, pieces: Floats) -> int:
    """Write the shadow of a triangle on a facet to pieces[0]; return its corners, counter-clockwise, 0 for none."""
    for k in range(3):  # the triangle shows the Sun its inside: turned round
        for j in range(3):
            pieces[0, k, j] = triangle[3 * (2 - k) + j]
            pieces[0, k, 3 + j] = 0.0
    # Only what is above the plane casts a shadow on it; of that, only what falls on the facet counts.
    n = cut(pieces[0], 3, Cutter((plane[0], plane[1], plane[2]), plane[3], ZERO, 0.0), pieces[1])
    if n < 3:
        return 0
    _project(pieces[1], n, plane, sun, turning)
    for side in range(3):
        first = vertex(corners, side)
        cutter = side_of(plane, first, minus(vertex(corners, (side + 1) % 3), first), ZERO, ZERO)
        n = cut(pieces[(side + 1) % 2], n, cutter, pieces[side % 2])
        if n < 3:
            return 0
    return n


@kernel
def _slope(corners: Floats, plane: Floats, a: float, b: float, c: float) -> Point:
    """Return the gradient along a facet of the linear function with these values at its corners."""
    normal, first = (plane[0], plane[1], plane[2]), vertex(corners, 0)
    u, v = minus(vertex(corners, 1), first), minus(vertex(corners, 2), first)
    area = dot(normal, cross(u, v))
    return plus(plus(ZERO, (b - a) / area, cross(v, normal)), (c - a) / area, cross(normal, u))


@kernel
def _write(polygon: Floats, n: int, receivers: Receivers, f: int, dark: Dark, out: Triangles, k: int) -> None:
    """Write a polygon's corners from row k on, with the light of facet f there and its rate."""
    corners, plane = receivers.corners[f], receivers.planes[f]
    a, b, c = receivers.shades[f, 0], receivers.shades[f, 1], receivers.shades[f, 2]
    still, rates = dark
    gradient = _slope(corners, plane, still[a], still[b], still[c])
    change = _slope(corners, plane, rates[a], rates[b], rates[c])
    for i in range(n):
        place = minus(row(polygon, i), vertex(corners, 0))
        for j in range(6):
            out.places[k + i, j] = polygon[i, j]
        out.light[k + i, 0] = max(still[a] + dot(gradient, place), 0.0)
        # A corner that moves over the facet passes its gradient.
        velocity = polygon[i, 3], polygon[i, 4], polygon[i, 5]
        out.light[k + i, 1] = rates[a] + dot(change, place) + dot(gradient, velocity)


@kernel
def add_triangle(out: Triangles, number: int, a: int, b: int, c: int, facet: int) -> None:
    """Write a triangle over a facet, from the corners in rows a, b and c."""
    out.faces[number, 0] = a
    out.faces[number, 1] = b
    out.faces[number, 2] = c
    out.over[number] = facet


@kernel
def _fan(out: Triangles, row: int, n: int, first: int, facet: int) -> None:
    """Write the triangles of a polygon of n corners from `row` on."""
    for i in range(n - 2):
        add_triangle(out, first + i, row, row + i + 1, row + i + 2, facet)


def blank_room(shadows: int) -> Room:
    """Return work arrays for `shadows` shadows on a facet."""
    corners, counts = np.zeros((2, MOST_PIECES, ROOM, 6)), np.zeros((2, MOST_PIECES), np.int32)
    pieces = Pieces(corners, counts, np.zeros((_MOST_EARLIER, 2), np.int32))
    return Room(pieces, np.zeros((shadows, ROOM, 6)), np.zeros(shadows, np.int32), np.zeros(shadows))


@kernel
def _add(
    tree: TriangleTree, k: int, corners: Floats, plane: Floats, seen: Seen, around: Surroundings, near_m: float,
    room: Room, count: int
) -> int:  # fmt: skip
    """Write the shadow of triangle k on a facet, and its area, behind `count` others; return the new count."""
    pieces = room.pieces.corners
    width = tree.corners.shape[2]
    triangle = tree.corners[k // width, :, k % width]
    if not covers(triangle, plane, plane[3] + near_m, seen, 0.0, 0.0):
        return count
    n = _shade(corners, plane, triangle, around.sun, around.turning, pieces[0])
    n = without_short_sides(pieces[0, 0], n, near_m)
    if n < 3:
        return count
    area = double_area(pieces[0, 0], n, plane)
    if area <= _LEAST_AREA * _double_facet(corners, plane):
        return count
    if count < len(room.shadows):
        copy_corners(pieces[0, 0], n, room.shadows[count])
        room.sizes[count], room.areas[count] = n, area
    return count + 1


@kernel
def _gather(
    tree: TriangleTree, corners: Floats, plane: Floats, seen: Seen, around: Surroundings, near_m: float, room: Room
) -> int:
    """Write the shadows of all triangles on a facet; return their number, including those beyond the room."""
    boxes, width = tree.boxes, tree.corners.shape[2]
    leaves, node, count = len(tree.sizes), 1, 0
    while True:
        if may_cover(boxes, node, plane, plane[3] + near_m, seen, 0.0):
            if node < leaves:
                node *= 2
                continue
            leaf = node - leaves
            for k in range(width * leaf, width * leaf + tree.sizes[leaf]):
                count = _add(tree, k, corners, plane, seen, around, near_m, room, count)
        node = after(node)
        if node == 1:
            return count


@kernel
def _lay(
    receivers: Receivers, f: int, shadows: int, dark: Dark, near_m: float, room: Room, out: Triangles,
    first: tuple[int, int]
) -> tuple[int, int]:  # fmt: skip
    """Write the shadows on facet f, each cut around those before; return the first free row and triangle.

    The largest come first, which gives the fewest pieces. A facet that is covered as a whole gets one triangle.
    """
    corners, plane = receivers.corners[f], receivers.planes[f]
    pieces, counts, earlier = room.pieces
    rows, count = first
    listed, covered = 0, 0.0
    area = _double_facet(corners, plane)
    for _ in range(shadows):
        k = int(np.argmax(room.areas[:shadows]))
        room.areas[k] = 0.0
        n = room.sizes[k]
        copy_corners(room.shadows[k], n, pieces[0, 0])
        counts[0, 0] = n
        number, at = cut_around(room.pieces, listed, out.places, plane, near_m, _LEAST_AREA * area)
        # Write the pieces, as earlier polygons for the next ones, or count what lacks room.
        for i in range(number):
            n = counts[at, i]
            covered += double_area(pieces[at, i], n, plane)
            if rows + n <= len(out.places) and count + n - 2 <= len(out.faces):
                _write(pieces[at, i], n, receivers, f, dark, out, rows)
                _fan(out, rows, n, count, receivers.numbers[f])
                if listed < len(earlier):
                    earlier[listed, 0], earlier[listed, 1] = rows, n
                    listed += 1
            rows, count = rows + n, count + n - 2
        if covered >= _WHOLE * area:
            break
    if covered >= _WHOLE * area and first[0] + 3 <= len(out.places) and first[1] < len(out.faces):
        rows, count = first[0] + 3, first[1] + 1
        for k in range(3):
            for j in range(3):
                pieces[0, 0, k, j], pieces[0, 0, k, 3 + j] = corners[3 * k + j], 0.0
        _write(pieces[0, 0], 3, receivers, f, dark, out, first[0])
        _fan(out, first[0], 3, first[1], receivers.numbers[f])
    return rows, count


@entry
def cast_polygons(
    tree: TriangleTree, receivers: Receivers, dark: Dark, around: Surroundings, near_m: float, memory: Memory,
    room: Room, out: Triangles
) -> tuple[int, int, int]:  # fmt: skip
    """Write the shadows on facets that face the Sun and the camera.

    Return the first free row and triangle, and the most shadows on one facet, including those beyond the room.

    Triangles count that reach `near_m` above a facet's plane.
    """
    suns, listed = memory
    corners, sun, eye = receivers.corners, around.sun, around.eye
    towards = sun[0], sun[1], sun[2]
    axes, most_shadows = axes_around(towards), 0
    first = 0, 0
    for f in range(len(corners)):
        plane = receivers.planes[f]
        normal = plane[0], plane[1], plane[2]
        if dot(normal, towards) < _LEAST_COSINE or not dot(normal, (eye[0], eye[1], eye[2])) > plane[3]:
            continue
        count = listed[f, 0]
        is_valid = dot(row(suns, f), towards) > suns[f, 3]
        if is_valid and count == 0:
            continue
        seen = Seen(axes, extent_of(corners[f], axes))
        if not is_valid:
            # Another angle for each, so that not all are searched again in the same step.
            wide = _WIDE_RAD * (0.5 + 0.5 * ((f * 0.6180339887) % 1.0))
            for j in range(3):
                suns[f, j] = sun[j]
            suns[f, 3] = math.cos(wide)
            count = list_near(tree, plane, plane[3] + near_m, seen, wide, listed[f, 1:])
            listed[f, 0] = count
        shadows = 0
        if count < listed.shape[1]:
            for i in range(1, count + 1):
                shadows = _add(tree, listed[f, i], corners[f], plane, seen, around, near_m, room, shadows)
        else:
            shadows = _gather(tree, corners[f], plane, seen, around, near_m, room)
        most_shadows = max(most_shadows, shadows)
        if shadows > 0:
            first = _lay(receivers, f, min(shadows, len(room.shadows)), dark, near_m, room, out, first)
    return first[0], first[1], most_shadows


@kernel
def _double_facet(corners: Floats, plane: Floats) -> float:
    """Return twice the area of a facet."""
    u, v = minus(vertex(corners, 1), vertex(corners, 0)), minus(vertex(corners, 2), vertex(corners, 0))
    return dot((plane[0], plane[1], plane[2]), cross(u, v))


_FIRST_ROWS = 1024
_FIRST_SHADOWS = 256  # on one facet
_FACETS_A_PART, _MOST_PARTS = 300, 4  # of one body; a part takes 15 us to begin


@dataclass(frozen=True, eq=False)
class Polygons:
    """Shadows on the bodies of a group, cut into triangles, in the frame of the group's first body.

    Attributes
    ----------
    body : number of the group's first body.
    corners : (n, 6), their places and velocities, m and m a second of stream time.
    radiance, rate : (n,), W m-2 sr-1 and that a second, following the corner.
    faces : (m, 3) int32, corners of each triangle, counter-clockwise as seen from outside; none overlaps another.
    over : (m,) int32, the facet below each triangle: facets of all bodies' surfaces are numbered one after another.
    """

    body: int
    corners: Floats
    radiance: Floats
    rate: Floats
    faces: Numbers
    over: Numbers


def with_narrow_penumbras(parameters: BodiesParameters, meshes: Sequence[Mesh], widest_m: float) -> frozenset[int]:
    """Return the flat-shaded bodies in whose group a penumbra is at most so wide, half the group behind its edge."""
    bodies: set[int] = set()
    for group in rigid_groups(parameters.bodies):
        placed = group.placed
        points = np.concatenate([meshes[k].vertices @ pose.world_from_body.T + pose.position_m for k, pose in placed])
        half_m = float(np.linalg.norm(np.ptp(points, axis=0))) / 2
        if 2 * math.tan(parameters.sun.radius_rad) * half_m <= widest_m:
            bodies.update(k for k in group.members if not parameters.bodies[k].smooth)
    return frozenset(bodies)


def receivers_of(surface: Surface, pose: Pose, first_facet: int = 0) -> Receivers:
    """Return the facets of a flat-shaded surface that have an area, in the frame in which the surface has the pose.

    `first_facet` is the number of the surface's first facet among those of all bodies.
    """
    corners = (surface.vertices @ pose.world_from_body.T + pose.position_m)[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    kept = length > 1e-9 * longest**2
    corners, normals = corners[kept], normals[kept] / length[kept, None]
    offsets = (normals * corners.mean(axis=1)).sum(axis=1)
    planes = np.column_stack([normals, offsets])
    numbers = (first_facet + np.flatnonzero(kept)).astype(np.int32)
    shades = np.ascontiguousarray(surface.shades[kept])
    return Receivers(np.ascontiguousarray(corners.reshape(-1, 9)), planes, shades, numbers)


class SharpShadows:
    """The shadows on some bodies of one group. Not for several threads at once.

    Parameters
    ----------
    tree : triangles that cast shadows, in the frame of the group.
    receivers : facets of each body that receives shadows, see `receivers_of`.
    near_m : triangles that reach less high above a facet's plane cast no shadow on it.
    pool : threads that share the facets; the shadows are the same to the last bit.
    """

    def __init__(
        self, body: int, tree: TriangleTree, receivers: Sequence[Receivers], near_m: float,
        pool: ThreadPool | None = None,
    ) -> None:  # fmt: skip
        self._body, self._tree = body, tree
        self._near_m = near_m
        self._pool = pool or ThreadPool(1)
        self._shares = [_Share(k, part) for k, all_of in enumerate(receivers) for part in _parts(all_of)]
        self._rooms = [blank_room(_FIRST_SHADOWS) for _ in range(self._pool.threads)]

    def cast(self, darks: Sequence[Dark], around: Surroundings) -> Polygons:
        """Return the shadows; `darks` is of each body."""

        def work(k: int, thread: int) -> None:
            share = self._shares[k]
            while not share.cast(self._tree, darks[share.body], around, self._near_m, self._rooms[thread]):
                if share.shadows > len(self._rooms[thread].shadows):
                    self._rooms[thread] = blank_room(2 * share.shadows)

        self._pool.each(work, len(self._shares))
        firsts = itertools.accumulate((share.rows for share in self._shares), initial=0)
        parts = [share.written(first) for share, first in zip(self._shares, firsts, strict=False)]
        places, light, faces, over = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return Polygons(self._body, places, light[:, 0], light[:, 1], faces, over)


class _Share:
    """Some facets of one body, and the shadows on them."""

    def __init__(self, body: int, receivers: Receivers) -> None:
        self.body, self._receivers = body, receivers
        facets = len(receivers.corners)
        suns, listed = np.tile([0.0, 0.0, 0.0, _NO_CONE], (facets, 1)), np.zeros((facets, 1 + _MOST_LISTED), np.int32)
        self._memory = Memory(suns, listed)
        self.rows = self._count = self.shadows = 0
        self._make_room(_FIRST_ROWS)

    def written(self, first: int) -> Triangles:
        """Return the shadows, their corners counted from `first`."""
        places, light, faces, over = self._out
        faces = faces[: self._count] + np.int32(first)
        return Triangles(places[: self.rows], light[: self.rows], faces, over[: self._count])

    def cast(self, tree: TriangleTree, dark: Dark, around: Surroundings, near_m: float, room: Room) -> bool:
        """Compute the shadows; return whether there was room for all of them."""
        self.rows, self._count, self.shadows = cast_polygons(
            tree, self._receivers, dark, around, near_m, self._memory, room, self._out
        )
        rows, capacity = max(self.rows, self._count), len(self._out.places)
        if rows > capacity:
            self._make_room(2 * rows)
        return rows <= capacity and self.shadows <= len(room.shadows)

    def _make_room(self, rows: int) -> None:
        faces, over = np.zeros((rows, 3), np.int32), np.zeros(rows, np.int32)
        self._out = Triangles(np.zeros((rows, 6)), np.zeros((rows, 2)), faces, over)


def _parts(receivers: Receivers) -> Iterator[Receivers]:
    """Yield consecutive parts of the facets, each the work of one thread."""
    parts = min(max(len(receivers.corners) // _FACETS_A_PART, 1), _MOST_PARTS)
    yield from itertools.starmap(Receivers, zip(*(np.array_split(field, parts) for field in receivers), strict=True))

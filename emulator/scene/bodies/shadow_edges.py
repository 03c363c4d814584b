"""Shadow edges on smooth surfaces, as polygons: facets that an edge crosses are cut along it, with its velocity.

The Sun is hidden from some corners of a facet and not from others (`sun_rays`). On each side between two such corners
the edge of the shadow is where the plane through an edge of the hiding triangle and the Sun meets the side:

    q + s d     the side, from its sunlit end, s = 0, to its hidden one
    e, c        the edge of the triangle, and its first corner less q
    s = (c x e).S / (d x e).S                             S: the Sun's direction

a ratio of two linear forms of S, so its rate is exact. From the hidden end the search leaves one hiding triangle after
the other, until a ray from just beyond the last one meets none. The facet becomes three parts, drawn over it:

    lit          up to where the disc of the Sun is whole
    penumbra     between the crossings of both rims of the disc, which lie across the edge; left out where it is narrow
    dark         the light without the Sun, beyond

Light falls linearly through a penumbra as wide as a uniform distribution of the disc's own variance, .866 of the disc.
It ends at the facet's corners. Edges inside a facet whose corners all see the Sun, or none of them, are left out.

Source of the method: none; that of the crossing: Blinn 1988, Me and my (fake) shadow, IEEE CG&A 8 (1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import Point, TriangleTree
from emulator.scene.bodies.compiled import entry, kernel
from emulator.scene.bodies.shadow_polygons import Polygons, Triangles
from emulator.scene.bodies.sun_rays import Verdicts, Window, depth_in, first_met, look_to_sun
from emulator.threads import ThreadPool

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]

_LIFT = 0.02  # of the mean length of sides: rays begin as high above the surface
_MOST_TRIANGLES = 32  # left one after the other on a side
_PAST = 2e-3  # of a side: the place behind a triangle's shadow at which the next ray begins
_STEEPEST = 1e5  # sides a radian of the Sun's motion: shadows that graze the surface are no faster
_DISC = math.sqrt(3) / 2
_NARROW_PX = 0.5  # penumbras narrower than this are edges
MARGIN_PX = 24.0  # around the light frame, within which the corners of its facets lie
_ROWS, _TRIANGLES = 7, 5  # of the parts of a facet, at most
_POINTS_A_PART = 4000
_FIRST_FACETS = 64
_PARTS = 8


class Receiver(NamedTuple):
    """A smooth surface in the frame of its group.

    Attributes
    ----------
    vertices : (n, 3) m.
    lifted : (n, 3) m, from where rays begin.
    faces : (m, 3).
    first_facet : number of the first facet among those of all bodies.
    """

    vertices: Floats
    lifted: Floats
    faces: Numbers
    first_facet: int


class Suns(NamedTuple):
    """The Sun's direction now and an instant later, (3,) each; the time between, s; its angular radius, rad."""

    now: Floats
    later: Floats
    between_s: float
    radius_rad: float


class Lights(NamedTuple):
    """Light of the vertices with the Sun and without it, and their rates, (n,) each."""

    lit: Floats
    lit_rate: Floats
    dark: Floats
    dark_rate: Floats


class _Side(NamedTuple):
    """A side from its sunlit end, m."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


class _Crossing(NamedTuple):
    """Where an edge crosses a side, as shares of it from the sunlit end: lit up to `lit`, dark from `dark` on."""

    lit: float
    lit_rate: float
    dark: float
    dark_rate: float


class _Forms(NamedTuple):
    """The linear forms of the Sun's direction whose ratio is s, and the edge."""

    ax: float
    ay: float
    az: float
    bx: float
    by: float
    bz: float
    ex: float
    ey: float
    ez: float


@kernel
def _forms(corners: Floats, t: int, edge: int, side: _Side) -> _Forms:
    """Return c x e, d x e and e of an edge of triangle t."""
    i, j = 3 * edge, 3 * ((edge + 1) % 3)
    ex, ey, ez = corners[t, j] - corners[t, i], corners[t, j + 1] - corners[t, i + 1], corners[t, j + 2] - corners[t, i + 2]
    cx, cy, cz = corners[t, i] - side.x, corners[t, i + 1] - side.y, corners[t, i + 2] - side.z
    return _Forms(
        cy * ez - cz * ey, cz * ex - cx * ez, cx * ey - cy * ex,
        side.dy * ez - side.dz * ey, side.dz * ex - side.dx * ez, side.dx * ey - side.dy * ex,
        ex, ey, ez,
    )  # fmt: skip


@kernel
def _share_at(f: _Forms, x: float, y: float, z: float) -> float:
    """Return s for the Sun's direction, or the sign of infinity where the plane holds the side."""
    below = f.bx * x + f.by * y + f.bz * z
    above: float = f.ax * x + f.ay * y + f.az * z
    return above / below if below != 0.0 else math.copysign(1e30, above)


@kernel
def _leaving(corners: Floats, t: int, side: _Side, before: float, sun: Floats) -> tuple[float, int]:
    """Return the last share of a side, up to `before`, at which it enters the shadow of triangle t; through an edge.

    The number of the edge is 3 where the side passes through the triangle's own plane.
    """
    last, through = -1e30, 3
    for edge in range(3):
        s = _share_at(_forms(corners, t, edge, side), sun[0], sun[1], sun[2])
        if last < s <= before:
            last, through = s, edge
    f = _forms(corners, t, 0, side)
    vx, vy, vz = corners[t, 6] - corners[t, 0], corners[t, 7] - corners[t, 1], corners[t, 8] - corners[t, 2]
    nx, ny, nz = f.ey * vz - f.ez * vy, f.ez * vx - f.ex * vz, f.ex * vy - f.ey * vx
    falls = side.dx * nx + side.dy * ny + side.dz * nz
    if falls != 0.0:
        cx, cy, cz = corners[t, 0] - side.x, corners[t, 1] - side.y, corners[t, 2] - side.z
        s = (cx * nx + cy * ny + cz * nz) / falls
        if last < s <= before:
            last, through = s, 3
    return last, through


@kernel
def _rims(corners: Floats, t: int, edge: int, side: _Side, s: float, suns: Suns, narrow: float) -> _Crossing:
    """Return the crossings of both rims of the disc with their rates; of its middle where they are nearer than `narrow`."""
    f = _forms(corners, t, edge, side)
    now, later = suns.now, suns.later
    moved = math.sqrt((later[0] - now[0]) ** 2 + (later[1] - now[1]) ** 2 + (later[2] - now[2]) ** 2)
    fastest = _STEEPEST * moved / suns.between_s
    rate = (_share_at(f, later[0], later[1], later[2]) - s) / suns.between_s
    rate = min(max(rate, -fastest), fastest)
    # Across the plane through the edge and the Sun.
    nx, ny, nz = f.ey * now[2] - f.ez * now[1], f.ez * now[0] - f.ex * now[2], f.ex * now[1] - f.ey * now[0]
    tilt = _DISC * suns.radius_rad / math.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-300))
    nx, ny, nz = nx * tilt, ny * tilt, nz * tilt
    s0 = _share_at(f, now[0] - nx, now[1] - ny, now[2] - nz)
    s1 = _share_at(f, now[0] + nx, now[1] + ny, now[2] + nz)
    if not narrow < abs(s1 - s0) < 2.0 or not min(s0, s1) <= s <= max(s0, s1):
        return _Crossing(s, rate, s, rate)
    later0 = _share_at(f, later[0] - nx, later[1] - ny, later[2] - nz)
    later1 = _share_at(f, later[0] + nx, later[1] + ny, later[2] + nz)
    rate0 = min(max((later0 - s0) / suns.between_s, -fastest), fastest)
    rate1 = min(max((later1 - s1) / suns.between_s, -fastest), fastest)
    if s1 < s0:
        s0, rate0, s1, rate1 = s1, rate1, s0, rate0
    if s0 < 0.0:
        s0, rate0 = 0.0, 0.0
    if s1 > 1.0:
        s1, rate1 = 1.0, 0.0
    return _Crossing(s0, rate0, s1, rate1)


@kernel
def _cross(tree: TriangleTree, receiver: Receiver, lit: int, dark: int, suns: Suns, narrow: float) -> _Crossing:
    """Return where a shadow's edge crosses the side from vertex `lit` to vertex `dark`."""
    places = receiver.lifted
    x, y, z = places[lit, 0], places[lit, 1], places[lit, 2]
    side = _Side(x, y, z, places[dark, 0] - x, places[dark, 1] - y, places[dark, 2] - z)
    sun = (suns.now[0], suns.now[1], suns.now[2])
    at = 1.0
    # The hiding triangle is searched for anew: that of an earlier light frame may be another one.
    t = first_met(tree, (places[dark, 0], places[dark, 1], places[dark, 2]), sun)
    for _ in range(_MOST_TRIANGLES):
        if t < 0:
            break
        s, edge = _leaving(tree.corners, t, side, at, suns.now)
        at = s - _PAST
        if at <= 0.0:
            return _Crossing(_PAST, 0.0, _PAST, 0.0)
        before = t
        t = first_met(tree, (x + at * side.dx, y + at * side.dy, z + at * side.dz), sun)
        if t < 0 and edge < 3:
            return _rims(tree.corners, before, edge, side, s, suns, narrow)
    return _Crossing(at, 0.0, at, 0.0)


@kernel
def _put(  # noqa: PLR0913, PLR0917
    receiver: Receiver, lights: Lights, a: int, b: int, s: float, rate: float, is_lit: bool, out: Triangles, row: int
) -> None:  # fmt: skip
    """Write a corner at the share s of the side from vertex a to vertex b, which moves along it by `rate` a second."""
    vertices, places = receiver.vertices, out.places
    for j in range(3):
        along = vertices[b, j] - vertices[a, j]
        places[row, j] = vertices[a, j] + s * along
        places[row, 3 + j] = rate * along
    light = lights.lit if is_lit else lights.dark
    change = lights.lit_rate if is_lit else lights.dark_rate
    out.light[row, 0] = light[a] + s * (light[b] - light[a])
    out.light[row, 1] = change[a] + s * (change[b] - change[a]) + rate * (light[b] - light[a])


@kernel
def _add_triangle(out: Triangles, number: int, a: int, b: int, c: int, facet: int) -> None:
    out.faces[number, 0], out.faces[number, 1], out.faces[number, 2] = a, b, c
    out.over[number] = facet


@kernel
def _faces_eye(receiver: Receiver, f: int, eye: Floats) -> bool:
    """Return whether a facet shows its outside to the camera."""
    v, (a, b, c) = receiver.vertices, (receiver.faces[f, 0], receiver.faces[f, 1], receiver.faces[f, 2])
    ux, uy, uz = v[b, 0] - v[a, 0], v[b, 1] - v[a, 1], v[b, 2] - v[a, 2]
    vx, vy, vz = v[c, 0] - v[a, 0], v[c, 1] - v[a, 1], v[c, 2] - v[a, 2]
    x, y, z = eye[0] - v[a, 0], eye[1] - v[a, 1], eye[2] - v[a, 2]
    return bool((uy * vz - uz * vy) * x + (uz * vx - ux * vz) * y + (ux * vy - uy * vx) * z > 0.0)


@kernel
def _narrow(receiver: Receiver, a: int, b: int, window: Window) -> float:
    """Return the share of the side from vertex a to vertex b that is as long as a narrow penumbra."""
    v = receiver.vertices
    depth = depth_in(window, v[a, 0], v[a, 1], v[a, 2])
    long2 = (v[b, 0] - v[a, 0]) ** 2 + (v[b, 1] - v[a, 1]) ** 2 + (v[b, 2] - v[a, 2]) ** 2
    return _NARROW_PX * depth / (window.focal_px * math.sqrt(max(long2, 1e-300)))


@entry
def cut_facets(  # noqa: PLR0913, PLR0917
    tree: TriangleTree,
    receiver: Receiver,
    part: tuple[int, int],
    is_hidden: npt.NDArray[np.int8],
    lights: Lights,
    suns: Suns,
    window: Window,
    out: Triangles,
) -> int:
    """Cut facets that a shadow edge crosses, and write the parts; return the number of those facets.

    Facets beyond the room are counted and not cut.

    Parameters
    ----------
    part : the first facet, and the one after the last.
    is_hidden : (n,), of each vertex: 1, 0, or -1 where that is not known.
    """
    count = 0
    for f in range(part[0], part[1]):
        a, b, c = receiver.faces[f, 0], receiver.faces[f, 1], receiver.faces[f, 2]
        hidden = is_hidden[a] + is_hidden[b] + is_hidden[c]
        if hidden < 1 or hidden > 2 or min(is_hidden[a], is_hidden[b], is_hidden[c]) < 0:
            continue
        if not _faces_eye(receiver, f, window.eye):
            continue
        count += 1
        row, number, facet = _ROWS * (count - 1), _TRIANGLES * (count - 1), receiver.first_facet + f
        if row + _ROWS > len(out.places):
            continue
        # Corner o differs from p and q.
        o, p, q = a, b, c
        if is_hidden[a] == is_hidden[c]:
            o, p, q = b, c, a
        elif is_hidden[a] == is_hidden[b]:
            o, p, q = c, a, b
        is_lit = is_hidden[o] == 0
        _put(receiver, lights, o, o, 0.0, 0.0, is_lit, out, row)
        for k in range(2):
            other = p if k == 0 else q
            lit, dark = (o, other) if is_lit else (other, o)
            x = _cross(tree, receiver, lit, dark, suns, _narrow(receiver, lit, dark, window))
            _put(receiver, lights, lit, dark, x.lit, x.lit_rate, True, out, row + (1 if is_lit else 3) + k)
            _put(receiver, lights, lit, dark, x.dark, x.dark_rate, False, out, row + (3 if is_lit else 1) + k)
        _put(receiver, lights, p, p, 0.0, 0.0, not is_lit, out, row + 5)
        _put(receiver, lights, q, q, 0.0, 0.0, not is_lit, out, row + 6)
        # Rows: o; near it, on both sides; beyond the penumbra, on both sides; p; q.
        _add_triangle(out, number, row, row + 1, row + 2, facet)
        _add_triangle(out, number + 1, row + 1, row + 3, row + 4, facet)
        _add_triangle(out, number + 2, row + 1, row + 4, row + 2, facet)
        _add_triangle(out, number + 3, row + 3, row + 5, row + 6, facet)
        _add_triangle(out, number + 4, row + 3, row + 6, row + 4, facet)
    return count


class ShadowEdges:
    """The shadow edges on one body. Not for several threads at once.

    Parameters
    ----------
    body : number of the first body of its group, in whose frame all is.
    tree : triangles that cast shadows.
    vertices, normals, faces : of the surface, (n, 3) m, (n, 3) unit, (m, 3).
    first_facet : its number among those of all bodies.
    pool : threads that share the work; the edges are the same to the last bit.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self, body: int, tree: TriangleTree, vertices: Floats, normals: Floats, faces: Numbers, first_facet: int,
        pool: ThreadPool,
    ) -> None:  # fmt: skip
        sides = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
        lift_m = _LIFT * float(np.linalg.norm(sides, axis=2).mean())
        lifted = np.ascontiguousarray(vertices + lift_m * normals)
        self._receiver = Receiver(np.ascontiguousarray(vertices), lifted, faces, first_facet)
        self._body, self._tree, self._pool = body, tree, pool
        self._verdicts = Verdicts.unknown(len(vertices))
        self._is_hidden = np.full(len(vertices), -1, np.int8)
        self._before = np.zeros(3)
        self._parts = [_Part(len(faces) * k // _PARTS, len(faces) * (k + 1) // _PARTS) for k in range(_PARTS)]

    def hidden_from_sun(self, chosen: Numbers, count: int, window: Window, sun: Floats) -> npt.NDArray[np.int8]:
        """Return for each vertex whether the Sun's middle is hidden: 0 or 1, else -1; `chosen` are to be tested."""
        self._is_hidden.fill(-1)
        moved_rad, self._before = float(np.linalg.norm(sun - self._before)), sun

        def work(k: int, _: int) -> None:
            part = k * _POINTS_A_PART, min((k + 1) * _POINTS_A_PART, count)
            points = self._receiver.lifted
            look_to_sun(self._tree, points, chosen, part, window, sun, moved_rad, self._verdicts, self._is_hidden)

        self._pool.each(work, -(-count // _POINTS_A_PART))
        return self._is_hidden

    def cut(self, lights: Lights, suns: Suns, window: Window) -> Polygons:
        """Return the parts of facets that an edge crosses, by the results of `hidden_from_sun`."""

        def work(k: int, _: int) -> None:
            part = self._parts[k]
            while not part.has_room_for(
                cut_facets(self._tree, self._receiver, part.facets, self._is_hidden, lights, suns, window, part.out)
            ):
                pass

        self._pool.each(work, len(self._parts))
        parts = [part.written for part in self._parts]
        rows = np.cumsum([0, *(len(part.places) for part in parts)])
        light = np.concatenate([part.light for part in parts])
        return Polygons(
            self._body,
            np.concatenate([part.places for part in parts]),
            light[:, 0],
            light[:, 1],
            np.concatenate([part.faces + np.int32(row) for part, row in zip(parts, rows, strict=False)]),
            np.concatenate([part.over for part in parts]),
        )


class _Part:
    """Some facets of a body, and the parts of those that an edge crosses."""

    def __init__(self, first: int, last: int) -> None:
        self.facets = first, last
        self._cut = 0
        self._make_room(_FIRST_FACETS)

    @property
    def written(self) -> Triangles:
        """Return the parts."""
        rows, triangles = _ROWS * self._cut, _TRIANGLES * self._cut
        return Triangles(self.out.places[:rows], self.out.light[:rows], self.out.faces[:triangles], self.out.over[:triangles])

    def has_room_for(self, cut: int) -> bool:
        """Take the number of facets that were cut; return whether there was room for their parts, or make it."""
        self._cut = cut
        if _ROWS * cut <= len(self.out.places):
            return True
        self._make_room(2 * cut)
        return False

    def _make_room(self, facets: int) -> None:
        rows, triangles = _ROWS * facets, _TRIANGLES * facets
        faces, over = np.zeros((triangles, 3), np.int32), np.zeros(triangles, np.int32)
        self.out = Triangles(np.zeros((rows, 6)), np.zeros((rows, 2)), faces, over)

"""Shadow edges on smooth surfaces, as polygons: facets that an edge crosses are cut along it, with its velocity.

The Sun is hidden from some corners of a facet and not from others (`sun_rays`). On each side between two such corners
the edge of the shadow is where the plane through an edge of the hiding triangle and the Sun meets the side:

    q + s d     the side, from its sunlit end, s = 0, to its hidden one
    e, c        the edge of the triangle, and its first corner less q
    s = (c x e).S / (d x e).S                             S: the Sun's direction

a ratio of two linear forms of S, so its rate is exact. From the hidden end the search leaves one hiding triangle after
the other, until a ray from just beyond the last one meets none. Where the hidden end is turned away from the Sun, it
begins at the terminator: there the cosine of incidence, linear between the ends, is 0, and so is the light. Rays begin
on the curve of the side, for the facets around hide the Sun from its chord. The facet becomes three parts, drawn over
it:

    lit          up to where the disc of the Sun is whole, or to the terminator
    penumbra     between the crossings of both rims of the disc, which lie across the edge; left out where it is narrow
    dark         the light without the Sun, beyond

Light falls linearly through a penumbra as wide as a uniform distribution of the disc's own variance, .866 of the disc.
It ends at the facet's corners. Edges inside a facet whose corners all see the Sun, or none of them, are left out.

Source of the crossing: Blinn 1988, Me and my (fake) shadow, IEEE CG&A 8 (1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import TriangleTree
from emulator.scene.bodies.compiled import Numbers, Point, cross, dot, entry, kernel, minus, plus, row
from emulator.scene.bodies.shadow_polygons import Polygons, Triangles, add_triangle
from emulator.scene.bodies.sun_rays import SUNLIT, Window, corner, depth_in, first_met, look_to_sun, next_met
from emulator.threads import ThreadPool
from firmware_protocol.events import Floats, Int64s

_LIFT = 0.002  # of the mean length of sides: rays begin as high above the surface; .005 loses low shadows
_MOST_TRIANGLES = 32  # left one after the other on a side
_PAST = 2e-3  # of a side: the place behind a triangle's shadow at which the next ray begins
_STEEPEST = 1e5  # sides a radian of the Sun's motion: shadows that graze the surface are no faster
_DISC = math.sqrt(3) / 2
_LEAST_PX = 0.005  # area of a facet that is cut: smaller ones have the light between their corners
_NARROW_PX = 0.5  # penumbras narrower than this are edges
MARGIN_PX = 24.0  # around the light frame, within which the corners of its facets lie
_ROWS, _TRIANGLES = 7, 5  # of the parts of a facet, at most
_POINTS_A_PART, _FACETS_A_PART = 4000, 256
_LAST_SIDES = 1024


class Receiver(NamedTuple):
    """A smooth surface in the frame of its group.

    Attributes
    ----------
    vertices : (n, 3) m.
    lifted : (n, 3) m, from where rays begin.
    normals : (n, 3) unit.
    first : the radiance of the first vertex among those of all bodies.
    """

    vertices: Floats
    lifted: Floats
    normals: Floats
    first: int


class FrameFacets(NamedTuple):
    """Facets of this light frame.

    Attributes
    ----------
    corners : (rows, 3), the radiance of each corner among those of all bodies.
    uncut, parts : rows of the body's facets and of parts of these: the first one and the one after the last.
    """

    corners: Numbers
    uncut: tuple[int, int]
    parts: tuple[int, int]


class Suns(NamedTuple):
    """The Sun's direction now and an instant later; the time between, s; its angular radius, rad."""

    now: Point
    later: Point
    between_s: float
    radius_rad: float


class Lights(NamedTuple):
    """Light of the vertices with the Sun and without it, each with its rate, (2, n)."""

    lit: Floats
    dark: Floats


class Sides(NamedTuple):
    """Crossings of the last sides: their ends, (k, 2), lit and dark vertex, and the numbers of `_Crossing`, (k, 4)."""

    ends: Numbers
    crossings: Floats


class _Crossing(NamedTuple):
    """Places where an edge crosses a side, shares of it from the sunlit end: lit up to `lit`, dark from `dark` on."""

    lit: float
    lit_rate: float
    dark: float
    dark_rate: float


class _Light(NamedTuple):
    """Light of a place, and its rate."""

    value: float
    rate: float


class _Forms(NamedTuple):
    """The linear forms of the Sun's direction whose ratio is s, and the edge."""

    above: Point  # c x e
    below: Point  # d x e
    edge: Point


@kernel
def _forms(corners: Floats, t: int, edge: int, q: Point, d: Point) -> _Forms:
    """Return the forms of an edge of triangle t and of the side q + s d."""
    first = corner(corners, t, edge)
    e = minus(corner(corners, t, (edge + 1) % 3), first)
    return _Forms(cross(minus(first, q), e), cross(d, e), e)


@kernel
def _share_at(forms: _Forms, sun: Point) -> float:
    """Return s, or the sign of infinity where the side lies in the plane of the edge and the Sun."""
    above = dot(forms.above, sun)
    below = dot(forms.below, sun)
    return above / below if below != 0.0 else math.copysign(1e30, above)


@kernel
def _leave(corners: Floats, t: int, q: Point, d: Point, before: float, sun: Point) -> tuple[float, int]:
    """Return the largest s up to `before` at which the side enters the shadow of triangle t, and through which edge.

    The edge is 3 where the side passes through the triangle's own plane.
    """
    last, through = -1e30, 3
    for edge in range(3):
        s = _share_at(_forms(corners, t, edge, q, d), sun)
        if last < s <= before:
            last, through = s, edge
    first = corner(corners, t, 0)
    normal = cross(minus(corner(corners, t, 1), first), minus(corner(corners, t, 2), first))
    falls = dot(d, normal)
    if falls != 0.0:
        s = dot(minus(first, q), normal) / falls
        if last < s <= before:
            last, through = s, 3
    return last, through


@kernel
def _rims(forms: _Forms, s: float, suns: Suns, narrow: float) -> _Crossing:
    """Return the crossings of both rims of the disc and their rates; that of its middle if they are `narrow` apart."""
    moved = minus(suns.later, suns.now)
    fastest = _STEEPEST * math.sqrt(dot(moved, moved))
    # Across the plane through the edge and the Sun.
    tilt = cross(forms.edge, suns.now)
    radius = _DISC * suns.radius_rad / math.sqrt(max(dot(tilt, tilt), 1e-300))
    low = _share_at(forms, plus(suns.now, -radius, tilt))
    high = _share_at(forms, plus(suns.now, radius, tilt))
    if high < low:
        radius = -radius
        low, high = high, low
    if not (narrow < high - low < 2.0 and low <= s <= high):
        radius = 0.0
        low = high = s
    low_moved = _share_at(forms, plus(suns.later, -radius, tilt)) - low
    high_moved = _share_at(forms, plus(suns.later, radius, tilt)) - high
    low_rate = min(max(low_moved, -fastest), fastest) / suns.between_s if low >= 0.0 else 0.0
    high_rate = min(max(high_moved, -fastest), fastest) / suns.between_s if high <= 1.0 else 0.0
    return _Crossing(max(low, 0.0), low_rate, min(high, 1.0), high_rate)


@kernel
def _terminator(receiver: Receiver, lit: int, dark: int, suns: Suns) -> tuple[float, float]:
    """Return the share of a side at which the cosine of incidence is 0, and its rate; 1 where it is 0 nowhere."""
    moved = minus(suns.later, suns.now)
    first, last = row(receiver.normals, lit), row(receiver.normals, dark)
    high, low = dot(first, suns.now), dot(last, suns.now)
    if low >= 0.0 or low >= high:
        return 1.0, 0.0
    share = high / (high - low)
    if share < _PAST:
        return _PAST, 0.0
    return share, ((1.0 - share) * dot(first, moved) + share * dot(last, moved)) / ((high - low) * suns.between_s)


@kernel
def _cross(tree: TriangleTree, receiver: Receiver, lit: int, dark: int, suns: Suns, narrow: float) -> _Crossing:
    """Return where a shadow's edge crosses the side from vertex `lit` to vertex `dark`."""
    q = row(receiver.lifted, lit)
    d = minus(row(receiver.lifted, dark), q)
    at, rate = _terminator(receiver, lit, dark, suns)
    first, last = row(receiver.normals, lit), row(receiver.normals, dark)
    if dot(d, last) > dot(d, first):  # the side bends outwards
        rise = 0.5 * at * (1.0 - at)
        q = plus(plus(q, rise * dot(d, last), last), -rise * dot(d, first), first)
    # The hiding triangle is searched for anew: that of an earlier light frame may be another one.
    triangle = first_met(tree, plus(q, at, d), suns.now)
    for _ in range(_MOST_TRIANGLES):
        if triangle < 0:
            break
        s, edge = _leave(tree.corners, triangle, q, d, at, suns.now)
        at, rate = s - _PAST, 0.0
        if at <= 0.0:
            return _Crossing(_PAST, 0.0, _PAST, 0.0)
        before = triangle
        triangle = next_met(tree, before, plus(q, at, d), suns.now)
        if triangle < 0 and edge < 3:
            return _rims(_forms(tree.corners, before, edge, q, d), s, suns, narrow)
    return _Crossing(at, rate, at, rate)


@kernel
def _light_of(light: Floats, k: int) -> _Light:
    """Return the light of vertex k."""
    return _Light(light[0, k], light[1, k])


@kernel
def _beyond(receiver: Receiver, lights: Lights, lit: int, dark: int, suns: Suns) -> _Light:
    """Return the light of the end `dark` that makes the Sun's light fall to 0 at the terminator, linear from `lit`."""
    end, rate = _terminator(receiver, lit, dark, suns)
    if end == 1.0:
        return _light_of(lights.lit, dark)
    sunlight = lights.lit[0, lit] - lights.dark[0, lit]
    change = lights.lit[1, lit] - lights.dark[1, lit]
    share = 1.0 - 1.0 / end
    return _Light(
        lights.dark[0, dark] + share * sunlight, lights.dark[1, dark] + share * change + sunlight * rate / (end * end)
    )


@kernel
def _put(  # noqa: PLR0913, PLR0917
    receiver: Receiver, a: int, b: int, s: float, rate: float, at_a: _Light, at_b: _Light, out: Triangles, row: int
) -> None:  # fmt: skip
    """Write a corner at the share s of the side from vertex a to vertex b, which moves along it by `rate` a second."""
    vertices, places = receiver.vertices, out.places
    for j in range(3):
        along = vertices[b, j] - vertices[a, j]
        places[row, j] = vertices[a, j] + s * along
        places[row, 3 + j] = rate * along
    out.light[row, 0] = at_a.value + s * (at_b.value - at_a.value)
    out.light[row, 1] = at_a.rate + s * (at_b.rate - at_a.rate) + rate * (at_b.value - at_a.value)


@kernel
def _corners(corners: Numbers, f: int, receiver: Receiver) -> tuple[int, int, int]:
    """Return the vertices at the corners of a facet."""
    return corners[f, 0] - receiver.first, corners[f, 1] - receiver.first, corners[f, 2] - receiver.first


@kernel
def _area_px(receiver: Receiver, a: int, b: int, c: int, window: Window) -> float:
    """Return the area of a facet in the light frame, below 0 where it turns its outside away from the camera."""
    first = row(receiver.vertices, a)
    u = minus(row(receiver.vertices, b), first)
    v = minus(row(receiver.vertices, c), first)
    away = minus((window.eye[0], window.eye[1], window.eye[2]), first)
    range2 = max(dot(away, away), 1e-300)
    return dot(cross(u, v), away) * window.focal_px * window.focal_px / (2.0 * range2 * math.sqrt(range2))


@kernel
def _cross_once(  # noqa: PLR0913, PLR0917
    tree: TriangleTree, receiver: Receiver, lit: int, dark: int, suns: Suns, window: Window, sides: Sides
) -> _Crossing:
    """Return `_cross` of a side; the facet on its other side, which comes soon, finds it among the last ones."""
    k = (lit * 31 + dark) % _LAST_SIDES
    if sides.ends[k, 0] != lit or sides.ends[k, 1] != dark:
        sides.ends[k, 0], sides.ends[k, 1] = lit, dark
        first = row(receiver.vertices, lit)
        side = minus(row(receiver.vertices, dark), first)
        narrow = _NARROW_PX * depth_in(window, first) / (window.focal_px * math.sqrt(max(dot(side, side), 1e-300)))
        x = _cross(tree, receiver, lit, dark, suns, narrow)
        for j in range(4):
            sides.crossings[k, j] = x[j]
    at = sides.crossings[k]
    return _Crossing(at[0], at[1], at[2], at[3])


@entry
def list_crossed(
    receiver: Receiver, facets: FrameFacets, is_hidden: npt.NDArray[np.int8], window: Window, crossed: Int64s
) -> int:
    """List facets before the camera of which one or two corners are hidden; return how many.

    `is_hidden`, (n,), is 1 or 0 for each vertex, -1 where that is not known; `crossed`, (facets,), takes their rows.
    """
    count = 0
    for rows in (facets.uncut, facets.parts):
        for f in range(rows[0], rows[1]):
            a, b, c = _corners(facets.corners, f, receiver)
            lowest = min(is_hidden[a], is_hidden[b], is_hidden[c])
            highest = max(is_hidden[a], is_hidden[b], is_hidden[c])
            if lowest == 0 and highest == 1 and _area_px(receiver, a, b, c, window) > _LEAST_PX:
                crossed[count] = f
                count += 1
    return count


@entry
def cut_facets(  # noqa: PLR0913, PLR0917
    tree: TriangleTree, receiver: Receiver, corners: Numbers, crossed: Int64s, part: tuple[int, int],
    is_hidden: npt.NDArray[np.int8], lights: Lights, suns: Suns, window: Window, sides: Sides, out: Triangles
) -> None:  # fmt: skip
    """Cut facets along the shadow edge that crosses them, and write the parts.

    Parameters
    ----------
    corners : of `FrameFacets`.
    crossed, part : numbers of rows, and the first of them to cut and the one after the last.
    out : with _ROWS corners and _TRIANGLES triangles for each of `crossed`; `over` of those left out stays as it is.
    """
    sides.ends[:] = -1
    for i in range(part[0], part[1]):
        f = crossed[i]
        row = _ROWS * i
        number = _TRIANGLES * i
        # Corner o differs from p and q.
        o, p, q = _corners(corners, f, receiver)
        if is_hidden[o] == is_hidden[q]:
            o, p, q = p, q, o
        elif is_hidden[o] == is_hidden[p]:
            o, p, q = q, o, p
        is_lit = is_hidden[o] == 0
        lit_row, dark_row = (row + 1, row + 3) if is_lit else (row + 3, row + 1)
        is_wide = False
        of_o, of_others = (lights.lit, lights.dark) if is_lit else (lights.dark, lights.lit)
        _put(receiver, o, o, 0.0, 0.0, _light_of(of_o, o), _light_of(of_o, o), out, row)
        for k in range(2):
            other = p if k == 0 else q
            lit, dark = (o, other) if is_lit else (other, o)
            x = _cross_once(tree, receiver, lit, dark, suns, window, sides)
            is_wide |= x.dark > x.lit
            at_lit, at_dark = _light_of(lights.lit, lit), _beyond(receiver, lights, lit, dark, suns)
            _put(receiver, lit, dark, x.lit, x.lit_rate, at_lit, at_dark, out, lit_row + k)
            at_lit, at_dark = _light_of(lights.dark, lit), _light_of(lights.dark, dark)
            _put(receiver, lit, dark, x.dark, x.dark_rate, at_lit, at_dark, out, dark_row + k)
            at_other = _light_of(of_others, other)
            _put(receiver, other, other, 0.0, 0.0, at_other, at_other, out, row + 5 + k)
        # Rows: o; near it, on both sides; beyond the penumbra, on both sides; p; q.
        add_triangle(out, number, row, row + 1, row + 2, f)
        add_triangle(out, number + 1, row + 3, row + 5, row + 6, f)
        add_triangle(out, number + 2, row + 3, row + 6, row + 4, f)
        if is_wide:
            add_triangle(out, number + 3, row + 1, row + 3, row + 4, f)
            add_triangle(out, number + 4, row + 1, row + 4, row + 2, f)


class ShadowEdges:
    """The shadow edges on one body. Not for several threads at once.

    Parameters
    ----------
    body : number of the first body of its group, in whose frame all is.
    tree : triangles that cast shadows.
    vertices, normals : of the surface, (n, 3) m and unit.
    side_m : mean length of its sides.
    first : the radiance of its first vertex among those of all bodies.
    pool : threads that share the work; the edges are the same to the last bit.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self, body: int, tree: TriangleTree, vertices: Floats, normals: Floats, side_m: float, first: int,
        pool: ThreadPool,
    ) -> None:  # fmt: skip
        lifted = np.ascontiguousarray(vertices + _LIFT * side_m * normals)
        self._receiver = Receiver(np.ascontiguousarray(vertices), lifted, np.ascontiguousarray(normals), first)
        self._body, self._tree, self._pool = body, tree, pool
        self._hiding = np.full(len(vertices), SUNLIT)
        self._is_hidden = np.full(len(vertices), -1, np.int8)
        self._sides = [
            Sides(np.zeros((_LAST_SIDES, 2), np.int32), np.zeros((_LAST_SIDES, 4))) for _ in range(pool.threads)
        ]

    def begin(self, sun: Floats, radius_rad: float) -> None:
        """Begin a light frame with the Sun in direction `sun`, (3,): no vertex is tested yet."""
        self._is_hidden.fill(-1)
        self._sun, self._radius_rad = sun, radius_rad

    def hidden_from_sun(self, chosen: Numbers, count: int, window: Window) -> npt.NDArray[np.int8]:
        """Return for each vertex whether the Sun's middle is hidden: 0 or 1, else -1; `chosen` are to be tested."""
        receiver = self._receiver

        def work(part: tuple[int, int], _: int) -> None:
            look_to_sun(
                self._tree, receiver.lifted, receiver.normals, chosen, part, window, self._sun, self._radius_rad,
                self._hiding, self._is_hidden,
            )  # fmt: skip

        self._share(work, count, _POINTS_A_PART)
        return self._is_hidden

    def cut(self, lights: Lights, suns: Suns, window: Window, facets: FrameFacets) -> Polygons:
        """Return the parts of facets that an edge crosses, by the results of `hidden_from_sun`."""
        hidden = self._is_hidden
        rows = facets.uncut[1] - facets.uncut[0] + facets.parts[1] - facets.parts[0]
        crossed = np.empty(rows, np.int64)
        count = list_crossed(self._receiver, facets, hidden, window, crossed)
        places, light = np.zeros((_ROWS * count, 6)), np.zeros((_ROWS * count, 2))
        faces, over = np.zeros((_TRIANGLES * count, 3), np.int32), np.full(_TRIANGLES * count, -1, np.int32)
        out = Triangles(places, light, faces, over)

        def work(part: tuple[int, int], thread: int) -> None:
            sides = self._sides[thread]
            cut_facets(
                self._tree, self._receiver, facets.corners, crossed, part, hidden, lights, suns, window, sides, out
            )

        self._share(work, count, _FACETS_A_PART)
        written = over >= 0
        return Polygons(self._body, places, light[:, 0], light[:, 1], faces[written], over[written])

    def _share(self, work: Callable[[tuple[int, int], int], None], count: int, size: int) -> None:
        """Let the threads do a work in parts of `size`."""
        self._pool.each(lambda k, thread: work((k * size, min((k + 1) * size, count)), thread), -(-count // size))

"""Radiance of bodies in sunlight at the points of their surfaces, and its rate of change, with shadows: on the CPU.

    L = E_sun r(mu0, mu, g) share + ambient r(mu, mu, 0) + E_sun [glint(mu0, mu, g) water + air(mu0, mu, g, A)] share

with a law of reflection r, the visible share of the Sun's disc, and of a planet the glint on open water and the air
(`Water`, `air_light`). Near a shadow edge mu0 is the mean over the visible disc, so light is smooth in time. Shadows:

    smooth bodies        rays at vertices (`sun_rays`), and polygons on facets that an edge crosses (`shadow_edges`), in
                         the shadows of all that is rigidly fixed to the body; sides are cut before (`curved_sides`)
    flat-shaded ones     polygons over their facets where penumbras are narrow enough (`shadow_polygons`), else covered
                         areas of the disc, traced (`cast_shadow`)
    bodies on others     traced, in the frame of the body that casts the shadow

The rate is that of the material point, a second of stream time: directions of the Sun and positions of the camera and
of other bodies in each body's frame, and their rates, come from poses shortly before and after (`Motion`). The kernels
compute everything at an instant and a moment later, so short that the difference is the derivative to seven digits: the
laws need no derivatives of their own. The first test skips points that no facet shows to the camera, and dark ones
without ambient light; they are 60 to 80 % of a closed body's.

Left out: light from one surface onto another, but for the ambient light; the Sun's limb is as bright as its centre.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Vector, unit
from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import PLANET_ALBEDO, Water, air_light
from emulator.photometry.reflection_kernels import Law, law_of, reflect
from emulator.raster.surfaces import camera_from_body, moments, motion_of
from emulator.raster.topology import Facets, join, prepare
from emulator.scene.bodies.cast_shadow import TriangleTree, build_tree, dim, seen_above
from emulator.scene.bodies.compiled import Numbers, dot, entry, minus, row
from emulator.scene.bodies.curved_sides import Sides, mark
from emulator.scene.bodies.grain import Ground, Octaves, Placed, placed
from emulator.scene.bodies.lit_surface import Surface, mean_side_m, shadow_triangles
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.shadow_edges import MARGIN_PX, FrameFacets, Lights, ShadowEdges, Suns
from emulator.scene.bodies.shadow_polygons import Dark, Polygons, SharpShadows, Surroundings, receivers_of
from emulator.scene.bodies.sun_rays import Window
from emulator.scene.bodies.table import BodiesParameters, Clouds
from emulator.scene.bodies.world import RigidGroup, rigid_groups
from emulator.threads import ThreadPool
from emulator.trajectory.pose import Pose, Timescale, Trajectory
from firmware_protocol.events import Bytes, Floats


@entry
def choose(
    points: Floats, normals: Floats, lean: Floats, marked: Bytes, suns: Floats, eyes: Floats, lowest: float,
    chosen: Numbers, angles: Floats
) -> int:  # fmt: skip
    """Select the points that can show light, write their numbers and angles, and return their count.

    Parameters
    ----------
    points, normals, lean : of a `Surface`.
    marked : (n,), 0 for points of sides that are not cut: they are left out.
    suns, eyes : (2, 3) unit directions, and m, now and an instant later.
    lowest : points with a cosine of incidence that is not above this are left out.
    chosen : (n,), numbers of points.
    angles : (6, n), cosines of incidence and of emission and squared chords from Sun to eye, of now and of later.
    """
    count = 0
    for k in range(len(points)):
        normal = row(normals, k)
        if marked[k] == 0 or not dot(normal, row(suns, 0)) > lowest:
            continue
        away = minus(row(eyes, 0), row(points, k))
        facing = dot(normal, away)
        if not (facing > 0.0 or facing * facing < lean[k] * lean[k] * dot(away, away)):
            continue
        chosen[count] = k
        count += 1
    for i in range(count):
        k = chosen[i]
        point, normal = row(points, k), row(normals, k)
        for m in range(2):
            sun, away = row(suns, m), minus(row(eyes, m), point)
            per_m = 1.0 / math.sqrt(max(dot(away, away), 1e-300))
            eye = away[0] * per_m, away[1] * per_m, away[2] * per_m
            chord = minus(sun, eye)
            angles[m, i] = dot(normal, sun)
            angles[2 + m, i] = dot(normal, eye)
            angles[4 + m, i] = min(dot(chord, chord), 4.0)
    return count


@entry
def dim_at_plane(count: int, radius: float, cosines: Floats, shares: Floats) -> None:
    """Write the Sun's share above tangent planes, and raise the cosines of incidence to its mean; see `cast_shadow`.

    `radius` is that of the Sun, rad; `cosines` and `shares` are (2, count), now and an instant later.
    """
    for i in range(count):
        for m in range(2):
            shares[m, i], lift = seen_above(cosines[m, i] / radius)
            cosines[m, i] += radius * lift


@entry
def write_radiance(
    law: Law, sun_w_m2: float, ambient_w_m2: float, between_s: float, chosen: Numbers, count: int, angles: Floats,
    shares: Floats, room: Floats, out: Floats
) -> None:  # fmt: skip
    """Write radiance, W m-2 sr-1, and its rate, a second, of the chosen points.

    Parameters
    ----------
    sun_w_m2, ambient_w_m2 : irradiance of the Sun, and ambient light.
    between_s : from one instant to the other.
    angles : of `choose`; shares : (2, n).
    room : (3, n), overwritten.
    out : (2, points).
    """
    kind, parameters = law
    for m in range(2):
        reflect(kind, parameters, angles[m], angles[2 + m], angles[4 + m], count, room[m])
        for i in range(count):
            room[m, i] *= sun_w_m2 * shares[m, i]
    if ambient_w_m2 > 0.0:
        for m in range(2):
            for i in range(count):
                angles[m, i] = abs(angles[2 + m, i])
                angles[4 + m, i] = 0.0
            reflect(kind, parameters, angles[m], angles[m], angles[4 + m], count, room[2])
            for i in range(count):
                room[m, i] += ambient_w_m2 * room[2, i]
    for i in range(count):
        k = chosen[i]
        out[0, k] = room[0, i]
        out[1, k] = (room[1, i] - room[0, i]) / between_s


_BEYOND = -0.5  # least cosine of incidence of a corner whose facet an edge may cross
_ROUNDED = 1.001  # no less than light is rounded by to float32
_NEAR = 1e-7  # of a tree's radius: points are above a plane from this height on
_TURN_RAD = 1e-7  # rotation between the two instants of a rate


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of the camera and of bodies in the world: of the first body of each rigid group at least, by its number."""

    camera: Pose
    bodies: Mapping[int, Pose]


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses at an instant, and shortly before and after for rates; `between_s` is the stream time between these, s."""

    now: Poses
    before: Poses
    after: Poses
    between_s: float

    @property
    def instants(self) -> tuple[Poses, Poses, Poses]:
        """Poses now, before and after."""
        return self.now, self.before, self.after


@dataclass(frozen=True, eq=False)
class Radiance:
    """Light of a body at the points of its surface.

    Attributes
    ----------
    radiance, rate : (e,) float64, W m-2 sr-1 and that a second; 0 at points that no facet shows to the camera.
    dark, dark_rate : the same without the Sun; used only where shadows are polygons.
    """

    radiance: Floats
    rate: Floats
    dark: Floats
    dark_rate: Floats


@dataclass(frozen=True, eq=False)
class _Lit:
    """A body's points in the frame of its group.

    `first_point` and `facets` are among those of all bodies, `marked` a view of theirs.
    """

    surface: Surface
    points: Floats
    normals: Floats
    law: Law
    sea: Water | None
    group: int
    middle_m: Vector
    radius_m: float
    marked: Bytes
    first_point: int
    facets: tuple[int, int]
    sharp: bool
    edges: ShadowEdges | None
    sides: Sides | None


@dataclass(frozen=True, eq=False)
class _Seen:
    """A group's surroundings in its own frame, now and an instant later: (2, 3, 3) and (2, 3); the camera's now."""

    world_from_group: Floats
    places_m: Floats
    suns: Floats
    eyes_m: Floats
    camera_from_group: Floats


def motion_at(t_ns: int, camera: Trajectory, bodies: Callable[[int], Mapping[int, Pose]], time: Timescale) -> Motion:
    """Return the motion at stream time `t_ns`; `bodies` gives their poses at a scene time, ns."""
    times_ns, between_s = moments(t_ns, time)
    now, before, after = (Poses(camera.pose(t), bodies(t)) for t in times_ns)
    return Motion(now, before, after, between_s)


class Lighting:
    """The light of the bodies of a scene. Not for several threads at once.

    Attributes
    ----------
    facets : of the last light frame.
    marked : of each body, (points,), 0 for those that are in no facet of it.

    Parameters
    ----------
    pinhole : the camera: shadow edges outside its frame are left out.
    meshes : of each body, for the shadows that it casts.
    surfaces : of each body, the points at which light is computed.
    sides : those of each smooth body that may be cut, by number; see `curved_sides`.
    sharp : flat-shaded bodies on which the shadows of their own group are polygons, to be drawn over them.
    threads : number of threads that compute shadows; the light is the same to the last bit.
    """

    def __init__(
        self, parameters: BodiesParameters, pinhole: Pinhole, meshes: Sequence[Mesh], surfaces: Sequence[Surface],
        sharp: Collection[int] = (), threads: int = 1, sides: Mapping[int, Sides] | None = None
    ) -> None:  # fmt: skip
        self.facets = facets_of(surfaces, meshes)
        self.marked = [np.ones(len(surface.points), np.uint8) for surface in surfaces]
        self._sun, self._ambient = parameters.sun, parameters.ambient_w_m2
        self._towards = unit(parameters.sun.direction)
        self._groups = rigid_groups(parameters.bodies)
        self._trees = [_group_tree(group, parameters, meshes) for group in self._groups]
        self._pool = ThreadPool(threads)
        self._pinhole = pinhole
        self._bodies = self._lit(parameters, surfaces, sharp, sides or {})
        self._sharp = list(self._sharp_shadows(surfaces))
        points = max(len(body.points) for body in self._bodies)
        self._chosen, self._angles = np.empty(points, np.int32), np.empty((6, points))
        self._shares, self._room = np.empty((2, points)), np.empty((3, points))

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._pool.close()

    def grounds(self, grain: Sequence[Octaves | None]) -> dict[int, list[Ground]]:
        """Return the bodies with grain, `grain` by body, by the number of the first body of their group."""
        grounds: dict[int, list[Ground]] = {}
        for octaves, body in zip(grain, self._bodies, strict=True):
            rough, albedo = body.surface.rough, body.surface.albedo
            if octaves is not None and rough is not None and (octaves.on_facets < 1).any():
                brightest = _ROUNDED * self._sun.irradiance_w_m2 * (1.0 if albedo is None else float(albedo.max()))
                normals = np.ascontiguousarray(body.normals)
                ground = Ground(body.first_point, normals, rough, octaves, body.law, brightest)
                grounds.setdefault(self._groups[body.group].members[0], []).append(ground)
        return grounds

    def placed(self, motion: Motion, bodies: Collection[int]) -> dict[int, Placed]:
        """Return where some bodies are before the camera, by number."""
        places = {}
        for k in bodies:
            cameras, poses = zip(*((poses.camera, poses.bodies[k]) for poses in motion.instants), strict=True)
            rates, sun = motion_of(cameras, poses, motion.between_s), self._towards @ poses[0].world_from_body
            places[k] = placed(*camera_from_body(cameras[0], poses[0]), rates, sun, self._pinhole)
        return places

    def light_and_polygons(self, motion: Motion) -> tuple[list[Radiance], list[Polygons]]:
        """Return the light of each body, and the shadow polygons to draw over the bodies."""
        step_s = self._step_s(motion)
        seen = [self._seen(motion, group.members[0], step_s) for group in self._groups]
        self._cut_sides(seen)
        cut: list[Polygons] = []
        radiances = [self._body_light(body, seen, step_s, cut) for body in self._bodies]
        for g, shadows in self._sharp:
            group = seen[g]
            around = Surroundings(group.suns[0], (group.suns[1] - group.suns[0]) / step_s, group.eyes_m[0])
            members = [radiances[k] for k in self._groups[g].members if self._bodies[k].sharp]
            cut.append(shadows.cast([Dark(light.dark, light.dark_rate) for light in members], around))
        return radiances, cut

    def _cut_sides(self, seen: Sequence[_Seen]) -> None:
        """Select the sides to cut, and cut the facets."""
        for body in self._bodies:
            group = seen[body.group]
            if body.edges is not None:
                body.edges.begin(group.suns[0], self._sun.radius_rad)
            if body.sides is not None:
                window = self._window(group)
                first = len(body.points) - len(body.sides.bends_m)
                body.marked[first:] = 0
                _, hidden = self._choose(body, group)
                room = self._angles[:3]
                mark(body.points, body.normals, body.sides, group.suns[0], window, hidden, room, body.marked)
        self.facets.cut(np.concatenate(self.marked))

    def _lit(
        self, parameters: BodiesParameters, surfaces: Sequence[Surface], sharp: Collection[int],
        sides: Mapping[int, Sides],
    ) -> list[_Lit]:  # fmt: skip
        where = {k: (g, pose) for g, group in enumerate(self._groups) for k, pose in group.placed}
        lit = []
        point = facet = 0
        for k, (body, surface) in enumerate(zip(parameters.bodies, surfaces, strict=True)):
            g, pose = where[k]
            points, normals = in_group(surface.points, pose), surface.normals
            if points is not surface.points:
                normals = normals @ pose.world_from_body.T
            low, high = points.min(axis=0), points.max(axis=0)
            tree, edges = self._trees[g], None
            if surface.smooth and tree is not None:
                side_m, root = mean_side_m(points, surface.faces), self._groups[g].members[0]
                edges = ShadowEdges(root, tree, points, normals, side_m, point, self._pool)
            facets = facet, facet + len(surface.faces)
            sea = Water(body.detail.wind_m_s) if isinstance(body.detail, Clouds) else None
            lit.append(_Lit(
                surface, points, normals, law_of(body.reflectance), sea, g, (low + high) / 2,
                float(np.linalg.norm(high - low)) / 2, self.marked[k], point, facets, k in sharp, edges, sides.get(k),
            ))  # fmt: skip
            point, facet = point + len(points), facets[1]
        return lit

    def _sharp_shadows(self, surfaces: Sequence[Surface]) -> Iterator[tuple[int, SharpShadows]]:
        """Yield each group that has shadow polygons, with their `SharpShadows`."""
        firsts = np.cumsum([0, *(len(surface.faces) for surface in surfaces)])
        for g, (group, tree) in enumerate(zip(self._groups, self._trees, strict=True)):
            members = [(k, pose) for k, pose in group.placed if self._bodies[k].sharp]
            if tree is not None and members:
                parts = [receivers_of(surfaces[k], pose, firsts[k]) for k, pose in members]
                yield g, SharpShadows(group.members[0], tree, parts, _NEAR * tree.radius_m, self._pool)

    def _step_s(self, motion: Motion) -> float:
        """Return a time in which no body turns, appears to turn, or moves relative to its size, by more than 1e-7."""
        roots = [group.members[0] for group in self._groups]
        least_m = max(min(body.radius_m for body in self._bodies), 1e-9)
        before, after = ({k: poses.bodies[k].world_from_body for k in roots} for poses in (motion.before, motion.after))
        fastest = max(float(np.linalg.norm(after[k] - before[k])) for k in roots)
        fastest = max(fastest, *(_moved_m(motion, k, roots[0]) / least_m for k in roots))
        for body in self._bodies:
            root = motion.now.bodies[roots[body.group]]
            middle_m = root.position_m + root.world_from_body @ body.middle_m
            gap_m = float(np.linalg.norm(motion.now.camera.position_m - middle_m)) - body.radius_m
            fastest = max(fastest, _moved_m(motion, roots[body.group]) / max(gap_m, 1e-3 * body.radius_m, 1e-9))
        return motion.between_s * (_TURN_RAD / fastest if fastest > 0 else 1.0)

    def _seen(self, motion: Motion, root: int, step_s: float) -> _Seen:
        now, before, after = (self._around(poses, root) for poses in motion.instants)
        share = step_s / motion.between_s
        turns, places, suns, eyes = (
            np.stack([a, a + share * (c - b)]) for a, b, c in zip(now, before, after, strict=True)
        )
        return _Seen(turns, places, suns, eyes, np.ascontiguousarray(motion.now.camera.world_from_body.T @ now[0]))

    def _around(self, poses: Poses, root: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Return world_from_group, the group's place, and the Sun's direction and the camera's place in its frame."""
        pose = poses.bodies[root]
        turn, place = pose.world_from_body, pose.position_m
        return turn, place, self._towards @ turn, (poses.camera.position_m - place) @ turn

    def _body_light(self, body: _Lit, seen: Sequence[_Seen], step_s: float, polygons: list[Polygons]) -> Radiance:
        """Return the light of a body, and append the parts of its facets that a shadow edge crosses to `polygons`."""
        group, radius = seen[body.group], self._sun.radius_rad
        chosen, angles, shares, room = self._chosen, self._angles, self._shares, self._room
        count, hidden = self._choose(body, group)
        dim_at_plane(count, radius, angles[:2], shares)
        for g, tree in enumerate(self._trees):
            if tree is not None and (g != body.group or (body.edges is None and not body.sharp)):
                self._cast(body, tree, group, seen[g], count)
        out, dark = np.zeros((2, 2, len(body.points)))
        irradiance = self._sun.irradiance_w_m2
        planet = self._sea_and_air(body, count)  # before `write_radiance` overwrites the angles
        write_radiance(body.law, irradiance, self._ambient, step_s, chosen, count, angles, shares, room, out)
        if (body.sharp or body.edges is not None) and self._ambient > 0:
            write_radiance(body.law, 0.0, self._ambient, step_s, chosen, count, angles, shares, room, dark)
        if body.surface.albedo is not None:
            out *= body.surface.albedo
            dark *= body.surface.albedo
        if planet is not None:
            out[:, chosen[:count]] += planet[0], (planet[1] - planet[0]) / step_s
        if body.edges is not None:
            facets = FrameFacets(self.facets.shades, body.facets, self.facets.parts_of(*body.facets))
            suns = Suns(tuple(group.suns[0].tolist()), tuple(group.suns[1].tolist()), step_s, radius)
            polygons.append(body.edges.cut(Lights(out, dark), suns, self._window(group), facets))
            in_shadow = chosen[:count][hidden[chosen[:count]] == 1]
            out[:, in_shadow] = dark[:, in_shadow]
        return Radiance(*out, *dark)

    def _choose(self, body: _Lit, group: _Seen) -> tuple[int, npt.NDArray[np.int8]]:
        """Select points of a body; return their count and, for smooth bodies, whether each is hidden from the Sun."""
        lowest = -2.0 if self._ambient > 0 else -math.sin(self._sun.radius_rad) if body.edges is None else _BEYOND
        count = choose(
            body.points, body.normals, body.surface.lean, body.marked, group.suns, group.eyes_m, lowest, self._chosen,
            self._angles,
        )  # fmt: skip
        if body.edges is None:
            return count, np.full(len(body.points), -1, np.int8)
        return count, body.edges.hidden_from_sun(self._chosen, count, self._window(group))

    def _sea_and_air(self, body: _Lit, count: int) -> Floats | None:
        """Return the light of a planet's water and air at the chosen points, now and an instant later, (2, count)."""
        if body.sea is None or body.surface.water is None or body.surface.albedo is None:
            return None
        chosen = self._chosen[:count]
        mu0, mu, chord2 = self._angles[:, :count].reshape(3, 2, -1)
        phase, water = 2 * np.arcsin(np.sqrt(chord2) / 2), body.surface.water[chosen]
        out = air_light(mu0, mu, phase, PLANET_ALBEDO * body.surface.albedo[chosen])
        wet = np.flatnonzero(water)
        out[:, wet] += water[wet] * body.sea.reflect(mu0[:, wet], mu[:, wet], phase[:, wet])
        return self._sun.irradiance_w_m2 * self._shares[:, :count] * out

    def _window(self, group: _Seen) -> Window:
        """Return the part of a group's space that the camera sees."""
        pinhole = self._pinhole
        half = [(size / 2 + MARGIN_PX) / pinhole.focal_px for size in pinhole.size]
        return Window(group.camera_from_group, group.eyes_m[0], half[0], half[1], pinhole.focal_px)

    def _cast(self, body: _Lit, tree: TriangleTree, group: _Seen, other: _Seen, count: int) -> None:
        """Dim the chosen points of a body, which is in `group`, by the shadow of another group or of its own."""
        moved = np.empty((2, 3, 5))
        for m in range(2):
            moved[m, :, :3] = other.world_from_group[m].T @ group.world_from_group[m]
            moved[m, :, 3] = other.world_from_group[m].T @ (group.places_m[m] - other.places_m[m])
            moved[m, :, 4] = other.suns[m]
        tangent = math.tan(self._sun.radius_rad)
        if group is other or _may_shade(tree, body, moved[0], tangent):
            dim(tree, body.points, self._chosen, count, moved, tangent, _NEAR * tree.radius_m, self._shares)


def in_group(points: Floats, pose: Pose) -> Floats:
    """Return points of a body, (n, 3) m, in the frame of its group: themselves where it is the body's own."""
    is_same = not pose.position_m.any() and (pose.world_from_body == np.eye(3)).all()
    return points if is_same else points @ pose.world_from_body.T + pose.position_m


def _group_tree(group: RigidGroup, parameters: BodiesParameters, meshes: Sequence[Mesh]) -> TriangleTree | None:
    """Return the triangles that cast the shadows of a group, in its frame."""
    parts = [
        shadow_triangles(replace(meshes[k], vertices=in_group(meshes[k].vertices, pose)))
        for k, pose in group.placed
        if parameters.shadows and parameters.bodies[k].throws_shadow
    ]
    if not parts:
        return None
    return build_tree(parts[0] if len(parts) == 1 else np.concatenate(parts))  # a copy of one takes 100 ms


def facets_of(surfaces: Sequence[Surface], meshes: Sequence[Mesh]) -> Facets:
    """Return the facets of all bodies, one after another."""
    parts, between = [], []
    first = 0
    for surface, mesh in zip(surfaces, meshes, strict=True):
        part = prepare(surface.faces, shades=surface.shades, two_sided=mesh.open_edges > 0)
        parts.append(replace(part, entries=len(surface.points)))
        uncut = np.full((len(surface.faces), 7), -1, np.int32)
        between.append(uncut if surface.between is None else surface.between + first * (surface.between >= 0))
        first += len(surface.points)
    return Facets(join(parts), np.concatenate(between).astype(np.int32))


def _moved_m(motion: Motion, k: int, other: int | None = None) -> float:
    """Return the distance that body k moves relative to another one, or to the camera."""
    places = [
        (poses.camera if other is None else poses.bodies[other]).position_m - poses.bodies[k].position_m
        for poses in (motion.before, motion.after)
    ]
    return float(np.linalg.norm(places[1] - places[0]))


def _may_shade(tree: TriangleTree, body: _Lit, moved: Floats, tangent: float) -> bool:
    """Return whether a ball around a body reaches into the shadow of the ball around a tree; `moved` is (3, 5)."""
    away = tree.middle_m - (moved[:, :3] @ body.middle_m + moved[:, 3])
    reach_m = tree.radius_m + body.radius_m
    along = float(away @ moved[:, 4])
    beside = math.sqrt(max(float(away @ away) - along * along, 0.0))
    return along > -reach_m and beside < reach_m + tangent * (along + reach_m)

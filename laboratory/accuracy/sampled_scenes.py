"""Light by rays through points of each pixel, in float64: the truth that renderers and shadows are judged by.

A pixel has `samples` x `samples` points where an edge of an outline or of a shadow crosses it, or its light varies by a
quarter; others have half as many along each side. From each point one ray goes to the scene, and from the place that it
hits one ray to a point of the Sun's disc. The law of reflection is evaluated there, in float64, and the light of a
pixel is the mean of its points. There are no facets of a renderer, no coverage, no shadows at vertices, no rates.

Of the scene's own code this uses shape models with their detail, maps, paths and the laws of reflection.

The surface of each scene, by which it is judged:

    smooth bodies    the vertices and normals of the shape with its detail, before facets are merged; between them each
                     facet is a curved triangle (Vlachos et al. 2001, Curved PN triangles), cut into n x n flat ones
                     whose sides are a third of a pixel at the closest, n at least 4, within _MOST_FACETS. Normals are
                     interpolated over the facet of the shape, as the scene defines them, and do not depend on n
    grain            below facets, at each point of a pixel, by scipy from the same tile of noise
    flat bodies      their facets, which are exact
    ground           the heights of the finest grid at a place, bilinear between posts; slopes are differences over two
                     posts, bilinear as well

Rays to bodies are those of embree, an independent library (embreex), in float32; the point on the facet is computed in
float64. Rays over ground follow its heights cell by cell, and skip what lies below the ray by the maxima of larger
cells. A ray to the Sun starts _LIFT of a small facet's side above it: more than float32 rounds, and so near that it
does not miss low shadows. Over ground, which is met in float64, it starts _GROUND_LIFT of the posts' distance up. A
shadow's edge moves by that height over the tangent of the Sun's elevation.

A board (`SampledBoard`) along the rows of pixels is the product of two square waves, each sampled along its axis.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from emulator.geometry.attitude import unit
from emulator.geometry.camera import Pinhole
from emulator.light import Light, MachineLacks, Scene, SceneError
from emulator.photometry.reflectance import PLANET_ALBEDO, Sun, Water, air_light
from emulator.scene.bodies.grain import TEXELS, Octaves
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.table import BodiesParameters, BodyTable, Clouds
from emulator.scene.bodies.world import BodyWorld
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.world import TerrainWorld
from emulator.scene.world import WorldScene
from emulator.threads import ThreadPool, available_threads
from emulator.trajectory.pose import Pose
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Float32s, Floats, Int64s, Mask

_Ints = Int64s
_compiled: Callable[[Callable[..., Any]], Callable[..., Any]] = entry_of(__name__)

_LIFT, _GROUND_LIFT = 2e-3, 1e-3
_FLAT_LIFT = 2e-6  # of a flat body's radius
_LEAST_CUTS, _MOST_FACETS, _SIDES_A_PIXEL = 4, 3_000_000, 3.0
_UNEVEN = 0.25  # of the mean light of a pixel
_AT_ONCE = 20_000  # points: their arrays stay in the cache of a processor
_GRAZING = 0.02  # least cosine of emission for which the laws of ground are used, as in the scene


class SampledScene(WorldScene[Any]):
    """A world as its camera sees it, by at most `samples` x `samples` points a pixel."""

    def __init__(self, world: BodyWorld | TerrainWorld, sun: Floats, sun_radius_rad: float, samples: int) -> None:
        super().__init__(world)
        self._patterns = _pattern(max(samples // 2, 1)), _pattern(samples)
        across = unit(np.cross(sun, np.eye(3)[np.abs(sun).argmin()]))
        self._sun, self._across = sun, sun_radius_rad * np.stack([across, np.cross(sun, across)])

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        shade, (width, height) = self._shader(t_ns), self.size
        light, kind = self._sampled(shade, np.arange(width * height), *self._patterns[0])
        mixed = _at_edges(light, kind, (height, width))
        mean = light.mean(axis=1)
        mean[mixed] = self._sampled(shade, mixed, *self._patterns[1])[0].mean(axis=1)
        out[:] = mean.reshape(height, width)

    def _shader(self, t_ns: int) -> Callable[[Floats, Floats], tuple[Floats, _Ints]]:
        """Return the function of rays that gives their light and what they meet.

        Its arguments are directions in camera axes, 1 along the boresight, and directions to points of the Sun, (n, 3)
        each; what they meet, (n,), differs across an edge.
        """
        raise NotImplementedError

    def _sampled(
        self, shade: Callable[[Floats, Floats], tuple[Floats, _Ints]], pixels: _Ints, within: Floats, disc: Floats
    ) -> tuple[Floats, _Ints]:
        """Return the light of pixels at places within them, and what is met there, (pixels, places) each."""
        places, (width, height), focal_px = len(within), self.size, self._world.pinhole.focal_px
        light, kind = np.zeros((len(pixels), places)), np.zeros((len(pixels), places), np.int64)
        to_sun = self._sun + disc @ self._across
        to_sun /= np.linalg.norm(to_sun, axis=1, keepdims=True)
        count, pool = max(_AT_ONCE // places, 1), ThreadPool(available_threads())

        def sample(k: int, _: int) -> None:
            part = slice(k * count, (k + 1) * count)
            rows, columns = np.divmod(pixels[part], width)
            x = (columns[:, None] + within[:, 0] - width / 2) / focal_px
            y = (rows[:, None] + within[:, 1] - height / 2) / focal_px
            rays = np.stack([x, y, np.ones(x.shape)], axis=-1).reshape(-1, 3)
            seen = shade(rays, np.tile(to_sun, (len(rows), 1)))
            light[part], kind[part] = (values.reshape(-1, places) for values in seen)

        pool.each(sample, -(-len(pixels) // count))
        pool.close()
        return light, kind


def _pattern(side: int) -> tuple[Floats, Floats]:
    """Return places in a pixel, (n, 2) from 0 to 1, and points of a disc of radius 1, (n, 2), for n = side^2.

    Each place has a cell of the pixel, a row and a column of its own: an edge along the rows is met n times. The points
    of the disc are Vogel's spiral in an order without relation to the places.
    """
    i, j = np.divmod(np.arange(side * side), side)
    within = np.stack([j + (i + 0.5) / side, i + (j + 0.5) / side], axis=1) / side
    k = np.random.default_rng(side).permutation(side * side) + 0.5
    radius, turn = np.sqrt(k) / side, k * math.pi * (3 - math.sqrt(5))
    disc = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)
    return within, disc - disc.mean(axis=0)


def _at_edges(light: Floats, kind: _Ints, shape: tuple[int, int]) -> _Ints:
    """Return the pixels with an edge: two neighbouring places meet different things, or their light is uneven."""
    side = math.isqrt(kind.shape[1])
    mixed = (np.ptp(light, axis=1) > _UNEVEN * light.mean(axis=1)).reshape(shape)
    whole = kind.reshape(*shape, side, side).transpose(0, 2, 1, 3).reshape(shape[0] * side, shape[1] * side)
    for axis in (0, 1):
        at = [np.array(place) // side for place in np.nonzero(np.diff(whole, axis=axis))]
        mixed[tuple(at)] = True
        at[axis] = (np.nonzero(np.diff(whole, axis=axis))[axis] + 1) // side
        mixed[tuple(at)] = True
    return np.flatnonzero(mixed)


def _angle(a: Floats, b: Floats) -> Floats:
    """Return the angles between unit vectors, (n,)."""
    return np.asarray(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))


class _Body:
    """A body's surface for rays, in its own frame, lengths over its radius; raises MachineLacks.

    Attributes
    ----------
    table : of the rig.
    radius_m : of a sphere about the origin, around it.
    """

    def __init__(self, table: BodyTable, mesh: Mesh, pixel_m: float) -> None:
        try:
            triangles = importlib.import_module("embreex.mesh_construction").TriangleMesh
            self._scene = importlib.import_module("embreex.rtcore_scene").EmbreeScene()
        except ImportError as error:
            raise MachineLacks("the reference casts rays by embree:  pip install embreex") from error
        self.table, self.radius_m = table, mesh.radius_m
        corners = mesh.vertices[mesh.faces] / mesh.radius_m
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        side = np.sqrt(2 * np.linalg.norm(flat, axis=1))
        if table.smooth:
            wanted = math.ceil(_SIDES_A_PIXEL * float(side.mean()) * mesh.radius_m / pixel_m)
            self.cuts = max(min(wanted, math.isqrt(_MOST_FACETS // len(corners))), _LEAST_CUTS)
            self._lift, normals = _LIFT * side / self.cuts, mesh.normals[mesh.faces]
            tints = mesh.tints(lambda values: mesh.at_vertices(values)[mesh.faces])
        else:
            self.cuts, self._lift = 1, np.full(len(corners), _FLAT_LIFT)
            tints = mesh.tints(lambda values: values)
            normals = np.repeat((flat / np.linalg.norm(flat, axis=1, keepdims=True))[:, None], 3, axis=1)
        plain = {"albedo": 1.0, "water": 0.0, "rough": 0.0}
        values = [tints.get(name, np.full(mesh.faces.shape, value)) for name, value in plain.items()]
        self._values = np.concatenate([normals, np.stack(values, axis=2)], axis=2)
        self._shares, self._parts = _lattice(self.cuts)
        self._points = np.round(_curved(corners, normals, self._shares) * 2**22) / 2**22  # exact in float32
        faces = (self._parts + len(self._shares) * np.arange(len(corners))[:, None, None]).reshape(-1, 3)
        self._mesh = triangles(self._scene, self._points.reshape(-1, 3).astype(np.float32), faces.astype(np.int32))

    def met(self, eye: Floats, rays: Floats) -> _Ints:
        """Return the small facet that each ray meets first, (n,); -1: none."""
        starts = np.broadcast_to(eye.astype(np.float32), rays.shape)
        return np.asarray(self._scene.run(np.ascontiguousarray(starts), rays.astype(np.float32)), np.int64)

    def hides(self, starts: Floats, rays: Floats) -> Mask:
        """Return whether each ray meets the surface, (n,)."""
        return np.asarray(self._scene.run(starts.astype(np.float32), rays.astype(np.float32), query="OCCLUDED") >= 0)

    def at(self, facets: _Ints, eye: Floats, rays: Floats) -> Floats:
        """Return of each ray that meets a small facet: its length, normal, albedo, water, roughness, lift, (n, 8)."""
        out = np.empty((len(facets), 8))
        _at_hits(facets, eye, rays, (self._points, self._shares, self._parts, self._values), out)
        out[:, 7] = self._lift[facets // len(self._parts)]
        return out


def _lattice(cuts: int) -> tuple[Floats, _Ints]:
    """Return the shares of the corners at the points of a facet cut `cuts` times along each side, and its parts."""
    places = [(i, j) for i in range(cuts + 1) for j in range(cuts + 1 - i)]
    number = {place: k for k, place in enumerate(places)}
    up = [((i, j), (i + 1, j), (i, j + 1)) for i, j in places if i + j < cuts]
    down = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in places if i + j < cuts - 1]
    shares = np.array([(cuts - i - j, i, j) for i, j in places]) / cuts
    return shares, np.array([[number[place] for place in part] for part in up + down])


def _curved(corners: Floats, normals: Floats, shares: Floats) -> Floats:
    """Return points of curved facets, (facets, places, 3): Bezier triangles through corners, along their planes."""
    b, out = shares.T[:, None, :, None], np.zeros((len(corners), len(shares), 3))
    middle = np.zeros((len(corners), 3))
    for i in range(3):
        out += b[i] ** 3 * corners[:, None, i]
        middle -= corners[:, i] / 6
        for j in range(3):
            if i != j:
                along = corners[:, j] - corners[:, i]
                point = corners[:, i] + (along - (along * normals[:, i]).sum(axis=1, keepdims=True) * normals[:, i]) / 3
                out += 3 * b[i] ** 2 * b[j] * point[:, None]
                middle += point / 4
    return np.asarray(out + 6 * b[0] * b[1] * b[2] * middle[:, None])


@_compiled
def _at_hits(
    facets: _Ints, eye: Floats, rays: Floats, surface: tuple[Floats, Floats, _Ints, Floats], out: Floats
) -> None:
    """Write length, normal, albedo and water of rays at small facets that they meet.

    Parameters
    ----------
    surface : points of facets, (facets, places, 3); shares of the corners at these, (places, 3); places at the corners
        of each part, (parts, 3); normals, albedo and water at the corners of facets, (facets, 3, 6).
    """
    points, shares, parts, values = surface
    for k in range(len(facets)):
        f, part = facets[k] // len(parts), parts[facets[k] % len(parts)]
        a, b, c = points[f, part[0]], points[f, part[1]], points[f, part[2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        dx, dy, dz = rays[k, 0], rays[k, 1], rays[k, 2]
        ax, ay, az = a[0] - eye[0], a[1] - eye[1], a[2] - eye[2]
        along = nx * dx + ny * dy + nz * dz
        t = (nx * ax + ny * ay + nz * az) / along if along != 0.0 else 0.0
        px, py, pz = t * dx - ax, t * dy - ay, t * dz - az
        size = nx * nx + ny * ny + nz * nz
        s = ((py * vz - pz * vy) * nx + (pz * vx - px * vz) * ny + (px * vy - py * vx) * nz) / size
        r = ((uy * pz - uz * py) * nx + (uz * px - ux * pz) * ny + (ux * py - uy * px) * nz) / size
        s = min(max(s, 0.0), 1.0)  # the ray that embree meets it with is rounded
        r = min(max(r, 0.0), 1.0 - s)
        out[k, 0] = ((ax + s * ux + r * vx) * dx + (ay + s * uy + r * vy) * dy + (az + s * uz + r * vz) * dz) / (
            dx * dx + dy * dy + dz * dz
        )
        out[k, 1:7] = 0.0
        for corner in range(3):
            own = shares[part[0], corner] * (1.0 - s - r) + shares[part[1], corner] * s + shares[part[2], corner] * r
            for i in range(6):
                out[k, 1 + i] += own * values[f, corner, i]
        length = math.sqrt(out[k, 1] ** 2 + out[k, 2] ** 2 + out[k, 3] ** 2)
        out[k, 1:4] /= max(length, 1e-12)


def _grain(places_m: Floats, o: Octaves) -> Floats:
    """Return slope and brightness of the grain below facets at places, (n, 4)."""
    out, weights = np.zeros((len(places_m), 4)), (1 - o.on_facets) * o.heights_m / o.waves_m
    fields = o.fields.reshape(32, 32, 32, 4)
    for n in np.flatnonzero((weights != 0) | (o.tints != 0)):
        at = TEXELS * (places_m / o.waves_m[n] + o.shifts[n]).T
        for k in range(4):
            height = map_coordinates(fields[..., k], at, np.float64, order=1, mode="grid-wrap")
            out[:, k] += (weights[n] if k < 3 else o.tints[n]) * height
    return out


class SampledBodies(SampledScene):
    """Bodies in sunlight as `pinhole` sees them; raises SceneError, and MachineLacks without embree."""

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole, samples: int = 8) -> None:
        world = BodyWorld(parameters, pinhole)
        self._p = world.parameters
        super().__init__(world, unit(self._p.sun.direction), self._p.sun.radius_rad, samples)
        self._bodies = [
            _Body(table, mesh, world.metres_a_pixel(k))
            for k, (table, mesh) in enumerate(zip(self._p.bodies, world.meshes, strict=True))
        ]

    def _shader(self, t_ns: int) -> Callable[[Floats, Floats], tuple[Floats, _Ints]]:
        camera = self._world.camera.pose(scene_ns := self._world.time.scene_ns(t_ns))
        poses = [*self._world.arrangement.poses_of(range(len(self._bodies)))(scene_ns).values()]
        eyes = [(camera.position_m - pose.position_m) @ pose.world_from_body for pose in poses]

        def shade(rays: Floats, to_sun: Floats) -> tuple[Floats, _Ints]:
            light, kind = np.zeros(len(rays)), np.zeros(len(rays), np.int64)
            nearest = np.full(len(rays), np.inf)
            rays = rays @ camera.world_from_body.T
            for k, (body, pose) in enumerate(zip(self._bodies, poses, strict=True)):
                eye, own = eyes[k] / body.radius_m, rays @ pose.world_from_body
                facets = body.met(eye, own)
                hit = np.flatnonzero(facets >= 0)
                there = body.at(facets[hit], eye, own[hit])
                nearer = there[:, 0] * body.radius_m < nearest[hit]
                hit, there = hit[nearer], there[nearer]
                nearest[hit] = there[:, 0] * body.radius_m
                light[hit], lit = self._radiance(k, there, own[hit], eye, to_sun[hit], poses)
                kind[hit] = 2 * k + 2 + lit
            return light, kind

        return shade

    def _radiance(
        self, k: int, there: Floats, rays: Floats, eye: Floats, to_sun: Floats, poses: list[Pose]
    ) -> tuple[Floats, Mask]:
        """Return the radiance of body k where rays meet it, (n,), and whether the Sun is seen there."""
        body, pose = self._bodies[k], poses[k]
        normals, toward, sun = there[:, 1:4], -rays, to_sun @ pose.world_from_body
        toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        mu0, mu, phase = ((normals * sun).sum(axis=1), (normals * toward).sum(axis=1), _angle(toward, sun))
        lit = mu0 > 0
        starts = eye + there[:, :1] * rays + there[:, 7:] * normals
        if self._p.shadows:
            lit[lit] = ~self._hidden(starts[lit] * body.radius_m, sun[lit], pose, poses)
        albedo = there[:, 4]
        if (octaves := self._world.grain[k]) is not None:
            grain = there[:, 6:7] * _grain((eye + there[:, :1] * rays) * body.radius_m, octaves)
            turned = normals - grain[:, :3] + (grain[:, :3] * normals).sum(axis=1, keepdims=True) * normals
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            mu0, mu = (turned * sun).sum(axis=1), np.maximum((turned * toward).sum(axis=1), _GRAZING)
            albedo = albedo * (1 + grain[:, 3])
        law, detail, sun_w_m2 = body.table.reflectance, body.table.detail, self._p.sun.irradiance_w_m2
        direct = np.where(lit, sun_w_m2 * law.reflect(np.maximum(mu0, 0), mu, phase), 0.0)
        radiance = albedo * (direct + self._p.ambient_w_m2 * law.reflect(np.abs(mu), np.abs(mu), 0.0))
        if isinstance(detail, Clouds):
            sea = there[:, 5] * Water(detail.wind_m_s).reflect(mu0, mu, phase)
            radiance += sun_w_m2 * lit * (sea + air_light(mu0, mu, phase, PLANET_ALBEDO * there[:, 4]))
        return radiance, lit

    def _hidden(self, starts_m: Floats, to_sun: Floats, pose: Pose, poses: list[Pose]) -> Mask:
        """Return whether a body stands before the Sun, (n,), for places and directions in the frame at `pose`."""
        hidden = np.zeros(len(starts_m), bool)
        for other, at in zip(self._bodies, poses, strict=True):
            if other.table.throws_shadow:
                turn = pose.world_from_body.T @ at.world_from_body
                shift = (pose.position_m - at.position_m) @ at.world_from_body
                hidden |= other.hides((starts_m @ turn + shift) / other.radius_m, to_sun @ turn)
        return hidden


class SampledBoard(Scene):
    """A checkerboard along the rows of pixels by `samples` points a pixel on each axis; raises SceneError."""

    def __init__(self, parameters: CheckerboardParameters, size: tuple[int, int], samples: int = 1024) -> None:
        if parameters.rotation_deg:
            raise SceneError("the sampled board lies along the rows of pixels: scene.rotation_deg must be 0")
        self._p = parameters
        self.size = size
        self._samples = samples

    @property
    def motion_bound_px_s(self) -> float:
        """Infinite: the reference is drawn at given steps."""
        return math.inf

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at `t_ns` into `out`, (height, width) float32."""
        direction, moved_px = math.radians(self._p.direction_deg), self._p.speed_px_s * t_ns * 1e-9
        right = self._wave(self.size[0], moved_px * math.cos(direction))
        down = self._wave(self.size[1], moved_px * math.sin(direction))
        middle, half = (self._p.bright + self._p.dark) / 2, (self._p.bright - self._p.dark) / 2
        out[:] = middle + half * np.outer(down, right)

    def close(self) -> None:
        """Do nothing: it holds memory only."""

    def _wave(self, pixels: int, moved_px: float) -> Floats:
        """Return the mean of a square wave over each pixel of an axis; at the start an edge lies in the middle."""
        at_px = (np.arange(pixels * self._samples) + 0.5) / self._samples - pixels / 2 - moved_px
        even = np.floor(at_px / self._p.square_px).astype(np.int64) % 2 == 0
        return np.asarray(np.where(even, 1.0, -1.0).reshape(pixels, -1).mean(axis=1))


class SampledTerrain(SampledScene):
    """Ground as `pinhole` sees it; raises SceneError."""

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole, samples: int = 8) -> None:
        world, sun = TerrainWorld(parameters, pinhole), Sun(distance_au=parameters.sun_distance_au)
        super().__init__(world, world.sun, sun.radius_rad, samples)
        self._irradiance_w_m2 = sun.irradiance_w_m2
        heights = world.ground.heights_m
        albedo = np.ones_like(heights) if world.ground.albedo is None else world.ground.albedo
        self._ground = heights, np.ascontiguousarray(albedo), *_peaks(heights), world.ground.unit_m
        relief_m, radius_m = float(np.ptp(heights)), parameters.body_radius_m
        self._lowest = -math.sqrt(2 * relief_m / radius_m) if radius_m else -math.inf  # of the Sun beyond the map

    def _shader(self, t_ns: int) -> Callable[[Floats, Floats], tuple[Floats, _Ints]]:
        pose = self._world.camera.pose(self._world.time.scene_ns(t_ns))
        p, eye = self._world.parameters, np.asarray(pose.position_m, np.float64)

        def shade(rays: Floats, to_sun: Floats) -> tuple[Floats, _Ints]:
            light, kind, there = np.zeros(len(rays)), np.zeros(len(rays), np.int64), np.empty((len(rays), 8))
            rays = np.ascontiguousarray(rays @ pose.world_from_body.T)
            _over_ground(self._ground, eye, rays, to_sun, there)
            hit = np.flatnonzero(np.isfinite(there[:, 0]))
            normals, sun, toward = there[hit, 1:4], to_sun[hit], -rays[hit]
            toward /= np.linalg.norm(toward, axis=1, keepdims=True)
            mu0, mu = (normals * sun).sum(axis=1), np.maximum((normals * toward).sum(axis=1), _GRAZING)
            lit = (there[hit, 5] > 0) & (sun[:, 2] > self._lowest)
            direct = p.reflectance.reflect(np.maximum(mu0, 1e-9), mu, _angle(toward, sun))
            level = np.clip(toward[:, 2], _GRAZING, 1)
            light[hit] = p.ambient_w_m2 * p.reflectance.reflect(level, level, 0.0)
            light[hit] += np.where(lit, self._irradiance_w_m2 * there[hit, 4] * direct, 0.0)
            kind[hit] = 1 + lit
            return light, kind

        return shade


_Ground = tuple[Float32s, Float32s, Floats, _Ints, float]
"""Heights, m, and albedo of the posts of all grids; `_peaks`; distance of the finest posts, m."""


def _peaks(heights: Float32s) -> tuple[Floats, _Ints]:
    """Return the greatest height in cells of all levels, and a table of levels: first cell, rows, columns, first x, y.

    A cell of level l has 2^l of the finest posts to a side: those of grid l, and above the last grid four cells of the
    level below.
    """
    grids, rows, columns = heights.shape
    levels: list[Floats] = []
    table = []
    while len(levels) < grids or levels[-1].size > 1:
        grid = min(len(levels), grids - 1)
        finer = _quarters(levels[-1]) if levels else np.empty((0, 0))
        if len(levels) < grids:
            z = heights[grid].astype(np.float64)
            peak = np.maximum(np.maximum(z[1:, 1:], z[1:, :-1]), np.maximum(z[:-1, 1:], z[:-1, :-1]))
            if levels:
                top, left = (rows - 1) // 4, (columns - 1) // 4
                inner = peak[top : top + len(finer), left : left + finer.shape[1]]
                np.maximum(inner, finer, out=inner)
        else:
            peak = finer
        first = sum(level.size for level in levels)
        table.append((first, *peak.shape, -((columns - 1) // 2) << grid, -((rows - 1) // 2) << grid))
        levels.append(peak)
    return np.concatenate([level.ravel() for level in levels]), np.array(table)


def _quarters(peak: Floats) -> Floats:
    """Return the greatest of two by two."""
    even = np.pad(peak, [(0, n % 2) for n in peak.shape], constant_values=-np.inf)
    return np.asarray(even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).max(axis=(1, 3)))


@_compiled
def _over_ground(ground: _Ground, eye: Floats, rays: Floats, to_sun: Floats, out: Floats) -> None:
    """Write of each ray its length to the ground, inf for none, the normal, albedo there, and 1 where it sees the Sun.

    Parameters
    ----------
    out : (n, 8), of which two are room.
    """
    for k in range(len(rays)):
        dx, dy, dz = rays[k, 0], rays[k, 1], rays[k, 2]
        t = _first_hit(ground, (eye[0], eye[1], eye[2]), (dx, dy, dz))
        out[k, 0] = t
        if not math.isfinite(t):
            continue
        x, y = eye[0] + t * dx, eye[1] + t * dy
        _write_surface(ground, x, y, out[k])
        sx, sy, sz = to_sun[k, 0], to_sun[k, 1], to_sun[k, 2]
        is_day = out[k, 1] * sx + out[k, 2] * sy + out[k, 3] * sz > 0.0
        start = x, y, out[k, 6] + _GROUND_LIFT * out[k, 7]
        out[k, 5] = 1.0 if is_day and _first_hit(ground, start, (sx, sy, sz)) == math.inf else 0.0


@_compiled
def _first_hit(ground: _Ground, start: tuple[float, float, float], ray: tuple[float, float, float]) -> float:
    """Return the length at which a ray first meets the ground; inf: it does not."""
    heights, peaks, table, unit_m = ground[0], ground[2], ground[3], ground[4]
    grids, rows, columns = heights.shape
    ox, oy, oz = start[0] / unit_m, start[1] / unit_m, start[2]  # posts of the finest grid, and metres
    dx, dy, dz = ray[0] / unit_m, ray[1] / unit_m, ray[2]
    last = len(table) - 1
    fastest = max(abs(dx), abs(dy), 1e-12)
    nudge = 1e-6 / fastest  # that a place lies clearly in a cell
    t, level = 0.0, last
    for axis in range(2):  # to the edge of the map
        o, d = (ox, dx) if axis == 0 else (oy, dy)
        low = float(table[grids - 1, 3 + axis])
        high = low + float(((columns if axis == 0 else rows) - 1) << (grids - 1))
        if o < low or o > high:
            if d == 0.0:
                return math.inf
            t = max(t, ((low if o < low else high) - o) / d)
            if (o < low) != (d > 0.0):
                return math.inf
    while True:
        x, y = ox + dx * (t + nudge), oy + dy * (t + nudge)
        size = float(1 << level)
        j, i = math.floor((x - table[level, 3]) / size), math.floor((y - table[level, 4]) / size)
        if i < 0 or j < 0 or i >= table[level, 1] or j >= table[level, 2]:
            if level >= grids - 1:
                return math.inf
            level += 1
            continue
        left, low = table[level, 3] + j * size, table[level, 4] + i * size
        to_x = (left + (size if dx > 0.0 else 0.0) - ox) / dx if dx != 0.0 else math.inf
        to_y = (low + (size if dy > 0.0 else 0.0) - oy) / dy if dy != 0.0 else math.inf
        end = max(min(to_x, to_y), t + nudge)
        lowest = oz + dz * (t if dz >= 0.0 else end)
        if lowest > peaks[table[level, 0] + i * table[level, 2] + j]:
            t = end
            level = min(level + 1, last)
            continue
        within = (rows - 1) // 4 <= i < 3 * ((rows - 1) // 4) and (columns - 1) // 4 <= j < 3 * ((columns - 1) // 4)
        if level >= grids or (level > 0 and within):
            level -= 1
            continue
        z = heights[level]
        u, v, du, dv = (ox + dx * t - left) / size, (oy + dy * t - low) / size, dx / size, dy / size
        a, b, c = z[i, j], z[i, j + 1] - z[i, j], z[i + 1, j] - z[i, j]
        d = z[i + 1, j + 1] - z[i + 1, j] - b
        above = oz + dz * t - (a + b * u + c * v + d * u * v)
        if above <= 0.0:
            return t
        step = _first_root(-d * du * dv, dz - (b * du + c * dv + d * (u * dv + v * du)), above)
        if step <= end - t:
            return float(t + step)
        t = end
        level = min(level + 1, last)


@_compiled
def _first_root(a: float, b: float, c: float) -> float:
    """Return the least s > 0 with a s^2 + b s + c = 0, c > 0; inf: there is none."""
    square = b * b - 4.0 * a * c
    if square < 0.0:
        return math.inf
    q = -0.5 * (b + math.copysign(math.sqrt(square), b))
    least = math.inf
    if q != 0.0 and c / q > 0.0:
        least = c / q
    if a != 0.0 and q / a > 0.0:
        least = min(least, q / a)
    return least


@_compiled
def _write_surface(ground: _Ground, x_m: float, y_m: float, out: Floats) -> None:
    """Write normal, albedo, height and the distance of posts at a place on the map into numbers 1 to 4, 6 and 7."""
    heights, albedo, _, table, unit_m = ground
    grids, rows, columns = heights.shape
    grid, x, y = 0, 0.0, 0.0
    for g in range(grids):
        grid = g
        x = (x_m / unit_m - table[g, 3]) / (1 << g)
        y = (y_m / unit_m - table[g, 4]) / (1 << g)
        if 0.0 <= x <= columns - 1.0 and 0.0 <= y <= rows - 1.0:
            break
    x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
    i, j = min(int(y), rows - 2), min(int(x), columns - 2)
    post_m = unit_m * (1 << grid)
    z = heights[grid]
    east = north = height = bright = 0.0
    for k in range(4):
        row, column = i + k // 2, j + k % 2
        share = (y - i if k // 2 else 1.0 - (y - i)) * (x - j if k % 2 else 1.0 - (x - j))
        west_, east_ = max(column - 1, 0), min(column + 1, columns - 1)
        south_, north_ = max(row - 1, 0), min(row + 1, rows - 1)
        east += share * (z[row, east_] - z[row, west_]) / ((east_ - west_) * post_m)
        north += share * (z[north_, column] - z[south_, column]) / ((north_ - south_) * post_m)
        height += share * z[row, column]
        bright += share * albedo[grid, row, column]
    length = math.sqrt(1.0 + east * east + north * north)
    out[1], out[2], out[3] = -east / length, -north / length, 1.0 / length
    out[4], out[6], out[7] = bright, height, post_m

"""Light by point samples: a z-buffer with many samples a pixel, in float64. The reference for renderers.

The sampler shares no code with the renderers, has no rates and no coverage, and is slow: each facet is tested against
every sample in its box, and the light of a pixel is the mean of its samples. Depth and light are interpolated linearly
in 1/z, as perspective requires. Facets are visible from both sides.

Bodies (`SampledBodies`) are drawn from every facet. Of the scene's own code this uses the shape models, the paths and
the laws of reflection in float64. Shadows are rays of an independent library (embree through trimesh) from each corner
to points of the Sun's disc. Light is linear over a facet, from corner to corner; flat facets are divided until they are
small: at the closest range no longer than five pixels. Of these only facets in the frame are drawn.

Ground (`SampledTerrain`) is drawn from every facet of its finest grids. Of the scene's own code this uses heights, the
visible share of the Sun at each post, paths, and the laws of reflection in float64. No block is coarser than the map,
nothing is filtered or cached. Light is linear over a facet, from post to post; the normal of a post comes from the
differences of heights over two posts. Facets that hold no sample are skipped in advance.

A board (`SampledBoard`) along the rows of pixels is the product of two square waves, each sampled along its axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import unit
from emulator.geometry.camera import Pinhole
from emulator.light import Light, MachineLacks, Scene, SceneError
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.bodies.world import Arrangement, BodyWorld, PlacedBody
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.world import TerrainWorld
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.pose import Pose, Timescale
from firmware_protocol.compiled import entry_of

_Floats = npt.NDArray[np.float64]
_compiled: Callable[[Callable[..., Any]], Callable[..., Any]] = entry_of(__name__)


class PointSampler:
    """Draws triangles by `samples` x `samples` points a pixel.

    Parameters
    ----------
    size : (width, height), pixels.
    focal_px : focal length over pixel pitch; the boresight is the middle of the light frame.
    """

    def __init__(self, size: tuple[int, int], focal_px: float, samples: int) -> None:
        self._size, self._samples = size, samples
        self._focal = focal_px * samples
        shape = size[1] * samples, size[0] * samples
        self._nearness, self._light = np.zeros(shape), np.zeros(shape)

    def draw(self, parts: Iterable[tuple[_Floats, _Floats]]) -> npt.NDArray[np.float32]:
        """Return the mean light of each pixel, (height, width) float32.

        Parameters
        ----------
        parts : of the scene, each as corners, (facets, 3, 3) m in camera axes (x right, y down, z along the boresight),
            and light at the corners, (facets, 3).
        """
        middle = self._size[0] * self._samples / 2, self._size[1] * self._samples / 2
        self._nearness[:] = 0.0
        self._light[:] = 0.0
        for corners_m, light in parts:
            _fill(*clipped(corners_m, light), (self._focal, *middle), self._nearness, self._light)
        out = np.empty((self._size[1], self._size[0]), np.float32)
        _average(self._light, self._samples, out)
        return out


def clipped(corners_m: _Floats, light: _Floats, nearest_m: float = 1e-3) -> tuple[_Floats, _Floats]:
    """Return the parts of facets beyond `nearest_m` along the boresight, (n, 3, 3), and the light at their corners."""
    before = corners_m[:, :, 2] > nearest_m
    whole = before[:, 0] & before[:, 1] & before[:, 2]
    cut = (before[:, 0] | before[:, 1] | before[:, 2]) & ~whole
    if whole.all():
        return corners_m, light
    parts = [_cut(*facet, nearest_m) for facet in zip(corners_m[cut], light[cut], strict=True)]
    more = [part for one in parts for part in one]
    if not more:
        return corners_m[whole], light[whole]
    corners, lights = (np.array(values) for values in zip(*more, strict=True))
    return np.concatenate((corners_m[whole], corners)), np.concatenate((light[whole], lights))


def _cut(corners: _Floats, light: _Floats, nearest_m: float) -> list[tuple[_Floats, _Floats]]:
    """Return the triangles of the remaining part of one facet, after Sutherland and Hodgman."""
    polygon: list[_Floats] = []
    points = np.column_stack((corners, light))
    for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
        if a[2] > nearest_m:
            polygon.append(a)
        if (a[2] > nearest_m) != (b[2] > nearest_m):
            polygon.append(a + (b - a) * (nearest_m - a[2]) / (b[2] - a[2]))
    fan = [np.array([polygon[0], polygon[k], polygon[k + 1]]) for k in range(1, len(polygon) - 1)]
    return [(part[:, :3], part[:, 3]) for part in fan]


@_compiled
def _fill(corners: _Floats, light: _Floats, screen: tuple[float, float, float], nearest: _Floats, out: _Floats) -> None:
    rows, columns = nearest.shape
    focal, middle_x, middle_y = screen
    for f in range(corners.shape[0]):
        wa, wb, wc = 1 / corners[f, 0, 2], 1 / corners[f, 1, 2], 1 / corners[f, 2, 2]
        ax, ay = corners[f, 0, 0] * wa * focal + middle_x, corners[f, 0, 1] * wa * focal + middle_y
        bx, by = corners[f, 1, 0] * wb * focal + middle_x, corners[f, 1, 1] * wb * focal + middle_y
        cx, cy = corners[f, 2, 0] * wc * focal + middle_x, corners[f, 2, 1] * wc * focal + middle_y
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0 or not math.isfinite(area):
            continue
        top, bottom = max(0, math.ceil(min(ay, by, cy) - 0.5)), min(rows - 1, math.floor(max(ay, by, cy) - 0.5))
        left, right = max(0, math.ceil(min(ax, bx, cx) - 0.5)), min(columns - 1, math.floor(max(ax, bx, cx) - 0.5))
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                a = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                b = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                c = 1.0 - a - b
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                near = a * wa + b * wb + c * wc
                if near > nearest[row, column]:
                    nearest[row, column] = near
                    seen = a * wa * light[f, 0] + b * wb * light[f, 1] + c * wc * light[f, 2]
                    out[row, column] = seen / near


@_compiled
def _average(samples: _Floats, side: int, out: npt.NDArray[np.float32]) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            total = 0.0
            for i in range(row * side, (row + 1) * side):
                for j in range(column * side, (column + 1) * side):
                    total += samples[i, j]
            out[row, column] = total / (side * side)


_DISC_POINTS = 16
_LIFT = 2e-6  # of the body's radius: height at which rays to the Sun start; 1e-4 is above low shadows
_FACET_PX = 5.0  # at the closest range: flat facets are divided to this size
_LARGEST_SHARE, _SMALLEST_SHARE = 32, 512  # of a body's radius, bounds of that size
_BESIDE = 1.1  # of half the frame: facets with a corner within are drawn


@dataclass(frozen=True, eq=False)
class _Body:
    """A body's points, (n, 3) m in its own frame, their normals and albedo, and those of each facet, (facets, 3)."""

    table: BodyTable
    points_m: _Floats
    normals: _Floats
    albedo: _Floats
    facets: npt.NDArray[np.int64]
    lift_m: float
    rays: Any


class SampledBodies(Scene):
    """Bodies in sunlight as `pinhole` sees them, by `samples` x `samples` points a pixel; raises MachineLacks."""

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole, samples: int = 16) -> None:
        self._p, self._pinhole = parameters, pinhole
        self._time = Timescale(parameters.time_scale)
        meshes = _meshes(parameters, pinhole)
        self._camera = build_trajectory(parameters.camera)
        names = [table.name for table in parameters.bodies]
        placed = [
            PlacedBody(build_trajectory(t.path), names.index(t.fixed_to) if t.fixed_to else None, mesh.radius_m)
            for t, mesh in zip(parameters.bodies, meshes, strict=True)
        ]
        self._arrangement = Arrangement(self._camera, placed, self._time)
        facet_m = _FACET_PX * self._arrangement.distance_m / pinhole.focal_px
        self._bodies = [_body(t, mesh, facet_m) for t, mesh in zip(parameters.bodies, meshes, strict=True)]
        self._to_sun = _disc(unit(parameters.sun.direction), parameters.sun.radius_rad)
        self._sampler = PointSampler(pinhole.size, pinhole.focal_px, samples)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._pinhole.size

    @property
    def motion_bound_px_s(self) -> float:
        """Infinite: the reference is drawn at given steps."""
        return math.inf

    @property
    def distance_m(self) -> float:
        """The closest range of any body, less its radius."""
        return self._arrangement.distance_m

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        scene_ns = self._time.scene_ns(t_ns)
        camera, poses = self._camera.pose(scene_ns), self._arrangement.poses(scene_ns)
        out[:] = self._sampler.draw(self._seen(k, camera, poses) for k in range(len(poses)))

    def close(self) -> None:
        """Do nothing: it holds memory only."""

    def _seen(self, k: int, camera: Pose, poses: list[Pose]) -> tuple[_Floats, _Floats]:
        """Return one body's corners in camera axes, (facets, 3, 3), and the radiance at each, (facets, 3)."""
        body, pose = self._bodies[k], poses[k]
        points = body.points_m @ pose.world_from_body.T + pose.position_m
        normals = body.normals @ pose.world_from_body.T
        from_eye = points - camera.position_m
        eye = -from_eye / np.linalg.norm(from_eye, axis=1, keepdims=True)
        sun = unit(self._p.sun.direction)
        mu0, mu, phase = normals @ sun, (normals * eye).sum(axis=1), np.arccos(np.clip(eye @ sun, -1, 1))
        law = body.table.reflectance
        lit = np.where(mu0 > 0, law.reflect(np.maximum(mu0, 0), mu, phase), 0.0)
        around = np.abs(mu)
        in_camera = from_eye @ camera.world_from_body
        near = self._in_frame(in_camera) | body.table.smooth  # facets that are not divided may be larger than the frame
        facets = body.facets[near[body.facets].any(axis=1)]
        wanted = np.zeros(len(points), bool)
        wanted[facets] = True
        sunlit = self._sunlit(points + normals * body.lift_m, wanted & (lit > 0), poses)
        radiance = self._p.sun.irradiance_w_m2 * lit * sunlit
        radiance += self._p.ambient_w_m2 * law.reflect(around, around, 0.0)
        return in_camera[facets], (body.albedo * radiance)[facets]

    def _in_frame(self, points_m: _Floats) -> npt.NDArray[np.bool_]:
        """Return whether points in camera axes, (n, 3), are in the frame, or close beside it."""
        x, y, z = points_m.T
        half = [_BESIDE * side / 2 / self._pinhole.focal_px for side in self._pinhole.size]
        return np.asarray((np.abs(x) <= half[0] * z) & (np.abs(y) <= half[1] * z))

    def _sunlit(self, starts_m: _Floats, wanted: npt.NDArray[np.bool_], poses: list[Pose]) -> _Floats:
        """Return the visible share of the Sun's disc at each point, (n,); 1 for points that are not wanted."""
        share = np.ones(len(starts_m))
        starts = starts_m[wanted]
        if not self._p.shadows or not len(starts):
            return share
        hidden = np.zeros((len(self._to_sun), len(starts)), bool)
        for other, pose in zip(self._bodies, poses, strict=True):
            if other.table.throws_shadow:
                own = (starts - pose.position_m) @ pose.world_from_body
                for i, direction in enumerate(self._to_sun @ pose.world_from_body):
                    hidden[i] |= other.rays.intersects_any(own, np.broadcast_to(direction, own.shape))
        share[wanted] = 1 - hidden.mean(axis=0)
        return share


def _meshes(parameters: BodiesParameters, pinhole: Pinhole) -> list[Mesh]:
    """Return the shape of each body, with its detail."""
    world = BodyWorld(parameters, pinhole)
    world.close()
    return world.meshes


def _body(table: BodyTable, mesh: Mesh, facet_m: float) -> _Body:
    lift_m, rays = _LIFT * mesh.radius_m, _rays(mesh)
    if table.smooth:
        return _Body(table, mesh.vertices, mesh.normals, mesh.vertex_albedo, mesh.faces.astype(np.int64), lift_m, rays)
    albedo = np.ones(mesh.faces.shape) if mesh.albedo is None else mesh.albedo
    both = np.concatenate([mesh.vertices[mesh.faces], albedo[:, :, None]], axis=2)
    facet_m = min(max(facet_m, mesh.radius_m / _SMALLEST_SHARE), mesh.radius_m / _LARGEST_SHARE)
    both = _divided(both, facet_m)
    corners, albedo = both[:, :, :3], both[:, :, 3]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    facets = np.arange(3 * len(corners)).reshape(-1, 3)
    return _Body(table, corners.reshape(-1, 3), np.repeat(across, 3, axis=0), albedo.ravel(), facets, lift_m, rays)


def _divided(corners: _Floats, size_m: float) -> _Floats:
    """Return facets cut in halves across their longest sides until none is longer than `size_m`.

    `corners` are (facets, 3, 4): places, and values that are linear between them.
    """
    done = []
    while len(corners):
        sides = np.linalg.norm((np.roll(corners, -1, axis=1) - corners)[:, :, :3], axis=2)
        long = sides.max(axis=1) > size_m
        done.append(corners[~long])
        turned = (
            np.stack([np.roll(c, -s, axis=0) for c, s in zip(corners[long], sides[long].argmax(axis=1), strict=True)])
            if long.any()
            else corners[:0]
        )
        a, b, c = turned[:, 0], turned[:, 1], turned[:, 2]
        middle = (a + b) / 2
        corners = np.concatenate((np.stack((a, middle, c), axis=1), np.stack((middle, b, c), axis=1)))
    return np.concatenate(done)


def _rays(mesh: Mesh) -> Any:
    """Return an embree ray caster of a mesh; raises MachineLacks."""
    try:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError as error:
        raise MachineLacks("the reference casts rays by embree:  pip install embreex") from error
    return RayMeshIntersector(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), scale_to_box=True)


def _disc(sun: _Floats, radius_rad: float) -> _Floats:
    """Return directions to points spread evenly over the Sun's disc, (points, 3): Vogel's spiral."""
    k = np.arange(_DISC_POINTS) + 0.5
    radius, turn = radius_rad * np.sqrt(k / _DISC_POINTS), k * math.pi * (3 - math.sqrt(5))
    across = unit(np.cross(sun, np.eye(3)[np.abs(sun).argmin()]))
    up = np.cross(sun, across)
    around = np.outer(radius * np.cos(turn), across) + np.outer(radius * np.sin(turn), up)
    return np.asarray((sun + around) / np.linalg.norm(sun + around, axis=1, keepdims=True))


class SampledBoard(Scene):
    """A checkerboard along the rows of pixels by `samples` points a pixel on each axis; raises SceneError."""

    def __init__(self, parameters: CheckerboardParameters, size: tuple[int, int], samples: int = 1024) -> None:
        if parameters.rotation_deg:
            raise SceneError("the sampled board lies along the rows of pixels: scene.rotation_deg must be 0")
        self._p, self._size, self._samples = parameters, size, samples

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._size

    @property
    def motion_bound_px_s(self) -> float:
        """Infinite: the reference is drawn at given steps."""
        return math.inf

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at `t_ns` into `out`, (height, width) float32."""
        direction, moved_px = math.radians(self._p.direction_deg), self._p.speed_px_s * t_ns * 1e-9
        right = self._wave(self._size[0], moved_px * math.cos(direction))
        down = self._wave(self._size[1], moved_px * math.sin(direction))
        middle, half = (self._p.bright + self._p.dark) / 2, (self._p.bright - self._p.dark) / 2
        out[:] = middle + half * np.outer(down, right)

    def close(self) -> None:
        """Do nothing: it holds memory only."""

    def _wave(self, pixels: int, moved_px: float) -> _Floats:
        """Return the mean of a square wave over each pixel of an axis; at the start an edge lies in the middle."""
        at_px = (np.arange(pixels * self._samples) + 0.5) / self._samples - pixels / 2 - moved_px
        even = np.floor(at_px / self._p.square_px).astype(np.int64) % 2 == 0
        return np.asarray(np.where(even, 1.0, -1.0).reshape(pixels, -1).mean(axis=1))


_Ints = npt.NDArray[np.int64]

_GRAZING = 0.02  # least cosine of emission for which the laws are used, as in the scene


class SampledTerrain(Scene):
    """Ground as `pinhole` sees it, by `samples` x `samples` points a pixel; raises SceneError."""

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole, samples: int = 16) -> None:
        self._world = TerrainWorld(parameters, pinhole)
        self._sunlit = self._world.sunlit()
        self._samples = samples
        self._sampler = PointSampler(pinhole.size, pinhole.focal_px, samples)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._world.pinhole.size

    @property
    def motion_bound_px_s(self) -> float:
        """As of the world."""
        return self._world.motion_bound_px_s

    @property
    def distance_m(self) -> float:
        """As of the world."""
        return self._world.distance_m

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        pose = self._world.camera.pose(self._world.time.scene_ns(t_ns))
        out[:] = self._sampler.draw(self._facets(grid, pose) for grid in range(self._world.ground.grids))

    def close(self) -> None:
        """Close the ports of live poses."""
        self._world.close()

    def _facets(self, grid: int, pose: Pose) -> tuple[_Floats, _Floats]:
        """Return corners in camera axes and light, of the facets with samples of one grid where no finer one lies."""
        i, j = self._quads(grid, pose)
        number = np.full(self._world.ground.shape, -1, np.int32)
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            number[i + down, j + right] = 0
        rows, columns = np.nonzero(number == 0)
        number[rows, columns] = np.arange(len(rows), dtype=np.int32)
        rays = self._rays(grid, rows, columns, pose)
        light, ahead = self._radiance(grid, rows, columns, rays), rays @ pose.world_from_body
        quads = [number[c] for c in ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j))]
        facets = np.stack([quads[k] for k in (0, 1, 2, 0, 2, 3)], axis=1).reshape(-1, 3)
        return ahead[facets], light[facets]

    def _quads(self, grid: int, pose: Pose) -> tuple[_Ints, _Ints]:
        """Return rows and columns of the quads that may hold a sample."""
        ground, pinhole = self._world.ground, self._world.pinhole
        focal_px = pinhole.focal_px * self._samples
        size = np.array(pinhole.size) * self._samples
        first = np.array(ground.first(grid)) * ground.unit_m
        return tuple(
            _holding(
                ground.heights_m[grid],
                (*first, ground.post_m(grid)),
                np.asarray(pose.position_m, np.float64),
                np.ascontiguousarray(pose.world_from_body),
                (focal_px, int(size[0]), int(size[1])),
                grid > 0,
            )
        )

    def _rays(self, grid: int, rows: _Ints, columns: _Ints, pose: Pose) -> _Floats:
        """Return posts from the camera, (n, 3) in the world."""
        ground = self._world.ground
        x0, y0 = ground.first(grid)
        x, y = ((first + at * 2**grid) * ground.unit_m for first, at in ((x0, columns), (y0, rows)))
        return np.asarray(np.stack([x, y, ground.heights_m[grid][rows, columns]], axis=-1) - pose.position_m)

    def _radiance(self, grid: int, rows: _Ints, columns: _Ints, rays: _Floats) -> _Floats:
        """Return the radiance of posts, (n,)."""
        world = self._world
        z, post_m = world.ground.heights_m[grid].astype(np.float64), world.ground.post_m(grid)
        down, right = (_slopes(z, rows, columns, axis) / post_m for axis in (0, 1))
        normals = np.stack([-right, -down, np.ones(len(rows))], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        eye = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        mu0, mu = normals @ world.sun, np.maximum((normals * eye).sum(axis=-1), _GRAZING)
        law = world.parameters.reflectance
        direct = law.reflect(np.maximum(mu0, 1e-9), mu, np.arccos(np.clip(eye @ world.sun, -1, 1)))
        level = np.clip(eye[:, 2], _GRAZING, 1)
        around = world.parameters.ambient_w_m2 * law.reflect(level, level, 0.0)
        lit = np.where(mu0 > 0, direct, 0) * self._sunlit[grid][rows, columns]
        return np.asarray(world.irradiance_w_m2 * lit + around)


def _slopes(z: _Floats, rows: _Ints, columns: _Ints, axis: int) -> _Floats:
    """Return differences of heights over two posts, or one at the border, a post."""
    at = [rows, columns]
    before, after = list(at), list(at)
    before[axis], after[axis] = np.maximum(at[axis] - 1, 0), np.minimum(at[axis] + 1, z.shape[axis] - 1)
    return np.asarray((z[tuple(after)] - z[tuple(before)]) / (after[axis] - before[axis]))


@_compiled
def _holding(
    z: npt.NDArray[np.float32],
    lattice: tuple[float, float, float],
    place: _Floats,
    world_from_camera: _Floats,
    screen: tuple[float, int, int],
    is_outer: bool,
) -> tuple[_Ints, _Ints]:
    """Return the quads whose boxes on the screen hold a sample, or that reach behind the camera.

    Parameters
    ----------
    lattice : x and y of the first post, and the distance of posts, m.
    screen : focal length, width and height, in samples.
    is_outer : True: a finer grid lies in the middle.
    """
    rows, columns = z.shape
    focal, width, height = screen
    x, y = np.empty((2, columns)), np.empty((2, columns))
    i_found, j_found = np.empty(rows * columns, np.int64), np.empty(rows * columns, np.int64)
    n = 0
    top, left = (rows - 1) // 4, (columns - 1) // 4
    for i in range(rows):
        line = i % 2
        for j in range(columns):
            rx, ry = lattice[0] + j * lattice[2] - place[0], lattice[1] + i * lattice[2] - place[1]
            rz = z[i, j] - place[2]
            ahead = rx * world_from_camera[0, 2] + ry * world_from_camera[1, 2] + rz * world_from_camera[2, 2]
            right = rx * world_from_camera[0, 0] + ry * world_from_camera[1, 0] + rz * world_from_camera[2, 0]
            down = rx * world_from_camera[0, 1] + ry * world_from_camera[1, 1] + rz * world_from_camera[2, 1]
            if ahead > 1e-3:
                x[line, j], y[line, j] = right / ahead * focal + 0.5 * width, down / ahead * focal + 0.5 * height
            else:
                x[line, j] = y[line, j] = math.nan
        if i == 0:
            continue
        for j in range(columns - 1):
            if is_outer and top < i <= 3 * top and left <= j < 3 * left:
                continue
            x0, x1 = min(x[0, j], x[0, j + 1], x[1, j], x[1, j + 1]), max(x[0, j], x[0, j + 1], x[1, j], x[1, j + 1])
            y0, y1 = min(y[0, j], y[0, j + 1], y[1, j], y[1, j + 1]), max(y[0, j], y[0, j + 1], y[1, j], y[1, j + 1])
            total = x[0, j] + x[0, j + 1] + x[1, j] + x[1, j + 1]
            if total == total:
                x0, x1, y0, y1 = max(x0, 0.0), min(x1, float(width)), max(y0, 0.0), min(y1, float(height))
                if math.ceil(x0 - 0.5) > math.floor(x1 - 0.5) or math.ceil(y0 - 0.5) > math.floor(y1 - 0.5):
                    continue
            elif not _is_seen(z, i - 1, j, lattice, place, world_from_camera, screen):
                continue
            i_found[n], j_found[n] = i - 1, j
            n += 1
    return i_found[:n].copy(), j_found[:n].copy()


@_compiled
def _is_seen(
    z: npt.NDArray[np.float32],
    i: int,
    j: int,
    lattice: tuple[float, float, float],
    place: _Floats,
    world_from_camera: _Floats,
    screen: tuple[float, int, int],
) -> bool:
    """Return whether a quad is not wholly beyond one of the planes around the view."""
    x, y = 0.5 * screen[1] / screen[0], 0.5 * screen[2] / screen[0]
    for plane in ((1.0, 0.0, x), (-1.0, 0.0, x), (0.0, 1.0, y), (0.0, -1.0, y), (0.0, 0.0, 1.0)):
        inside = False
        for k in range(4):
            row, column = i + k // 2, j + k % 2
            rx, ry = lattice[0] + column * lattice[2] - place[0], lattice[1] + row * lattice[2] - place[1]
            rz = z[row, column] - place[2]
            ahead = 0.0
            for axis in range(3):
                along = rx * world_from_camera[0, axis] + ry * world_from_camera[1, axis]
                ahead += plane[axis] * (along + rz * world_from_camera[2, axis])
            inside = inside or ahead > 0.0
        if not inside:
            return False
    return True

"""The bodies of a rig by point samples, from every facet: the reference for the renderers of bodies.

Of the scene's own code it uses the shape models, the paths and the laws of reflection in float64. Visibility is by
`point_sampler`, shadows are rays of an independent library (embree through trimesh) from each corner to points of the
Sun's disc. Light is linear over a facet, from corner to corner; flat facets are divided until they are small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.accuracy.point_sampler import PointSampler
from emulator.geometry.attitude import unit
from emulator.geometry.pinhole import Pinhole
from emulator.light import Light, MachineLacks, Scene
from emulator.scene.bodies.arrangement import Arrangement, Placed
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.bodies.world import BodyWorld
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.pose import Pose
from emulator.trajectory.timescale import Timescale

__all__ = ["SampledBodies"]

_Floats = npt.NDArray[np.float64]
_DISC_POINTS = 16
_LIFT = 2e-6  # of the body's radius: how far above it rays to the Sun start; 1e-4 is above low shadows
_SMALLEST_SHARE = 32  # of a body's radius: flat facets are divided to this part of it


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
            Placed(build_trajectory(t.path), names.index(t.fixed_to) if t.fixed_to else None, mesh.radius_m)
            for t, mesh in zip(parameters.bodies, meshes, strict=True)
        ]
        self._bodies = [_body(t, mesh) for t, mesh in zip(parameters.bodies, meshes, strict=True)]
        self._arrangement = Arrangement(self._camera, placed, self._time)
        self._to_sun = _disc(unit(parameters.sun.direction), parameters.sun.radius_rad)
        self._sampler = PointSampler(pinhole.size, pinhole.focal_px, samples)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._pinhole.size

    @property
    def motion_bound_px_s(self) -> float:
        """Infinite: the reference is drawn at the steps that it is given."""
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
        radiance = self._p.sun.irradiance_w_m2 * lit * self._sunlit(points + normals * body.lift_m, lit > 0, poses)
        radiance += self._p.ambient_w_m2 * law.reflect(around, around, 0.0)
        return (from_eye @ camera.world_from_body)[body.facets], (body.albedo * radiance)[body.facets]

    def _sunlit(self, starts_m: _Floats, wanted: npt.NDArray[np.bool_], poses: list[Pose]) -> _Floats:
        """Return the share of the Sun's disc that each point sees, (n,); of those that are not wanted, 1."""
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


def _body(table: BodyTable, mesh: Mesh) -> _Body:
    lift_m, rays = _LIFT * mesh.radius_m, _rays(mesh)
    if table.smooth:
        return _Body(table, mesh.vertices, mesh.normals, mesh.vertex_albedo, mesh.faces.astype(np.int64), lift_m, rays)
    albedo = np.ones(mesh.faces.shape) if mesh.albedo is None else mesh.albedo
    both = np.concatenate([mesh.vertices[mesh.faces], albedo[:, :, None]], axis=2)
    both = _divided(both, mesh.radius_m / _SMALLEST_SHARE)
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

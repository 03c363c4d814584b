"""Depth, optical flow and labels of bodies, from their shapes and poses alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from emulator.geometry.seen import Given, Placed, Rays, SceneGeometry, Seen
from emulator.scene.bodies.lighting import Motion, Poses, motion_at
from emulator.scene.bodies.table import BodyTable
from emulator.scene.bodies.world import BodyWorld
from emulator.trajectory.pose import Pose
from emulator.truth.motion import motion_of, write_depth_and_flow
from emulator.truth.surfaces import NearestSurface

__all__ = ["BodiesGeometry"]

_NEAREST_SHARE = 1e-6  # of the range to the nearest body: facets are cut this near the camera


class BodiesGeometry(SceneGeometry):
    """The geometry of a world of bodies; shapes have the detail that is drawn."""

    gives: frozenset[Given] = frozenset({"poses", "depth", "flow", "labels"})

    def __init__(self, world: BodyWorld, rays: Rays | None = None) -> None:
        self._world, self._rays = world, rays or Rays.straight(world.pinhole)
        self.names = _names(world.parameters.bodies)
        self._meshes = [world.as_seen(k) for k in range(len(world.meshes))]
        surfaces = [(mesh.faces, len(mesh.vertices), mesh.open_edges > 0) for mesh in self._meshes]
        self._surfaces = NearestSurface(surfaces, world.pinhole, _NEAREST_SHARE * world.arrangement.distance_m)
        self._inverse_depth = np.zeros_like(self._rays.columns)

    def look(self, t_ns: int, out: Seen) -> None:
        """Write depth, flow and labels at `t_ns`."""
        motion = self._motion(t_ns)
        self._surfaces.look(self._vertices(motion), self._rays, out.labels, self._inverse_depth)
        write_depth_and_flow(self._inverse_depth, _motions(motion), self._world.pinhole, self._rays, out)

    def places(self, t_ns: int) -> Placed:
        """Return the poses at `t_ns`."""
        scene_ns = self._world.time.scene_ns(t_ns)
        camera, bodies = self._world.camera.pose(scene_ns), self._world.arrangement.poses(scene_ns)
        return Placed(
            camera.position_m,
            camera.q_world_from_body,
            np.array([pose.position_m for pose in bodies]),
            np.array([pose.q_world_from_body for pose in bodies]),
        )

    def _motion(self, t_ns: int) -> Motion:
        world = self._world
        return motion_at(t_ns, world.camera, world.arrangement.poses, world.time)

    def _vertices(self, motion: Motion) -> np.ndarray:
        eye, camera_from_world = motion.now.camera.position_m, motion.now.camera.world_from_body.T
        return np.concatenate(
            [
                mesh.vertices @ (camera_from_world @ pose.world_from_body).T
                + camera_from_world @ (pose.position_m - eye)
                for mesh, pose in zip(self._meshes, _in_order(motion.now), strict=True)
            ]
        )


def _motions(motion: Motion) -> np.ndarray:
    """Return M and c of the sky and of each body, (bodies + 1, 3, 4)."""
    now, before, after = motion.now, motion.before, motion.after
    camera = now.camera, before.camera, after.camera
    bodies = [None, *zip(_in_order(now), _in_order(before), _in_order(after), strict=True)]
    return np.array([motion_of(camera, body, motion.between_s) for body in bodies])


def _in_order(poses: Poses) -> list[Pose]:
    """Return the poses of all bodies."""
    return [poses.bodies[k] for k in range(len(poses.bodies))]


def _names(bodies: Sequence[BodyTable]) -> tuple[str, ...]:
    """Return a name of its own for each body: that of the rig, else that of its shape."""
    names: list[str] = []
    for body in bodies:
        name = body.name or Path(str(body.shape)).stem
        same = sum(other == name or other.startswith(f"{name} ") for other in names)
        names.append(f"{name} {same + 1}" if same else name)
    return tuple(names)

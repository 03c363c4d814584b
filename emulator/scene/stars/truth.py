"""Optical flow of the sky, and where moving points are in it.

Stars are infinitely far and turn with the camera. A moving point covers no pixel; those whose middles lie within two
standard deviations of its blur, or within a pixel, have its label, its depth and its flow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from emulator.geometry.pinhole import Pinhole
from emulator.geometry.seen import Given, Placed, Rays, SceneGeometry, Seen
from emulator.trajectory.pose import Trajectory
from emulator.trajectory.timescale import Timescale
from emulator.truth.motion import Instants, instants, motion_of, write_depth_and_flow

__all__ = ["Sky", "StarsGeometry"]

_REACH = 2.0  # standard deviations


@dataclass(frozen=True, eq=False)
class Sky:
    """The camera's path and those of the moving points."""

    camera: Trajectory
    points: Sequence[Trajectory]
    time: Timescale


class StarsGeometry(SceneGeometry):
    """The geometry of a sky; label k is the k-th moving point.

    Parameters
    ----------
    sigma_px : standard deviation of the blur.
    """

    gives: frozenset[Given] = frozenset({"poses", "depth", "flow", "labels"})

    def __init__(self, sky: Sky, camera: Pinhole, sigma_px: float, rays: Rays) -> None:
        self._sky, self._camera, self._rays = sky, camera, rays
        self.names = tuple(f"point {k + 1}" for k in range(len(sky.points)))
        self._reach_px = max(1.0, _REACH * sigma_px)
        self._inverse_depth = np.zeros_like(rays.columns)

    def look(self, t_ns: int, out: Seen) -> None:
        """Write depth, flow and labels at `t_ns`."""
        (camera, *points), between_s = instants(t_ns, [self._sky.camera, *self._sky.points], self._sky.time)
        out.labels.fill(0)
        for k, point in enumerate(points):
            self._mark(k + 1, camera, point, out)
        motions = np.array([motion_of(camera, body, between_s) for body in (None, *points)])
        write_depth_and_flow(self._inverse_depth, motions, self._camera, self._rays, out)

    def _mark(self, label: int, camera: Instants, point: Instants, out: Seen) -> None:
        """Write label and 1 / depth of the pixels near a point, where nothing nearer is."""
        own = camera[0].world_from_body.T @ (point[0].position_m - camera[0].position_m)
        if own[2] <= 0:
            return
        focal, (width, height) = self._camera.focal_px, self._camera.size
        column, row = width / 2 + focal * own[0] / own[2], height / 2 + focal * own[1] / own[2]
        near = np.hypot(self._rays.columns - column, self._rays.rows - row) <= self._reach_px
        near &= (out.labels == 0) | (self._inverse_depth < 1 / own[2])
        out.labels[near], self._inverse_depth[near] = label, 1 / own[2]

    def places(self, t_ns: int) -> Placed:
        """Return the poses at `t_ns`."""
        scene_ns = self._sky.time.scene_ns(t_ns)
        camera, points = self._sky.camera.pose(scene_ns), [path.pose(scene_ns) for path in self._sky.points]
        return Placed(
            camera.position_m,
            camera.q_world_from_body,
            np.array([pose.position_m for pose in points]).reshape(-1, 3),
            np.array([pose.q_world_from_body for pose in points]).reshape(-1, 4),
        )

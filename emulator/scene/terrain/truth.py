"""Depth, optical flow and labels of terrain, from the facets of its picture.

Their corners are posts of the map, as fine as they are seen; between them the ground is taken for flat, as it is drawn.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from emulator.geometry.seen import Given, Placed, Rays, SceneGeometry, Seen
from emulator.scene.terrain.world import TerrainWorld
from emulator.trajectory.pose import STILL
from emulator.truth.motion import instants, motion_of, write_depth_and_flow
from emulator.truth.surfaces import nearest_along

__all__ = ["TerrainGeometry"]

Facets = Callable[[int], tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]]
"""Gives, for a stream time, the facet at each pixel of the straight picture and the facets, see `nearest_along`."""


class TerrainGeometry(SceneGeometry):
    """The geometry of a ground that stands still, label 1."""

    names = ("ground",)
    gives: frozenset[Given] = frozenset({"poses", "depth", "flow", "labels"})

    def __init__(self, world: TerrainWorld, facets_at: Facets, rays: Rays | None = None) -> None:
        self._world, self._facets_at = world, facets_at
        self._rays = rays or Rays.straight(world.pinhole)
        self._inverse_depth = np.zeros_like(self._rays.columns)

    def look(self, t_ns: int, out: Seen) -> None:
        """Write depth, flow and labels at `t_ns`."""
        world = self._world
        nearest, facets = self._facets_at(t_ns)
        nearest_along(nearest, facets, np.ones(len(facets), np.uint16), self._rays, (out.labels, self._inverse_depth))
        (camera,), between_s = instants(t_ns, [world.camera], world.time)
        motions = np.array([motion_of(camera, body, between_s) for body in (None, (STILL, STILL, STILL))])
        write_depth_and_flow(self._inverse_depth, motions, world.pinhole, self._rays, out)

    def places(self, t_ns: int) -> Placed:
        """Return the camera's pose at `t_ns`; the ground's frame is the world."""
        camera = self._world.camera.pose(self._world.time.scene_ns(t_ns))
        return Placed(
            camera.position_m, camera.q_world_from_body, STILL.position_m[None], STILL.q_world_from_body[None]
        )

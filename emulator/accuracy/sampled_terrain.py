"""The ground of a rig by point samples, from every facet of its finest grids: the reference for renderers of terrain.

Of the scene's own code it uses heights, the share of the Sun that each post sees, paths, and the laws of reflection in
float64. No block is coarser than the map, nothing is filtered or remembered. Light is linear over a facet, from post to
post; the normal of a post comes of the differences of heights over two posts.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.accuracy.point_sampler import PointSampler
from emulator.geometry.pinhole import Pinhole
from emulator.light import Light, Scene
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.world import TerrainWorld
from emulator.trajectory.pose import Pose

__all__ = ["SampledTerrain"]

_Floats = npt.NDArray[np.float64]
_GRAZING = 0.02  # the laws are used for no smaller cosine of emission, as the scene's documents say


class SampledTerrain(Scene):
    """Ground as `pinhole` sees it, by `samples` x `samples` points a pixel; raises SceneError."""

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole, samples: int = 8) -> None:
        self._world = TerrainWorld(parameters, pinhole)
        self._sunlit = self._world.sunlit()
        self._sampler = PointSampler(pinhole.size, pinhole.focal_px, samples)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._world.pinhole.size

    @property
    def motion_bound_px_s(self) -> float:
        """As of the world."""
        return self._world.motion_bound_px_s

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        pose = self._world.camera.pose(self._world.time.scene_ns(t_ns))
        parts = [self._facets(grid, pose) for grid in range(self._world.ground.grids)]
        corners, light = (np.concatenate(values) for values in zip(*parts, strict=True))
        out[:] = self._sampler.draw(corners, light)

    def close(self) -> None:
        """Close the ports of live poses."""
        self._world.close()

    def _facets(self, grid: int, pose: Pose) -> tuple[_Floats, _Floats]:
        """Return corners in camera axes and light, of the facets in view of one grid where no finer one lies."""
        ground = self._world.ground
        z = ground.heights_m[grid].astype(np.float64)
        x0, y0 = ground.first(grid)
        y, x = np.indices(z.shape, dtype=np.float64)
        posts = np.stack([(x0 + x * 2**grid) * ground.unit_m, (y0 + y * 2**grid) * ground.unit_m, z], axis=-1)
        rays = posts - pose.position_m
        quads = self._seen(rays, pose)
        if grid > 0:
            rows, columns = ((n - 1) // 4 for n in z.shape)
            quads[rows : 3 * rows, columns : 3 * columns] = False
        i, j = np.nonzero(quads)
        wanted = np.zeros(z.shape, bool)
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            wanted[i + down, j + right] = True
        light = np.zeros(z.shape)
        light[wanted] = self._radiance(grid, z, rays, wanted)
        ahead = rays @ pose.world_from_body
        corners = [(i, j), (i, j + 1), (i + 1, j + 1), (i, j), (i + 1, j + 1), (i + 1, j)]
        at = np.stack([ahead[c] for c in corners], axis=1).reshape(-1, 3, 3)
        return at, np.stack([light[c] for c in corners], axis=1).reshape(-1, 3)

    def _seen(self, rays: _Floats, pose: Pose) -> npt.NDArray[np.bool_]:
        """Return which quads are not wholly beyond one of the planes around the view, (rows - 1, columns - 1)."""
        seen = np.ones((rays.shape[0] - 1, rays.shape[1] - 1), bool)
        for plane in self._world.planes(pose):
            inside = rays @ plane > 0
            seen &= inside[:-1, :-1] | inside[:-1, 1:] | inside[1:, :-1] | inside[1:, 1:]
        return seen

    def _radiance(self, grid: int, z: _Floats, rays: _Floats, wanted: npt.NDArray[np.bool_]) -> _Floats:
        """Return the radiance of the wanted posts, (n,)."""
        world = self._world
        post_m = world.ground.post_m(grid)
        down, right = np.gradient(z, post_m, axis=0), np.gradient(z, post_m, axis=1)
        normals = np.stack([-right[wanted], -down[wanted], np.ones(int(wanted.sum()))], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        eye = -rays[wanted] / np.linalg.norm(rays[wanted], axis=-1, keepdims=True)
        mu0, mu = normals @ world.sun, np.maximum((normals * eye).sum(axis=-1), _GRAZING)
        law = world.parameters.reflectance
        direct = law.reflect(np.maximum(mu0, 1e-9), mu, np.arccos(np.clip(eye @ world.sun, -1, 1)))
        level = np.clip(eye[:, 2], _GRAZING, 1)
        around = world.parameters.ambient_w_m2 * law.reflect(level, level, 0.0)
        lit = np.where(mu0 > 0, direct, 0) * self._sunlit[grid][wanted]
        return np.asarray(world.irradiance_w_m2 * lit + around)

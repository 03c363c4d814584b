"""The ground of a rig by point samples, from every facet of its finest grids: the reference for renderers of terrain.

Of the scene's own code it uses heights, the share of the Sun that each post sees, paths, and the laws of reflection in
float64. No block is coarser than the map, nothing is filtered or remembered. Light is linear over a facet, from post to
post; the normal of a post comes of the differences of heights over two posts. Facets that hold no sample are left out
beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.accuracy.point_sampler import PointSampler
from emulator.geometry.pinhole import Pinhole
from emulator.light import Light, Scene
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.world import TerrainWorld
from emulator.trajectory.pose import Pose
from firmware_protocol.compiled import entry_of

__all__ = ["SampledTerrain"]

_Floats = npt.NDArray[np.float64]
_Ints = npt.NDArray[np.int64]
_compiled: Callable[[Callable[..., Any]], Callable[..., Any]] = entry_of(__name__)
_GRAZING = 0.02  # the laws are used for no smaller cosine of emission, as the scene's documents say


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
    is_outer : whether a finer grid lies in the middle.
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

"""Ground under a low Sun drawn by the CPU: light of each pixel by exact coverage and the fine map, and its rate; no GL.

    pose --> blocks in view (`quadtree`) --> their vertices (`quadtree`) --> `raster` --> facets of pixels
                                             fine map, facets --> `pixel_shading` --> light of pixels

Light is radiance, W m-2 sr-1, 400 to 700 nm: sunlight by the ground's law of reflection, with the shadows that the
ground casts on itself and their penumbra, and an even light from all around. The ground curves with the body. Not
modelled: light from slope to slope, and ground beyond the map, where the light frame is black. The time derivative is
that of the shading, as footprints move over the map (`pixel_law`). There is no light of single pixels between light
frames: light frames at an eighth of the step made as many wrong events (docs/accuracy.md).

Depth, optical flow and labels come from the facets of the light frame. Their corners are posts of the map, as fine as
they are drawn; between them the ground is flat, as it is drawn. `camera_motion` gives the rates of the camera's pose
from poses shortly before and after.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Given, Pinhole, Rays, SceneGeometry, ScenePoses, Seen
from emulator.light import NOTHING, LastArrays, Light
from emulator.photometry.reflection_kernels import law_of
from emulator.raster.layout import Owners, Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.surfaces import instants, motion_of, nearest_along, write_depth_and_flow
from emulator.raster.topology import Topology, join, prepare
from emulator.scene.terrain.pixel_hits import Grids, Posts, Projection, Sight
from emulator.scene.terrain.pixel_law import Motion, Sunlight, rate_of_doubtful
from emulator.scene.terrain.pixel_parts import LINE_FIELDS, Peaks
from emulator.scene.terrain.pixel_shading import ROW_FIELDS, Smooth, shade_doubtful, shade_rows
from emulator.scene.terrain.quadtree import (
    CORNERS,
    LEAST_REACH,
    Camera,
    Quadtree,
    Vertices,
    block_facets,
    block_vertices,
)
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.tile import new_tile
from emulator.scene.terrain.world import TerrainWorld
from emulator.scene.world import WorldScene
from emulator.threads import ThreadPool, available_threads
from emulator.trajectory.pose import STILL, Pose, Timescale, Trajectory

Facets = Callable[[int], tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]]
"""Function from a stream time to the facet at each pixel without distortion, and the facets, see `nearest_along`."""


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
        label, rays = np.ones(len(facets), np.uint16), self._rays
        nearest_along(nearest, facets, label, rays.columns, rays.rows, out.labels, self._inverse_depth)
        (camera,), between_s = instants(t_ns, [world.camera], world.time)
        motions = np.array([motion_of(camera, body, between_s) for body in (None, (STILL, STILL, STILL))])
        write_depth_and_flow(self._inverse_depth, motions, world.pinhole, self._rays, out)

    def places(self, t_ns: int) -> ScenePoses:
        """Return the camera's pose at `t_ns`; the ground's frame is the world."""
        camera = self._world.camera.pose(self._world.time.scene_ns(t_ns))
        return ScenePoses(
            camera.position_m, camera.q_world_from_body, STILL.position_m[None], STILL.q_world_from_body[None]
        )


def camera_motion(t_ns: int, camera: Trajectory, time: Timescale) -> tuple[Pose, Camera]:
    """Return the pose at stream time `t_ns` and the motion then, as kernels take it, a second of stream time.

    At the start, where a path may begin, the motion is from poses after it only.
    """
    ((now, before, after),), between_s = instants(t_ns, [camera], time)
    turn, turning = (
        np.ascontiguousarray(m.T)
        for m in (now.world_from_body, (after.world_from_body - before.world_from_body) / between_s)
    )
    velocity = (after.position_m - before.position_m) / between_s
    return now, Camera(np.asarray(now.position_m, np.float64), velocity, turn, turning)


_NEAREST_SHARE = 1e-3  # of the least height of the camera: facets are cut this near
_FIRST_BLOCKS = 256
_FINEST_PX = 1.0
_COARSER = 2.0  # light has the fine map's detail and its height (`pixel_shading`), so facets twice as large are enough
_BAND = 32  # rows that a thread shades at a time
_FAINT = 0.1  # of the mean of the light frame: changes of less light are not refined
_HEIGHTS = 4097  # of the eye's direction, in the table of the ambient light


class RasterTerrain(WorldScene[TerrainWorld]):
    """The ground of `parameters` as `pinhole` sees it, in radiance, drawn by the CPU; raises SceneError.

    With any number of `threads`, 0: the machine's, the light frames are the same to the last bit.
    """

    has_rate = True

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole, threads: int = 1) -> None:
        world, threads = TerrainWorld(parameters, pinhole), threads or available_threads()
        super().__init__(world)
        self._reach = max(pinhole.focal_px / facet_px(parameters, pinhole, _FINEST_PX, _COARSER), LEAST_REACH)
        self._tree = Quadtree(world.ground, self._reach)
        self._pyramid = world.pyramid(len(self._tree.levels) + 1)
        # A map is large: albedo is part of the light now, and the pyramid begins with the same heights.
        shape = world.ground.heights_m.shape
        heights_m = self._pyramid.heights[: math.prod(shape)].reshape(shape)
        world.ground = dataclasses.replace(world.ground, heights_m=heights_m, albedo=None)
        self._peaks = Peaks(self._tree.highest, self._tree.levels)
        heights = np.linspace(0, 1, _HEIGHTS)
        law = parameters.reflectance
        ambient = parameters.ambient_w_m2 * law.reflect(heights, heights, 0.0)
        self._sun = Sunlight(world.disc, world.irradiance_w_m2, *law_of(law), ambient)
        self._blocks = _Blocks(prepare(block_facets()[1]), _FIRST_BLOCKS)
        width, height = pinhole.size
        screen = Screen(width, height, pinhole.focal_px, (width / 2, height / 2), _NEAREST_SHARE * world.distance_m)
        self._renderer = Renderer(self._blocks.topology(0), screen, threads)
        self._pool = ThreadPool(threads)
        self._tiles = [new_tile() for _ in range(threads)]
        self._lines = [(np.zeros((ROW_FIELDS, width + 2)), np.zeros((LINE_FIELDS, width + 2))) for _ in range(threads)]
        pyramid = self._pyramid
        grids = Grids(world.ground.unit_m, world.ground.grids, (min(world.ground.shape) - 1) / 2)
        self._posts = Posts(pyramid.heights, pyramid.moments, pyramid.levels, grids, pyramid.shadows)
        light, rate = (np.zeros((height, width), np.float32) for _ in range(2))
        self._smooth = Smooth(light, np.zeros((height, width), np.uint8), rate)
        self._owners = Owners.of(width, height)
        self._spare = np.zeros((height, width), np.float32)
        self._drawn = NOTHING
        self._arrays = LastArrays()
        self._frame_ns: int | None = None

    def geometry(self, rays: Rays | None = None) -> TerrainGeometry:
        """Return depth, flow and labels of the ground, from the facets that were drawn."""
        return TerrainGeometry(self._world, self._facets_at, rays)

    def _facets_at(self, t_ns: int) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]:
        """Return the facet at each pixel, -1 for none, and the facets at `t_ns`, drawn if they are not yet."""
        if self._frame_ns != t_ns:
            self.light(t_ns, np.zeros_like(self._spare))
        return self._owners.facets, self._renderer.facets

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32; raises SceneError below the ground."""
        self.light_and_rate(t_ns, out, self._spare)

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the radiance at `t_ns` and its rate, a second, both (height, width) float32."""
        before = self._drawn if self._arrays.are(light, rate) else None
        pose, camera = camera_motion(t_ns, self._world.camera, self._world.time)
        self._drawn = self._renderer.draw(self._view(t_ns, pose, camera), light, rate, None, self._owners)
        self._shade(camera, light, rate)
        self._frame_ns = t_ns
        self.changed = None if before is None else self._drawn.union(before)

    def close(self) -> None:
        """End the threads and close the port; a second call does nothing."""
        self._renderer.close()
        self._pool.close()
        super().close()

    def _shade(self, camera: Camera, light: Light, rate: Light) -> None:
        """Write the fine map's light into the light frame, and its rate."""
        height, width = light.shape
        projection = Projection(self._world.pinhole.focal_px, width / 2, height / 2)
        sight = Sight(self._owners.facets, self._renderer.facets, projection, camera.place, camera.turn)
        samples, posts, sun, smooth = float(self._world.parameters.samples), self._posts, self._sun, self._smooth
        # Velocities of places by where they are: in the world, of those that turn with the camera, and in its axes, of
        # the ground.
        of_directions = Motion(camera.turning.T @ camera.turn, camera.velocity)
        of_ground = Motion(camera.turning @ camera.turn.T, -camera.turn @ camera.velocity)

        def shade(band: int, thread: int) -> None:
            shade_rows(_rows(band, height), sight, of_directions, posts, sun, self._tiles[thread], smooth)

        self._pool.each(shade, -(-height // _BAND))
        faint = _FAINT * float(smooth.light.mean())

        def refine(band: int, thread: int) -> None:
            tile, (values, listed) = self._tiles[thread], self._lines[thread]
            coverage = self._owners.coverage
            rows, peaks = _rows(band, height), self._peaks
            shade_doubtful(
                rows, sight, coverage, posts, peaks, samples, faint, sun, tile, values, listed, smooth, light, rate
            )

        def follow(band: int, thread: int) -> None:
            rate_of_doubtful(_rows(band, height), sight, of_ground, smooth.doubtful, light, rate)

        for work in (refine, follow):
            self._pool.each(work, -(-height // _BAND))

    def _view(self, t_ns: int, pose: Pose, camera: Camera) -> View:
        """Return the vertices in view, and give the renderer their topology."""
        world = self._world
        world.height_m(world.time.scene_ns(t_ns), pose)
        chosen = self._tree.by_level(pose.position_m, world.planes(pose))
        self._renderer.topology = self._blocks.topology(len(chosen))
        share = -(-len(chosen) // self._pool.threads)
        unit_m, posts = world.ground.unit_m, self._posts

        def fill(k: int, _: int) -> None:
            first, last = k * share, min((k + 1) * share, len(chosen))
            reach_m, crowd, room = self._reach * unit_m, self._tree.crowd, self._blocks.vertices
            block_vertices(chosen, first, last, posts.heights, posts.levels, unit_m, reach_m, crowd, camera, room)

        self._pool.each(fill, self._pool.threads)
        return self._blocks.view(len(chosen))


class _Blocks:
    """Arrays for many blocks: their vertices, and facets numbered one block after another."""

    def __init__(self, block: Topology, count: int) -> None:
        self._block = block
        self._grow(count)

    def _grow(self, count: int) -> None:
        n = count * CORNERS
        self._all = join([self._block] * count)
        self.vertices, self._dark = Vertices(np.zeros((n, 3)), np.zeros((n, 3))), np.zeros(n)

    def topology(self, count: int) -> Topology:
        """Return the facets of `count` blocks; call it before the arrays are written."""
        if count * CORNERS > self._all.vertices:
            self._grow(2 * count)
        a = self._all
        m, n = count * len(self._block.faces), count * CORNERS
        return Topology(a.faces[:m], a.shades[:m], a.across[:m], a.smooth[:m], a.two_sided[:m], n, n)

    def view(self, count: int) -> View:
        """Return the first `count` blocks, without light."""
        positions, velocities = (array[: count * CORNERS] for array in self.vertices)
        return View(positions, velocities, self._dark[: count * CORNERS], self._dark[: count * CORNERS])


def facet_px(p: TerrainParameters, pinhole: Pinhole, finest_px: float, coarser: float = 1.0) -> float:
    """Return the side of a facet: `coarser` times what the rig gives, or `finest_px`; two facets are a quad."""
    affordable = math.sqrt(2 * pinhole.width * pinhole.height / p.most_facets)
    return max(coarser * p.detail_px, affordable) if p.detail_px else finest_px


def _rows(band: int, height: int) -> tuple[int, int]:
    return band * _BAND, min((band + 1) * _BAND, height)

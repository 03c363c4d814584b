"""Ground under a low Sun drawn by GL, by points in each pixel: for a quick look, and as a check of the CPU painter.

Light is radiance, W m-2 sr-1, 400 to 700 nm: sunlight by the ground's law of reflection, with the shadows that the
ground throws on itself and their penumbra, and an even light from all around. The ground curves with the body. What is
not modelled: light from slope to slope, and what lies beyond the map, where the picture is black.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.geometry.seen import Rays
from emulator.gl.painter import QUICK_LOOK, Painter
from emulator.gl.render_target import Stage, depth_terms
from emulator.light import Light, Scene
from emulator.scene.terrain.ground_mesh import GroundMesh, GroundView, shading
from emulator.scene.terrain.quadtree import LEAST_REACH, Quadtree
from emulator.scene.terrain.raster_terrain import RasterTerrain
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.truth import TerrainGeometry
from emulator.scene.terrain.world import TerrainWorld
from emulator.trajectory.parameters import BasiliskPath, LivePath
from emulator.trajectory.pose import Pose

if TYPE_CHECKING:
    import moderngl
from emulator.trajectory.pose import Trajectory
from emulator.trajectory.timescale import Timescale

__all__ = ["GlTerrain"]

_FINEST_PX = 0.25
_NEAR_SHARE = 0.25  # of the camera's height: nothing is nearer, along the boresight


class GlTerrain(Scene):
    """The ground of `parameters` as `pinhole` sees it, in radiance.

    Raises
    ------
    SceneError
        The map or the path cannot be used, the camera is below the ground, or there is no GL.
    """

    def __init__(self, parameters: TerrainParameters, pinhole: Pinhole) -> None:
        world = self._world = TerrainWorld(parameters, pinhole)
        self._own_facets: RasterTerrain | None = None
        reach = max(pinhole.focal_px / _facet_px(parameters, pinhole), LEAST_REACH)
        self._tree = Quadtree(world.ground, reach)
        sunlit = world.sunlit()
        self._stage = Stage(pinhole.size, parameters.samples)
        with self._stage.context as gl:
            cells = shading(world.ground, sunlit, world.sun)
            self._mesh = GroundMesh(gl, world.ground, cells, parameters.reflectance, (reach, self._tree.crowd))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._world.pinhole.size

    @property
    def painter(self) -> Painter:
        """GL."""
        return "gl"

    @property
    def renderer(self) -> str:
        """The name of what draws, in GL's words."""
        return self._stage.renderer

    @property
    def camera_path(self) -> Trajectory:
        """The camera's path, on the scene's time."""
        return self._world.camera

    @property
    def path_time(self) -> Timescale:
        """Stream time to scene time."""
        return self._world.time

    @property
    def motion_bound_px_s(self) -> float:
        """From the path's speed, turning and height, looked at once a second of the first four minutes."""
        return self._world.motion_bound_px_s

    @property
    def distance_m(self) -> float:
        """The least height over the ground beneath, of those looked at beforehand."""
        return self._world.distance_m

    @property
    def notes(self) -> tuple[str, ...]:
        """That GL draws, what is odd about the map, what lies beyond it, and a black picture."""
        first = np.zeros(self.size[::-1], np.float32)
        self.light(0, first)
        return (QUICK_LOOK, *self._world.notes(first))

    @property
    def counts(self) -> Mapping[str, int]:
        """What poses from outside did."""
        return self._world.counts

    def geometry(self, rays: Rays | None = None) -> TerrainGeometry | None:
        """Return depth, flow and labels of the ground, from facets drawn by the CPU; None where poses are live."""
        if isinstance(self._world.parameters.camera, LivePath | BasiliskPath):
            return None  # the facets need a path of their own, and its port is taken
        self._own_facets = RasterTerrain(self._world.parameters, self._world.pinhole)
        return self._own_facets.geometry(rays)

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32; raises SceneError below the ground."""
        self.lights((t_ns,), (out,))

    def lights(self, times_ns: Sequence[int], outs: Sequence[Light]) -> None:
        """Write the radiance at several times into their pictures."""
        self._stage.draw_all([self._beginning(t_ns) for t_ns in times_ns], outs)

    def close(self) -> None:
        """Give back the GL context and the port; a second call does nothing."""
        if self._own_facets is not None:
            self._own_facets.close()
        self._stage.close()
        self._world.close()

    def _beginning(self, t_ns: int) -> Callable[[], None]:
        """Return what lets the stage begin the picture of `t_ns`; whatever can fail has been done."""
        world = self._world
        scene_ns = world.time.scene_ns(t_ns)
        pose = world.camera.pose(scene_ns)
        view = self._view(pose, world.height_m(scene_ns, pose))
        blocks = self._tree.blocks(pose.position_m, world.planes(pose))
        return partial(self._stage.begin, partial(self._render, view, blocks))

    def _render(self, view: GroundView, blocks: list[npt.NDArray[np.int32]], _: moderngl.Context) -> None:
        self._mesh.render(view, self._world.sun, blocks)

    def _view(self, pose: Pose, height_m: float) -> GroundView:
        world = self._world
        far_m = 1.5 * world.ground.half_m + float(np.linalg.norm(pose.position_m))
        near_m = _NEAR_SHARE * min(height_m, far_m)
        turned = pose.world_from_body.T
        return GroundView(
            pose.position_m,
            turned,
            world.pinhole.zoom,
            depth_terms(near_m, 2 * far_m),
            world.irradiance_w_m2,
            world.parameters.ambient_w_m2,
        )

    def _motion_px_s(self, t_ns: int) -> float:
        return self._world.motion_px_s(t_ns)


def _facet_px(p: TerrainParameters, pinhole: Pinhole) -> float:
    """Return the side of a facet; two facets are a quad."""
    affordable = math.sqrt(2 * pinhole.width * pinhole.height / p.most_facets)
    return max(p.detail_px, affordable) if p.detail_px else _FINEST_PX

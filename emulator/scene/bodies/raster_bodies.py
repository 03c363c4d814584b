"""Bodies in sunlight drawn by the CPU: exact light of each pixel and its exact time derivative, no GL.

    poses just before, at and after t --> light at the points of surfaces (`lighting`) --+
                                      --> vertices and their velocities -----------------+--> `raster` --> light, rate

Light is linear over a facet. Facets longer than LONGEST_PX pixels are divided, so that highlights and the edges of
shadows on them are drawn; facets too small to be seen are gathered (see `BodyWorld.as_seen`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.light import Light, PixelLight, Region, Scene, SceneError
from emulator.raster import Box, Renderer, Screen, View, join, prepare
from emulator.scene.bodies.lighting import Lighting, Motion, Poses, motion_at
from emulator.scene.bodies.lit_surface import Surface, lit_surface, subdivide
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.bodies.world import BodyWorld

__all__ = ["LONGEST_PX", "RasterBodies"]

LONGEST_PX = 12.0
_MOST_DIVIDED = 8000  # facets of one body: a large side near the camera is divided no further
_NEAREST_SHARE = 1e-6  # of the range to the nearest body: facets are cut this near the camera


class RasterBodies(Scene):
    """The bodies of `parameters` as `pinhole` sees them, in radiance, drawn by the CPU; raises SceneError.

    Parameters
    ----------
    threads : how many draw; the pictures are the same to the last bit.
    """

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole, threads: int = 1) -> None:
        self._world = world = BodyWorld(parameters, pinhole)
        self._surfaces = [self._surface(k) for k in range(len(world.meshes))]
        self._lighting = Lighting(parameters, world.meshes, self._surfaces)
        parts = [
            prepare(surface.faces, shades=surface.shades, two_sided=mesh.open_edges > 0)
            for surface, mesh in zip(self._surfaces, world.meshes, strict=True)
        ]
        width, height = pinhole.size
        middle = width / 2, height / 2
        screen = Screen(width, height, pinhole.focal_px, middle, _NEAREST_SHARE * self.distance_m)
        self._renderer = Renderer(join(parts), screen, threads)
        self._spare = np.zeros((height, width), np.float32)
        self._drawn = Box()
        self._changed: Region | None = None
        self._closed = False
        self._pictures: tuple[Light | None, Light | None] = (None, None)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._world.pinhole.size

    @property
    def renderer(self) -> str:
        """The name of what draws."""
        return "the CPU, exact coverage"

    @property
    def motion_bound_px_s(self) -> float:
        """From the paths' speeds and turns."""
        return self._world.motion_bound_px_s

    @property
    def distance_m(self) -> float:
        """The closest range of any body, less its radius."""
        return self._world.arrangement.distance_m

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd about the shapes, what detail was left out, and a black picture."""
        first = np.zeros(self.size[::-1], np.float32)
        self.light(0, first)
        return self._world.notes(first)

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of the poses that came from outside."""
        return self._world.counts

    @property
    def changed(self) -> Region | None:
        """The part of the last picture that may differ from the one before it in the same arrays."""
        return self._changed

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        self.light_and_rate(t_ns, out, self._spare)

    @property
    def has_rate(self) -> bool:
        """True: the renderer gives the exact derivative."""
        return True

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the radiance at `t_ns` and its exact time derivative, a second, both (height, width) float32."""
        known = self._pictures[0] is light and self._pictures[1] is rate
        before = self._drawn if known else None
        self._drawn = self._renderer.draw(self._view(t_ns), light, rate, before)
        self._pictures = (light, rate)
        self._changed = None if before is None else _region(self._drawn.union(before))

    @property
    def pixel_light(self) -> PixelLight:
        """Tells the light and its rate of single pixels at any instant."""
        return self._pixels

    def close(self) -> None:
        """End the threads and close the ports; a second call does nothing."""
        self._closed = True
        self._renderer.close()
        self._world.close()

    def _pixels(self, t_ns: int, pixels: npt.NDArray[np.int64]) -> tuple[Light, Light]:
        return self._renderer.query(self._view(t_ns), pixels)

    def _surface(self, k: int) -> Surface:
        """Return where body k is lit: facets that are large in the picture are divided, within a limit."""
        world = self._world
        mesh, smooth = world.as_seen(k), world.parameters.bodies[k].smooth
        if len(mesh.faces) < _MOST_DIVIDED:
            longest_m = max(LONGEST_PX * world.metres_a_pixel(k), math.sqrt(2 * mesh.area_m2 / _MOST_DIVIDED))
            mesh = subdivide(mesh, longest_m)
        return lit_surface(mesh, smooth=smooth)

    def _view(self, t_ns: int) -> View:
        if self._closed:
            raise SceneError("the scene is closed: build it again")
        world = self._world
        motion = motion_at(t_ns, world.camera, world.arrangement.poses, world.time)
        glows = self._lighting.light(motion)
        places = [self._places(k, motion) for k in range(len(self._surfaces))]
        return View(
            np.concatenate([place for place, _ in places]),
            np.concatenate([velocity for _, velocity in places]),
            np.concatenate([glow.radiance for glow in glows]),
            np.concatenate([glow.rate for glow in glows]),
        )

    def _places(self, k: int, motion: Motion) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the vertices of body k in camera axes and their velocities, m and m a second of stream time."""
        vertices = self._surfaces[k].vertices
        turn, place = _camera_from_body(motion.now, k)
        turn0, place0 = _camera_from_body(motion.before, k)
        turn1, place1 = _camera_from_body(motion.after, k)
        turning, moving = (turn1 - turn0) / motion.between_s, (place1 - place0) / motion.between_s
        return vertices @ turn.T + place, vertices @ turning.T + moving


def _camera_from_body(poses: Poses, k: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    camera_from_world = poses.camera.world_from_body.T
    pose = poses.bodies[k]
    return camera_from_world @ pose.world_from_body, camera_from_world @ (pose.position_m - poses.camera.position_m)


def _region(box: Box) -> Region:
    return Region(box.first_row, box.last_row, box.first_column, box.last_column)

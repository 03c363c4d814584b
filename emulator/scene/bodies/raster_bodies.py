"""Bodies in sunlight drawn by the CPU: exact light of each pixel and its exact time derivative, no GL.

    poses just before, at and after t --> light at the points of surfaces (`lighting`) --+
                                      --> vertices and their velocities -----------------+--> `raster` --> light, rate

Light is linear over a facet. Large facets are divided:

    flat ones whose shadows are polygons    where a highlight would be wrong by LINEAR_WITHIN of its height
    others                                  to LONGEST_PX pixels, for the edges of shadows too

A lobe cos^m of half the angle between view and mirror has the second derivative m / 4 of its height, and the straight
line over a length h is wrong by m h^2 / 32: h is an angle seen from the camera, so larger pictures need no more facets.
Facets too small to be seen are gathered (see `BodyWorld.as_seen`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.geometry.seen import Rays
from emulator.light import Light, PixelLight, Region, Scene, SceneError
from emulator.photometry.reflectance import Glossy, Lambert
from emulator.raster import Box, Patches, Renderer, Screen, View, join, prepare
from emulator.scene.bodies.lighting import Lighting, Motion, Poses, motion_at
from emulator.scene.bodies.lit_surface import Surface, lit_surface, subdivide
from emulator.scene.bodies.moving_points import move
from emulator.scene.bodies.rigid_groups import rigid_groups
from emulator.scene.bodies.sharp_shadows import with_narrow_penumbras
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.bodies.truth import BodiesGeometry
from emulator.scene.bodies.world import BodyWorld
from emulator.threads import available_threads
from emulator.trajectory.pose import Trajectory
from emulator.trajectory.timescale import Timescale

__all__ = ["LINEAR_WITHIN", "LONGEST_PX", "RasterBodies", "build_bodies"]

LONGEST_PX = 12.0
LINEAR_WITHIN = 0.01
_MOST_DIVIDED = 8000  # facets of one body: a large side near the camera is divided no further
_LIFT = 1e-6  # of its distance: how much nearer to the camera than its facet a shadow is drawn
_NEAREST_SHARE = 1e-6  # of the range to the nearest body: facets are cut this near the camera
_THREADS_FROM_PX = 50_000  # smaller light frames are drawn sooner than a second thread is awake

_Floats = npt.NDArray[np.float64]


def build_bodies(parameters: BodiesParameters, pinhole: Pinhole) -> RasterBodies:
    """Return the bodies of `parameters` before `pinhole`, with the machine's threads if large; raises SceneError."""
    large = pinhole.width * pinhole.height >= _THREADS_FROM_PX
    return RasterBodies(parameters, pinhole, threads=available_threads() if large else 1)


class RasterBodies(Scene):
    """The bodies of `parameters` as `pinhole` sees them, in radiance, drawn by the CPU; raises SceneError.

    Parameters
    ----------
    threads : how many draw; the pictures are the same to the last bit.
    """

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole, threads: int = 1) -> None:
        self._world = world = BodyWorld(parameters, pinhole)
        bodies = range(len(world.meshes))
        pixel_m = min(map(self._nearest_m, bodies)) / pinhole.focal_px
        self._sharp = with_narrow_penumbras(parameters, world.meshes, LONGEST_PX * pixel_m)
        self._surfaces = [self._surface(k) for k in bodies]
        self._lighting = Lighting(parameters, world.meshes, self._surfaces, self._sharp, threads)
        self._placed = _in_groups(parameters, self._surfaces)
        self._poses = world.arrangement.poses_of({root for root, _ in self._placed})
        parts = [
            prepare(surface.faces, shades=surface.shades, two_sided=mesh.open_edges > 0)
            for surface, mesh in zip(self._surfaces, world.meshes, strict=True)
        ]
        width, height = pinhole.size
        middle = width / 2, height / 2
        screen = Screen(width, height, pinhole.focal_px, middle, _NEAREST_SHARE * self.distance_m)
        topology = join(parts)
        self._patches = Patches(topology)
        self._renderer = Renderer(topology, screen, threads)
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
    def camera_path(self) -> Trajectory:
        """The camera's path, on the scene's time."""
        return self._world.camera

    @property
    def path_time(self) -> Timescale:
        """Stream time to scene time."""
        return self._world.time

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

    def geometry(self, rays: Rays | None = None) -> BodiesGeometry:
        """Return depth, flow and labels of the bodies, from shapes and poses alone."""
        return BodiesGeometry(self._world, rays)

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        whole = out if out.flags.c_contiguous else np.empty(out.shape, np.float32)  # of the kernels' only layout
        self.light_and_rate(t_ns, whole, self._spare)
        if whole is not out:
            out[...] = whole

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
        self._lighting.close()
        self._world.close()

    def _pixels(self, t_ns: int, pixels: npt.NDArray[np.int64]) -> tuple[Light, Light]:
        return self._renderer.query(self._view(t_ns), pixels)

    def _surface(self, k: int) -> Surface:
        """Return where body k is lit: facets that are large in the picture are divided, within a limit."""
        world = self._world
        mesh, smooth = world.as_seen(k), world.parameters.bodies[k].smooth
        if len(mesh.faces) < _MOST_DIVIDED:
            mesh = subdivide(mesh, max(self._longest_m(k), math.sqrt(2 * mesh.area_m2 / _MOST_DIVIDED)))
        return lit_surface(mesh, smooth=smooth)

    def _longest_m(self, k: int) -> float:
        """Return how long the sides of body k's facets may be."""
        world = self._world
        body = world.parameters.bodies[k]
        fine_m = LONGEST_PX * world.metres_a_pixel(k)
        shaded = _is_shaded_by_others(world.parameters, k)
        if k not in self._sharp or shaded or not isinstance(body.reflectance, Glossy | Lambert):
            return fine_m
        lobe = body.reflectance.sharpness if isinstance(body.reflectance, Glossy) else 1.0
        return math.sqrt(32 * LINEAR_WITHIN / lobe) * self._nearest_m(k)

    def _nearest_m(self, k: int) -> float:
        vertices = self._world.meshes[k].vertices
        return self._world.arrangement.nearest_m(k, vertices.min(axis=0), vertices.max(axis=0))

    def _view(self, t_ns: int) -> View:
        if self._closed:
            raise SceneError("the scene is closed: build it again")
        world = self._world
        motion = motion_at(t_ns, world.camera, self._poses, world.time)
        glows, shadows = self._lighting.light_and_polygons(motion)
        bodies = [(root, vertices, 1.0) for root, vertices in self._placed]
        over = [(polygons.body, polygons.corners, 1.0 - _LIFT) for polygons in shadows]
        places, velocities = _in_camera_axes([*bodies, *over], motion)
        if shadows:
            firsts = np.cumsum([0, *(len(shadow.corners) for shadow in shadows)], dtype=np.int32)
            faces = [shadow.faces + first for shadow, first in zip(shadows, firsts, strict=False)]
            below = np.concatenate([shadow.over for shadow in shadows])
            self._renderer.topology = self._patches.on(np.concatenate(faces), below)
        return View(
            places,
            velocities,
            np.concatenate([*(glow.radiance for glow in glows), *(shadow.radiance for shadow in shadows)]),
            np.concatenate([*(glow.rate for glow in glows), *(shadow.rate for shadow in shadows)]),
        )


def _is_shaded_by_others(parameters: BodiesParameters, k: int) -> bool:
    """Return whether a body of another rigid group may throw a shadow on body k."""
    others = [group.members for group in rigid_groups(parameters.bodies) if k not in group.members]
    return parameters.shadows and any(parameters.bodies[m].throws_shadow for members in others for m in members)


def _in_groups(parameters: BodiesParameters, surfaces: Sequence[Surface]) -> list[tuple[int, _Floats]]:
    """Return for each body the first body of its rigid group, and the body's vertices in the frame of that one."""
    placed = {}
    for group in rigid_groups(parameters.bodies):
        for k, pose in zip(group.members, group.poses, strict=True):
            vertices = surfaces[k].vertices
            if k != group.members[0]:
                vertices = vertices @ pose.world_from_body.T + pose.position_m
            placed[k] = (group.members[0], vertices)
    return [placed[k] for k in range(len(surfaces))]


def _in_camera_axes(parts: Sequence[tuple[int, _Floats, float]], motion: Motion) -> tuple[_Floats, _Floats]:
    """Return points in camera axes and their velocities, (n, 3) m and m a second of stream time.

    Parameters
    ----------
    parts : a body's number, points in its frame as `move` takes them, and how far from the camera they are drawn, as a
        share of their distance.
    """
    out = np.empty((2, sum(len(points) for _, points, _ in parts), 3))
    motions = {k: _seen_motion(motion, k) for k in {k for k, _, _ in parts}}
    row = 0
    for k, points, share in parts:
        row = move(points, *motions[k], share, row, (out[0], out[1]))
    return out[0], out[1]


def _seen_motion(motion: Motion, k: int) -> tuple[_Floats, _Floats]:
    """Return turns and shifts of body k against the camera, with their rates, as `move` takes them."""
    now, before, after = (_camera_from_body(poses, k) for poses in (motion.now, motion.before, motion.after))
    turns, shifts = (np.stack([a, (c - b) / motion.between_s]) for a, b, c in zip(now, before, after, strict=True))
    return turns, shifts


def _camera_from_body(poses: Poses, k: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    camera_from_world = poses.camera.world_from_body.T
    pose = poses.bodies[k]
    return camera_from_world @ pose.world_from_body, camera_from_world @ (pose.position_m - poses.camera.position_m)


def _region(box: Box) -> Region:
    return Region(box.first_row, box.last_row, box.first_column, box.last_column)

"""Bodies in sunlight drawn by the CPU: exact light of each pixel and its exact time derivative, no GL.

    poses just before, at and after t --> light at the points of surfaces (`lighting`) --+
                                      --> vertices and their velocities -----------------+--> `raster` --> light, rate
                                                                                                 `grain` below facets

Light is linear over a facet. Large facets are divided:

    flat ones whose shadows are polygons    where a highlight would be wrong by LINEAR_WITHIN of its height
    others                                  to LONGEST_PX pixels, for the edges of shadows too

A lobe cos^m of half the angle between view and mirror has the second derivative m / 4 of its height, and the straight
line over a length h is wrong by m h^2 / 32: h is an angle seen from the camera, so larger light frames need no more
facets. Facets too small to be visible are merged (see `BodyWorld.as_seen`).

`BodiesGeometry` gives depth, optical flow and labels of bodies, from their shapes and poses alone.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from emulator.geometry.camera import Given, Pinhole, Rays, SceneGeometry, ScenePoses, Seen
from emulator.light import NOTHING, LastArrays, Light, SceneError
from emulator.photometry.reflectance import Glossy, Lambert
from emulator.raster.layout import Owners, Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.surfaces import NearestSurface, camera_from_body, motion_of, write_depth_and_flow, write_flow
from emulator.scene.bodies.compiled import entry
from emulator.scene.bodies.curved_sides import BEND_PX, Sides, cached_thirds, split_round
from emulator.scene.bodies.grain import GrainLayer, Ground, Placed
from emulator.scene.bodies.lighting import Lighting, Motion, in_group, motion_at
from emulator.scene.bodies.lit_surface import Surface, lit_surface, near_in_memory, subdivide
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.shadow_polygons import with_narrow_penumbras
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.bodies.world import BodyWorld, rigid_groups
from emulator.scene.world import WorldScene
from emulator.threads import available_threads
from firmware_protocol.events import Floats

NEAREST_SHARE = 1e-6  # of the range to the nearest body: facets are cut this near the camera


class BodiesGeometry(SceneGeometry):
    """The geometry of a world of bodies; shapes have the detail that is drawn."""

    gives: frozenset[Given] = frozenset({"poses", "depth", "flow", "labels"})

    def __init__(self, world: BodyWorld, rays: Rays | None = None) -> None:
        self._world, self._rays = world, rays or Rays.straight(world.pinhole)
        self.names = _names(world.parameters.bodies)
        self._meshes = [world.as_seen(k) for k in range(len(world.meshes))]
        self._poses = world.arrangement.poses_of(range(len(world.meshes)))
        surfaces = [(mesh.faces, len(mesh.vertices), mesh.open_edges > 0) for mesh in self._meshes]
        self._surfaces = NearestSurface(surfaces, world.pinhole, NEAREST_SHARE * world.distance_m)
        self._inverse_depth = np.zeros_like(self._rays.columns)

    def look(self, t_ns: int, out: Seen) -> None:
        """Write depth, flow and labels at `t_ns`."""
        motion = motion_at(t_ns, self._world.camera, self._poses, self._world.time)
        now = (camera_from_body(motion.now.camera, pose) for pose in motion.now.bodies.values())
        vertices = [mesh.vertices @ turn.T + shift for mesh, (turn, shift) in zip(self._meshes, now, strict=True)]
        self._surfaces.look(np.concatenate(vertices), self._rays, out.labels, self._inverse_depth)
        camera, *bodies = zip(*((poses.camera, *poses.bodies.values()) for poses in motion.instants), strict=True)
        motions = np.array([motion_of(camera, body, motion.between_s) for body in (None, *bodies)])  # None: the sky
        write_depth_and_flow(self._inverse_depth, motions, self._world.pinhole, self._rays, out)

    def places(self, t_ns: int) -> ScenePoses:
        """Return the poses at `t_ns`."""
        scene_ns = self._world.time.scene_ns(t_ns)
        camera, bodies = self._world.camera.pose(scene_ns), self._poses(scene_ns).values()
        places = np.array([pose.position_m for pose in bodies])
        turns = np.array([pose.q_world_from_body for pose in bodies])
        return ScenePoses(camera.position_m, camera.q_world_from_body, places, turns)


def _names(bodies: Sequence[BodyTable]) -> tuple[str, ...]:
    """Return a unique name for each body: that of the rig, else that of its shape."""
    names: list[str] = []
    for body in bodies:
        name = body.name or Path(str(body.shape)).stem
        same = sum(other == name or other.startswith(f"{name} ") for other in names)
        names.append(f"{name} {same + 1}" if same else name)
    return tuple(names)


@entry
def move(  # noqa: PLR0913, PLR0917
    points: Floats, turns: Floats, shifts: Floats, scale: float, first: int, places: Floats, velocities: Floats
) -> int:
    """Write places and velocities from row `first` on; return the row after the last.

    Parameters
    ----------
    points : (n, 3) m, fixed in a frame, or (n, 6) with velocities in it, m/s.
    turns, shifts : (2, 3, 3) and (2, 3), camera from frame, m, and their rates, a second.
    scale : of what is written.
    places, velocities : (rows, 3) m and (rows, 3) m/s.
    """
    drifts = points.shape[1] == 6
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        for j in range(3):
            a, b, c = turns[0, j, 0], turns[0, j, 1], turns[0, j, 2]
            speed = turns[1, j, 0] * x + turns[1, j, 1] * y + turns[1, j, 2] * z + shifts[1, j]
            if drifts:
                speed += a * points[k, 3] + b * points[k, 4] + c * points[k, 5]
            places[first + k, j] = scale * (a * x + b * y + c * z + shifts[0, j])
            velocities[first + k, j] = scale * speed
    return first + len(points)


LONGEST_PX = 12.0
LINEAR_WITHIN = 0.01
_MOST_DIVIDED = 8000  # facets of one body: a large side near the camera is divided no further
LIFT = 1e-6  # of its distance: how much nearer to the camera than its facet a shadow is drawn

_NO_FACETS = np.zeros((0, 3), np.int32)
_THREADS_FROM_PX = 50_000  # smaller light frames are drawn before a second thread could start


class LitBodies:
    """The surfaces of a world of bodies and their light at any time, for both painters; raises SceneError.

    With any number of `threads` they are the same to the last bit.
    """

    def __init__(self, world: BodyWorld, pinhole: Pinhole, threads: int) -> None:
        self._world = world
        parameters = world.parameters
        bodies = range(len(world.meshes))
        distances_m = (world.arrangement.median_distance_m(k, world.meshes[k].vertices) for k in bodies)
        self._sharp = with_narrow_penumbras(parameters, world.meshes, LONGEST_PX * min(distances_m) / pinhole.focal_px)
        self._sides: dict[int, Sides] = {}
        casters = [world.as_seen(k) for k in bodies]
        self.surfaces = [self._surface(k, casters) for k in bodies]
        self._lighting = Lighting(parameters, pinhole, casters, self.surfaces, self._sharp, threads, self._sides)
        self._placed = _in_groups(parameters, self.surfaces)
        self._poses = world.arrangement.poses_of({root for root, *_ in self._placed})
        self.topology = self._lighting.facets.on(_NO_FACETS, _NO_FACETS[:, 0])
        """Facets of the last view, the patches with shadows behind all others; the next view writes into it."""
        self._closed = False

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._closed = True
        self._lighting.close()

    def view(self, t_ns: int) -> View:
        """Return vertices and their light at `t_ns`, and renew `topology`; raises SceneError after `close`."""
        if self._closed:
            raise SceneError("the scene is closed: build it again")
        world = self._world
        self._motion = motion = motion_at(t_ns, world.camera, self._poses, world.time)
        world.inside.look(t_ns, motion.now.camera, motion.now.bodies)
        surface_lights, shadows = self._lighting.light_and_polygons(motion)
        bodies = [(root, vertices, 1.0) for root, vertices, _ in self._placed]
        between = [
            (root, points[marked[-len(points) :] != 0], 1.0)
            for (root, _, points), marked in zip(self._placed, self._lighting.marked, strict=True)
            if len(points)
        ]
        over = [(polygons.body, polygons.corners, 1.0 - LIFT) for polygons in shadows]
        places, velocities = _in_camera_axes([*bodies, *between, *over], motion)
        firsts = np.cumsum([0, *(len(shadow.corners) for shadow in shadows)], dtype=np.int32)
        faces = [shadow.faces + first for shadow, first in zip(shadows, firsts, strict=False)]
        below = np.concatenate([_NO_FACETS[:, 0], *(shadow.over for shadow in shadows)])
        self.topology = self._lighting.facets.on(np.concatenate([_NO_FACETS, *faces]), below)
        return View(
            places,
            velocities,
            np.concatenate([*(light.radiance for light in surface_lights), *(shadow.radiance for shadow in shadows)]),
            np.concatenate([*(light.rate for light in surface_lights), *(shadow.rate for shadow in shadows)]),
        )

    def grounds(self) -> dict[int, list[Ground]]:
        """Return the bodies with grain, by the number of the body in whose frame they are."""
        return self._lighting.grounds(self._world.grain)

    def placed(self, bodies: Collection[int]) -> dict[int, Placed]:
        """Return where bodies are in the last view, by number."""
        return self._lighting.placed(self._motion, bodies)

    def _surface(self, k: int, casters: list[Mesh]) -> Surface:
        """Return the lit surface of body k: facets that are large in the light frame are divided, within a limit.

        Of a smooth one all sides that may be cut are cut in `casters`, for its shadows.
        """
        world = self._world
        mesh, smooth = casters[k], world.parameters.bodies[k].smooth
        if len(mesh.faces) < _MOST_DIVIDED:
            size_m = max(self._longest_m(k), math.sqrt(2 * mesh.area_m2 / _MOST_DIVIDED))
            mesh = subdivide(mesh, size_m, split_round if smooth else None)
        if not smooth or mesh.open_edges:  # a sheet is seen from both sides, its parts are not
            return lit_surface(near_in_memory(mesh), smooth=smooth)
        surface, self._sides[k], casters[k] = cached_thirds(mesh, BEND_PX * world.metres_a_pixel(k))
        return surface

    def _longest_m(self, k: int) -> float:
        """Return the longest allowed side of body k's facets."""
        world = self._world
        bodies = world.parameters.bodies
        body, fine_m = bodies[k], LONGEST_PX * world.metres_a_pixel(k, world.arrangement.median_ranges_m)
        beside = [j for group in rigid_groups(bodies) if k not in group.members for j in group.members]
        shaded = world.parameters.shadows and any(bodies[j].throws_shadow for j in beside)
        if k not in self._sharp or shaded or not isinstance(body.reflectance, Glossy | Lambert):
            return fine_m
        lobe = body.reflectance.sharpness if isinstance(body.reflectance, Glossy) else 1.0
        return math.sqrt(32 * LINEAR_WITHIN / lobe) * world.arrangement.median_distance_m(k, world.meshes[k].vertices)


class RasterBodies(WorldScene[BodyWorld]):
    """The bodies of `parameters` as `pinhole` sees them, in radiance, drawn by the CPU; raises SceneError.

    With any number of `threads` the light frames are the same to the last bit; 0: those of the machine for a large
    light frame, else one.
    """

    has_rate = True

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole, threads: int = 1) -> None:
        super().__init__(BodyWorld(parameters, pinhole))
        large = pinhole.width * pinhole.height >= _THREADS_FROM_PX
        threads = threads or (available_threads() if large else 1)
        self._lit = LitBodies(self._world, pinhole, threads)
        width, height = pinhole.size
        screen = Screen(width, height, pinhole.focal_px, (width / 2, height / 2), NEAREST_SHARE * self.distance_m)
        self._renderer = Renderer(self._lit.topology, screen, threads)
        self._spare = np.zeros((height, width), np.float32)
        self._drawn = NOTHING
        self._grain = GrainLayer(self._lit.grounds(), pinhole.size, threads)
        self._owners = self._grain.owners if self._grain.bodies else Owners.of(width, height)
        self._arrays = LastArrays()

    def geometry(self, rays: Rays | None = None) -> BodiesGeometry:
        """Return depth, flow and labels of the bodies, from shapes and poses alone."""
        return BodiesGeometry(self._world, rays)

    def flow(self, out: Seen) -> bool:
        """Write the flow of the last frame, of its facets."""
        write_flow(self._owners.facets, self._renderer.data, out.flow, out.labels)
        return True

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        light = out if out.flags.c_contiguous else np.empty(out.shape, np.float32)  # of the kernels' only layout
        self.light_and_rate(t_ns, light, self._spare)
        if light is not out:
            out[...] = light

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the radiance at `t_ns` and its exact time derivative, a second, both (height, width) float32."""
        before = self._drawn if self._arrays.are(light, rate) else None
        view = self._lit.view(t_ns)
        self._renderer.topology = self._lit.topology
        self._drawn = self._renderer.draw(view, light, rate, before, self._owners)
        self._grain.add(self._renderer, self._lit.placed(self._grain.bodies), self._drawn, light, rate)
        self.changed = None if before is None else self._drawn.union(before)

    def close(self) -> None:
        """End the threads and close the ports; a second call does nothing."""
        self._renderer.close()
        self._grain.close()
        self._lit.close()
        super().close()


def _in_groups(parameters: BodiesParameters, surfaces: Sequence[Surface]) -> list[tuple[int, Floats, Floats]]:
    """Return for each body the first body of its rigid group, and in the frame of that one its vertices.

    Apart are the points that cut facets, which are drawn where these are cut.
    """
    placed = {}
    for group in rigid_groups(parameters.bodies):
        for k, pose in group.placed:
            vertices = in_group(surfaces[k].vertices, pose)
            corners = int(surfaces[k].faces.max()) + 1
            placed[k] = (group.members[0], np.ascontiguousarray(vertices[:corners]), vertices[corners:])
    return [placed[k] for k in range(len(surfaces))]


def _in_camera_axes(parts: Sequence[tuple[int, Floats, float]], motion: Motion) -> tuple[Floats, Floats]:
    """Return points in camera axes and their velocities, (n, 3) m and m a second of stream time.

    `parts` are a body's number, points in its frame as `move` takes them, and the distance from the camera at which
    they are drawn, as a share of their own.
    """
    out = np.empty((2, sum(len(points) for _, points, _ in parts), 3))
    motions = {}  # turns and shifts of each body against the camera, with their rates, as `move` takes them
    for k in {k for k, _, _ in parts}:
        now, before, after = (camera_from_body(poses.camera, poses.bodies[k]) for poses in motion.instants)
        turns, shifts = (np.stack([a, (c - b) / motion.between_s]) for a, b, c in zip(now, before, after, strict=True))
        motions[k] = turns, shifts
    first = 0
    for k, points, share in parts:
        first = move(points, *motions[k], share, first, out[0], out[1])
    return out[0], out[1]

"""Bodies in sunlight drawn by GL, by points in each pixel: for a quick look, and as a check of the CPU painter.

The scene has any number of bodies, each on its path, and a camera on its own path. A body has its pose in the world, or
in the frame of another body that it is fixed to (a panel on a spacecraft). Light is radiance, W m-2 sr-1, 400 to 700
nm, by each body's law of reflection; all positions are relative to the camera, subtracted in float64.

Detail: a mesh whose facets would be smaller than `detail_px` even at the closest approach is simplified to vertices at
that distance, with the normals of the fine mesh (see `coarser`). Shadow casters are as coarse as the map (see
`ShadowMap`). Left out: light from one surface onto another, but for an even `ambient_w_m2`.

Only the part of a light frame that bodies can touch is drawn: the rectangle around the boxes of the bodies. A box has
its sides along the body's own axes. While all of its corners are in front of the camera, its contents appear between
the corners; with corners in front and behind, they may appear anywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import unit
from emulator.geometry.camera import Pinhole, Rays
from emulator.gl.render_target import Rectangle, RenderTarget, depth_terms
from emulator.scene.bodies.facets import Facets, Frame, ShadowCaster, ShadowMap
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.raster_bodies import BodiesGeometry
from emulator.scene.bodies.regolith import coarser, facet_size_m, flat
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.bodies.world import BodyWorld, middle
from emulator.scene.world import GlScene
from emulator.trajectory.pose import Pose

if TYPE_CHECKING:
    import moderngl


_BLACK = Rectangle(0, 0, 1, 1)
_ROUNDING_PX = 1  # what float32 and GL's rounding may add

Floats = npt.NDArray[np.float64]


def box_corners(points: Floats) -> Floats:
    """Return the corners, (8, 3), of the box around points, (n, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    return np.asarray([np.where([k & 1, k & 2, k & 4], high, low) for k in range(8)])


def touched_region(boxes: Iterable[Floats], pinhole: Pinhole) -> Rectangle:
    """Return a rectangle around the visible parts of `boxes`, each the corners of one, (8, 3), in the camera's axes."""
    frame = Rectangle(0, 0, *pinhole.size)
    before = [corners for corners in boxes if (corners[:, 2] > 0).any()]
    if not before:
        return _BLACK
    corners = np.concatenate(before)
    if (corners[:, 2] <= 0).any():
        return frame
    size = np.array(pinhole.size)
    with np.errstate(over="ignore"):
        seen = pinhole.focal_px * corners[:, :2] / corners[:, 2:] + size / 2
    first = np.clip(np.floor(seen.min(axis=0)) - _ROUNDING_PX, 0, size - 1).astype(int)
    last = np.clip(np.ceil(seen.max(axis=0)) + _ROUNDING_PX, first + 1, size).astype(int)
    return Rectangle(*map(int, first), *map(int, last - first))


_FINE = 2.0  # pixels or texels: for facets as small as this, shadows are computed at their corners
_APART = 100.0  # ratio of ranges from which on farther bodies get a depth range of their own
_NEAREST_SHARE = 1e-4  # of the farthest depth: no nearer plane, or float32 depth would resolve nothing
_ROOM = 1.01  # of a body's radius: what rounding may add to it

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Seen:
    """A body's pose in the camera's axes."""

    camera_from_body: Matrix
    place_m: Matrix


@dataclass(eq=False)
class _Part:
    """A body as it is drawn."""

    mesh: Mesh
    corners: Matrix
    facets: Facets | None = None
    caster: ShadowCaster | None = None


class GlBodies(GlScene[BodyWorld]):
    """The bodies of `parameters` as `pinhole` sees them, in radiance, drawn by GL.

    Raises
    ------
    SceneError
        A shape or a path cannot be used, the camera begins inside a body, or there is no GL.
    """

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole) -> None:
        world = BodyWorld(parameters, pinhole)
        super().__init__(world, RenderTarget(pinhole.size, parameters.samples))
        self._p, self._pinhole = world.parameters, pinhole
        self._sun = unit(parameters.sun.direction)
        self._casters = [k for k, body in enumerate(self._p.bodies) if body.throws_shadow]
        self._parts = [_Part(mesh, box_corners(mesh.vertices)) for mesh in world.meshes]
        self._shadows: ShadowMap | None = None
        with self._render_target.context as gl:
            self._upload(gl)

    def geometry(self, rays: Rays | None = None) -> BodiesGeometry:
        """Return depth, flow and labels of the bodies, from shapes and poses alone."""
        return BodiesGeometry(self._world, rays)

    def _upload(self, gl: moderngl.Context) -> None:
        """Copy meshes into the context's memory, with as much detail as is visible."""
        world = self._world
        if self._p.shadows and self._casters:
            # a tenth more than in the first minute, for what comes later
            around_m = 1.1 * world.arrangement.radius_m(self._casters)
            self._shadows = ShadowMap(gl, around_m, self.distance_m / self._pinhole.focal_px)
        for k, (body, part) in enumerate(zip(self._p.bodies, self._parts, strict=True)):
            seen = world.as_seen(k)
            # Facets of at most two pixels, or two texels of the shadow map, read it at their corners.
            texel_m = self._shadows.texel_m if self._shadows else 0.0
            fine = body.smooth and facet_size_m(seen) <= _FINE * max(texel_m, world.metres_a_pixel(k))
            shown = seen if body.smooth else flat(seen)
            shadows = self._shadows if self._may_be_shaded(k) else None
            part.facets = Facets(gl, shown, body.reflectance, shadows, at_vertices=fine)
            if self._shadows and body.throws_shadow:
                part.caster = self._shadows.caster(coarser(part.mesh, self._shadows.coarse_m))

    def _may_be_shaded(self, k: int) -> bool:
        """Return whether body k is, at the start, within the shadow map; a planet behind the scene is not."""
        if self._shadows is None:
            return False
        poses, parts = self._world.arrangement.poses(self._world.time.scene_ns(0)), self._parts
        centre = middle([(poses[j], parts[j].mesh.radius_m) for j in self._casters])
        away_m = float(np.linalg.norm(poses[k].position_m - centre))
        return away_m - parts[k].mesh.radius_m < self._shadows.range_m

    def _shadow_from_bodies(self, poses: list[Pose]) -> list[Matrix]:
        """Return shadow_from_body of each body, (4, 4)."""
        if self._shadows is None:
            return [np.eye(4)] * len(poses)
        shadow_from_world = self._shadows.from_world(
            self._sun, middle([(poses[k], self._parts[k].mesh.radius_m) for k in self._casters])
        )
        return [shadow_from_world @ _matrix(pose) for pose in poses]

    def _drawing(self, t_ns: int) -> Callable[[], None]:
        scene_ns = self._world.time.scene_ns(t_ns)
        camera, poses = self._world.camera.pose(scene_ns), self._world.arrangement.poses(scene_ns)
        camera_from_world = camera.world_from_body.T
        seen = [
            _Seen(camera_from_world @ pose.world_from_body, camera_from_world @ (pose.position_m - camera.position_m))
            for pose in poses
        ]
        frames = self._frames(camera_from_world @ self._sun, seen)
        shadow_from_bodies = self._shadow_from_bodies(poses)
        boxes = (part.corners @ s.camera_from_body.T + s.place_m for part, s in zip(self._parts, seen, strict=True))
        return partial(
            self._render_target.begin,
            partial(self._render, frames, seen, shadow_from_bodies),
            partial(self._cast, shadow_from_bodies),
            touched_region(boxes, self._pinhole),
        )

    def _cast(self, shadow_from_bodies: list[Matrix]) -> None:
        """Draw the shadow map."""
        if self._shadows is not None:
            placed = zip(self._parts, shadow_from_bodies, strict=True)
            self._shadows.render([(part.caster, matrix) for part, matrix in placed if part.caster is not None])

    def _render(
        self,
        frames: list[tuple[Frame, list[int]]],
        seen: list[_Seen],
        shadow_from_bodies: list[Matrix],
        gl: moderngl.Context,
    ) -> None:
        for number, (frame, members) in enumerate(frames):
            if number:
                _forget_depth(gl)
            for k in members:
                facets, how = self._parts[k].facets, seen[k]
                if facets is not None:
                    facets.render(frame, how.camera_from_body, how.place_m, shadow_from_bodies[k])

    def _frames(self, sun: Matrix, seen: list[_Seen]) -> list[tuple[Frame, list[int]]]:
        """Return the groups of bodies that are drawn together, with their common inputs, the farthest group first.

        Bodies much farther than all others get a depth range of their own.
        """
        ends = [
            (float(how.place_m[2]) - part.mesh.radius_m * _ROOM, float(how.place_m[2]) + part.mesh.radius_m * _ROOM)
            for how, part in zip(seen, self._parts, strict=True)
        ]
        frames: list[tuple[Frame, list[int]]] = []
        for k in sorted(range(len(ends)), key=lambda k: ends[k][0]):
            if not frames or ends[k][0] > _APART * max(ends[j][1] for j in frames[-1][1]) > 0:
                frames.append((self._frame(sun, [ends[k]]), [k]))
            else:
                members = [*frames[-1][1], k]
                frames[-1] = self._frame(sun, [ends[j] for j in members]), members
        return frames[::-1]

    def _frame(self, sun: Matrix, ends: list[tuple[float, float]]) -> Frame:
        """Return the common inputs of bodies between these depths; depths behind the camera are ignored."""
        ahead = [(near_m, far_m) for near_m, far_m in ends if far_m > 0]
        far_m = max((far_m for _, far_m in ahead), default=1.0)
        near_m = min((near_m for near_m, _ in ahead), default=0.5)
        return Frame(
            sun,
            self._pinhole.zoom,
            depth_terms(max(near_m, _NEAREST_SHARE * far_m), far_m),
            self._p.sun.irradiance_w_m2,
            self._p.ambient_w_m2,
        )


def _forget_depth(gl: moderngl.Context) -> None:
    """Clear the depth of the target, not its light: the next bodies are drawn in front of all earlier ones."""
    target = gl.fbo
    target.color_mask = False, False, False, False
    target.clear()
    target.color_mask = True, True, True, True
    target.use()  # the mask takes effect


def _matrix(pose: Pose) -> Matrix:
    """Return world_from_body, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.world_from_body, pose.position_m
    return matrix

"""Bodies in sunlight, any number of them, each on its path and seen from a camera on its own.

A body stands in the world, or in the frame of another one that it is fixed to (a panel on a spacecraft). Light is
radiance, W m-2 sr-1, 400 to 700 nm, by each body's law of reflection; all is drawn relative to the camera, subtracted
in float64.

Detail: a mesh whose facets would be smaller than `detail_px` even at the closest approach is gathered into vertices
that far apart, with the normals of the fine one (see `detail`). What throws shadows is as coarse as the map (see
`shadows`). Left out: light from one surface onto another, but for an even `ambient_w_m2`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import unit
from emulator.geometry.pinhole import Pinhole
from emulator.gl.render_target import Stage, depth_terms
from emulator.light import Light, Scene, SceneError
from emulator.scene.bodies.arrangement import Arrangement, Placed, middle
from emulator.scene.bodies.detail import coarser, facet_size_m, flat
from emulator.scene.bodies.facets import Facets, Frame
from emulator.scene.bodies.mesh import Mesh, find_shape, load_mesh
from emulator.scene.bodies.shadows import ShadowMap, Thrower
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.bodies.touched_region import box_corners, reach
from emulator.trajectory.building import build_trajectories
from emulator.trajectory.pose import Pose, Trajectory, TrajectoryError
from emulator.trajectory.pose_receiver import close_receivers, live_counts
from emulator.trajectory.timescale import Timescale

if TYPE_CHECKING:
    import moderngl

__all__ = ["Bodies"]

_FINE = 2.0  # pixels or texels: facets as small as this answer for shadows at their corners
_NEAREST_SHARE = 1e-4  # of the farthest depth: no nearer plane, or float32 depth would resolve nothing
_ROOM = 1.01  # of a body's radius: what rounding may add to it

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Where a body is in the camera's axes."""

    camera_from_body: Matrix
    place_m: Matrix


@dataclass(eq=False)
class _Part:
    """A body as it is drawn."""

    placed: Placed
    mesh: Mesh
    corners: Matrix
    facets: Facets | None = None
    thrower: Thrower | None = None


class Bodies(Scene):
    """The bodies of `parameters` as `pinhole` sees them, in radiance.

    Raises
    ------
    SceneError
        A shape or a path cannot be used, the camera begins inside a body, or there is no GL.
    """

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole) -> None:
        self._p, self._pinhole = parameters, pinhole
        self._time = Timescale(parameters.time_scale)
        self._sun = unit(parameters.sun.direction)
        self._throwing = [k for k, body in enumerate(parameters.bodies) if body.throws_shadow]
        try:
            self._camera, *paths = build_trajectories([parameters.camera, *(b.path for b in parameters.bodies)])
            self._parts = [self._part(body, path) for body, path in zip(parameters.bodies, paths, strict=True)]
        except (TrajectoryError, OSError) as error:
            raise SceneError(f"scene: {error}") from error
        self._notes = [
            f"{b.shape}: {w}"
            for b, part in zip(parameters.bodies, self._parts, strict=True)
            for w in part.mesh.warnings
        ]
        self._arrangement = Arrangement(self._camera, [part.placed for part in self._parts], self._time)
        self._require_outside()
        self._stage = Stage(pinhole.size, parameters.samples)
        self._shadows: ShadowMap | None = None
        with self._stage.context as gl:
            self._upload(gl)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._pinhole.size

    @property
    def renderer(self) -> str:
        """The name of what draws, in GL's words."""
        return self._stage.renderer

    @property
    def motion_bound_px_s(self) -> float:
        """From the paths' speeds and turns, at the closest ranges met in the first minute."""
        in_a_corner = 1 + math.tan(self._pinhole.widest_rad) ** 2
        return self._pinhole.focal_px * in_a_corner * self._arrangement.turn_bound_rad_s * self._time.factor

    @property
    def distance_m(self) -> float:
        """The closest range of any body, less its radius."""
        return self._arrangement.distance_m

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd about the shapes, what detail was left out, and a black picture."""
        picture = np.zeros(self.size[::-1], np.float32)
        self.light(0, picture)
        black = () if picture.any() else ("the first picture is black: no sunlit side is before the camera",)
        return (*self._notes, *black)

    @property
    def counts(self) -> Mapping[str, int]:
        """What poses from outside did."""
        return live_counts(self._camera, *(part.placed.path for part in self._parts))

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        self.lights((t_ns,), (out,))

    def lights(self, times_ns: Sequence[int], outs: Sequence[Light]) -> None:
        """Write the radiance at several times into their pictures."""
        self._stage.draw_all([self._beginning(t_ns) for t_ns in times_ns], outs)

    def close(self) -> None:
        """Give back the GL context and the ports; a second call does nothing."""
        self._stage.close()
        close_receivers(self._camera, *(part.placed.path for part in self._parts))

    def _part(self, body: BodyTable, path: Trajectory) -> _Part:
        names = [other.name for other in self._p.bodies]
        parent = names.index(body.fixed_to) if body.fixed_to else None
        mesh = load_mesh(find_shape(body.shape), body.units_m)
        placed = Placed(path, parent, mesh.radius_m)
        return _Part(placed, mesh, box_corners(mesh.vertices))

    def _require_outside(self) -> None:
        for body, part, range_m in zip(self._p.bodies, self._parts, self._arrangement.ranges_m, strict=True):
            core_m = float(np.linalg.norm(part.mesh.vertices, axis=1).min())
            if range_m <= core_m:
                raise SceneError(
                    f"the camera comes within {range_m:g} m of the middle of {body.shape}, whose surface is at least "
                    f"{core_m:g} m from it: it would be inside. Move it out, or look at units_m"
                )
        across = max(
            2 * part.mesh.radius_m / r for part, r in zip(self._parts, self._arrangement.ranges_m, strict=True)
        )
        if across * self._pinhole.focal_px < 2:
            raise SceneError(
                f"the largest body is {across * self._pinhole.focal_px:.2g} px across at its closest and would be lost "
                "between samples: go nearer, take a longer lens, or look at units_m"
            )

    def _upload(self, gl: moderngl.Context) -> None:
        """Take meshes into the context's memory, with as much detail as is seen."""
        if self._p.shadows and self._throwing:
            # a tenth more than in the first minute, for what comes later
            around_m = 1.1 * self._arrangement.radius_m(self._throwing)
            self._shadows = ShadowMap(gl, around_m, self.distance_m / self._pinhole.focal_px)
        for body, part, range_m in zip(self._p.bodies, self._parts, self._arrangement.ranges_m, strict=True):
            room_m = max(range_m - part.mesh.radius_m, 1e-6)
            seen = self._as_seen(part.mesh, self._p.detail_px * room_m / self._pinhole.focal_px, str(body.shape))
            fine = body.smooth and facet_size_m(seen) <= self._fine_m(room_m)
            drawn = seen if body.smooth else flat(seen)
            part.facets = Facets(gl, drawn, body.reflectance, self._shadows, at_vertices=fine)
            if self._shadows and body.throws_shadow:
                part.thrower = self._shadows.thrower(coarser(part.mesh, self._shadows.coarse_m))

    def _fine_m(self, room_m: float) -> float:
        """Return the size of facets at whose corners the shadow map may be asked: two pixels, or two texels."""
        texel_m = self._shadows.texel_m if self._shadows else 0.0
        return _FINE * max(texel_m, room_m / self._pinhole.focal_px)

    def _as_seen(self, mesh: Mesh, cell_m: float, name: str) -> Mesh:
        if facet_size_m(mesh) > cell_m:
            return mesh
        seen = coarser(mesh, cell_m)
        if seen is not mesh:
            self._notes.append(
                f"{name}: {len(seen.faces)} of {len(mesh.faces)} facets: the others are too small to be seen"
            )
        return seen

    def _shadow_from_bodies(self, poses: list[Pose]) -> list[Matrix]:
        """Return shadow_from_body of each body, (4, 4)."""
        if self._shadows is None:
            return [np.eye(4)] * len(poses)
        shadow_from_world = self._shadows.from_world(
            self._sun, middle([(poses[k], self._parts[k].mesh.radius_m) for k in self._throwing])
        )
        return [shadow_from_world @ _matrix(pose) for pose in poses]

    def _beginning(self, t_ns: int) -> Callable[[], None]:
        """Return what lets the stage begin the picture of `t_ns`; whatever can fail has been done."""
        scene_ns = self._time.scene_ns(t_ns)
        camera, poses = self._camera.pose(scene_ns), self._arrangement.poses(scene_ns)
        camera_from_world = camera.world_from_body.T
        seen = [
            _Seen(camera_from_world @ pose.world_from_body, camera_from_world @ (pose.position_m - camera.position_m))
            for pose in poses
        ]
        frame = self._frame(camera_from_world @ self._sun, seen)
        shadow_from_bodies = self._shadow_from_bodies(poses)
        boxes = (part.corners @ s.camera_from_body.T + s.place_m for part, s in zip(self._parts, seen, strict=True))
        return partial(
            self._stage.begin,
            partial(self._render, frame, seen, shadow_from_bodies),
            partial(self._cast, shadow_from_bodies),
            reach(boxes, self._pinhole),
        )

    def _cast(self, shadow_from_bodies: list[Matrix]) -> None:
        """Draw the shadow map."""
        if self._shadows is not None:
            both = zip(self._parts, shadow_from_bodies, strict=True)
            self._shadows.render([(part.thrower, matrix) for part, matrix in both if part.thrower is not None])

    def _render(self, frame: Frame, seen: list[_Seen], shadow_from_bodies: list[Matrix], _: moderngl.Context) -> None:
        for part, how, shadow_from_body in zip(self._parts, seen, shadow_from_bodies, strict=True):
            if part.facets is not None:
                part.facets.render(frame, how.camera_from_body, how.place_m, shadow_from_body)

    def _frame(self, sun: Matrix, seen: list[_Seen]) -> Frame:
        """Return what is the same for all bodies; depths reach around all that is before the camera."""
        ahead = [
            (how.place_m[2], part.mesh.radius_m * _ROOM)
            for how, part in zip(seen, self._parts, strict=True)
            if how.place_m[2] + part.mesh.radius_m > 0
        ]
        far = max((z + r for z, r in ahead), default=1.0)
        near = min((z - r for z, r in ahead), default=0.5)
        return Frame(
            sun,
            self._pinhole.zoom,
            depth_terms(max(near, _NEAREST_SHARE * far), far),
            self._p.sun.irradiance_w_m2,
            self._p.ambient_w_m2,
        )


def _matrix(pose: Pose) -> Matrix:
    """Return world_from_body, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.world_from_body, pose.position_m
    return matrix

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

from emulator.optics.pinhole import Pinhole
from emulator.scene.attitude import unit
from emulator.scene.base import Light, Scene, SceneError
from emulator.scene.bodies_table import BodiesParameters, BodyTable
from emulator.scene.detail import coarser, facet_size_m, flat
from emulator.scene.facets import Facets, Frame
from emulator.scene.mesh import Mesh, find_shape, load_mesh
from emulator.scene.shadows import ShadowMap, Thrower
from emulator.scene.stage import Stage, depth_terms
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.live import close_inlets, live_counts
from emulator.trajectory.pose import Pose, Trajectory, TrajectoryError
from emulator.trajectory.timescale import Timescale

if TYPE_CHECKING:
    import moderngl

__all__ = ["Bodies"]

_FINE = 2.0  # pixels or texels: facets as small as this answer for shadows at their corners
_LOOKS = 64  # instants at which ranges are taken beforehand
_LOOK_S = 60.0
_NEAREST_SHARE = 1e-4  # of the farthest depth: no nearer plane, or float32 depth would resolve nothing

Matrix = npt.NDArray[np.float64]


@dataclass(eq=False)
class _Part:
    """A body as it is drawn."""

    path: Trajectory
    parent: int | None
    mesh: Mesh
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
        try:
            self._camera = build_trajectory(parameters.camera)
            self._parts = [self._part(body) for body in parameters.bodies]
        except (TrajectoryError, OSError) as error:
            raise SceneError(f"scene: {error}") from error
        self._notes = [
            f"{b.shape}: {w}"
            for b, part in zip(parameters.bodies, self._parts, strict=True)
            for w in part.mesh.warnings
        ]
        self._ranges_m = self._closest()
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
        p, focal = self._pinhole, self._pinhole.focal_px
        turn = self._camera.turn_bound_rad_s * focal * (1 + math.tan(p.widest_rad) ** 2)
        fastest = 0.0
        for k, part in enumerate(self._parts):
            chain = list(self._ancestry(k))
            speed = self._camera.speed_bound_m_s + sum(one.path.speed_bound_m_s for one in chain)
            around = sum(one.path.turn_bound_rad_s for one in chain) * part.mesh.radius_m
            room_m = max(self._ranges_m[k] - part.mesh.radius_m, 0.01 * part.mesh.radius_m)
            fastest = max(fastest, focal * (speed + around) / room_m)
        return (turn + fastest) * self._time.factor

    @property
    def distance_m(self) -> float:
        """The closest range of any body, less its radius."""
        gaps = (r - part.mesh.radius_m for r, part in zip(self._ranges_m, self._parts, strict=True))
        return max(min(gaps), 1e-3)

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
        return live_counts(self._camera, *(part.path for part in self._parts))

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        self.lights((t_ns,), (out,))

    def lights(self, times_ns: Sequence[int], outs: Sequence[Light]) -> None:
        """Write the radiance at several times into their pictures."""
        self._stage.draw_all([self._beginning(t_ns) for t_ns in times_ns], outs)

    def close(self) -> None:
        """Give back the GL context and the ports; a second call does nothing."""
        self._stage.close()
        close_inlets(self._camera, *(part.path for part in self._parts))

    def _part(self, body: BodyTable) -> _Part:
        names = [other.name for other in self._p.bodies]
        parent = names.index(body.fixed_to) if body.fixed_to else None
        return _Part(build_trajectory(body.path), parent, load_mesh(find_shape(body.shape), body.units_m))

    def _ancestry(self, k: int) -> Sequence[_Part]:
        """Return a body and those that it is fixed to, one after another."""
        chain = [self._parts[k]]
        while chain[-1].parent is not None:
            chain.append(self._parts[chain[-1].parent])
        return chain

    def _poses(self, scene_ns: int) -> list[Pose]:
        """Return each body's pose in the world."""
        poses: list[Pose] = []
        for part in self._parts:
            own = part.path.pose(scene_ns)
            poses.append(own if part.parent is None else poses[part.parent].after(own))
        return poses

    def _closest(self) -> list[float]:
        """Return each body's closest range in the first minute, m."""
        times = [self._time.scene_ns(round(k * _LOOK_S / _LOOKS * 1e9)) for k in range(_LOOKS)]
        ranges = np.array(
            [[np.linalg.norm(p.position_m - self._camera.pose(t).position_m) for p in self._poses(t)] for t in times]
        )
        return [float(r) for r in ranges.min(axis=0)]

    def _require_outside(self) -> None:
        for body, part, range_m in zip(self._p.bodies, self._parts, self._ranges_m, strict=True):
            core_m = float(np.linalg.norm(part.mesh.vertices, axis=1).min())
            if range_m <= core_m:
                raise SceneError(
                    f"the camera comes within {range_m:g} m of the middle of {body.shape}, whose surface is at least "
                    f"{core_m:g} m from it: it would be inside. Move it out, or look at units_m"
                )
        across = max(2 * part.mesh.radius_m / r for part, r in zip(self._parts, self._ranges_m, strict=True))
        if across * self._pinhole.focal_px < 2:
            raise SceneError(
                f"the largest body is {across * self._pinhole.focal_px:.2g} px across at its closest and would be lost "
                "between samples: go nearer, take a longer lens, or look at units_m"
            )

    def _upload(self, gl: moderngl.Context) -> None:
        """Take meshes into the context's memory, with as much detail as is seen."""
        throwing = [part for body, part in zip(self._p.bodies, self._parts, strict=True) if body.throws_shadow]
        if self._p.shadows and throwing:
            self._shadows = ShadowMap(gl, self._throwing_radius_m(), self.distance_m / self._pinhole.focal_px)
        for body, part, range_m in zip(self._p.bodies, self._parts, self._ranges_m, strict=True):
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

    def _throwing(self, poses: list[Pose]) -> list[tuple[Pose, float]]:
        return [
            (pose, part.mesh.radius_m)
            for body, part, pose in zip(self._p.bodies, self._parts, poses, strict=True)
            if body.throws_shadow
        ]

    def _throwing_radius_m(self) -> float:
        """Return the radius of a sphere around all that throws shadows, in the first minute and a tenth more."""
        radii = []
        for k in range(_LOOKS):
            spheres = self._throwing(self._poses(self._time.scene_ns(round(k * _LOOK_S / _LOOKS * 1e9))))
            centre = _middle(spheres)
            radii.append(max(float(np.linalg.norm(pose.position_m - centre)) + radius for pose, radius in spheres))
        return 1.1 * max(radii)

    def _shadow_from_world(self, poses: list[Pose]) -> Matrix:
        if self._shadows is None:
            return np.eye(4)
        return self._shadows.from_world(self._sun, _middle(self._throwing(poses)))

    def _beginning(self, t_ns: int) -> Callable[[], None]:
        """Return what lets the stage begin the picture of `t_ns`; whatever can fail has been done."""
        scene_ns = self._time.scene_ns(t_ns)
        camera, poses = self._camera.pose(scene_ns), self._poses(scene_ns)
        shadow_from_world = self._shadow_from_world(poses)
        return partial(
            self._stage.begin,
            partial(self._render, camera, poses, shadow_from_world),
            partial(self._cast, poses, shadow_from_world),
        )

    def _cast(self, poses: list[Pose], shadow_from_world: Matrix) -> None:
        """Draw the shadow map."""
        if self._shadows is not None:
            throwers = [
                (part.thrower, shadow_from_world @ _matrix(pose))
                for part, pose in zip(self._parts, poses, strict=True)
                if part.thrower is not None
            ]
            self._shadows.render(throwers)

    def _render(self, camera: Pose, poses: list[Pose], shadow_from_world: Matrix, gl: moderngl.Context) -> None:
        camera_from_world = camera.world_from_body.T
        seen = [camera_from_world @ (pose.position_m - camera.position_m) for pose in poses]
        frame = Frame(
            camera_from_world @ self._sun,
            self._pinhole.zoom,
            self._depth([place[2] for place in seen]),
            self._p.sun.irradiance_w_m2,
            self._p.ambient_w_m2,
        )
        for part, pose, place in zip(self._parts, poses, seen, strict=True):
            if part.facets is not None:
                turned = camera_from_world @ pose.world_from_body
                part.facets.render(frame, turned, place, shadow_from_world @ _matrix(pose))

    def _depth(self, ahead_m: list[float]) -> tuple[float, float]:
        """Return depth terms around all that is before the camera."""
        radii = [part.mesh.radius_m for part in self._parts]
        far = max([z + r for z, r in zip(ahead_m, radii, strict=True) if z + r > 0], default=1.0)
        near = min([z - r for z, r in zip(ahead_m, radii, strict=True) if z + r > 0], default=0.5)
        return depth_terms(max(0.99 * near, _NEAREST_SHARE * far), 1.01 * far)


def _middle(spheres: list[tuple[Pose, float]]) -> npt.NDArray[np.float64]:
    """Return the middle of the box around spheres."""
    low = np.min([pose.position_m - radius for pose, radius in spheres], axis=0)
    high = np.max([pose.position_m + radius for pose, radius in spheres], axis=0)
    return np.asarray((low + high) / 2)


def _matrix(pose: Pose) -> Matrix:
    """Return world_from_body, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.world_from_body, pose.position_m
    return matrix

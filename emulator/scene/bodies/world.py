"""The bodies of a scene and its camera: shapes, paths, and what is known of them before anything is drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.light import SceneError
from emulator.scene.bodies.arrangement import Arrangement, Placed
from emulator.scene.bodies.detail import coarser, facet_size_m
from emulator.scene.bodies.detailed import detailed
from emulator.scene.bodies.mesh import Mesh, find_shape, load_mesh
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.trajectory.building import build_trajectories
from emulator.trajectory.pose import Trajectory, TrajectoryError
from emulator.trajectory.pose_receiver import close_receivers, live_counts
from emulator.trajectory.timescale import Timescale

__all__ = ["BodyWorld"]


class BodyWorld:
    """The bodies of `parameters` before `pinhole`, as every renderer needs them.

    Attributes
    ----------
    parameters, pinhole : as given.
    time : stream time to scene time.
    camera : the camera's path.
    meshes : the shape of each body, with its detail.
    placed : the path of each body.
    arrangement : poses and ranges.
    ranges_m : (bodies,), the closest range of each body's origin.

    Raises
    ------
    SceneError
        A shape or a path cannot be used, the camera begins inside a body, or nothing is large enough to be seen.
    """

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole) -> None:
        self.parameters, self.pinhole = parameters, pinhole
        self.time = Timescale(parameters.time_scale)
        try:
            self.camera, *paths = build_trajectories([parameters.camera, *(b.path for b in parameters.bodies)])
            self.meshes = [load_mesh(find_shape(body.shape), body.units_m) for body in parameters.bodies]
            self.placed = [self._placed(k, path) for k, path in enumerate(paths)]
        except (TrajectoryError, OSError) as error:
            raise SceneError(f"scene: {error}") from error
        self._notes = [
            f"{body.shape}: {warning}"
            for body, mesh in zip(parameters.bodies, self.meshes, strict=True)
            for warning in mesh.warnings
        ]
        self.arrangement = Arrangement(self.camera, self.placed, self.time)
        self.ranges_m = self.arrangement.ranges_m
        self.meshes = [
            detailed(mesh, body.detail, self.metres_a_pixel(k))
            for k, (mesh, body) in enumerate(zip(self.meshes, parameters.bodies, strict=True))
        ]
        self._as_seen: dict[int, Mesh] = {}
        self._require_outside()
        self._require_seen()

    @property
    def motion_bound_px_s(self) -> float:
        """From the paths' speeds and turns, at the closest ranges met in the first minute."""
        in_a_corner = 1 + math.tan(self.pinhole.widest_rad) ** 2
        return self.pinhole.focal_px * in_a_corner * self.arrangement.turn_bound_rad_s * self.time.factor

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of the poses that came from outside."""
        return live_counts(self.camera, *(placed.path for placed in self.placed))

    def notes(self, first_frame: npt.NDArray[np.float32]) -> tuple[str, ...]:
        """Return what is odd about the shapes, what detail was left out, and whether the first frame is black."""
        black = () if first_frame.any() else ("the first picture is black: no sunlit side is before the camera",)
        return (*self._notes, *black)

    def as_seen(self, k: int) -> Mesh:
        """Return the shape of body k with as much detail as can be seen at its closest range."""
        if k not in self._as_seen:
            self._as_seen[k] = self._gathered(k)
        return self._as_seen[k]

    def _gathered(self, k: int) -> Mesh:
        mesh, name = self.meshes[k], str(self.parameters.bodies[k].shape)
        cell_m = self.parameters.detail_px * self.metres_a_pixel(k)
        if facet_size_m(mesh) > cell_m:
            return mesh
        seen = coarser(mesh, cell_m)
        if seen is not mesh:
            self._notes.append(
                f"{name}: {len(seen.faces)} of {len(mesh.faces)} facets: the others are too small to be seen"
            )
        return seen

    def metres_a_pixel(self, k: int) -> float:
        """Return what a pixel spans on body k where it comes closest."""
        return max(float(self.ranges_m[k]) - self.meshes[k].radius_m, 1e-6) / self.pinhole.focal_px

    def close(self) -> None:
        """Close the ports of live poses; a second call does nothing."""
        close_receivers(self.camera, *(placed.path for placed in self.placed))

    def _placed(self, k: int, path: Trajectory) -> Placed:
        names, fixed_to = [body.name for body in self.parameters.bodies], self.parameters.bodies[k].fixed_to
        return Placed(path, names.index(fixed_to) if fixed_to else None, self.meshes[k].radius_m)

    def _each(self) -> Sequence[tuple[BodyTable, Mesh, float]]:
        return list(zip(self.parameters.bodies, self.meshes, map(float, self.ranges_m), strict=True))

    def _require_outside(self) -> None:
        for body, mesh, range_m in self._each():
            core_m = float(np.linalg.norm(mesh.vertices, axis=1).min())
            if range_m <= core_m:
                raise SceneError(
                    f"the camera comes within {range_m:g} m of the middle of {body.shape}, whose surface is at least "
                    f"{core_m:g} m from it: it would be inside. Move it out, or look at units_m"
                )

    def _require_seen(self) -> None:
        across_px = max(2 * mesh.radius_m / range_m for _, mesh, range_m in self._each()) * self.pinhole.focal_px
        if across_px < 2:
            raise SceneError(
                f"the largest body is {across_px:.2g} px across at its closest and would be lost "
                "between samples: go nearer, take a longer lens, or look at units_m"
            )

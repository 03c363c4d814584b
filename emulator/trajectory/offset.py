"""Something mounted beside what moves on a path, at a fixed place of its frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import cross
from emulator.trajectory.motion import Motion
from emulator.trajectory.parameters import TrajectoryParameters
from emulator.trajectory.pose import Pose, Trajectory

__all__ = ["Offset", "OffsetPath"]


@dataclass(frozen=True)
class OffsetPath:
    """Parameters of a path beside another one; no rig writes it. See `Offset`."""

    path: TrajectoryParameters
    offset_m: tuple[float, float, float]
    q_path_from_body: tuple[float, float, float, float]


class Offset(Trajectory):
    """A thing at `offset_m`, (3,) along the axes of `path`, turned against them by the fixed `q_path_from_body`."""

    def __init__(self, path: Trajectory, offset_m: npt.ArrayLike, q_path_from_body: npt.ArrayLike) -> None:
        self._path = path
        self._mounted = Pose(np.asarray(offset_m, np.float64), np.asarray(q_path_from_body, np.float64))

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        return self._path.pose(t_ns).after(self._mounted)

    def motion(self, t_ns: int) -> Motion:
        """Return its motion: velocity and turning of a rigid body, the acceleration from differences of places."""
        path, world_from_path = self._path.motion(t_ns), self._path.pose(t_ns).world_from_body
        carried = world_from_path @ cross(path.turn_rad_s, self._mounted.position_m)
        acceleration = super().motion(t_ns).acceleration_m_s2
        return Motion(path.velocity_m_s + carried, acceleration, self._mounted.world_from_body.T @ path.turn_rad_s)

    @property
    def speed_bound_m_s(self) -> float:
        """That of the path, and that of turning about it."""
        arm_m = float(np.linalg.norm(self._mounted.position_m))
        return self._path.speed_bound_m_s + arm_m * self._path.turn_bound_rad_s

    @property
    def turn_bound_rad_s(self) -> float:
        """That of the path."""
        return self._path.turn_bound_rad_s

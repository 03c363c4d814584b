"""A camera carried along a path, with its boresight on a target.

Its +z axis (the boresight) points at the target, and its -y axis (up in the picture) lies as near to a given direction
as that allows. Where the line of sight runs along that very direction the picture's turn is not defined; there any
fixed turn is taken, and a path that passes through such a place turns the picture quickly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, Vector, cross, quaternion_of, unit
from emulator.trajectory.measured import measured_bounds
from emulator.trajectory.motion import Motion, rate_of_frame
from emulator.trajectory.pose import Pose, Trajectory, TrajectoryError

__all__ = ["Looking", "looking_along"]

_ALONG = 1e-9


class Looking(Trajectory):
    """The path of `place`, with the boresight on `target_m`, (3,) in the world.

    Parameters
    ----------
    up : (3,) direction in the world that is up in the picture.
    times_ns : when its turning is measured, see `measured`.
    """

    def __init__(self, place: Trajectory, target_m: npt.ArrayLike, up: npt.ArrayLike, times_ns: Sequence[int]) -> None:
        self._place = place
        self._target_m = np.asarray(target_m, np.float64)
        self._up = unit(up)
        self._turn_rad_s = measured_bounds(self.pose, times_ns)[1]

    def pose(self, t_ns: int) -> Pose:
        """Return the pose; raises TrajectoryError when the camera is at the target itself."""
        place = self._place.pose(t_ns).position_m
        sight = self._target_m - place
        if not sight.any():
            raise TrajectoryError(f"at {t_ns * 1e-9:g} s the camera is at the very point that it looks at")
        return Pose(place, quaternion_of(looking_along(sight, self._up)))

    def motion(self, t_ns: int) -> Motion:
        """Return the path's motion with the turning that keeps the boresight on the target."""
        place, axes = self._place.motion(t_ns), self.pose(t_ns).world_from_body
        x, _, z = axes.T
        across = cross(z, self._up)
        if np.linalg.norm(across) < _ALONG:
            return Motion(place.velocity_m_s, place.acceleration_m_s2, super().motion(t_ns).turn_rad_s)
        sight = self._target_m - self._place.pose(t_ns).position_m
        z_rate = _turning(-place.velocity_m_s, z) / np.linalg.norm(sight)
        x_rate = _turning(cross(z_rate, self._up), x) / np.linalg.norm(across)
        y_rate = cross(z_rate, x) + cross(z, x_rate)
        rates = np.column_stack([x_rate, y_rate, z_rate])
        return Motion(place.velocity_m_s, place.acceleration_m_s2, rate_of_frame(axes, rates))

    @property
    def speed_bound_m_s(self) -> float:
        """That of the path."""
        return self._place.speed_bound_m_s

    @property
    def turn_bound_rad_s(self) -> float:
        """Measured, see `measured`."""
        return self._turn_rad_s


def looking_along(sight: npt.ArrayLike, up: npt.ArrayLike) -> Matrix:
    """Return world_from_camera of a camera with its boresight along `sight` and `up` up in its picture."""
    z = unit(sight)
    x = cross(z, unit(up))
    if np.linalg.norm(x) < _ALONG:
        x = cross(z, _any_other(z))
    x = unit(x)
    return np.column_stack([x, cross(z, x), z])


def _turning(rate: Vector, direction: Vector) -> Vector:
    """Return the part of `rate` that turns a vector along the unit vector `direction`, not the one that stretches."""
    return np.asarray(rate - (rate @ direction) * direction)


def _any_other(axis: Vector) -> Vector:
    return np.asarray(np.eye(3)[int(np.argmin(np.abs(axis)))])

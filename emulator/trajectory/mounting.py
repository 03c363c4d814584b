"""Trajectories made of others: a camera with its boresight on a target, a rotating body, a mounted camera.

`Looking` carries a camera along a path. Its +z axis (the boresight) points at the target, and its -y axis (up in the
picture) lies as near to a given direction as that allows. Where the line of sight runs along that very direction the
picture's turn is not defined; there any fixed turn is taken, and a path that passes through such a place turns the
picture quickly.

`Spinning` is a steady spin, or the tumbling of a body with an axis of symmetry. A body free of torques whose moments of
inertia about two of its axes are equal turns about its third, +Z, at a steady rate, while that axis goes round the
(fixed) angular momentum at another steady rate and a steady tilt (Goldstein, Classical Mechanics, section 5.6). In
matrices, with `spin` from `attitude`:

    world_from_body = spin(momentum, precession) * Rx(tilt) * Rz(turned)

Without a tilt it spins about the momentum. Phases are exact for as long as the stream lasts (see `cycle`).

`PlaceAndAttitude` has the places of one trajectory and the attitudes of another; `Mounted` is fixed to a path.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, Vector, cross, quaternion_of, spin, unit
from emulator.geometry.camera import Cycle
from emulator.trajectory.pose import Bounds, Motion, Pose, Trajectory, TrajectoryError, measured_bounds

_ALONG = 1e-9


class Looking(Trajectory):
    """The path of `place`, with the boresight on `target_m`, (3,) in the world, and `up`, (3,), up in the picture.

    `times_ns` are the instants at which its turning is measured, see `measured_bounds`.
    """

    def __init__(self, place: Trajectory, target_m: npt.ArrayLike, up: npt.ArrayLike, times_ns: Sequence[int]) -> None:
        self._place = place
        self.span_ns = place.span_ns
        self._target_m = np.asarray(target_m, np.float64)
        self._up = unit(up)
        self.bounds = Bounds(place.bounds.speed_m_s, measured_bounds(self.pose, times_ns).turn_rad_s)

    def pose(self, t_ns: int) -> Pose:
        """Return the pose; raises TrajectoryError when the camera is at the target itself."""
        place = self._place.pose(t_ns).position_m
        sight = self._target_m - place
        if not sight.any():
            raise TrajectoryError(f"at {t_ns * 1e-9:g} s the camera is at the very point that it looks at")
        return Pose(place, quaternion_of(looking_along(sight, self._up)))

    def motion(self, t_ns: int) -> Motion:
        """Return the path's motion with the turning that keeps the boresight on the target."""
        place, axes = self._place.motion(t_ns), self.pose(t_ns).world_from_body  # axes of the camera are its columns
        x, _, z = axes.T
        across = cross(z, self._up)
        if np.linalg.norm(across) < _ALONG:
            return Motion(place.velocity_m_s, place.acceleration_m_s2, super().motion(t_ns).turn_rad_s)
        sight = self._target_m - self._place.pose(t_ns).position_m
        z_rate = _turning(-place.velocity_m_s, z) / np.linalg.norm(sight)
        x_rate = _turning(cross(z_rate, self._up), x) / np.linalg.norm(across)
        y_rate = cross(z_rate, x) + cross(z, x_rate)
        turn = axes.T @ np.column_stack([x_rate, y_rate, z_rate])
        rate = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
        return Motion(place.velocity_m_s, place.acceleration_m_s2, rate)


def looking_along(sight: npt.ArrayLike, up: npt.ArrayLike) -> Matrix:
    """Return world_from_camera of a camera with its boresight along `sight` and `up` up in its picture."""
    z = unit(sight)
    x = cross(z, unit(up))
    if x @ x < _ALONG**2:
        x = cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])  # any other axis
    x = unit(x)
    return np.column_stack([x, cross(z, x), z])


def _turning(rate: Vector, direction: Vector) -> Vector:
    """Return the part of `rate` that turns a vector along the unit vector `direction`, not the one that stretches."""
    return np.asarray(rate - (rate @ direction) * direction)


_NO_PRECESSION = Cycle(0)


class Spinning(Trajectory):
    """A body at `position_m` (3,) turning about its +Z axis.

    The axis lies along `momentum` (3,), or precesses about it at an angle of `tilt_rad`.
    """

    def __init__(
        self,
        position_m: npt.ArrayLike,
        momentum: npt.ArrayLike,
        turned: Cycle,
        tilt_rad: float = 0.0,
        precession: Cycle = _NO_PRECESSION,
    ) -> None:
        self._position_m = np.asarray(position_m, np.float64)
        self._momentum = unit(momentum)
        self._turned, self._precession = turned, precession
        self._tilt_rad = tilt_rad
        # The greatest rate is that of both, when the axes lie along each other.
        self.bounds = Bounds(0.0, 2 * math.pi * float(abs(turned.rate_hz) + abs(precession.rate_hz)))
        self.span_ns = 0, max(round(1e9 / abs(c.rate_hz)) if c.rate_hz else 0 for c in (turned, precession))

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        c, s = math.cos(self._tilt_rad), math.sin(self._tilt_rad)
        about_x = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
        angle = 2 * math.pi * self._turned.turns(t_ns)
        c, s = math.cos(angle), math.sin(angle)
        about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        turning = spin(self._momentum, self._precession.turns(t_ns)) @ about_x
        return Pose(self._position_m, quaternion_of(turning @ about_z))

    def motion(self, t_ns: int) -> Motion:
        """Return the rate: the spin along its own +Z and the precession along the momentum, added."""
        spin_rad_s, precession_rad_s = (2 * math.pi * float(c.rate_hz) for c in (self._turned, self._precession))
        momentum = self.pose(t_ns).world_from_body.T @ self._momentum
        return Motion(np.zeros(3), np.zeros(3), precession_rad_s * momentum + [0.0, 0.0, spin_rad_s])


class PlaceAndAttitude(Trajectory):
    """The places of one trajectory with the attitudes of another, each at its own times.

    `places_zero_ns` and `attitudes_zero_ns` are the time on each that is time 0 here.
    """

    def __init__(self, places: Trajectory, attitudes: Trajectory, places_zero_ns: int, attitudes_zero_ns: int) -> None:
        self._places, self._attitudes = places, attitudes
        self._places_zero_ns, self._attitudes_zero_ns = places_zero_ns, attitudes_zero_ns
        self.span_ns = places.span_ns[0] - places_zero_ns, places.span_ns[1] - places_zero_ns

    def pose(self, t_ns: int) -> Pose:
        """Return the place of one and the attitude of the other at `t_ns`."""
        attitude = self._attitudes.pose(t_ns + self._attitudes_zero_ns).q_world_from_body
        return Pose(self._places.pose(t_ns + self._places_zero_ns).position_m, attitude)

    def motion(self, t_ns: int) -> Motion:
        """Return the velocity of the one and the turning of the other."""
        place = self._places.motion(t_ns + self._places_zero_ns)
        turn = self._attitudes.motion(t_ns + self._attitudes_zero_ns).turn_rad_s
        return Motion(place.velocity_m_s, place.acceleration_m_s2, turn)

    @cached_property
    def bounds(self) -> Bounds:
        """Bounds of the places, and of the attitudes."""
        return Bounds(self._places.bounds.speed_m_s, self._attitudes.bounds.turn_rad_s)


class Mounted(Trajectory):
    """A body fixed to a path at `mounting`, its pose along the axes of the path."""

    def __init__(self, path: Trajectory, mounting: Pose) -> None:
        self._path, self._mounting = path, mounting
        self.span_ns = path.span_ns

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        return self._path.pose(t_ns).after(self._mounting)

    def motion(self, t_ns: int) -> Motion:
        """Return the motion of a rigid body; the acceleration beside the path is from differences of places."""
        path, arm_m = self._path.motion(t_ns), self._mounting.position_m
        turn_rad_s = self._mounting.world_from_body.T @ path.turn_rad_s
        if not arm_m.any():
            return Motion(path.velocity_m_s, path.acceleration_m_s2, turn_rad_s)
        carried = self._path.pose(t_ns).world_from_body @ cross(path.turn_rad_s, arm_m)
        return Motion(path.velocity_m_s + carried, super().motion(t_ns).acceleration_m_s2, turn_rad_s)

    @cached_property
    def bounds(self) -> Bounds:
        """Bounds of the path, and of turning about it."""
        path, arm_m = self._path.bounds, float(np.linalg.norm(self._mounting.position_m))
        return Bounds(path.speed_m_s + (arm_m * path.turn_rad_s if arm_m else 0.0), path.turn_rad_s)

"""Rotating bodies: a steady spin, and the tumbling of a body with an axis of symmetry.

A body free of torques whose moments of inertia about two of its axes are equal turns about its third, +Z, at a steady
rate, while that axis goes round the (fixed) angular momentum at another steady rate and a steady tilt (Goldstein,
Classical Mechanics, section 5.6). In matrices, with `spin` from `attitude`:

    world_from_body = spin(momentum, precession) * Rx(tilt) * Rz(turned)

Without a tilt it spins about the momentum. Phases are exact for as long as the stream lasts (see `cycle`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, quaternion_of, spin, unit
from emulator.geometry.cycle import Cycle
from emulator.trajectory.motion import Motion
from emulator.trajectory.pose import Pose, Trajectory

__all__ = ["Spinning", "Tilt"]


@dataclass(frozen=True)
class Tilt:
    """Angle of the body's +Z axis to the momentum, and its precession."""

    tilt_rad: float
    precession: Cycle


_UPRIGHT = Tilt(0.0, Cycle(0))


class Spinning(Trajectory):
    """A body at `position_m` (3,) turning about its +Z axis, which lies along `momentum` (3,) or precesses about it."""

    def __init__(
        self, position_m: npt.ArrayLike, momentum: npt.ArrayLike, turned: Cycle, tilt: Tilt = _UPRIGHT
    ) -> None:
        self._position_m = np.asarray(position_m, np.float64)
        self._momentum = unit(momentum)
        self._turned, self._tilt = turned, tilt

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        turning = spin(self._momentum, self._tilt.precession.turns(t_ns)) @ _about_x(self._tilt.tilt_rad)
        return Pose(self._position_m, quaternion_of(turning @ _about_z(self._turned.turns(t_ns))))

    def motion(self, t_ns: int) -> Motion:
        """Return its rate: the spin along its own +Z and the precession along the momentum, added."""
        spin_rad_s, precession_rad_s = (2 * math.pi * float(c.rate_hz) for c in (self._turned, self._tilt.precession))
        momentum = self.pose(t_ns).world_from_body.T @ self._momentum
        return Motion(np.zeros(3), np.zeros(3), precession_rad_s * momentum + [0.0, 0.0, spin_rad_s])

    @property
    def speed_bound_m_s(self) -> float:
        """It stays."""
        return 0.0

    @property
    def turn_bound_rad_s(self) -> float:
        """Both rates added, which they are when the axes lie along each other."""
        return 2 * math.pi * float(abs(self._turned.rate_hz) + abs(self._tilt.precession.rate_hz))


def _about_x(angle: float) -> Matrix:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def _about_z(turns: float) -> Matrix:
    c, s = math.cos(2 * math.pi * turns), math.sin(2 * math.pi * turns)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])

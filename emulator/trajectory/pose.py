"""Poses (a place and an attitude), and trajectories that give one at every instant.

World: metres, right-handed. `q_world_from_body` is a unit quaternion, scalar first: it turns coordinates along the
body's own axes into coordinates along the world's. A camera's own axes are OpenCV's: x right, y down, z out along the
boresight.

Attitudes of other programs can be converted to `q_world_from_camera`, scalar first, OpenCV camera axes:

    evstim, OpenCV     x right, y down, z out          (w, x, y, z), turns camera coordinates into the world's
    OpenGL             x right, y up, looks along -z
    ROS, scipy         (the camera frame 'optical' of ROS is OpenCV's)  (x, y, z, w)
    Basilisk, Vizard   image frame as OpenCV's         MRP sigma_CN: camera from inertial
    SPICE              each instrument's own axes      C-matrix: instrument from frame; NEAR's MSI looks along +X

For programs that write poses for evstim: tables (`.csv`), keyframes of a rig, or live poses (`firmware_protocol`).

    >>> from_basilisk([0.0, 0.0, 0.41421356]).round(3)
    array([0.707, 0.   , 0.   , 0.707])

Sources: Basilisk's CameraConfigMsg and Vizard pages; NAIF's Required Reading on rotations; Schaub and Junkins,
Analytical Mechanics of Space Systems, section 3.5 (MRP); REP 103 for ROS.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, Quaternion, Vector, conjugate, matrix_of, multiply
from emulator.trajectory.motion import AT_REST, Motion, differences

__all__ = [
    "CAMERA_FROM_MSI",
    "FARTHEST_M",
    "OPENGL_FROM_CAMERA",
    "STILL",
    "Fixed",
    "Pose",
    "Trajectory",
    "TrajectoryError",
    "from_basilisk",
    "from_opengl",
    "from_scalar_last",
    "from_spice",
]


FARTHEST_M = 1e18
"""A hundred light years; the squares and cubes of it stay finite."""

_UNIT_WITHIN = 1e-3


class TrajectoryError(Exception):
    """A trajectory cannot be used; the message contains the error and its place."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A place and an attitude.

    Attributes
    ----------
    position_m : (3,) float64, in the world.
    q_world_from_body : (4,) float64, unit, scalar first; one within 0.1 % of unit length is made so.

    Raises
    ------
    ValueError
        Not finite, or not a unit quaternion.
    """

    position_m: Vector
    q_world_from_body: Quaternion

    def __post_init__(self) -> None:
        position, q = np.asarray(self.position_m, np.float64), np.asarray(self.q_world_from_body, np.float64)
        if position.shape != (3,) or not (np.abs(position) <= FARTHEST_M).all():  # NaN compares false
            raise ValueError(f"a position is three finite metres, at most {FARTHEST_M:g}, got {position}")
        length = float(np.linalg.norm(q)) if (np.abs(q) < 2).all() else math.inf
        if q.shape != (4,) or not abs(length - 1) < _UNIT_WITHIN:
            raise ValueError(f"an attitude is a unit quaternion (w, x, y, z), got {q} of length {length:.4g}")
        object.__setattr__(self, "position_m", position)
        object.__setattr__(self, "q_world_from_body", q / length)

    @cached_property
    def world_from_body(self) -> Matrix:
        """The attitude as a matrix, (3, 3), not to be written to."""
        matrix = matrix_of(self.q_world_from_body)
        matrix.flags.writeable = False
        return matrix

    def after(self, child: Pose) -> Pose:
        """Return the pose in the world of `child`, which is given in the frame of this pose."""
        position = self.position_m + self.world_from_body @ child.position_m
        return Pose(position, multiply(self.q_world_from_body, child.q_world_from_body))

    def inverse(self) -> Pose:
        """Return the pose of the world in the frame of this pose."""
        return Pose(-(self.world_from_body.T @ self.position_m), conjugate(self.q_world_from_body))


STILL = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
"""At the origin, turned with the world's axes."""


class Trajectory(ABC):
    """A pose at every instant."""

    @abstractmethod
    def pose(self, t_ns: int) -> Pose:
        """Return the pose at time `t_ns`, which depends on nothing else unless poses come from outside."""

    def motion(self, t_ns: int) -> Motion:
        """Return the motion at `t_ns`; from differences of poses where no closed form is known, see `motion`."""
        return differences(self.pose, t_ns)

    def pose_and_motion(self, t_ns: int) -> tuple[Pose, Motion]:
        """Return both at `t_ns`, not for a light frame: poses from outside are neither read nor counted."""
        return self.pose(t_ns), self.motion(t_ns)

    @property
    @abstractmethod
    def speed_bound_m_s(self) -> float:
        """Upper bound of the speed, m/s; infinite where none is known."""

    @property
    @abstractmethod
    def turn_bound_rad_s(self) -> float:
        """Upper bound of the rate of turning, rad/s; infinite where none is known."""


class Fixed(Trajectory):
    """A trajectory that stays at one pose."""

    def __init__(self, pose: Pose = STILL) -> None:
        self._pose = pose

    def pose(self, t_ns: int) -> Pose:
        """Return the one pose."""
        return self._pose

    def motion(self, t_ns: int) -> Motion:
        """Return rest."""
        return AT_REST

    @property
    def speed_bound_m_s(self) -> float:
        """Zero: it does not move."""
        return 0.0

    @property
    def turn_bound_rad_s(self) -> float:
        """Zero: it does not turn."""
        return 0.0


CAMERA_FROM_MSI: Matrix = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""OpenCV axes from those of NEAR's camera, whose boresight is +X: right is +Y, down is +Z (kernel msi15.ti)."""

OPENGL_FROM_CAMERA: Quaternion = np.array([0.0, 1.0, 0.0, 0.0])
"""OpenGL's camera axes from OpenCV's: a half turn about x."""


def from_opengl(q_world_from_camera: npt.ArrayLike) -> Quaternion:
    """Return the attitude of a camera that looks along its -z with +y up; both quaternions are scalar first."""
    return _signed(multiply(np.asarray(q_world_from_camera, np.float64), OPENGL_FROM_CAMERA))


def from_scalar_last(q: npt.ArrayLike) -> Quaternion:
    """Return the same quaternion scalar first, as ROS and scipy write it scalar last."""
    return np.asarray(np.roll(np.asarray(q, np.float64), 1))


def from_basilisk(sigma_cn: npt.ArrayLike) -> Quaternion:
    """Return the attitude of Modified Rodrigues Parameters (3,), of the camera's frame from the inertial one."""
    from scipy.spatial.transform import (
        Rotation,  # loaded where it is used: it takes longer than the rest of a short run's imports
    )

    # An MRP set of `C from N` names the turn that takes N's axes into C's, which is world from camera.
    return _signed(Rotation.from_mrp(sigma_cn).as_quat(scalar_first=True))


def from_spice(instrument_from_frame: npt.ArrayLike, camera_from_instrument: npt.ArrayLike) -> Quaternion:
    """Return the attitude of a C-matrix (3, 3) and the instrument's axes (3, 3), such as CAMERA_FROM_MSI."""
    from scipy.spatial.transform import Rotation

    camera_from_world = np.asarray(camera_from_instrument) @ np.asarray(instrument_from_frame)
    return _signed(Rotation.from_matrix(camera_from_world).inv().as_quat(scalar_first=True))


def _signed(q: Quaternion) -> Quaternion:
    """Return the one of two equal quaternions with its scalar not below 0."""
    return np.asarray(-q if q[0] < 0 else q)

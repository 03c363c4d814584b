"""Poses (a place and an attitude), their motion, and trajectories that give both at every instant.

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

The motion of a trajectory is the derivatives of its pose, in closed form or from differences. Differences are central,
over a step h of 5 ms to either side of t (p: place, w: rate of turning, e = 1.1e-16):

    velocity       (p(t+h) - p(t-h)) / 2h                  error h^2/6 |p'''|  + e |p| / h
    acceleration   (p(t+h) - 2 p(t) + p(t-h)) / h^2        error h^2/12 |p''''| + 4 e |p| / h^2
    turning        turn from t-h to t+h / 2h               error h^2/6 |w''|   + 4 e / h

At 1 km from the origin rounding makes an acceleration wrong by 2e-8 m/s2 at most, at 10 000 km by 2e-4 m/s2. Where a
path has a kink (its ends, a change of segment), they see it within h.

Scene time is stream time by an exact factor that makes slow motion fast. Itokawa turns once in half a day, and from
Hayabusa's home position a pixel of motion takes a quarter of a minute. A factor of 100 shows the same in minutes;
events then come 100 times as fast as they would, which a summary should never hide.

Bounds on speed and rate of turning are measured where no closed form gives them: poses are taken at many instants,
evenly spread. The bound is the largest difference quotient and a quarter more, for the motion between the instants. A
path that is smooth between them (splines, orbits, spins) keeps it.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, Quaternion, Vector, conjugate, matrix_of, multiply

_H_NS = 5_000_000
_H_S = _H_NS * 1e-9
_SMALL_RAD = 1e-4


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a body at one instant.

    Attributes
    ----------
    velocity_m_s, acceleration_m_s2 : (3,), in the world.
    turn_rad_s : (3,), angular rate against the world, along the body's own axes.
    """

    velocity_m_s: Vector
    acceleration_m_s2: Vector
    turn_rad_s: Vector


AT_REST = Motion(np.zeros(3), np.zeros(3), np.zeros(3))


def differences(pose: Callable[[int], Pose], t_ns: int) -> Motion:
    """Return the motion at `t_ns` from the poses 5 ms before, then and 5 ms after; for its errors see above."""
    before, now, after = (pose(t_ns + k * _H_NS) for k in (-1, 0, 1))
    velocity = (after.position_m - before.position_m) / (2 * _H_S)
    step = (after.position_m - now.position_m) - (now.position_m - before.position_m)
    turned = multiply(conjugate(before.q_world_from_body), after.q_world_from_body)
    vector = rotation_vector(turned)  # along the axes of the body before and, as they differ by it, after and half-way
    return Motion(velocity, step / _H_S**2, vector / (2 * _H_S))


def rotation_vector(q: Quaternion) -> Vector:
    """Return the rotation vector of a unit quaternion, rad, (3,), at most half a turn long."""
    sine = float(np.linalg.norm(q[1:]))
    half = math.atan2(sine, abs(q[0]))
    return np.asarray(math.copysign(2 * half / sine if sine > 0 else 2.0, q[0]) * q[1:])


def rate_of_vector(vector: Vector, rate: Vector) -> Vector:
    """Return the angular rate along the body's axes, (3,), of the attitude exp(vector) whose vector changes by `rate`.

    Source: the right Jacobian of SO(3) (Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2, 10.86).
    """
    angle = float(np.linalg.norm(vector))
    if angle < _SMALL_RAD:
        first, second = 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        first = (1 - math.cos(angle)) / angle**2
        second = (angle - math.sin(angle)) / angle**3
    crossed = np.cross(vector, rate)
    return np.asarray(rate - first * crossed + second * np.cross(vector, crossed))


class Timescale:
    """Scene time = factor * stream time; `factor` is taken as the decimal number that a person wrote."""

    def __init__(self, factor: float = 1.0) -> None:
        self._factor = Fraction(repr(float(factor)))

    @property
    def factor(self) -> float:
        """Scene time per unit of stream time."""
        return float(self._factor)

    def scene_ns(self, t_ns: int) -> int:
        """Return the scene's time at stream time `t_ns`, ns, rounded down."""
        return int(t_ns) * self._factor.numerator // self._factor.denominator


FARTHEST_M = 1e18
"""A hundred light years; the squares and cubes of it stay finite."""

_UNIT_WITHIN = 1e-3
_FROM_MATRIX = (
    "; a rotation matrix (3, 3) becomes one by "
    "scipy.spatial.transform.Rotation.from_matrix(matrix).as_quat(scalar_first=True), a scalar last (x, y, z, w) by "
    "evstim.attitude_from_scalar_last"
)


class TrajectoryError(Exception):
    """A trajectory cannot be used; the message contains the error and its place."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A place and an attitude; raises ValueError if not finite, or not a unit quaternion.

    Attributes
    ----------
    position_m : (3,) float64, in the world; read-only copies both.
    q_world_from_body : (4,) float64, unit, scalar first; one within 0.1 % of unit length is made so.
    """

    position_m: Vector
    q_world_from_body: Quaternion

    def __post_init__(self) -> None:
        position, q = np.array(self.position_m, np.float64), np.array(self.q_world_from_body, np.float64)
        if position.shape != (3,) or not all(abs(x) <= FARTHEST_M for x in position.tolist()):  # NaN compares false
            raise ValueError(f"a position is three finite metres, at most {FARTHEST_M:g}, got {position}")
        length = math.hypot(*q) if q.shape == (4,) else math.nan
        if not abs(length - 1) < _UNIT_WITHIN:
            fault = f" of length {length:.4g}" if length < math.inf else ""
            advice = _FROM_MATRIX if q.shape in ((3, 3), (4, 4), (9,), (16,)) else ""
            raise ValueError(f"an attitude is a unit quaternion (w, x, y, z), got {q}{fault}{advice}")
        q /= math.sqrt(q @ q)
        position.flags.writeable = q.flags.writeable = False
        object.__setattr__(self, "position_m", position)
        object.__setattr__(self, "q_world_from_body", q)

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


class Bounds(NamedTuple):
    """Upper bounds of the speed, m/s, and of the rate of turning, rad/s; infinite where none is known."""

    speed_m_s: float = 0.0
    turn_rad_s: float = 0.0


class Trajectory(ABC):
    """A pose at every instant; between the times `span_ns` it has all its poses: to its end, or in one period."""

    span_ns: tuple[int, int] = (0, 0)

    @abstractmethod
    def pose(self, t_ns: int) -> Pose:
        """Return the pose at time `t_ns`, which depends on nothing else unless poses come from outside."""

    def motion(self, t_ns: int) -> Motion:
        """Return the motion at `t_ns`; from differences of poses where no closed form is known."""
        return differences(self.pose, t_ns)

    def pose_and_motion(self, t_ns: int) -> tuple[Pose, Motion]:
        """Return both at `t_ns`, not for a light frame: poses from outside are neither read nor counted."""
        return self.pose(t_ns), self.motion(t_ns)

    @cached_property
    def bounds(self) -> Bounds:
        """Bounds of its motion; a subclass defines them, or sets them as an attribute."""
        raise NotImplementedError


class Fixed(Trajectory):
    """A trajectory that stays at one pose."""

    bounds = Bounds()

    def __init__(self, pose: Pose = STILL) -> None:
        self._pose = pose

    def pose(self, t_ns: int) -> Pose:
        """Return the one pose."""
        return self._pose

    def motion(self, t_ns: int) -> Motion:
        """Return rest."""
        return AT_REST


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
    # Loaded where it is used: it takes longer than the rest of a short run's imports.
    from scipy.spatial.transform import Rotation

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


_A_PIECE = 8
_MOST = 4096
_LATEST_NS = 1 << 62


def require_increasing(times_ns: Sequence[int], poses: int) -> None:
    """Raise TrajectoryError unless there is at least one time, as many as poses, each later than the one before."""
    if not len(times_ns):
        raise TrajectoryError("an empty trajectory: at least one pose is needed")
    if len(times_ns) != poses:
        raise TrajectoryError(f"{len(times_ns)} times for {poses} poses")
    if max(abs(times_ns[0]), abs(times_ns[-1])) > _LATEST_NS:
        farthest_s = max(abs(times_ns[0]), abs(times_ns[-1])) // 10**9
        raise TrajectoryError(f"times reach {farthest_s:.3g} s: at most {_LATEST_NS // 10**9} s, 140 years, are kept")
    for k, (before, after) in enumerate(itertools.pairwise(times_ns), start=1):
        if after <= before:
            problem = "again" if after == before else "goes back"
            raise TrajectoryError(f"pose {k}: time {after * 1e-9:g} s {problem} after {before * 1e-9:g} s")


def instants_between(times_ns: npt.NDArray[np.int64]) -> list[int]:
    """Return eight instants for each piece between two times, or every k-th time where there are very many."""
    pieces = len(times_ns) - 1
    if pieces * _A_PIECE > _MOST:
        every = -(-pieces // _MOST)
        return [int(t) for t in times_ns[::every]]
    x = np.arange(_A_PIECE) / _A_PIECE
    inside = (times_ns[:-1, None] + np.diff(times_ns)[:, None] * x).ravel()
    return [int(t) for t in np.unique(np.append(inside.astype(np.int64), times_ns[-1]))]


def instants_over(paths: Iterable[Trajectory], first_ns: int, count: int) -> list[int]:
    """Return `count` instants of each path, evenly spread from the first one on to where it has had all its poses."""
    spans_ns = {max(min(path.span_ns[1], _LATEST_NS) - first_ns, 0) for path in paths}
    return sorted({first_ns + k * span_ns // (count - 1) for span_ns in spans_ns for k in range(count)})


_MORE = 1.25


def measured_bounds(pose: Callable[[int], Pose], times_ns: Sequence[int]) -> Bounds:
    """Return the bounds of the motion between `times_ns`, increasing."""
    speed = turn = 0.0
    before, t0_ns = pose(times_ns[0]), times_ns[0]
    for t_ns in times_ns[1:]:
        after, dt = pose(t_ns), (t_ns - t0_ns) * 1e-9
        speed = max(speed, float(np.linalg.norm(after.position_m - before.position_m)) / dt)
        turn = max(turn, turn_rad(before, after) / dt)
        before, t0_ns = after, t_ns
    return Bounds(_MORE * speed, _MORE * turn)


def turn_rad(a: Pose, b: Pose) -> float:
    """Return the angle of the turn between two attitudes, 0 to pi; good for the smallest ones too."""
    q, p = a.q_world_from_body, b.q_world_from_body
    if q @ p < 0:
        p = -p
    return 4 * math.asin(min(1.0, float(np.linalg.norm(p - q)) / 2))

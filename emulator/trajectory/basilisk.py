"""Poses in a rig's world, from Basilisk's cameras, spacecraft and celestial bodies.

    q_world_from_camera = q(sigma_BN) q(sigma_CB)
    camera              = r_BN_N + R(q(sigma_BN)) r_CB_B
    world               = N, moved to the celestial body `origin`

The matrix [BN] turns coordinates of N into those of B, so the quaternion q(sigma_BN), of Hamilton's product, turns
those of B into those of N. The camera's frame C is that of evstim: z out along the boresight, x right, y down. On the
wire a camera's attitude has a third of a turn into Unity's axes added to sigma_CB, which is undone here.

Sources: CameraConfigMsg, the pages on vizInterface and `vizInterface.cpp` of AVSLab/basilisk; Schaub and Junkins,
Analytical Mechanics of Space Systems, section 3.5.

A simulation gives poses step by step, while the run waits for it. The pose of a light frame of time t is

    between two known poses     straight line, great circle; how it moved within its step is not known
    after the newest one        the motion of the last step goes on (rates of change are taken a moment around t)
    before the first one        the first one; the pose that the rig gives where none has come
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from emulator.geometry.attitude import Matrix, Quaternion, Vector, multiply
from emulator.trajectory.live import ComingPoses, TimedPose, between, known_motion
from emulator.trajectory.parameters import BasiliskPath
from emulator.trajectory.pose import AT_REST, Motion, Pose, TrajectoryError, from_basilisk
from firmware_protocol.vizard import Update, UpdateError

_KNOWN = 64


class SimulatedPath(ComingPoses):
    """A path that a simulation drives; `add` gives it poses.

    Parameters
    ----------
    first : the pose until one comes.
    """

    def __init__(self, first: Pose) -> None:
        self._first = first
        self._known: deque[TimedPose] = deque(maxlen=_KNOWN)

    def add(self, t_ns: int, pose: Pose) -> None:
        """Add the pose at `t_ns`, later than all before; raises TrajectoryError where it is not."""
        if self._known and t_ns <= self._known[-1][0]:
            raise TrajectoryError(f"a pose at {t_ns} ns came after the one at {self._known[-1][0]} ns")
        self._known.append(TimedPose(t_ns, pose))

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`, as far as it is known by now."""
        poses = self._known
        if not poses:
            return self._first
        if t_ns <= poses[0][0] or len(poses) == 1:
            return poses[0][1]
        after = next((k for k, (at_ns, _) in enumerate(poses) if at_ns >= t_ns), len(poses) - 1)
        return between(poses[after - 1], poses[after], t_ns)

    def motion(self, t_ns: int) -> Motion:
        """Return the motion at `t_ns` from the poses known now, see `known_motion`."""
        if len(self._known) < 2 or t_ns < self._known[0][0]:
            return AT_REST
        return known_motion(list(self._known), t_ns)


_CAMERA_FROM_UNITY: Quaternion = np.array([0.5, -0.5, -0.5, 0.5])
_ROTATION_WITHIN = 1e-3
_LARGEST_MRP = 1e6  # of one part; within a millionth of a whole turn


@dataclass(frozen=True)
class ConnectedPath(BasiliskPath):
    """A Basilisk path of a rig that a simulation drives."""

    simulated: SimulatedPath | None = None


def simulated_path(path: BasiliskPath) -> SimulatedPath:
    """Return a path for a simulation; without one it stays at the pose that the rig gives."""
    if isinstance(path, ConnectedPath) and path.simulated is not None:
        return path.simulated
    return SimulatedPath(Pose(np.array(path.position_m), np.array(path.q_world_from_body)))


def pose_of(path: BasiliskPath, update: Update) -> Pose:
    """Return the pose of the object that `path` names; raises TrajectoryError with the error in the update."""
    try:
        pose = _pose_in_n(path, update)
        origin_m = np.array(update.body(path.origin).position_m) if path.origin else np.zeros(3)
        return Pose(pose.position_m - origin_m, pose.q_world_from_body)
    except (UpdateError, ValueError) as error:
        raise TrajectoryError(f"simulated time {update.time_ns * 1e-9:g} s: {error}") from error


def _pose_in_n(path: BasiliskPath, update: Update) -> Pose:
    if path.camera is not None:
        camera = update.camera(path.camera)
        q_parent_from_camera = multiply(_from_mrp(camera.direction), _CAMERA_FROM_UNITY)
        mounted = Pose(np.array(camera.position_m), q_parent_from_camera)
        return _spacecraft(update, camera.parent).after(mounted)
    if path.spacecraft:
        return _spacecraft(update, path.spacecraft)
    body = update.body(path.body)
    return Pose(_vector(body.position_m), _from_matrix(np.reshape(body.rotation, (3, 3)), path.body))


def _spacecraft(update: Update, name: str) -> Pose:
    state = update.spacecraft(name)
    return Pose(_vector(state.position_m), _from_mrp(state.rotation))


def _from_mrp(sigma: tuple[float, ...]) -> Quaternion:
    if max(map(abs, sigma)) > _LARGEST_MRP:
        raise ValueError(f"the Modified Rodrigues Parameters {sigma} are too large for an attitude")
    return from_basilisk(sigma)


def _from_matrix(body_from_n: Matrix, name: str) -> Quaternion:
    from scipy.spatial.transform import (
        Rotation,  # loaded where it is used: it takes longer than the rest of a short run's imports
    )

    small = bool((np.abs(body_from_n) < 1 + _ROTATION_WITHIN).all())  # so that nothing below overflows
    off = np.abs(body_from_n @ body_from_n.T - np.eye(3)).max() if small else np.inf
    if off > _ROTATION_WITHIN or np.linalg.det(body_from_n) < 0:
        raise ValueError(f"the matrix of celestial body {name!r} is no rotation")
    return np.asarray(Rotation.from_matrix(body_from_n.T).as_quat(scalar_first=True))


def _vector(numbers: tuple[float, ...]) -> Vector:
    return np.array(numbers)

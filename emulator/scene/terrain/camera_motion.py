"""The camera's place and attitude at an instant, and their rates from poses shortly before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.trajectory.pose import Pose, Trajectory
from emulator.trajectory.timescale import Timescale

__all__ = ["CameraMotion", "camera_motion"]

_SIDE_NS = 1_000_000  # of scene time, between the poses for rates

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """A pose and its rates, a second of stream time.

    Attributes
    ----------
    velocity_m_s : (3,) in the world.
    turn, turning : camera_from_world, (3, 3), and its rate.
    """

    pose: Pose
    velocity_m_s: Floats
    turn: Floats
    turning: Floats

    @property
    def figures(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Place, velocity, turn and turning, as kernels take them."""
        return np.asarray(self.pose.position_m, np.float64), self.velocity_m_s, self.turn, self.turning


def camera_motion(t_ns: int, camera: Trajectory, time: Timescale) -> CameraMotion:
    """Return the motion at stream time `t_ns`; at the start, where a path may begin, from poses after it only."""
    now_ns = time.scene_ns(t_ns)
    first_ns, last_ns = max(now_ns - _SIDE_NS, min(now_ns, time.scene_ns(0))), now_ns + _SIDE_NS
    now, before, after = camera.pose(now_ns), camera.pose(first_ns), camera.pose(last_ns)
    between_s = (last_ns - first_ns) / (1e9 * time.factor)
    turn, turning = (
        np.ascontiguousarray(m.T)
        for m in (now.world_from_body, (after.world_from_body - before.world_from_body) / between_s)
    )
    return CameraMotion(now, (after.position_m - before.position_m) / between_s, turn, turning)

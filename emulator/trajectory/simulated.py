"""Poses that a simulation gives step by step, while the run waits for it.

For a picture of time t

    between two known poses     straight line, great circle; how it moved within its step is not known
    after the newest one        the motion of the last step goes on (rates of change are taken a moment around t)
    before the first one        the first one; the pose that the rig gives where none has come
"""

from __future__ import annotations

from collections import deque

from emulator.trajectory.live import between, known_motion
from emulator.trajectory.motion import AT_REST, Motion
from emulator.trajectory.pose import Pose, Trajectory, TrajectoryError

__all__ = ["SimulatedPath"]

_KNOWN = 64


class SimulatedPath(Trajectory):
    """A path that a simulation flies; fed by `add`.

    Parameters
    ----------
    first : the pose until one comes.
    """

    def __init__(self, first: Pose) -> None:
        self._first = first
        self._known: deque[tuple[int, Pose]] = deque(maxlen=_KNOWN)

    def add(self, t_ns: int, pose: Pose) -> None:
        """Take the pose at `t_ns`, later than all before; raises TrajectoryError where it is not."""
        if self._known and t_ns <= self._known[-1][0]:
            raise TrajectoryError(f"a pose at {t_ns} ns came after the one at {self._known[-1][0]} ns")
        self._known.append((t_ns, pose))

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`, as far as it is known by now."""
        known = self._known
        if not known:
            return self._first
        if t_ns <= known[0][0] or len(known) == 1:
            return known[0][1]
        after = next((k for k, (at_ns, _) in enumerate(known) if at_ns >= t_ns), len(known) - 1)
        return between(known[after - 1], known[after], t_ns)

    def motion(self, t_ns: int) -> Motion:
        """Return how it moves at `t_ns` by what is known now, see `known_motion`."""
        if len(self._known) < 2 or t_ns < self._known[0][0]:
            return AT_REST
        return known_motion(list(self._known), t_ns)

    @property
    def speed_bound_m_s(self) -> float:
        """Infinite: poses to come are not known."""
        return float("inf")

    @property
    def turn_bound_rad_s(self) -> float:
        """Infinite: poses to come are not known."""
        return float("inf")

"""Trajectories in segments that follow one another in time."""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from emulator.trajectory.motion import Motion
from emulator.trajectory.pose import Pose, Trajectory, TrajectoryError

__all__ = ["Segment", "Segmented"]


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of a trajectory.

    Attributes
    ----------
    path : on a time axis of its own.
    zero_ns : the instant of the whole's time axis at which the path's time is 0.
    start_ns, stop_ns : when the path may be used, on the whole's time axis.
    """

    path: Trajectory
    zero_ns: int
    start_ns: int
    stop_ns: int


class Segmented(Trajectory):
    """A trajectory of segments in turn; at an instant that two share the later one holds.

    Before the first segment and after the last the pose stays what it is there.

    Raises
    ------
    TrajectoryError
        No segment, or segments that overlap or leave a gap.
    """

    def __init__(self, segments: Sequence[Segment]) -> None:
        if not segments:
            raise TrajectoryError("an empty trajectory: the file holds no samples")
        for number, (a, b) in enumerate(itertools.pairwise(segments), start=2):
            if b.start_ns != a.stop_ns:
                apart_s = (b.start_ns - a.stop_ns) * 1e-9
                problem = f"starts {apart_s:g} s after" if apart_s > 0 else f"starts {-apart_s:g} s before"
                raise TrajectoryError(f"segment {number} {problem} the end of the one before: they must follow closely")
        self._segments = tuple(segments)
        self._starts_ns = [segment.start_ns for segment in segments]

    @property
    def span_ns(self) -> tuple[int, int]:
        """Start of the first segment and end of the last."""
        return self._segments[0].start_ns, self._segments[-1].stop_ns

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        segment = self._segment(t_ns)
        return segment.path.pose(min(max(t_ns, segment.start_ns), segment.stop_ns) - segment.zero_ns)

    def motion(self, t_ns: int) -> Motion:
        """Return the motion of the segment at `t_ns`."""
        segment = self._segment(t_ns)
        return segment.path.motion(min(max(t_ns, segment.start_ns), segment.stop_ns) - segment.zero_ns)

    def _segment(self, t_ns: int) -> Segment:
        return self._segments[max(0, bisect_right(self._starts_ns, t_ns) - 1)]

    @property
    def speed_bound_m_s(self) -> float:
        """The greatest of the segments; jumps from one to the next are left out."""
        return max(segment.path.speed_bound_m_s for segment in self._segments)

    @property
    def turn_bound_rad_s(self) -> float:
        """The greatest of the segments; jumps from one to the next are left out."""
        return max(segment.path.turn_bound_rad_s for segment in self._segments)

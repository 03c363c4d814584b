"""Checks of sampled times, and bounds on speed and rate of turning, measured where no closed form gives them.

Poses are taken at many instants, evenly spread. The bound is the largest difference quotient and a quarter more, for
the motion between the instants. A path that is smooth between them (splines, orbits, spins) keeps it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from emulator.trajectory.pose import Pose, TrajectoryError

__all__ = ["instants_between", "measured_bounds", "require_increasing", "turn_rad"]


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


_MORE = 1.25


def measured_bounds(pose: Callable[[int], Pose], times_ns: Sequence[int]) -> tuple[float, float]:
    """Return the speed, m/s, and the rate of turning, rad/s, that are not exceeded between `times_ns`, increasing."""
    speed = turn = 0.0
    before, t0_ns = pose(times_ns[0]), times_ns[0]
    for t_ns in times_ns[1:]:
        after, dt = pose(t_ns), (t_ns - t0_ns) * 1e-9
        speed = max(speed, float(np.linalg.norm(after.position_m - before.position_m)) / dt)
        turn = max(turn, turn_rad(before, after) / dt)
        before, t0_ns = after, t_ns
    return _MORE * speed, _MORE * turn


def turn_rad(a: Pose, b: Pose) -> float:
    """Return the angle of the turn between two attitudes, 0 to pi; good for the smallest ones too."""
    q, p = a.q_world_from_body, b.q_world_from_body
    if q @ p < 0:
        p = -p
    return 4 * math.asin(min(1.0, float(np.linalg.norm(p - q)) / 2))

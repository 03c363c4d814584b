"""Bounds on speed and rate of turning, measured where no closed form gives them.

Poses are taken at many instants, evenly spread. The bound is the largest difference quotient and a quarter more, for
what lies between the instants. A path that is smooth between them (splines, orbits, spins) keeps it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from emulator.trajectory.pose import Pose

__all__ = ["measured_bounds", "turn_rad"]

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

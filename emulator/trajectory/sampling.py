"""Checks of sampled times, and instants between them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from emulator.trajectory.pose import TrajectoryError

__all__ = ["instants_between", "require_increasing"]

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

"""Poses at given times, joined smoothly.

Places are joined by cubic Hermite curves through the given velocities, or, where none are given, through those of
parabolas over each keyframe and its neighbours (three-point formula for uneven times; one-sided at the ends). Attitudes
are joined component by component in the same way and made unit again, after signs were chosen so that neighbours lie
close: smooth, and within 0.3 % of the turn from the great circle for 45 degrees from one keyframe to the next (2 % for
90). A turn of more than 120 degrees between neighbours is refused, because which way it goes would be a guess.

Before the first keyframe and after the last the pose stays what it is there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from emulator.trajectory.measured import measured_bounds
from emulator.trajectory.pose import Pose, Trajectory, TrajectoryError

__all__ = ["Keyframes"]

_WIDEST_TURN = math.radians(120)
_MEASURED_A_PIECE = 8
_MOST_MEASURED = 4096

_Floats = npt.NDArray[np.float64]


class Keyframes(Trajectory):
    """Goes through poses at given times.

    Parameters
    ----------
    times_ns : (n,) stream times, increasing.
    poses : (n,) where it is then.
    velocities_m_s : (n, 3), where they are known.

    Raises
    ------
    TrajectoryError
        No keyframe, times that do not increase, a turn whose sense cannot be told.
    """

    def __init__(
        self, times_ns: Sequence[int], poses: Sequence[Pose], velocities_m_s: npt.ArrayLike | None = None
    ) -> None:
        _require_increasing(times_ns, len(poses))
        self._times_ns = np.array(times_ns, np.int64)
        self._seconds = (self._times_ns - self._times_ns[0]) * 1e-9
        self._places = np.array([pose.position_m for pose in poses])
        self._turns = _neighbourly(np.array([pose.q_world_from_body for pose in poses]), self._times_ns)
        given = None if velocities_m_s is None else np.asarray(velocities_m_s, np.float64)
        if given is not None and (given.shape != self._places.shape or not np.isfinite(given).all()):
            raise TrajectoryError(f"velocities are {given.shape}: one of three finite m/s is needed for each keyframe")
        self._velocities = _slopes(self._seconds, self._places) if given is None else given
        self._rates = _slopes(self._seconds, self._turns)
        self._bounds: tuple[float, float] | None = None

    @property
    def span_ns(self) -> tuple[int, int]:
        """Time of the first keyframe and of the last."""
        return int(self._times_ns[0]), int(self._times_ns[-1])

    @property
    def speed_bound_m_s(self) -> float:
        """Measured, see `measured`."""
        return self._measured()[0]

    @property
    def turn_bound_rad_s(self) -> float:
        """Measured, see `measured`."""
        return self._measured()[1]

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        first, last = self.span_ns
        t_ns = min(max(int(t_ns), first), last)
        if first == last:
            return Pose(self._places[0], self._turns[0])
        k = min(int(np.searchsorted(self._times_ns, t_ns, "right")) - 1, len(self._times_ns) - 2)
        length_s = float(self._seconds[k + 1] - self._seconds[k])
        x = (t_ns - int(self._times_ns[k])) / int(self._times_ns[k + 1] - self._times_ns[k])
        q = _hermite(x, length_s, self._turns[k : k + 2], self._rates[k : k + 2])
        return Pose(_hermite(x, length_s, self._places[k : k + 2], self._velocities[k : k + 2]), q / np.linalg.norm(q))

    def _measured(self) -> tuple[float, float]:
        if self._bounds is None:
            self._bounds = measured_bounds(self.pose, self._instants())
        return self._bounds

    def _instants(self) -> list[int]:
        """Return times within each piece, or evenly spread where there are very many."""
        pieces = len(self._times_ns) - 1
        if pieces * _MEASURED_A_PIECE > _MOST_MEASURED:
            every = -(-pieces // _MOST_MEASURED)
            return [int(t) for t in self._times_ns[::every]]
        x = np.arange(_MEASURED_A_PIECE) / _MEASURED_A_PIECE
        inside = (self._times_ns[:-1, None] + np.diff(self._times_ns)[:, None] * x).ravel()
        return [int(t) for t in np.unique(np.append(inside.astype(np.int64), self._times_ns[-1]))]


def _require_increasing(times_ns: Sequence[int], poses: int) -> None:
    if not len(times_ns):
        raise TrajectoryError("an empty trajectory: at least one pose is needed")
    if len(times_ns) != poses:
        raise TrajectoryError(f"{len(times_ns)} times for {poses} poses")
    for k, (before, after) in enumerate(itertools.pairwise(times_ns), start=1):
        if after <= before:
            problem = "again" if after == before else "goes back"
            raise TrajectoryError(f"pose {k}: time {after * 1e-9:g} s {problem} after {before * 1e-9:g} s")


def _neighbourly(quaternions: _Floats, times_ns: npt.NDArray[np.int64]) -> _Floats:
    """Return the same attitudes, each with the sign that lies closer to the one before."""
    cosines = np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1])
    wide = np.flatnonzero(np.abs(cosines) < math.cos(_WIDEST_TURN / 2))
    if wide.size:
        k = int(wide[0])
        turn = math.degrees(2 * math.acos(min(1.0, abs(float(cosines[k])))))
        raise TrajectoryError(
            f"pose {k + 1}, at {times_ns[k + 1] * 1e-9:g} s, is turned by {turn:.0f} degrees from the one before: "
            "which way it goes cannot be told; give poses in between, at most 120 degrees apart"
        )
    signs = np.cumprod(np.concatenate([[1.0], np.where(cosines < 0, -1.0, 1.0)]))
    return np.asarray(quaternions * signs[:, None])


def _slopes(t: _Floats, values: _Floats) -> _Floats:
    """Return the slopes at each point of parabolas through it and its neighbours, (n, k)."""
    if len(t) < 3:
        step = np.diff(values, axis=0) / np.diff(t)[:, None] if len(t) == 2 else np.zeros_like(values[:1])
        return np.repeat(step, len(t), axis=0)
    return np.asarray(np.gradient(values, t, axis=0, edge_order=2))


def _hermite(x: float, length_s: float, values: _Floats, slopes: _Floats) -> _Floats:
    """Return the cubic through two values and slopes, `x` of the way."""
    y = 1 - x
    ends = (1 + 2 * x) * y * y * values[0] + x * x * (1 + 2 * y) * values[1]
    return np.asarray(ends + length_s * x * y * (y * slopes[0] - x * slopes[1]))

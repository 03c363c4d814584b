"""Poses at given times, joined smoothly.

Places are joined by cubic Hermite curves through the given velocities, or, where none are given, through those of
parabolas over each keyframe and its neighbours (three-point formula for uneven times; one-sided at the ends).

Attitudes are joined by scipy's RotationSpline: between two keyframes the rotation vector from the first is a cubic of
time, and rate and acceleration of the turn are continuous, also at keyframes. Two keyframes make a steady turn on the
great circle, and a steady turn about a fixed axis is followed exactly (both to 1e-9 rad). Of a smooth turn whose axis
moves the error falls with the fourth power of the step. A turn of more than 120 degrees between neighbours is refused,
because its sense would be a guess.

Before the first keyframe and after the last the pose is constant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import multiply, quaternion_of_vector
from emulator.trajectory.pose import (
    AT_REST,
    Bounds,
    Motion,
    Pose,
    Trajectory,
    TrajectoryError,
    instants_between,
    measured_bounds,
    rate_of_vector,
    require_increasing,
)
from firmware_protocol.events import Floats

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

_WIDEST_TURN = math.radians(120)


class Keyframes(Trajectory):
    """A smooth path through poses at given times.

    Raises TrajectoryError without a keyframe, for times that do not increase, and for a turn of unknown sense.

    Parameters
    ----------
    times_ns : (n,) stream times, increasing.
    poses : (n,) at these times.
    velocities_m_s : (n, 3), where they are known.
    """

    def __init__(
        self, times_ns: Sequence[int], poses: Sequence[Pose], velocities_m_s: npt.ArrayLike | None = None
    ) -> None:
        require_increasing(times_ns, len(poses))
        self._times_ns = np.array(times_ns, np.int64)
        self.span_ns = int(times_ns[0]), int(times_ns[-1])
        self._seconds = (self._times_ns - self._times_ns[0]) * 1e-9
        self._places = np.array([pose.position_m for pose in poses])
        self._turns = np.array([pose.q_world_from_body for pose in poses])
        cosines = np.abs(np.einsum("ij,ij->i", self._turns[1:], self._turns[:-1]))
        for k in np.flatnonzero(cosines < math.cos(_WIDEST_TURN / 2)):
            turn = math.degrees(2 * math.acos(min(1.0, float(cosines[k]))))
            raise TrajectoryError(
                f"pose {k + 1}, at {self._times_ns[k + 1] * 1e-9:g} s, is turned by {turn:.0f} degrees from the one "
                "before: its sense is unknown; give poses in between, at most 120 degrees apart"
            )
        velocities = None if velocities_m_s is None else np.asarray(velocities_m_s, np.float64)
        if velocities is not None and (velocities.shape != self._places.shape or not np.isfinite(velocities).all()):
            raise TrajectoryError(
                f"velocities are {velocities.shape}: one of three finite m/s is needed for each keyframe"
            )
        self._curve, self._vectors = _splines(self._seconds, self._places, velocities, self._turns)
        self._velocity, self._acceleration = self._curve.derivative(), self._curve.derivative(2)
        self._vector_rates = self._vectors.derivative()

    @cached_property
    def bounds(self) -> Bounds:
        """Measured bounds."""
        return measured_bounds(self.pose, instants_between(self._times_ns))

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        first, last = self.span_ns
        if t_ns <= first:
            return Pose(self._places[0], self._turns[0])
        if t_ns >= last:
            return Pose(self._places[-1], self._turns[-1])
        k = int(np.searchsorted(self._times_ns, t_ns, "right")) - 1
        t_s = (int(t_ns) - first) * 1e-9
        return Pose(self._curve(t_s), multiply(self._turns[k], quaternion_of_vector(self._vectors(t_s))))

    def motion(self, t_ns: int) -> Motion:
        """Return the derivatives of the curves; the acceleration may jump at a keyframe. It rests outside its span."""
        first, last = self.span_ns
        if not first <= t_ns < last:
            return AT_REST
        t_s = (int(t_ns) - first) * 1e-9
        turn = rate_of_vector(self._vectors(t_s), self._vector_rates(t_s))
        return Motion(self._velocity(t_s), self._acceleration(t_s), turn)


def _splines(seconds: Floats, places: Floats, velocities: Floats | None, turns: Floats) -> tuple[PPoly, PPoly]:
    """Return the places, and the rotation vectors from the keyframe before, as functions of seconds.

    RotationSpline's own call takes 0.2 ms, as it checks and copies; its polynomials (`interpolator`) take 4 us.
    """
    # Loaded where it is used: it takes longer than the rest of a short run's imports.
    from scipy.interpolate import CubicHermiteSpline, PPoly
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(seconds) == 1:
        nothing = np.zeros((1, 1, 3))
        return PPoly(nothing + places, [0.0, 1.0]), PPoly(nothing, [0.0, 1.0])
    if velocities is None:  # those of parabolas, or of the line through two keyframes
        velocities = np.gradient(places, seconds, axis=0, edge_order=1 if len(seconds) == 2 else 2)
    rotations = RotationSpline(seconds, Rotation.from_quat(turns, scalar_first=True))
    return CubicHermiteSpline(seconds, places, velocities), rotations.interpolator

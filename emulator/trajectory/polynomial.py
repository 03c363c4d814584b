"""Places on polynomials through the nearest samples, as orbit files ask for.

    Lagrange of degree d     through d + 1 samples
    Hermite of degree d      through (d + 1) / 2 samples and their velocities; an even degree is raised by one

The samples lie evenly before and after the instant, an odd one before it; at the ends of the path they are the first or
last ones. One polynomial follows another at a sample, which both go through, so the place makes no jump. Computed
by scipy's KroghInterpolator (Krogh 1970, Mathematics of Computation 24, 185) in steps of time, which keeps it well
conditioned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.trajectory.measured import measured_bounds
from emulator.trajectory.motion import AT_REST, Motion
from emulator.trajectory.pose import STILL, Pose, Trajectory, TrajectoryError
from emulator.trajectory.sampling import instants_between, require_increasing

if TYPE_CHECKING:
    from scipy.interpolate import KroghInterpolator

__all__ = ["PolynomialPath"]

_HIGHEST_DEGREE = 25


class PolynomialPath(Trajectory):
    """A path through places at given times on polynomials, with the attitude of the world.

    Parameters
    ----------
    times_ns : (n,) increasing.
    places_m : (n, 3).
    degree : of the polynomials.
    velocities_m_s : (n, 3) for Hermite's, None for Lagrange's.

    Raises
    ------
    TrajectoryError
        Times that do not increase, or too few samples for the degree.
    """

    def __init__(
        self,
        times_ns: Sequence[int],
        places_m: npt.ArrayLike,
        degree: int,
        velocities_m_s: npt.ArrayLike | None = None,
    ) -> None:
        self._places_m = np.asarray(places_m, np.float64)
        self._velocities = None if velocities_m_s is None else np.asarray(velocities_m_s, np.float64)
        require_increasing(times_ns, len(self._places_m))
        self._times_ns = np.array(times_ns, np.int64)
        self._used = degree + 1 if velocities_m_s is None else degree // 2 + 1
        if not 1 <= degree <= _HIGHEST_DEGREE:
            raise TrajectoryError(f"a degree of {degree}: 1 to {_HIGHEST_DEGREE} can be used")
        if len(times_ns) < self._used:
            raise TrajectoryError(f"degree {degree} needs {self._used} samples, and there are {len(times_ns)}")
        self._at: tuple[int, KroghInterpolator] | None = None
        self._bounds: tuple[float, float] | None = None

    @property
    def span_ns(self) -> tuple[int, int]:
        """Time of the first sample and of the last."""
        return int(self._times_ns[0]), int(self._times_ns[-1])

    def pose(self, t_ns: int) -> Pose:
        """Return the place at `t_ns`; before the first sample and after the last it stays."""
        t_ns = min(max(int(t_ns), self.span_ns[0]), self.span_ns[1])
        first, curve = self._curve(t_ns)
        return Pose(curve(self._steps(first, t_ns)), STILL.q_world_from_body)

    def motion(self, t_ns: int) -> Motion:
        """Return the polynomial's derivatives at `t_ns`; it rests outside its span."""
        if not self.span_ns[0] <= t_ns < self.span_ns[1]:
            return AT_REST
        first, curve = self._curve(t_ns)
        _, slope, bend = curve.derivatives(self._steps(first, t_ns), der=3)
        step_s = self._step_ns(first) * 1e-9
        return Motion(slope / step_s, bend / step_s**2, np.zeros(3))

    def _curve(self, t_ns: int) -> tuple[int, KroghInterpolator]:
        """Return the polynomial around `t_ns`, and the first sample that it goes through."""
        first = self._first_used(t_ns)
        if self._at is None or self._at[0] != first:
            self._at = first, self._through(first)
        return self._at

    @property
    def speed_bound_m_s(self) -> float:
        """Measured, see `measured`."""
        if self._bounds is None:
            self._bounds = measured_bounds(self.pose, instants_between(self._times_ns))
        return self._bounds[0]

    @property
    def turn_bound_rad_s(self) -> float:
        """It does not turn."""
        return 0.0

    def _first_used(self, t_ns: int) -> int:
        """Return the first of the samples around `t_ns`."""
        after = int(np.searchsorted(self._times_ns, t_ns, "right"))
        return min(max(after - (self._used + 1) // 2, 0), len(self._times_ns) - self._used)

    def _through(self, first: int) -> KroghInterpolator:
        from scipy.interpolate import (
            KroghInterpolator,  # loaded where it is used: it takes longer than the rest of a short run's imports
        )

        used = slice(first, first + self._used)
        steps = (self._times_ns[used] - self._times_ns[first]) / self._step_ns(first)
        if self._velocities is None:
            return KroghInterpolator(steps, self._places_m[used])
        pairs = np.stack([self._places_m[used], self._velocities[used] * self._step_ns(first) * 1e-9], axis=1)
        return KroghInterpolator(np.repeat(steps, 2), pairs.reshape(-1, 3))

    def _steps(self, first: int, t_ns: int) -> float:
        return (t_ns - int(self._times_ns[first])) / self._step_ns(first)

    def _step_ns(self, first: int) -> float:
        return (int(self._times_ns[first + self._used - 1]) - int(self._times_ns[first])) / (self._used - 1 or 1) or 1.0

"""Motion of a trajectory: the derivatives of its pose, in closed form or from differences; and scene time.

Differences are central, over a step h of 5 ms to either side of t (p: place, w: rate of turning, e = 1.1e-16):

    velocity       (p(t+h) - p(t-h)) / 2h                  error h^2/6 |p'''|  + e |p| / h
    acceleration   (p(t+h) - 2 p(t) + p(t-h)) / h^2        error h^2/12 |p''''| + 4 e |p| / h^2
    turning        turn from t-h to t+h / 2h               error h^2/6 |w''|   + 4 e / h

At 1 km from the origin rounding makes an acceleration wrong by 2e-8 m/s2 at most, at 10 000 km by 2e-4 m/s2. Where a
path has a kink (its ends, a change of segment), they see it within h.

Scene time is stream time by an exact factor that makes slow motion fast. Itokawa turns once in half a day, and from
Hayabusa's home position a pixel of motion takes a quarter of a minute. A factor of 100 shows the same in minutes;
events then come 100 times as fast as they would, which a summary should never hide.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from emulator.geometry.attitude import Matrix, Quaternion, Vector, conjugate, multiply

if TYPE_CHECKING:
    from emulator.trajectory.pose import Pose

__all__ = ["AT_REST", "Motion", "Timescale", "differences", "rate_of_frame", "rate_of_vector", "rotation_vector"]


_H_NS = 5_000_000
_H_S = _H_NS * 1e-9
_SMALL_RAD = 1e-4


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a body at one instant.

    Attributes
    ----------
    velocity_m_s, acceleration_m_s2 : (3,), in the world.
    turn_rad_s : (3,), angular rate against the world, along the body's own axes.
    """

    velocity_m_s: Vector
    acceleration_m_s2: Vector
    turn_rad_s: Vector


AT_REST = Motion(np.zeros(3), np.zeros(3), np.zeros(3))


def differences(pose: Callable[[int], Pose], t_ns: int) -> Motion:
    """Return the motion at `t_ns` from the poses 5 ms before, then and 5 ms after; for its errors see above."""
    before, now, after = (pose(t_ns + k * _H_NS) for k in (-1, 0, 1))
    velocity = (after.position_m - before.position_m) / (2 * _H_S)
    step = (after.position_m - now.position_m) - (now.position_m - before.position_m)
    turned = multiply(conjugate(before.q_world_from_body), after.q_world_from_body)
    vector = rotation_vector(turned)  # along the axes of the body before and, as they differ by it, after and half-way
    return Motion(velocity, step / _H_S**2, vector / (2 * _H_S))


def rotation_vector(q: Quaternion) -> Vector:
    """Return the rotation vector of a unit quaternion, rad, (3,), at most half a turn long."""
    sine = float(np.linalg.norm(q[1:]))
    half = math.atan2(sine, abs(q[0]))
    return np.asarray(math.copysign(2 * half / sine if sine > 0 else 2.0, q[0]) * q[1:])


def rate_of_vector(vector: Vector, rate: Vector) -> Vector:
    """Return the angular rate along the body's axes, (3,), of the attitude exp(vector) whose vector changes by `rate`.

    Source: the right Jacobian of SO(3) (Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2, 10.86).
    """
    angle = float(np.linalg.norm(vector))
    if angle < _SMALL_RAD:
        first, second = 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        first = (1 - math.cos(angle)) / angle**2
        second = (angle - math.sin(angle)) / angle**3
    crossed = np.cross(vector, rate)
    return np.asarray(rate - first * crossed + second * np.cross(vector, crossed))


def rate_of_frame(axes: Matrix, rates: Matrix) -> Vector:
    """Return the angular rate along a body's axes, the columns of `axes`, (3, 3), which change by `rates` a second."""
    turn = axes.T @ rates
    return np.array([turn[2, 1], turn[0, 2], turn[1, 0]])


class Timescale:
    """Scene time = start + factor * stream time; `factor` is taken as the decimal number that a person wrote."""

    def __init__(self, factor: float = 1.0, start_s: float = 0.0) -> None:
        self._factor = Fraction(repr(float(factor)))
        self._start_ns = round(Fraction(repr(float(start_s))) * 10**9)

    @property
    def factor(self) -> float:
        """Scene time per unit of stream time."""
        return float(self._factor)

    def scene_ns(self, t_ns: int) -> int:
        """Return the scene's time at stream time `t_ns`, ns, rounded down."""
        return self._start_ns + int(t_ns) * self._factor.numerator // self._factor.denominator

"""A lunar lander as a rigid body: thrust with limits and lag, mass flow, an attitude loop; flat ground, z up.

    r' = v        v' = T b_z / m - (0, 0, g)        m' = -T / (Isp g0)        T' = (T_wanted - T) / lag
    q' = q (0, w) / 2                               J w' = torque - w x J w

    torque = -J (wn^2 e + 2 zeta wn w), clipped; e = 2 sign(e_w) e_vec of conj(q_wanted) q

The body's z axis is the direction of the thrust; the camera looks along -z. The command, an acceleration without
gravity's, is constant between two calls, and the equations are integrated by RK4 in steps of 10 ms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import conjugate, cross

Vector = npt.NDArray[np.float64]

GRAVITY_M_S2 = 1.62
_G0_M_S2 = 9.80665
_STEP_S = 0.01
NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
_LEAST_UP = 0.3  # beside the horizontal part of the wanted acceleration: a tilt of 73 degrees at most


@dataclass(frozen=True)
class Lander:
    """Parameters of the vehicle; the defaults hover at 40 % of their thrust on the Moon."""

    thrust_n: tuple[float, float] = (400.0, 4000.0)  # least and most while the engine runs
    isp_s: float = 310.0  # specific impulse
    lag_s: float = 0.1  # time constant of the engine
    inertia_kg_m2: tuple[float, float, float] = (800.0, 800.0, 800.0)  # about the three axes of the body
    bandwidth_rad_s: float = 1.5  # of the attitude loop, with the next two
    damping: float = 0.8
    torque_nm: float = 200.0
    thrust_scale: float = 1.0  # thrust given for thrust wanted; its error is unknown to the guidance
    mass_error_kg: float = 0.0  # mass that the engine's control assumes, less the true one
    gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, -GRAVITY_M_S2)  # true, (east, north, up)


@dataclass(frozen=True)
class State:
    """Position, motion and mass of the vehicle: m, m/s, unit quaternion world from body, rad/s in the body, N, kg."""

    position_m: Vector
    velocity_m_s: Vector
    attitude: Vector = field(default_factory=NO_TURN.copy)
    turning_rad_s: Vector = field(default_factory=lambda: np.zeros(3))
    thrust_n: float = 0.0
    mass_kg: float = 1000.0

    def packed(self) -> Vector:
        """Return all as one array, (15,), in this order."""
        return np.hstack(list(vars(self).values()))


Height = Callable[[float, float], float]
"""Height of the ground, m, by the place east and north, m."""


def matrix(q: Vector) -> Vector:
    """Return the matrix of a unit quaternion, (3, 3): world from body."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def advance(lander: Lander, state: State, command_m_s2: Vector, seconds: float, error: Vector = NO_TURN) -> State:
    """Return the state `seconds` later under a constant command, (3,) in the world, gravity's not included.

    `error` is the turn from the true attitude to the one that the attitude loop uses, a unit quaternion in the body.
    """
    steps = max(1, round(seconds / _STEP_S))
    h = seconds / steps
    y, wanted = state.packed(), _wanted(lander, state, command_m_s2, error)
    for _ in range(steps):
        a = _derivative(lander, y, *wanted)
        b = _derivative(lander, y + h / 2 * a, *wanted)
        c = _derivative(lander, y + h / 2 * b, *wanted)
        d = _derivative(lander, y + h * c, *wanted)
        y = y + h / 6 * (a + 2 * b + 2 * c + d)
        y[6:10] /= np.linalg.norm(y[6:10])
    q = y[6:10] / np.linalg.norm(y[6:10])
    return State(y[0:3], y[3:6], q, y[10:13], float(y[13]), float(y[14]))


def _wanted(lander: Lander, state: State, command_m_s2: Vector, error: Vector) -> tuple[float, Vector]:
    """Return thrust, N, and attitude that give an acceleration, if mass and attitude are as the vehicle assumes."""
    up = max(float(command_m_s2[2]), _LEAST_UP * float(np.hypot(*command_m_s2[:2])), 1e-3)
    wanted = np.array([command_m_s2[0], command_m_s2[1], up])
    size = float(np.linalg.norm(wanted))
    thrust_n = float(np.clip((state.mass_kg + lander.mass_error_kg) * size, *lander.thrust_n)) * lander.thrust_scale
    x, y, z = wanted / size
    q = np.array([1 + z, -y, x, 0.0])  # the shortest turn of z to that direction
    return thrust_n, product(q / np.linalg.norm(q), conjugate(error))


def _derivative(lander: Lander, y: Vector, thrust_wanted_n: float, attitude_wanted: Vector) -> Vector:
    velocity, q, w, (thrust_n, mass_kg) = y[3:6], y[6:10], y[10:13], y[13:15]
    inertia = np.array(lander.inertia_kg_m2)
    turn = product(conjugate(attitude_wanted), q)
    error = 2 * turn[1:] * (1.0 if turn[0] >= 0 else -1.0)  # of the shorter way round
    torque = -inertia * (lander.bandwidth_rad_s**2 * error + 2 * lander.damping * lander.bandwidth_rad_s * w)
    torque = np.clip(torque, -lander.torque_nm, lander.torque_nm)
    acceleration = matrix(q)[:, 2] * thrust_n / mass_kg + lander.gravity_m_s2
    turning = (torque - cross(w, inertia * w)) / inertia
    rest = ((thrust_wanted_n - thrust_n) / lander.lag_s, -thrust_n / (lander.isp_s * _G0_M_S2))
    return np.concatenate([velocity, acceleration, product(q, np.array([0.0, *w])) / 2, turning, rest])


def product(a: Vector, b: Vector) -> Vector:
    """Return the product of two quaternions: the turn b, then the turn a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )

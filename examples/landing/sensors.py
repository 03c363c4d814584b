"""The vehicle's own sensors.

The errors of the sensors are numbers of a seed: white noise is keyed by (seed, purpose, sample), a constant by (seed,
purpose), and a drift is a first-order Gauss-Markov sequence of the samples from zero on. A sample therefore depends on
the true motion and on its own number, not on the step of the dynamics, or on what was read before it. The defaults are
assumptions, of the order of tactical MEMS units, small star trackers and small altimeters.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from functools import cache

import frames
import numpy as np
from vehicle import Height, Lander, State, Vector, matrix, product

from emulator.geometry.attitude import conjugate

PERIOD_S = 0.02
"""Period of the IMU."""

PICTURE_S, STEP_S = 0.04, 0.01
"""Time between two attitudes that are given: a light frame in lockstep, a step of the dynamics in real time."""

_IMU_DELAY = 1  # all in periods
_STAR_EVERY, _STAR_DELAY = 10, 10
_RANGE_EVERY, _RANGE_DELAY = 5, 2
_ARC_S = math.pi / 648_000
_CHUNK = 512
_RANGE_ROUNDS = 4


@dataclass(frozen=True)
class Inertial:
    """Errors of a gyroscope (rad/s) or an accelerometer (m/s2), 1 sigma of each axis.

    `white` is of the integral after a second; `bias` is constant, `drift` a first-order Gauss-Markov bias.
    """

    white: float
    bias: float
    drift: float
    correlation_s: float = 300.0


@dataclass(frozen=True)
class SensorErrors:
    """Errors of all sensors, 1 sigma: the star tracker's about the body's axes, its boresight being the body's x."""

    gyroscope: Inertial = Inertial(white=4.4e-5, bias=2.4e-5, drift=2.4e-6)
    accelerometer: Inertial = Inertial(white=1.0e-3, bias=5.0e-3, drift=5.0e-4)
    star_white_rad: tuple[float, float, float] = (100 * _ARC_S, 20 * _ARC_S, 20 * _ARC_S)
    misalignment_rad: float = 30 * _ARC_S
    range_white_m: float = 0.3
    range_white_scale: float = 0.003  # of the range, as the next one, which is fixed in a flight
    range_scale: float = 0.003
    longest_range_m: float = 3000.0


@cache
def _chunk(seed: int, purpose: int, number: int) -> Vector:
    key = np.array([seed, purpose], np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, number])).standard_normal((_CHUNK, 3))


def normal(seed: int, purpose: int, sample: int) -> Vector:
    """Return three normal numbers of a sample; `purpose` is another number for each use."""
    return _chunk(seed, purpose, sample // _CHUNK)[sample % _CHUNK]


class _Triad:
    """A gyroscope or an accelerometer: errors of the integral over a period."""

    def __init__(self, errors: Inertial, seed: int, purpose: int) -> None:
        self._errors, self._seed, self._purpose = errors, seed, purpose
        self._bias = errors.bias * normal(seed, purpose + 2, 0)
        self._drifts: list[Vector] = []  # of variance 1, from the first sample on

    def error(self, sample: int) -> Vector:
        """Return the error of a sample, (3,)."""
        errors, drifts = self._errors, self._drifts
        decay = math.exp(-PERIOD_S / errors.correlation_s)
        while sample >= len(drifts):
            fresh = normal(self._seed, self._purpose + 1, len(drifts))
            share = math.sqrt(1 - decay**2) if drifts else 1 - decay
            drifts.append(decay * (drifts[-1] if drifts else fresh) + share * fresh)
        bias = self._bias + errors.drift * drifts[sample]
        white = normal(self._seed, self._purpose, sample)
        return bias * PERIOD_S + errors.white * math.sqrt(PERIOD_S) * white


class Sensors:
    """All sensors of one vehicle, with the errors of a seed; `ground_m` is the height of the ground by place."""

    def __init__(self, errors: SensorErrors, lander: Lander, seed: int, ground_m: Height) -> None:
        self._errors, self._seed, self._ground_m = errors, seed, ground_m
        self._gravity = np.array(lander.gravity_m_s2)
        self._turns, self._pushes = _Triad(errors.gyroscope, seed, 10), _Triad(errors.accelerometer, seed, 20)
        self._misalignment = errors.misalignment_rad * normal(seed, 31, 0)
        self._scale = 1 + errors.range_scale * float(normal(seed, 41, 0)[0])
        self._waiting: dict[int, list[tuple[int, bytes]]] = defaultdict(list)  # by the period in which they are sent

    def frames(self, number: int, before: State, after: State) -> list[tuple[int, bytes]]:
        """Sample the period that ends at `number`, between two true states; return the frames that are sent then.

        The accelerometer's is the last of them: the others have waited longer.
        """
        if number % _STAR_EVERY == 0:
            star = frames.pack_attitude(self.attitude(number, after), number)
            self._waiting[number + _STAR_DELAY].append((frames.STAR, star))
        if number % _RANGE_EVERY == 0 and (range_m := self.range_m(number, after)) > 0:
            data = frames.RANGE_FRAME.pack(round(range_m / frames.RANGE_M), number % (1 << 16))
            self._waiting[number + _RANGE_DELAY].append((frames.RANGE, data))
        turn = frames.pack_words(self.turn_rad(number, before, after) / frames.TURN_RAD, number)
        push = frames.pack_words(self.push_m_s(number, before, after) / frames.PUSH_M_S, number)
        self._waiting[number + _IMU_DELAY] += [(frames.TURN, turn), (frames.PUSH, push)]
        return self._waiting.pop(number, [])

    def turn_rad(self, number: int, before: State, after: State) -> Vector:
        """Return the measured turn of a period, a rotation vector in the body, (3,)."""
        turned = product(conjugate(before.attitude), after.attitude)
        return vector_of(turned) + self._turns.error(number)

    def push_m_s(self, number: int, before: State, after: State) -> Vector:
        """Return the measured change of speed without gravity's, (3,)."""
        pushed = after.velocity_m_s - before.velocity_m_s - self._gravity * PERIOD_S
        middle = before.attitude + after.attitude
        return matrix(middle / np.linalg.norm(middle)).T @ pushed + self._pushes.error(number)

    def attitude(self, number: int, state: State) -> Vector:
        """Return the star tracker's attitude, a unit quaternion world from body."""
        white = np.array(self._errors.star_white_rad) * normal(self._seed, 30, number)
        return product(state.attitude, turn_of(self._misalignment + white))

    def range_m(self, number: int, state: State) -> float:
        """Return the measured slant range; 0 beyond the longest."""
        errors, down = self._errors, -matrix(state.attitude)[:, 2]
        true_m = 0.0
        for _ in range(_RANGE_ROUNDS):  # the ground is nearly level beside the height
            x, y, _ = state.position_m + down * true_m
            true_m = max((state.position_m[2] - self._ground_m(float(x), float(y))) / -down[2], 0.0)
        white = normal(self._seed, 40, number)
        measured_m = self._scale * true_m + errors.range_white_m * white[0]
        measured_m += errors.range_white_scale * true_m * white[1]
        return max(float(measured_m), 0.0) if true_m <= errors.longest_range_m else 0.0


def vector_of(q: Vector) -> Vector:
    """Return the rotation vector of a unit quaternion, rad, (3,)."""
    q = q if q[0] >= 0 else -q
    sine = float(np.linalg.norm(q[1:]))
    return q[1:] * (2 * math.atan2(sine, q[0]) / sine if sine > 1e-12 else 2.0)


def turn_of(vector: Vector) -> Vector:
    """Return the unit quaternion of a rotation vector."""
    angle = float(np.linalg.norm(vector))
    return np.array([math.cos(angle / 2), *(vector * (math.sin(angle / 2) / angle if angle > 1e-12 else 0.5))])

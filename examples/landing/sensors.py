"""The vehicle's own sensors: gyroscope, accelerometer, star tracker, altimeter; what they measure, when it is sent.

    gyroscope       turn of the body in one period   + (bias + drift) period + white, rounded to 1e-6 rad
    accelerometer   change of speed without gravity's, in the axes of the middle of the period, with the same errors
    star tracker    attitude, with a fixed misalignment and white noise about the three axes
    altimeter       slant range along the body's -z to the ground: (1 + scale) range + white

All errors are numbers of a seed: white noise is keyed by (seed, purpose, sample), a constant by (seed, purpose), and a
drift is a first-order Gauss-Markov sequence of the samples from zero on, x' = f x + sqrt(1 - f^2) s n with f =
exp(-period / correlation time). A sample therefore depends on the true motion and on its own number, not on the step of
the dynamics, or on what was read before it.

The defaults are assumptions, of the order of tactical MEMS units (0.15 degree per root hour, bias 5, drift 0.5 degree
per hour; 0.06 m/s per root hour, bias 0.5 mg of the Earth), of small star trackers (20 arc-seconds across, 100 about
the boresight), and of small altimeters (0.3 m + 0.3 % of the range).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from frames import PUSH, PUSH_M_S, RANGE, STAR, TURN, TURN_RAD, pack_attitude, pack_range, pack_vector
from vehicle import Lander, State, Vector, matrix, product

__all__ = [
    "PERIOD_S",
    "Altimeter",
    "Draws",
    "Inertial",
    "SensorErrors",
    "Sensors",
    "StarTracker",
    "turn_of",
    "vector_of",
]

PERIOD_S = 0.02
_ARC_S = math.pi / 648_000
_CHUNK = 512
_RANGE_ROUNDS = 4

Frame = tuple[int, bytes]
Height = Callable[[float, float], float]


@dataclass(frozen=True)
class Inertial:
    """Errors of a gyroscope (rad/s) or an accelerometer (m/s2).

    Attributes
    ----------
    white : of the integral, 1 sigma after a second: rad or m/s per root second.
    bias : constant, 1 sigma of each axis.
    drift, correlation_s : of a first-order Gauss-Markov bias, its 1 sigma and its time.
    """

    white: float
    bias: float
    drift: float
    correlation_s: float = 300.0


@dataclass(frozen=True)
class StarTracker:
    """Errors, rad about the body's axes: white, fixed; samples, in periods of the IMU: every, delay.

    Its boresight is the body's x axis.
    """

    white_rad: tuple[float, float, float] = (100 * _ARC_S, 20 * _ARC_S, 20 * _ARC_S)
    misalignment_rad: float = 30 * _ARC_S
    every: int = 10
    delay: int = 10


@dataclass(frozen=True)
class Altimeter:
    """Errors: white, m; white and fixed scale, relative to the range; longest range, m; every, delay as above."""

    white_m: float = 0.3
    white_scale: float = 0.003
    scale: float = 0.003
    longest_m: float = 3000.0
    every: int = 5
    delay: int = 2


@dataclass(frozen=True)
class SensorErrors:
    """Errors of all sensors; `imu_delay` in periods."""

    gyroscope: Inertial = Inertial(white=4.4e-5, bias=2.4e-5, drift=2.4e-6)
    accelerometer: Inertial = Inertial(white=1.0e-3, bias=5.0e-3, drift=5.0e-4)
    star_tracker: StarTracker = field(default_factory=StarTracker)
    altimeter: Altimeter = field(default_factory=Altimeter)
    imu_delay: int = 1


class Draws:
    """Normal numbers of a seed and a purpose, three for each sample.

    Parameters
    ----------
    seed : of the flight.
    purpose : a number, different for each use.
    """

    def __init__(self, seed: int, purpose: int) -> None:
        self._key = np.array([seed, purpose], np.uint64)
        self._chunks: dict[int, Vector] = {}
        self._drifts: list[Vector] = []

    def normal(self, sample: int) -> Vector:
        """Return the numbers of a sample, (3,)."""
        return self._chunk(sample // _CHUNK)[sample % _CHUNK]

    def drift(self, sample: int, decay: float) -> Vector:
        """Return the Gauss-Markov sequence of variance 1 at a sample, (3,); the first value has that variance too."""
        while sample >= len(self._drifts):
            number = self.normal(len(self._drifts))
            before = self._drifts[-1] if self._drifts else number
            fresh = math.sqrt(1 - decay**2) if self._drifts else 1 - decay
            self._drifts.append(decay * before + fresh * number)
        return self._drifts[sample]

    def _chunk(self, chunk: int) -> Vector:
        if chunk not in self._chunks:
            generator = np.random.Generator(np.random.Philox(key=self._key, counter=[0, 0, 0, chunk]))
            self._chunks[chunk] = generator.standard_normal((_CHUNK, 3))
        return self._chunks[chunk]


class _Triad:
    """A gyroscope or an accelerometer: errors of the integral over a period."""

    def __init__(self, errors: Inertial, seed: int, purpose: int) -> None:
        self._errors = errors
        self._white, self._drift, constant = (Draws(seed, purpose + k) for k in range(3))
        self._bias = errors.bias * constant.normal(0)
        self._decay = math.exp(-PERIOD_S / errors.correlation_s)

    def error(self, sample: int) -> Vector:
        """Return the error of a sample, (3,)."""
        errors = self._errors
        bias = self._bias + errors.drift * self._drift.drift(sample, self._decay)
        return bias * PERIOD_S + errors.white * math.sqrt(PERIOD_S) * self._white.normal(sample)


class Sensors:
    """All sensors of one vehicle.

    Parameters
    ----------
    errors : of the sensors.
    lander : for the true gravity.
    seed : of the flight's sensor errors.
    ground_m : height of the ground by place.
    """

    def __init__(self, errors: SensorErrors, lander: Lander, seed: int, ground_m: Height) -> None:
        self._errors, self._gravity, self._ground_m = errors, np.array(lander.gravity_m_s2), ground_m
        self._turns, self._pushes = _Triad(errors.gyroscope, seed, 10), _Triad(errors.accelerometer, seed, 20)
        self._stars, self._ranges = Draws(seed, 30), Draws(seed, 40)
        self._misalignment = errors.star_tracker.misalignment_rad * Draws(seed, 31).normal(0)
        self._scale = 1 + errors.altimeter.scale * float(Draws(seed, 41).normal(0)[0])
        self._waiting: list[tuple[int, Frame]] = []

    def take(self, number: int, before: State, after: State) -> None:
        """Sample the period that ends at `number`, between two true states."""
        errors = self._errors
        for delay, frame in (
            (errors.imu_delay, (TURN, pack_vector(self.turn_rad(number, before, after), TURN_RAD, number))),
            (errors.imu_delay, (PUSH, pack_vector(self.push_m_s(number, before, after), PUSH_M_S, number))),
            *self._slow(number, after),
        ):
            self._waiting.append((number + delay, frame))

    def due(self, number: int) -> Iterator[Frame]:
        """Yield the frames that are sent at `number`, the accelerometer's last."""
        due = [frame for at, frame in self._waiting if at <= number]
        self._waiting = [one for one in self._waiting if one[0] > number]
        yield from sorted(due, key=lambda frame: frame[0] == PUSH)

    def turn_rad(self, number: int, before: State, after: State) -> Vector:
        """Return the measured turn of a period, a rotation vector in the body, (3,)."""
        turned = product(before.attitude * (1, -1, -1, -1), after.attitude)
        return vector_of(turned) + self._turns.error(number)

    def push_m_s(self, number: int, before: State, after: State) -> Vector:
        """Return the measured change of speed without gravity's, (3,)."""
        pushed = after.velocity_m_s - before.velocity_m_s - self._gravity * PERIOD_S
        middle = before.attitude + after.attitude
        return matrix(middle / np.linalg.norm(middle)).T @ pushed + self._pushes.error(number)

    def attitude(self, number: int, state: State) -> Vector:
        """Return the star tracker's attitude, a unit quaternion world from body."""
        white = np.array(self._errors.star_tracker.white_rad) * self._stars.normal(number)
        return product(state.attitude, turn_of(self._misalignment + white))

    def range_m(self, number: int, state: State) -> float:
        """Return the measured slant range; 0 beyond the longest."""
        altimeter, down = self._errors.altimeter, -matrix(state.attitude)[:, 2]
        true_m = 0.0
        for _ in range(_RANGE_ROUNDS):  # the ground is nearly level beside the height
            x, y, _ = state.position_m + down * true_m
            true_m = max((state.position_m[2] - self._ground_m(float(x), float(y))) / -down[2], 0.0)
        white = self._ranges.normal(number)
        measured_m = self._scale * true_m + altimeter.white_m * white[0] + altimeter.white_scale * true_m * white[1]
        return max(float(measured_m), 0.0) if true_m <= altimeter.longest_m else 0.0

    def _slow(self, number: int, state: State) -> Iterator[tuple[int, Frame]]:
        tracker, altimeter = self._errors.star_tracker, self._errors.altimeter
        if number % tracker.every == 0:
            yield tracker.delay, (STAR, pack_attitude(self.attitude(number, state), number))
        if number % altimeter.every == 0 and (range_m := self.range_m(number, state)) > 0:
            yield altimeter.delay, (RANGE, pack_range(range_m, number))


def vector_of(q: Vector) -> Vector:
    """Return the rotation vector of a unit quaternion, rad, (3,)."""
    q = q if q[0] >= 0 else -q
    sine = float(np.linalg.norm(q[1:]))
    return q[1:] * (2 * math.atan2(sine, q[0]) / sine if sine > 1e-12 else 2.0)


def turn_of(vector: Vector) -> Vector:
    """Return the unit quaternion of a rotation vector."""
    angle = float(np.linalg.norm(vector))
    return np.array([math.cos(angle / 2), *(vector * (math.sin(angle / 2) / angle if angle > 1e-12 else 0.5))])

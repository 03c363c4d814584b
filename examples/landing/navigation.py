"""Navigation of the flight computer: an error-state Kalman filter that uses only frames of the bus and events.

State, on the IMU's periods k: position (m, height above the site), velocity, attitude world from body, bias of the
accelerometer, bias of the gyroscope; 15 errors in that order, the attitude's in the body.

    p' = v,  v' = R (f - b_a) - g,  q' = q (0, w - b_g) / 2          f, w: accelerometer, gyroscope

    star tracker   attitude
    altimeter      p_z / (cosine of the tilt), the ground taken as level
    events         (v_east, -v_north, -v_up) / p_z in the middle of a window: three numbers, 1/s

Events give a speed over a height, and the accelerometer gives changes of that speed in m/s: while the vehicle brakes,
both follow, the scale too. For an upright vehicle the unknown part of gravity is a bias of the accelerometer.

Measurements are older than the newest sample of the IMU. The filter keeps its state before each period of the last
seconds, takes a measurement at its own time, and steps through the samples since again: the order of arrival has no
influence. Windows of events overlap: the variance is multiplied by the number of turns in a window. Of a measurement
whose residual is beyond two standard deviations, r of them, the variance is multiplied by (r / 2)^4: a filter that has
gone wrong is not cut off from what would correct it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from sensors import PERIOD_S, SensorErrors, turn_of, vector_of
from vehicle import GRAVITY_M_S2, NO_TURN, Vector, product
from vehicle import matrix as matrix_of

from emulator.geometry.attitude import conjugate

_KEPT = 350  # periods: 7 s, longer than the longest window
_GATE = 4.0  # square of standard deviations, for each number of a measurement
_P, _V, _Q, _A, _G = (slice(k, k + 3) for k in range(0, 15, 3))
_DOWN = np.array([0.0, 0.0, -GRAVITY_M_S2])
_ATTITUDE_RAD, _GRAVITY_ERROR_M_S2 = 0.002, 0.003  # 1 sigma at the start
_LEAST_M = 0.5
_EYE = np.eye(15)


@dataclass(frozen=True)
class Known:
    """State from navigation at the start, and its 1 sigma of each axis: m, m/s, rad."""

    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]
    place_sigma_m: float = 0.0
    height_sigma_m: float = 0.0
    velocity_sigma_m_s: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """State and covariance of its 15 errors."""

    position_m: Vector
    velocity_m_s: Vector
    attitude: Vector
    accelerometer_bias: Vector
    gyroscope_bias: Vector
    covariance: Vector


Measurement = tuple[Callable[[Estimate], tuple[Vector, Vector]], Vector]
"""A function that gives residual and matrix at an estimate; the variances."""


def of_star(attitude: Vector, errors: SensorErrors) -> Measurement:
    """Return the measurement of a star tracker's attitude."""
    rounding = 2 / 32767 / math.sqrt(12)
    variance = np.array(errors.star_white_rad) ** 2 + errors.misalignment_rad**2 + rounding**2

    def linear(now: Estimate) -> tuple[Vector, Vector]:
        return vector_of(product(conjugate(now.attitude), attitude)), _EYE[_Q]

    return linear, variance


def of_range(range_m: float, errors: SensorErrors, relief_m: float) -> Measurement:
    """Return the measurement of an altimeter's range; `relief_m` is the ground's, 1 sigma."""
    scale = math.hypot(errors.range_scale, errors.range_white_scale) * range_m
    variance = np.array([errors.range_white_m**2 + scale**2 + relief_m**2])

    def linear(now: Estimate) -> tuple[Vector, Vector]:
        cosine = float(matrix_of(now.attitude)[2, 2])
        return np.array([range_m - now.position_m[2] / cosine]), _EYE[2:3] / cosine

    return linear, variance


def of_events(motion: Vector, variance: Vector) -> Measurement:
    """Return the measurement of velocity east, south, down over height, 1/s, with its variances, (3,)."""

    def linear(now: Estimate) -> tuple[Vector, Vector]:
        height_m = max(float(now.position_m[2]), _LEAST_M)
        signs = np.array([1.0, -1.0, -1.0])
        predicted = signs * now.velocity_m_s / height_m
        matrix = np.zeros((3, 15))
        matrix[:, _V] = np.diag(signs / height_m)
        matrix[:, 2] = -predicted / height_m
        return motion - predicted, matrix

    return linear, variance


class Filter:
    """The filter of one flight, from the state known at time 0, upright, and the errors of its sensors on."""

    def __init__(self, known: Known, errors: SensorErrors) -> None:
        self.errors = errors
        self.newest = 0  # period
        gyroscope, accelerometer = errors.gyroscope, errors.accelerometer
        bias = math.sqrt(accelerometer.bias**2 + accelerometer.drift**2 + _GRAVITY_ERROR_M_S2**2)
        sigma = [known.place_sigma_m] * 2 + [known.height_sigma_m] + [known.velocity_sigma_m_s] * 3
        sigma += [_ATTITUDE_RAD] * 3 + [bias] * 3 + [math.hypot(gyroscope.bias, gyroscope.drift)] * 3
        place, velocity, no_bias = np.array(known.position_m), np.array(known.velocity_m_s), np.zeros(3)
        self._before = {0: Estimate(place, velocity, NO_TURN, no_bias, no_bias, np.diag(np.square(sigma)))}
        self._samples: dict[int, tuple[Vector, Vector]] = {}
        self._measured: dict[int, list[Measurement]] = {}
        self._from = 0  # period whose estimate, and all later ones, are out of date
        growth = np.zeros(15)  # of the variances, in a period
        rounding = np.array([1e-5, 1e-6]) ** 2 / 12  # of push and turn on the bus
        growth[_V] = accelerometer.white**2 * PERIOD_S + rounding[0]
        growth[_Q] = gyroscope.white**2 * PERIOD_S + rounding[1]
        for part, triad in ((_A, accelerometer), (_G, gyroscope)):
            growth[part] = 2 * triad.drift**2 * PERIOD_S / triad.correlation_s
        self._growth = np.diag(growth)

    @property
    def now(self) -> Estimate:
        """Estimate at the newest sample, with all measurements."""
        return self.at(self.newest)

    def at(self, number: int) -> Estimate:
        """Return the estimate of a period that is still stored, with all measurements until then."""
        for k in range(self._from, self.newest):
            self._before[k + 1] = self._stepped(self._after(k), *self._samples[k + 1])
        self._from = self.newest
        return self._after(min(max(number, min(self._before)), self.newest))

    def sample(self, number: int, turn_rad: Vector, push_m_s: Vector) -> None:
        """Take the next sample of the IMU; where the bus lost some, this one stands for them."""
        while self.newest < number:
            last = self.now
            self.newest = self._from = self.newest + 1
            self._samples[self.newest] = turn_rad, push_m_s
            self._before[self.newest] = self._stepped(last, turn_rad, push_m_s)
            for table in (self._before, self._samples, self._measured):
                table.pop(self.newest - _KEPT, None)

    def measure(self, number: int, measurement: Measurement) -> bool:
        """Take a measurement of a period; False when it is older than those stored, or newer."""
        if number not in self._before:
            return False
        self._measured.setdefault(number, []).append(measurement)
        self._from = min(self._from, number)
        return True

    def _stepped(self, last: Estimate, turn_rad: Vector, push_m_s: Vector) -> Estimate:
        turn = turn_rad - last.gyroscope_bias * PERIOD_S
        push = push_m_s - last.accelerometer_bias * PERIOD_S
        middle = matrix_of(product(last.attitude, turn_of(turn / 2)))
        change = middle @ push + _DOWN * PERIOD_S
        q = product(last.attitude, turn_of(turn))
        step = _EYE.copy()
        step[_P, _V] = np.eye(3) * PERIOD_S
        step[_V, _Q] = -middle @ np.cross(np.eye(3), push)  # the matrix of a cross product from the left
        step[_V, _A] = -middle * PERIOD_S
        step[_Q, _Q] = matrix_of(turn_of(-turn))
        step[_Q, _G] = -np.eye(3) * PERIOD_S
        return replace(
            last,
            position_m=last.position_m + (last.velocity_m_s + change / 2) * PERIOD_S,
            velocity_m_s=last.velocity_m_s + change,
            attitude=q / np.linalg.norm(q),
            covariance=step @ last.covariance @ step.T + self._growth,
        )

    def _after(self, number: int) -> Estimate:
        """Return the estimate of a period with its own measurements."""
        now = self._before[number]
        for measurement in self._measured.get(number, ()):
            now = _corrected(now, measurement)
        return now


def _corrected(now: Estimate, measurement: Measurement) -> Estimate:
    """Return the estimate with a measurement, one that does not fit with less weight; Joseph's form."""
    linear, variance = measurement
    (residual, matrix), noise = linear(now), np.diag(variance)
    expected = matrix @ now.covariance @ matrix.T + noise
    beyond = float(residual @ np.linalg.solve(expected, residual)) / (_GATE * len(residual))
    if beyond > 1:
        noise = noise * beyond**2
        expected = matrix @ now.covariance @ matrix.T + noise
    gain = np.linalg.solve(expected, matrix @ now.covariance).T
    rest = _EYE - gain @ matrix
    covariance = rest @ now.covariance @ rest.T + gain @ noise @ gain.T
    error = gain @ residual
    q = product(now.attitude, turn_of(error[_Q]))
    return Estimate(
        now.position_m + error[_P],
        now.velocity_m_s + error[_V],
        q / np.linalg.norm(q),
        now.accelerometer_bias + error[_A],
        now.gyroscope_bias + error[_G],
        (covariance + covariance.T) / 2,
    )

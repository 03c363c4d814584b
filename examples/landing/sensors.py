"""The vehicle's own sensors, and all frames on the CAN bus between spacecraft and flight computer.

A frame has 8 bytes, little-endian, 11-bit identifiers.

    0x210  command    i16 east, i16 north, i16 up: acceleration without gravity's, mm/s2 | u16 turn that it answers
    0x211  attitude   i16 x, y, z: vector part of q_world_from_body in 1/32767, its w >= 0 | u16 number of its time
    0x212  edge       u16 counter of the SYNC | u48 time of its edge among the events, us (in real time alone)
    0x20f  estimate   as attitude: the flight computer's, for the attitude control | u16 number of its time
    0x213  range      u32 slant range, mm | u16 number of its time | u16 0
    0x214  star       as attitude: the star tracker's | u16 number of its time
    0x215  turn       i16 x, y, z: turn of the body in one period of the IMU, 1e-6 rad | u16 number of its end
    0x216  push       i16 x, y, z: its change of speed without gravity's, body, 1e-5 m/s | u16 number of its end

The SYNC of the bus (0x080) begins a turn; the camera sends the same instant as an edge among its events. Attitudes that
are given are numbered by light frames in lockstep, by steps of the dynamics in real time; other frames by periods of
the IMU, 20 ms. An identifier decides on the bus who sends first: a push comes after all frames of its time, and a
command after its estimate.

The errors of the sensors are numbers of a seed: white noise is keyed by (seed, purpose, sample), a constant by (seed,
purpose), and a drift is a first-order Gauss-Markov sequence of the samples from zero on. A sample therefore depends on
the true motion and on its own number, not on the step of the dynamics, or on what was read before it. The defaults are
assumptions, of the order of tactical MEMS units, small star trackers and small altimeters.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from vehicle import Height, Lander, State, Vector, matrix, product

SYNC, COMMAND, ATTITUDE, EDGE = 0x080, 0x210, 0x211, 0x212
ESTIMATE, RANGE, STAR, TURN, PUSH = 0x20F, 0x213, 0x214, 0x215, 0x216
TURN_RAD, PUSH_M_S, _RANGE_M = 1e-6, 1e-5, 1e-3

_WORDS, _RANGE = struct.Struct("<hhhH"), struct.Struct("<IHH")
_MM, _UNIT = 1000.0, 32767.0
_NUMBERS = 1 << 16


def pack_command(acceleration_m_s2: Vector, turn: int) -> bytes:
    """Return the data of a command; accelerations beyond 32 m/s2 are clipped."""
    return _packed(acceleration_m_s2 * _MM, turn)


def unpack_command(data: bytes) -> tuple[Vector, int]:
    """Return acceleration, m/s2, and turn; raises ValueError for other data, as all that follow."""
    words, turn = _unpacked(data)
    return words / _MM, turn


def pack_attitude(q_world_from_body: Vector, number: int) -> bytes:
    """Return the data of an attitude, a unit quaternion, scalar first."""
    return _packed(q_world_from_body[1:] * (1.0 if q_world_from_body[0] >= 0 else -1.0) * _UNIT, number)


def unpack_attitude(data: bytes) -> tuple[Vector, int]:
    """Return quaternion and number."""
    words, number = _unpacked(data)
    vector = words / _UNIT
    return np.array([math.sqrt(max(0.0, 1 - float(vector @ vector))), *vector]), number


def pack_edge(counter: int, t_us: int) -> bytes:
    """Return the data with the time of a SYNC's edge."""
    return counter.to_bytes(2, "little") + t_us.to_bytes(6, "little")


def unpack_edge(data: bytes) -> tuple[int, int]:
    """Return counter and time, us."""
    _check(data)
    return int.from_bytes(data[:2], "little"), int.from_bytes(data[2:], "little")


def pack_vector(vector: Vector, unit: float, number: int) -> bytes:
    """Return the data of a turn or a push in its unit; what is beyond 16 bits is clipped."""
    return _packed(vector / unit, number)


def unpack_vector(data: bytes, unit: float) -> tuple[Vector, int]:
    """Return vector and number."""
    words, number = _unpacked(data)
    return words * unit, number


def pack_range(range_m: float, number: int) -> bytes:
    """Return the data of a range."""
    return _RANGE.pack(round(range_m / _RANGE_M), number % _NUMBERS, 0)


def unpack_range(data: bytes) -> tuple[float, int]:
    """Return range, m, and number."""
    _check(data)
    words, number, _ = _RANGE.unpack(data)
    return words * _RANGE_M, number


def nearest_number(number: int, newest: int) -> int:
    """Return the full number of one that was sent modulo 65 536: the nearest to the newest known."""
    return number + _NUMBERS * round((newest - number) / _NUMBERS)


def _packed(words: Vector, number: int) -> bytes:
    return _WORDS.pack(*np.clip(np.round(words), -_UNIT, _UNIT).astype(int).tolist(), number % _NUMBERS)


def _unpacked(data: bytes) -> tuple[Vector, int]:
    _check(data)
    *words, number = _WORDS.unpack(data)
    return np.array(words), number


def _check(data: bytes) -> None:
    if len(data) != _WORDS.size:
        raise ValueError(f"{len(data)} bytes: a frame of this bus has {_WORDS.size}")


PERIOD_S = 0.02
"""Period of the IMU."""

_ARC_S = math.pi / 648_000
_CHUNK = 512
_RANGE_ROUNDS = 4

Frame = tuple[int, bytes]


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
class StarTracker:
    """Errors about the body's axes; `every`, `delay` in periods. Its boresight is the body's x axis."""

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
    """Normal numbers of a flight's seed and a purpose, a number for each use; three for each sample."""

    def __init__(self, seed: int, purpose: int) -> None:
        self._key = np.array([seed, purpose], np.uint64)
        self._chunks: dict[int, Vector] = {}
        self._drifts: list[Vector] = []

    def normal(self, sample: int) -> Vector:
        """Return the numbers of a sample, (3,)."""
        chunk = sample // _CHUNK
        if chunk not in self._chunks:
            generator = np.random.Generator(np.random.Philox(key=self._key, counter=[0, 0, 0, chunk]))
            self._chunks[chunk] = generator.standard_normal((_CHUNK, 3))
        return self._chunks[chunk][sample % _CHUNK]

    def drift(self, sample: int, decay: float) -> Vector:
        """Return the Gauss-Markov sequence of variance 1 at a sample, (3,); the first value has that variance too."""
        while sample >= len(self._drifts):
            number = self.normal(len(self._drifts))
            before = self._drifts[-1] if self._drifts else number
            fresh = math.sqrt(1 - decay**2) if self._drifts else 1 - decay
            self._drifts.append(decay * before + fresh * number)
        return self._drifts[sample]


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
        errors, tracker, altimeter = self._errors, self._errors.star_tracker, self._errors.altimeter
        turn = pack_vector(self.turn_rad(number, before, after), TURN_RAD, number)
        push = pack_vector(self.push_m_s(number, before, after), PUSH_M_S, number)
        self._waiting += [(number + errors.imu_delay, (TURN, turn)), (number + errors.imu_delay, (PUSH, push))]
        if number % tracker.every == 0:
            star = pack_attitude(self.attitude(number, after), number)
            self._waiting.append((number + tracker.delay, (STAR, star)))
        if number % altimeter.every == 0 and (range_m := self.range_m(number, after)) > 0:
            self._waiting.append((number + altimeter.delay, (RANGE, pack_range(range_m, number))))

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


def vector_of(q: Vector) -> Vector:
    """Return the rotation vector of a unit quaternion, rad, (3,)."""
    q = q if q[0] >= 0 else -q
    sine = float(np.linalg.norm(q[1:]))
    return q[1:] * (2 * math.atan2(sine, q[0]) / sine if sine > 1e-12 else 2.0)


def turn_of(vector: Vector) -> Vector:
    """Return the unit quaternion of a rotation vector."""
    angle = float(np.linalg.norm(vector))
    return np.array([math.cos(angle / 2), *(vector * (math.sin(angle / 2) / angle if angle > 1e-12 else 0.5))])

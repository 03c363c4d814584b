"""Samples of an IMU on a camera's path: motion and gravity, errors, filters and counts.

The elements measure

    specific force    R^T (a - g)      R: world_from_imu, a: acceleration of the path, g: gravity at its place
    angular rate      along the unit's axes

with a gravity that is the same everywhere, or that of a point mass at the origin. Sample k is taken at k periods of
stream time, 1 ms on the unit's own clock. Where the scene's time runs faster than stream time by a factor, rates are
faster by it and accelerations, gravity's too, by its square: it is the same motion, faster, and free fall stays free. A
record of motion, before filter and converter, is IMU_MOTION:

    t            u64     stream time, us
    index        u64     number of the sample since time zero, at the unit's own rate of about 1 kHz
    force        3 f64   specific force along x, y, z of the unit, m/s2: acceleration less gravity, so zero in free fall
    rate         3 f64   angular rate about them, rad/s
    temperature  f64     degrees Celsius

Errors are bias, its random walk, and white noise, before any filter:

    error of sample k = bias + walk of the first k periods + noise / sqrt(2 period) * normal(k)

A one-sided noise density n makes white samples of variance n^2 / (2 period); behind a filter of noise bandwidth B the
variance is n^2 B, and the Allan deviation of the unfiltered samples is n / sqrt(2 tau). All draws are keyed by (seed,
purpose, axis, sample), so a sample does not depend on the time or the batch of its request.

The converter makes counts, with the settings of the host's registers:

    motion at 1 kHz -> low-pass -> every n-th sample -> rounded to whole counts, cut at 16 bits

The low-pass is Butterworth's with two poles; the data sheet gives only bandwidths and delays. With the drivers' default
white noise gets a correlation from sample to sample of 0.72 for the gyroscope and 0.65 for the accelerometer; a real
DAVIS346 had 0.72 and 0.52. Its delay at low frequencies is 1.2 ms at 184 Hz; the data sheet gives 2.9 ms, so a part of
the real delay is left out. Settings apply from the next sample on; a filter changed or switched on starts settled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Vector, matrix_of
from emulator.light import LightFrame
from emulator.sensor.numerics.keyed import Purpose, normal
from emulator.sensor.parameters import ImuParameters
from emulator.trajectory.pose import Timescale, Trajectory
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.events import Floats
from firmware_protocol.imu_samples import IMU_SAMPLE, THERMOMETERS, ImuSamples, ImuScale, ImuSettings, no_samples

AXES = 6
_BLOCK = 1 << 14


@dataclass(frozen=True, eq=False)
class Errors:
    """Sizes of the errors, (6,) each: three of the accelerometer, m/s2, then three of the gyroscope, rad/s.

    Attributes
    ----------
    density : one-sided noise density, a root of hertz.
    walk : of the bias, a root of second.
    bias : at the start; where NaN, it is drawn with `spread`.
    """

    density: Floats
    walk: Floats
    bias: Floats
    spread: Floats


class ElementErrors:
    """The errors of one unit, sample by sample, `period_s` apart."""

    def __init__(self, errors: Errors, period_s: float, seed: int) -> None:
        self._errors, self._seed = errors, seed
        self._deviation = errors.density / np.sqrt(2 * period_s)
        self._step = errors.walk * np.sqrt(period_s)
        random_bias = errors.spread * normal(seed, Purpose.IMU_BIAS, np.arange(AXES))
        self.bias = np.where(np.isnan(errors.bias), random_bias, errors.bias)
        self._bias_sum = 0, np.zeros(AXES)  # number of steps, and their sum

    def at(self, first: int, count: int) -> Floats:
        """Return the errors of samples `first` to `first + count - 1`, (count, 6)."""
        index = np.arange(first, first + count)[:, None]
        white = self._deviation * normal(self._seed, Purpose.IMU_NOISE, np.arange(AXES), index)
        return np.asarray(self.bias + self._bias_walk(first, count) + white)

    def _bias_walk(self, first: int, count: int) -> Floats:
        """Return the walks after `first`, `first + 1`, ... steps, (count, 6)."""
        if not self._step.any() or not count:
            return np.zeros((count, AXES))
        step, total = self._bias_sum if self._bias_sum[0] <= first else (0, np.zeros(AXES))
        while step < first:
            upto = min(first, step + _BLOCK)
            total = self._summed(total, step, upto)[-1]
            step = upto
        walks = self._summed(total, first, first + count - 1)
        self._bias_sum = first + count - 1, walks[-1]
        return walks

    def _summed(self, total: Floats, first: int, last: int) -> Floats:
        """Return the sums after `first` to `last` steps, the first being `total`; added one by one."""
        index = np.arange(first, last)[:, None]
        steps = self._step * normal(self._seed, Purpose.IMU_WALK, np.arange(AXES), index)
        return np.cumsum(np.concatenate([total[None], steps]), axis=0)


IMU_MOTION = np.dtype([("t", "<u8"), ("index", "<u8"), ("force", "<f8", 3), ("rate", "<f8", 3), ("temperature", "<f8")])

ImuMotion = npt.NDArray[np.void]
"""An array of IMU_MOTION records, shape (n,), sorted by t."""

STANDARD_GRAVITY_M_S2 = 9.80665
"""1 g: the unit of accelerometers, by definition (CGPM 1901)."""


@dataclass(frozen=True, eq=False)
class Gravity:
    """A field of gravity: `uniform_m_s2`, (3,), in the world, and `gm_m3_s2` of a point mass at the origin, 0: none."""

    uniform_m_s2: Vector = field(default_factory=lambda: np.zeros(3))
    gm_m3_s2: float = 0.0

    def at(self, place_m: Vector) -> Vector:
        """Return the acceleration of free fall at a place, (3,) m/s2."""
        distance_m = float(np.linalg.norm(place_m))
        if not self.gm_m3_s2 or not distance_m:
            return self.uniform_m_s2
        return np.asarray(self.uniform_m_s2 - self.gm_m3_s2 / distance_m**3 * place_m)


WEIGHTLESS = Gravity()
MOON_BELOW = Gravity(np.array([0.0, 0.0, -1.62]))
"""The Moon's mean surface gravity, in a world with z up."""
EARTH_IN_THE_PICTURE = Gravity(np.array([0.0, STANDARD_GRAVITY_M_S2, 0.0]))
"""1 g downwards in the image of a camera at rest with the world's axes."""

_PERIOD_NS = 1_000_000


@dataclass(frozen=True, eq=False)
class Carried:
    """Motion of the unit: the camera's path, its time, and the gravity along it."""

    path: Trajectory
    gravity: Gravity
    time: Timescale


class ImuUnit:
    """The elements of an IMU on a camera."""

    def __init__(self, parameters: ImuParameters, carried: Carried, seed: int) -> None:
        self._carried = carried
        self._period_ns = _PERIOD_NS / (1 + parameters.clock_ppm * 1e-6)
        self._camera_from_imu = matrix_of(np.array(parameters.q_camera_from_imu))
        self._temperature_c = parameters.temperature_c
        self._errors = ElementErrors(errors_of(parameters), self._period_ns * 1e-9, seed)

    def between(self, t0_ns: int, t1_ns: int) -> ImuMotion:
        """Return the samples after `t0_ns` and up to `t1_ns` of stream time, (n,) IMU_MOTION."""
        first, last = self._samples_until(t0_ns), self._samples_until(t1_ns)
        motion = np.zeros(last - first, IMU_MOTION)
        for k in range(first, last):
            self._sense(self._time_ns(k), motion[k - first : k - first + 1])
        errors = self._errors.at(first, last - first)
        motion["force"] += errors[:, :3]
        motion["rate"] += errors[:, 3:]
        motion["index"] = np.arange(first, last)
        motion["temperature"] = self._temperature_c
        return motion

    def _samples_until(self, t_ns: int) -> int:
        """Return the number of samples up to `t_ns`, without the first one at time zero."""
        count = int(t_ns / self._period_ns)
        while self._time_ns(count + 1) <= t_ns:
            count += 1
        while count > 0 and self._time_ns(count) > t_ns:
            count -= 1
        return count + 1

    def _time_ns(self, index: int) -> int:
        return round(index * self._period_ns)

    def _sense(self, t_ns: int, out: ImuMotion) -> None:
        carried = self._carried
        scene_ns, factor = carried.time.scene_ns(t_ns), carried.time.factor
        pose, motion = carried.path.pose_and_motion(scene_ns)
        felt = motion.acceleration_m_s2 - carried.gravity.at(pose.position_m)
        imu_from_camera = self._camera_from_imu.T
        out["t"] = t_ns // 1000
        out["force"] = factor**2 * (imu_from_camera @ (pose.world_from_body.T @ felt))
        out["rate"] = factor * (imu_from_camera @ motion.turn_rad_s)


# Standard deviations of the biases drawn; sources in `parameters`.
_BIAS_SPREAD_G, _BIAS_SPREAD_DEG_S = 0.02, 0.4


def errors_of(p: ImuParameters) -> Errors:
    """Return the errors of the elements in SI units."""
    degree, g = np.pi / 180, STANDARD_GRAVITY_M_S2

    def six(force: object, rate: object) -> np.ndarray:
        axes = [np.full(3, np.nan) if size is None else np.broadcast_to(np.array(size), 3) for size in (force, rate)]
        return np.concatenate([axes[0] * g, axes[1] * degree])

    return Errors(
        density=six(p.accelerometer_noise_ug * 1e-6, p.gyroscope_noise_deg_s),
        walk=six(p.accelerometer_walk_g, p.gyroscope_walk_deg_s),
        bias=six(p.accelerometer_bias_g, p.gyroscope_bias_deg_s),
        spread=six(_BIAS_SPREAD_G, _BIAS_SPREAD_DEG_S),
    )


_RATE_HZ = 1000.0


class Converter:
    """Filters and converters. Motion goes in, samples in counts come out."""

    _filter: _LowPass | None = None

    def samples(self, motion: ImuMotion, settings: ImuSettings) -> ImuSamples:
        """Return the samples of `motion`, (n,) IMU_MOTION in order: (m <= n,) IMU_SAMPLE."""
        samples = no_samples(len(motion))
        taken = np.zeros(len(motion), np.bool_)
        bandwidths = settings.accelerometer_mhz / 1000, settings.gyroscope_mhz / 1000
        for k, sensed in enumerate(motion):
            felt = np.concatenate([sensed["force"], sensed["rate"]])
            if self._filter is None or self._filter.bandwidths_hz != bandwidths:
                self._filter = _LowPass(*bandwidths, felt)
            felt = self._filter.step(felt)
            taken[k] = settings.takes(int(sensed["index"]))
            if taken[k]:
                samples[k] = sensed["t"], settings.scale, _counts(felt, float(sensed["temperature"]), settings)
        return samples[taken]


def _counts(felt: Floats, temperature_c: float, settings: ImuSettings) -> npt.NDArray[np.int16]:
    """Return the seven counts: accelerometer, temperature, gyroscope; 0 for elements that are off."""
    scale, (per_degree, offset_c) = ImuScale.parse(settings.scale, settings.unit), THERMOMETERS[settings.unit]
    is_on = [scale.accelerometer] * 3 + [scale.temperature] + [scale.gyroscope] * 3
    force, rate = felt[:3] / STANDARD_GRAVITY_M_S2 / scale.acceleration_g, np.degrees(felt[3:]) / scale.rate_deg_s
    counts = np.concatenate([force, [(temperature_c - offset_c) * per_degree], rate])
    return np.where(is_on, np.clip(np.rint(counts), -32768, 32767), 0).astype(np.int16)


class _LowPass:
    """Butterworth low-pass of two poles for six signals at 1 kHz, settled at `start`; no effect from half the rate on.

    Source: the bilinear transform with the corner kept (Oppenheim and Schafer, Discrete-Time Signal Processing, 7.1).
    """

    def __init__(self, accelerometer_hz: float, gyroscope_hz: float, start: Floats) -> None:
        self.bandwidths_hz = accelerometer_hz, gyroscope_hz
        self._b, self._a1, self._a2 = np.repeat([_coefficients(hz) for hz in self.bandwidths_hz], 3, axis=0).T
        bypassed = self._b == 1.0
        self._twice = np.where(bypassed, 0.0, 2.0)
        self._once = np.where(bypassed, 0.0, 1.0)
        self._s2 = (self._once * self._b - self._a2) * start
        self._s1 = (self._twice * self._b - self._a1) * start + self._s2

    def step(self, x: Floats) -> Floats:
        """Return the output for the input `x`, (6,)."""
        y = self._b * x + self._s1
        self._s1 = self._twice * self._b * x - self._a1 * y + self._s2
        self._s2 = self._once * self._b * x - self._a2 * y
        return np.asarray(y)


def _coefficients(bandwidth_hz: float) -> tuple[float, float, float]:
    """Return b0 (b1 = 2 b0, b2 = b0), a1 and a2; (1, 0, 0) for a bandwidth beyond half the rate."""
    if bandwidth_hz >= _RATE_HZ / 2:
        return 1.0, 0.0, 0.0
    k = math.tan(math.pi * bandwidth_hz / _RATE_HZ)
    norm = 1 + math.sqrt(2) * k + k * k
    return k * k / norm, 2 * (k * k - 1) / norm, (1 - math.sqrt(2) * k + k * k) / norm


class ImuSource:
    """Source of the samples of a unit, in counts. It costs nothing while it is switched off."""

    kind = ReadingKind.IMU
    record = IMU_SAMPLE

    def __init__(self, unit: ImuUnit) -> None:
        self._unit = unit
        self._converter = Converter()
        self._t_ns = 0

    def reset(self, frame: LightFrame) -> None:
        """Start at the time of `frame`."""
        self._t_ns = frame.t_ns
        self._converter = Converter()

    def read(self, frame: LightFrame, settings: tuple[int, ...]) -> ImuSamples:
        """Move to the time of `frame` and return the samples until then."""
        requested = ImuSettings(bool(settings[0]), *settings[1:]) if settings else ImuSettings()
        since_ns, self._t_ns = self._t_ns, frame.t_ns
        if not requested.run:
            self._converter = Converter()
            return no_samples()
        return self._converter.samples(self._unit.between(since_ns, frame.t_ns), requested)

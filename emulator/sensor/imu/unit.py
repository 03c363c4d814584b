"""What an IMU on a camera's path feels, sample after sample of its own clock.

    specific force    R^T (a - g)      R: world_from_imu, a: acceleration of the path, g: gravity at its place
    angular rate      along the unit's axes

Sample k is taken at k periods of stream time, 1 ms on the unit's own clock. Where the scene's time goes faster than
stream time by a factor, rates are faster by it and accelerations, gravity's too, by its square: it is the same motion,
seen in fast motion, and free fall stays free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.geometry.attitude import matrix_of
from emulator.sensor.imu.errors import ElementErrors, Errors
from emulator.sensor.imu.gravity import STANDARD_GRAVITY_M_S2, Gravity
from emulator.sensor.imu.motion import ImuMotion, no_motion
from emulator.sensor.imu.parameters import ImuParameters
from emulator.trajectory.pose import Trajectory
from emulator.trajectory.timescale import Timescale

__all__ = ["Carried", "ImuUnit", "errors_of"]

_PERIOD_NS = 1_000_000


@dataclass(frozen=True, eq=False)
class Carried:
    """How the unit is carried: the camera's path, its time, and the gravity along it."""

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
        motion = no_motion(last - first)
        for k in range(first, last):
            self._feel(self._time_ns(k), motion[k - first : k - first + 1])
        errors = self._errors.at(first, last - first)
        motion["force"] += errors[:, :3]
        motion["rate"] += errors[:, 3:]
        motion["index"] = np.arange(first, last)
        motion["temperature"] = self._temperature_c
        return motion

    def _samples_until(self, t_ns: int) -> int:
        """Return how many samples are taken up to `t_ns`; the first one at time zero is not."""
        count = int(t_ns / self._period_ns)
        while self._time_ns(count + 1) <= t_ns:
            count += 1
        while count > 0 and self._time_ns(count) > t_ns:
            count -= 1
        return count + 1

    def _time_ns(self, index: int) -> int:
        return round(index * self._period_ns)

    def _feel(self, t_ns: int, out: ImuMotion) -> None:
        carried = self._carried
        scene_ns, factor = carried.time.scene_ns(t_ns), carried.time.factor
        pose, motion = carried.path.pose_and_motion(scene_ns)
        felt = motion.acceleration_m_s2 - carried.gravity.at(pose.position_m)
        imu_from_camera = self._camera_from_imu.T
        out["t"] = t_ns // 1000
        out["force"] = factor**2 * (imu_from_camera @ (pose.world_from_body.T @ felt))
        out["rate"] = factor * (imu_from_camera @ motion.turn_rad_s)


def errors_of(p: ImuParameters) -> Errors:
    """Return the errors of the elements in SI units."""
    degree, g = np.pi / 180, STANDARD_GRAVITY_M_S2

    def six(force: object, rate: object) -> np.ndarray:
        both = [np.full(3, np.nan) if some is None else np.broadcast_to(np.array(some), 3) for some in (force, rate)]
        return np.concatenate([both[0] * g, both[1] * degree])

    return Errors(
        density=six(p.accelerometer_noise_ug * 1e-6, p.gyroscope_noise_deg_s),
        walk=six(p.accelerometer_walk_g, p.gyroscope_walk_deg_s),
        bias=six(p.accelerometer_bias_g, p.gyroscope_bias_deg_s),
        spread=six(p.accelerometer_bias_spread_g, p.gyroscope_bias_spread_deg_s),
    )

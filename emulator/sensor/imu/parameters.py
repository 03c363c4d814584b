"""The [camera.imu] table of a rig: an IMU as its data sheet describes it, and the gravity that acts on it.

Defaults, with their sources:

    noise density     0.007 deg/s, 160 ug a root of Hz   one recording of a DAVIS346: 0.10 deg/s and 2 to 3 mg rms
                                                         behind the filters that drivers select by default
    bias              0.4 deg/s, 20 mg (spreads)         the same: up to 0.74 deg/s of the gyroscope; 20 mg: an estimate
    walk of the bias  2e-4 deg/s, 1e-5 g a root of s     estimates: no source was found for this unit
    clock             1500 ppm fast                      the same: periods of 998 and 999 us
    temperature       28.5 C                             the same
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from emulator.sensor.checks import check, check_finite

__all__ = ["ImuParameters"]

_Triple = tuple[float, float, float]


@dataclass(frozen=True)
class ImuParameters:
    """An inertial measurement unit.

    Attributes
    ----------
    unit
        "mpu_9250", also for the MPU-6500 of a DAVIS346, or "mpu_6050": its filters and its thermometer.
    q_camera_from_imu
        Rotation against the camera (x right, y down, z along the boresight): unit quaternion, scalar first.
    gravity_m_s2
        Gravity in the world, the same everywhere. Without it, and without `gm_m3_s2`: that of the Moon above a terrain,
        straight down in -z; that of the central body of a path of kind "orbit"; that of the Earth, straight down in the
        image, where the camera has no path; else none.
    gm_m3_s2
        Above 0: gravity of a point mass at the world's origin instead.
    gyroscope_noise_deg_s, accelerometer_noise_ug
        Noise density, one-sided, a root of hertz.
    gyroscope_walk_deg_s, accelerometer_walk_g
        Random walk of the bias, a root of second.
    gyroscope_bias_deg_s, accelerometer_bias_g
        Bias at the start; without it one is drawn from the seed, with the spread below.
    gyroscope_bias_spread_deg_s, accelerometer_bias_spread_g
        Standard deviation of the biases drawn.
    temperature_c
        Temperature of the unit.
    clock_ppm
        Rate error of its own clock, positive when it runs too fast.
    """

    unit: Literal["mpu_9250", "mpu_6050"] = "mpu_9250"
    q_camera_from_imu: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    gravity_m_s2: _Triple | None = None
    gm_m3_s2: float = 0.0
    gyroscope_noise_deg_s: float = 0.007
    accelerometer_noise_ug: float = 160.0
    gyroscope_walk_deg_s: float = 2e-4
    accelerometer_walk_g: float = 1e-5
    gyroscope_bias_deg_s: _Triple | None = None
    accelerometer_bias_g: _Triple | None = None
    gyroscope_bias_spread_deg_s: float = 0.4
    accelerometer_bias_spread_g: float = 0.02
    temperature_c: float = 28.5
    clock_ppm: float = 1500.0

    def __post_init__(self) -> None:
        check_finite(self)
        for name in ("gravity_m_s2", "gyroscope_bias_deg_s", "accelerometer_bias_g", "q_camera_from_imu"):
            value = getattr(self, name)
            if value is not None and not all(abs(part) < 1e9 for part in value):  # NaN compares false
                raise ValueError(f"{name} = {value}: must be finite numbers")
        if abs(math.hypot(*self.q_camera_from_imu) - 1) >= 1e-3:
            raise ValueError(f"q_camera_from_imu = {self.q_camera_from_imu}: must be a unit quaternion (w, x, y, z)")
        if self.gravity_m_s2 is not None and self.gm_m3_s2:
            raise ValueError("gm_m3_s2: gravity is either gravity_m_s2 or that of a point mass, not both")
        for name in ("gyroscope_noise_deg_s", "accelerometer_noise_ug", "gyroscope_walk_deg_s", "accelerometer_walk_g"):
            check(self, name, 0.0, 1e6)
        for name in ("gm_m3_s2", "gyroscope_bias_spread_deg_s", "accelerometer_bias_spread_g"):
            check(self, name, 0.0)
        check(self, "temperature_c", -60, 125)
        check(self, "clock_ppm", -50_000, 50_000)

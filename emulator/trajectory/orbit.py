"""Circular and elliptical orbits about the world's origin: the two-body problem in closed form.

    M = M0 + sqrt(GM / a^3) t    E - e sin E = M    (Kepler; Vallado, Fundamentals of Astrodynamics, 2.2)
    in the plane of the orbit: x = a (cos E - e), y = a sqrt(1 - e^2) sin E

then turned by the argument of periapsis about z, the inclination about x, the node about z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from emulator.geometry.attitude import Matrix, Vector
from emulator.trajectory.pose import STILL, Motion, Pose, Trajectory

_NEWTON_STEPS = 50


@dataclass(frozen=True)
class Elements:
    """An orbit about a point mass at the origin.

    Attributes
    ----------
    gm_m3_s2 : gravitational parameter of the body; 4.4628e5 for Eros.
    semi_major_axis_m : mean of nearest and farthest distance.
    eccentricity : 0 for a circle, below 1.
    inclination_deg, node_deg, periapsis_deg : of the orbit's plane against the world's x-y plane.
    anomaly_deg : mean anomaly at time zero.
    """

    gm_m3_s2: float
    semi_major_axis_m: float
    eccentricity: float = 0.0
    inclination_deg: float = 0.0
    node_deg: float = 0.0
    periapsis_deg: float = 0.0
    anomaly_deg: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"{name} is {value}: it must be finite")
        for name in ("gm_m3_s2", "semi_major_axis_m"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is {getattr(self, name):g}: it must be above 0")
        if not 0 <= self.eccentricity < 1:
            raise ValueError(f"eccentricity is {self.eccentricity:g}: an orbit that returns has 0 to below 1")

    @property
    def mean_motion_rad_s(self) -> float:
        """Mean angular rate."""
        return math.sqrt(self.gm_m3_s2 / self.semi_major_axis_m**3)

    @property
    def period_s(self) -> float:
        """Time of one revolution."""
        return 2 * math.pi / self.mean_motion_rad_s

    @property
    def periapsis_speed_m_s(self) -> float:
        """The greatest speed, at the nearest point (vis-viva)."""
        e = self.eccentricity
        return math.sqrt(self.gm_m3_s2 / self.semi_major_axis_m * (1 + e) / (1 - e))


class Orbit(Trajectory):
    """An orbit around the origin, with the attitude of the world (see `looking` to look at the body)."""

    def __init__(self, elements: Elements) -> None:
        self._elements = elements
        self._world_from_plane = _plane(elements)

    def pose(self, t_ns: int) -> Pose:
        """Return the place at `t_ns`."""
        k, anomaly = self._elements, self._anomaly(t_ns)
        across = math.sqrt(1 - k.eccentricity**2) * math.sin(anomaly)
        in_plane: Vector = k.semi_major_axis_m * np.array([math.cos(anomaly) - k.eccentricity, across, 0.0])
        return Pose(self._world_from_plane @ in_plane, STILL.q_world_from_body)

    def motion(self, t_ns: int) -> Motion:
        """Return velocity and acceleration, that of free fall: -GM r / |r|^3."""
        k, anomaly, place = self._elements, self._anomaly(t_ns), self.pose(t_ns).position_m
        speed = k.semi_major_axis_m * k.mean_motion_rad_s / (1 - k.eccentricity * math.cos(anomaly))
        across = math.sqrt(1 - k.eccentricity**2) * math.cos(anomaly)
        velocity = self._world_from_plane @ (speed * np.array([-math.sin(anomaly), across, 0.0]))
        return Motion(velocity, -k.gm_m3_s2 * place / np.linalg.norm(place) ** 3, np.zeros(3))

    def _anomaly(self, t_ns: int) -> float:
        k = self._elements
        mean = math.radians(k.anomaly_deg) + math.fmod(k.mean_motion_rad_s * (t_ns * 1e-9), 2 * math.pi)
        return eccentric_anomaly(mean, k.eccentricity)

    @property
    def speed_bound_m_s(self) -> float:
        """The speed at the nearest point."""
        return self._elements.periapsis_speed_m_s

    @property
    def turn_bound_rad_s(self) -> float:
        """Zero: it does not turn."""
        return 0.0


def eccentric_anomaly(mean_rad: float, eccentricity: float) -> float:
    """Solve Kepler's equation for E, rad, 0 <= eccentricity < 1; to a few units in the last place."""
    mean = math.remainder(mean_rad, 2 * math.pi)
    anomaly = math.copysign(math.pi, mean) if eccentricity > 0.8 else mean  # Newton's method converges from there
    for _ in range(_NEWTON_STEPS):
        step = (anomaly - eccentricity * math.sin(anomaly) - mean) / (1 - eccentricity * math.cos(anomaly))
        anomaly -= step
        if abs(step) <= 1e-15 * max(1.0, abs(anomaly)):
            break
    return anomaly


def _plane(k: Elements) -> Matrix:
    """Return world_from_plane: the turns by node, inclination and periapsis."""

    def about(axis: int, degrees: float) -> Matrix:
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        i, j = (axis + 1) % 3, (axis + 2) % 3
        m = np.eye(3)
        m[i, i], m[i, j], m[j, i], m[j, j] = c, -s, s, c
        return m

    return np.asarray(about(2, k.node_deg) @ about(0, k.inclination_deg) @ about(2, k.periapsis_deg))

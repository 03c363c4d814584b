"""Paths by a law: orbits, and landings in phases.

Circular and elliptical orbits about the world's origin: the two-body problem in closed form.

    M = M0 + sqrt(GM / a^3) t    E - e sin E = M    (Kepler; Vallado, Fundamentals of Astrodynamics, 2.2)
    in the plane of the orbit: x = a (cos E - e), y = a sqrt(1 - e^2) sin E

then turned by the argument of periapsis about z, the inclination about x, the node about z.

A landing in phases: gates of height and speed, joined smoothly, above a flat world with z up.

    t_s   height_m  forward_m_s  down_m_s  depression_deg      phase that begins here
      0     1500        100         30          35              braking
     30      700         45         22          50              approach
     60      250          8          8          70              vertical
     85      150          0          0          90              hover
    100      150          0          0          90              descent to the ground
    165        4          0          1          90              touchdown

The camera moves along `heading_deg` (0 along +y, 90 along +x), and its boresight lies `depression_deg` below the
horizontal, ahead; up in the picture is up in the world, or ahead when it looks straight down. Heights and forward
distances are cubic Hermite curves with the gates' speeds; the forward distance between two gates is the mean of their
speeds times the time, which is that of constant deceleration. The depression is a monotone cubic (PCHIP, Fritsch and
Carlson 1980), so a boresight that is held straight down stays there. The landing site, where the last gate stands, is
at `site_m`. Source of the phases: Chandrayaan-3's (rough braking, attitude hold, fine braking, vertical descent,
hover, touchdown below 2 m/s) and Apollo's gates (high gate 2 km, low gate 150 m), both as reported in public; the
default is such a landing's last three minutes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from emulator.geometry.attitude import Vector, matrix_of, multiply, quaternion_of, quaternion_of_vector
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.mounting import looking_along
from emulator.trajectory.pose import (
    STILL,
    Bounds,
    Motion,
    Pose,
    Trajectory,
    TrajectoryError,
    instants_between,
    measured_bounds,
)
from firmware_protocol.bounds import check_bounds

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

_Positive = Annotated[float, Meta(gt=0)]
_NEWTON_STEPS = 50


class Checked:
    """Base of tables: numbers must be finite, attitudes unit quaternions, and directions not zero."""

    def __post_init__(self) -> None:
        check_bounds(self)
        for name, value in vars(self).items():
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(n, float) and not math.isfinite(n) for n in numbers):
                raise ValueError(f"{name} is {value}: it must be finite")
            if name == "q_world_from_body" and abs(math.hypot(*value) - 1) >= 1e-3:
                length = math.hypot(*value)
                raise ValueError(f"{name} is {value}, of length {length:.4g}: a unit quaternion (w, x, y, z) is needed")
            if name in ("up", "pole") and not any(value):
                raise ValueError(f"{name} is all zeros and points nowhere")


@dataclass(frozen=True)
class OrbitPath(Checked):
    """An elliptical orbit around the origin.

    Attributes
    ----------
    gm_m3_s2 : gravitational parameter of the body; 4.4628e5 for Eros.
    semi_major_axis_m : mean of nearest and farthest distance.
    eccentricity : 0 for a circle, below 1.
    inclination_deg, node_deg, periapsis_deg : of the orbit's plane against the world's x-y plane.
    anomaly_deg : mean anomaly at time zero.
    look_at_m : a point to look at; the origin, where the body is.
    up : direction that is up in the image.
    """

    kind: ClassVar[str] = "orbit"
    gm_m3_s2: _Positive
    semi_major_axis_m: _Positive
    eccentricity: float = 0.0
    inclination_deg: float = 0.0
    node_deg: float = 0.0
    periapsis_deg: float = 0.0
    anomaly_deg: float = 0.0
    look_at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
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

    def __init__(self, elements: OrbitPath) -> None:
        self._elements = elements
        self.bounds = Bounds(elements.periapsis_speed_m_s)
        self.span_ns = 0, round(elements.period_s * 1e9)
        turns_deg = (0, 0, elements.node_deg), (elements.inclination_deg, 0, 0), (0, 0, elements.periapsis_deg)
        turns = (quaternion_of_vector(np.radians(turn)) for turn in turns_deg)
        self._world_from_plane = matrix_of(reduce(multiply, turns))

    def pose(self, t_ns: int) -> Pose:
        """Return the place at `t_ns`."""
        k = self._elements
        anomaly = self._anomaly(t_ns)
        across = math.sqrt(1 - k.eccentricity**2) * math.sin(anomaly)
        in_plane: Vector = k.semi_major_axis_m * np.array([math.cos(anomaly) - k.eccentricity, across, 0.0])
        return Pose(self._world_from_plane @ in_plane, STILL.q_world_from_body)

    def motion(self, t_ns: int) -> Motion:
        """Return velocity and acceleration, that of free fall: -GM r / |r|^3."""
        k = self._elements
        anomaly = self._anomaly(t_ns)
        place = self.pose(t_ns).position_m
        speed = k.semi_major_axis_m * k.mean_motion_rad_s / (1 - k.eccentricity * math.cos(anomaly))
        across = math.sqrt(1 - k.eccentricity**2) * math.cos(anomaly)
        velocity = self._world_from_plane @ (speed * np.array([-math.sin(anomaly), across, 0.0]))
        return Motion(velocity, -k.gm_m3_s2 * place / np.linalg.norm(place) ** 3, np.zeros(3))

    def _anomaly(self, t_ns: int) -> float:
        k = self._elements
        mean = math.radians(k.anomaly_deg) + math.fmod(k.mean_motion_rad_s * (t_ns * 1e-9), 2 * math.pi)
        return eccentric_anomaly(mean, k.eccentricity)


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


_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Gate(Checked):
    """Height, speeds and pitch of a lander at one instant.

    Attributes
    ----------
    t_s : stream time.
    height_m : above the site.
    forward_m_s, down_m_s : speeds along the heading and downward.
    depression_deg : of the boresight below the horizontal.
    """

    t_s: float
    height_m: _Positive
    forward_m_s: float = 0.0
    down_m_s: float = 0.0
    depression_deg: Annotated[float, Meta(ge=0, le=90)] = 90.0


LANDING = (
    Gate(0.0, 1500.0, 100.0, 30.0, 35.0),
    Gate(30.0, 700.0, 45.0, 22.0, 50.0),
    Gate(60.0, 250.0, 8.0, 8.0, 70.0),
    Gate(85.0, 150.0),
    Gate(100.0, 150.0),
    Gate(165.0, 4.0, 0.0, 1.0),
)
"""The last three minutes of a lunar landing."""


class Descent(Trajectory):
    """A descent through `gates`, in order of time, to `site_m` (3,); raises TrajectoryError below the ground."""

    def __init__(
        self, gates: Sequence[Gate] = LANDING, heading_deg: float = 0.0, site_m: npt.ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        heading = math.radians(heading_deg)
        ahead = np.array([math.sin(heading), math.cos(heading), 0.0])
        site = np.asarray(site_m, np.float64)
        steps_m = [(b.t_s - a.t_s) * (a.forward_m_s + b.forward_m_s) / 2 for a, b in itertools.pairwise(gates)]
        forward_m = [-sum(steps_m[k:]) for k in range(len(gates))]  # along the heading, the last gate's being 0
        places = [site + s * ahead + gate.height_m * _UP for s, gate in zip(forward_m, gates, strict=True)]
        velocities = [gate.forward_m_s * ahead - gate.down_m_s * _UP for gate in gates]
        times_ns = [round(gate.t_s * 1e9) for gate in gates]
        self._path = Keyframes(times_ns, [Pose(place, STILL.q_world_from_body) for place in places], velocities)
        self.span_ns = self._path.span_ns
        self._ahead, self._depression_rad = ahead, _depression(gates)
        self._depression_rate = self._depression_rad.derivative()
        measured = measured_bounds(self.pose, instants_between(np.array(times_ns, np.int64)))
        self.bounds = Bounds(self._path.bounds.speed_m_s, measured.turn_rad_s)
        for t_ns in np.linspace(*self.span_ns, 1000).astype(np.int64):
            if self._path.pose(int(t_ns)).position_m[2] <= site[2]:
                raise TrajectoryError(
                    f"the descent goes through the ground at {t_ns * 1e-9:.1f} s: "
                    "between two gates the speeds need more height than there is"
                )

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`; after the last gate it stays there."""
        first, last = self.span_ns
        depression = float(self._depression_rad(min(max(t_ns, first), last) * 1e-9))
        c, s = math.cos(depression), math.sin(depression)
        # The picture's up turns with the boresight, from the zenith to straight ahead.
        axes = looking_along(c * self._ahead - s * _UP, s * self._ahead + c * _UP)
        return Pose(self._path.pose(t_ns).position_m, quaternion_of(axes))

    def motion(self, t_ns: int) -> Motion:
        """Return the motion; it turns about the camera's x axis, backwards as the depression grows."""
        first, last = self.span_ns
        rate = float(self._depression_rate(t_ns * 1e-9)) if first <= t_ns < last else 0.0
        path = self._path.motion(t_ns)
        return Motion(path.velocity_m_s, path.acceleration_m_s2, np.array([-rate, 0.0, 0.0]))


def _depression(gates: Sequence[Gate]) -> PPoly:
    """Return the boresight's depression, rad, as a function of seconds; between gates it stays between theirs."""
    # Loaded where it is used: it takes longer than the rest of a short run's imports.
    from scipy.interpolate import PchipInterpolator, PPoly

    radians = [math.radians(gate.depression_deg) for gate in gates]
    if len(gates) == 1:
        return PPoly([radians], [0.0, 1.0])
    return PchipInterpolator([gate.t_s for gate in gates], radians)

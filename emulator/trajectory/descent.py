"""A landing in phases: gates of height and speed, joined smoothly, above a flat world with z up.

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
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Quaternion, Vector, quaternion_of
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.mounting import looking_along
from emulator.trajectory.pose import STILL, Motion, Pose, Trajectory, TrajectoryError, instants_between, measured_bounds

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Gate:
    """Height, speeds and pitch of a lander at one instant.

    Attributes
    ----------
    t_s : stream time.
    height_m : above the site, > 0.
    forward_m_s, down_m_s : speeds along the heading and downward.
    depression_deg : of the boresight below the horizontal, 0 to 90.
    """

    t_s: float
    height_m: float
    forward_m_s: float = 0.0
    down_m_s: float = 0.0
    depression_deg: float = 90.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise ValueError(f"{name} is {value}: it must be finite")
        if self.height_m <= 0:
            raise ValueError(f"height_m is {self.height_m:g}: it must be above 0")
        if not 0 <= self.depression_deg <= 90:
            raise ValueError(f"depression_deg is {self.depression_deg:g}: it must be 0 to 90")


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
        forward, site = _forward_m(gates), np.asarray(site_m, np.float64)
        places = [site + s * ahead + gate.height_m * _UP for s, gate in zip(forward, gates, strict=True)]
        velocities = [gate.forward_m_s * ahead - gate.down_m_s * _UP for gate in gates]
        times_ns = [round(gate.t_s * 1e9) for gate in gates]
        self._path = Keyframes(times_ns, [Pose(place, STILL.q_world_from_body) for place in places], velocities)
        self._ahead, self._depression_rad = ahead, _depression(gates)
        self._depression_rate = self._depression_rad.derivative()
        self._turn_rad_s = measured_bounds(self.pose, instants_between(np.array(times_ns, np.int64)))[1]
        self._require_above(float(site[2]))

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`; after the last gate it stays there."""
        first, last = self.span_ns
        depression = float(self._depression_rad(min(max(t_ns, first), last) * 1e-9))
        return Pose(self._path.pose(t_ns).position_m, _attitude(self._ahead, depression))

    def motion(self, t_ns: int) -> Motion:
        """Return the motion; it turns about the camera's x axis, backwards as the depression grows."""
        first, last = self.span_ns
        rate = float(self._depression_rate(t_ns * 1e-9)) if first <= t_ns < last else 0.0
        path = self._path.motion(t_ns)
        return Motion(path.velocity_m_s, path.acceleration_m_s2, np.array([-rate, 0.0, 0.0]))

    @property
    def span_ns(self) -> tuple[int, int]:
        """Time of the first gate and of the last."""
        return self._path.span_ns

    @property
    def speed_bound_m_s(self) -> float:
        """Measured, see `measured`."""
        return self._path.speed_bound_m_s

    @property
    def turn_bound_rad_s(self) -> float:
        """Measured, see `measured`."""
        return self._turn_rad_s

    def _require_above(self, ground_m: float) -> None:
        first, last = self.span_ns
        for t_ns in np.linspace(first, last, 1000).astype(np.int64):
            if self.pose(int(t_ns)).position_m[2] <= ground_m:
                raise TrajectoryError(
                    f"the descent goes through the ground at {t_ns * 1e-9:.1f} s: "
                    "between two gates the speeds need more height than there is"
                )


def _forward_m(gates: Sequence[Gate]) -> list[float]:
    """Return the distances along the heading, the last gate's being 0."""
    steps = [(b.t_s - a.t_s) * (a.forward_m_s + b.forward_m_s) / 2 for a, b in itertools.pairwise(gates)]
    return [-sum(steps[k:]) for k in range(len(gates))]


def _depression(gates: Sequence[Gate]) -> PPoly:
    """Return the boresight's depression, rad, as a function of seconds; between gates it stays between theirs."""
    from scipy.interpolate import (  # loaded where it is used: it takes longer than the rest of a short run's imports
        PchipInterpolator,
        PPoly,
    )

    radians = [math.radians(gate.depression_deg) for gate in gates]
    if len(gates) == 1:
        return PPoly([radians], [0.0, 1.0])
    return PchipInterpolator([gate.t_s for gate in gates], radians)


def _attitude(ahead: Vector, depression_rad: float) -> Quaternion:
    """Return world_from_camera: the picture's up turns with the boresight, from the zenith to straight ahead."""
    c, s = math.cos(depression_rad), math.sin(depression_rad)
    return quaternion_of(looking_along(c * ahead - s * _UP, s * ahead + c * _UP))

"""Trajectories made of others: places of one with attitudes of another, and a camera mounted on what moves."""

from __future__ import annotations

from emulator.geometry.attitude import Quaternion, matrix_of, multiply
from emulator.trajectory.motion import Motion
from emulator.trajectory.pose import Pose, Trajectory

__all__ = ["Mounted", "PlaceAndAttitude"]


class PlaceAndAttitude(Trajectory):
    """The places of one trajectory with the attitudes of another, each at its own times.

    Parameters
    ----------
    places, attitudes : the two.
    places_zero_ns, attitudes_zero_ns : the time on each that is time 0 here.
    """

    def __init__(
        self, places: Trajectory, attitudes: Trajectory, places_zero_ns: int = 0, attitudes_zero_ns: int = 0
    ) -> None:
        self._places, self._attitudes = places, attitudes
        self._places_zero_ns, self._attitudes_zero_ns = places_zero_ns, attitudes_zero_ns

    def pose(self, t_ns: int) -> Pose:
        """Return the place of one and the attitude of the other at `t_ns`."""
        attitude = self._attitudes.pose(t_ns + self._attitudes_zero_ns).q_world_from_body
        return Pose(self._places.pose(t_ns + self._places_zero_ns).position_m, attitude)

    def motion(self, t_ns: int) -> Motion:
        """Return how the place of one moves and the attitude of the other turns."""
        place = self._places.motion(t_ns + self._places_zero_ns)
        turn = self._attitudes.motion(t_ns + self._attitudes_zero_ns).turn_rad_s
        return Motion(place.velocity_m_s, place.acceleration_m_s2, turn)

    @property
    def speed_bound_m_s(self) -> float:
        """That of the places."""
        return self._places.speed_bound_m_s

    @property
    def turn_bound_rad_s(self) -> float:
        """That of the attitudes."""
        return self._attitudes.turn_bound_rad_s


class Mounted(Trajectory):
    """Something at the place of `path`, turned against its axes by the fixed `q_path_from_body`."""

    def __init__(self, path: Trajectory, q_path_from_body: Quaternion) -> None:
        self._path, self._q = path, q_path_from_body

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        pose = self._path.pose(t_ns)
        return Pose(pose.position_m, multiply(pose.q_world_from_body, self._q))

    def motion(self, t_ns: int) -> Motion:
        """Return the path's motion, its turning along the axes of what is mounted."""
        path = self._path.motion(t_ns)
        return Motion(path.velocity_m_s, path.acceleration_m_s2, matrix_of(self._q).T @ path.turn_rad_s)

    @property
    def speed_bound_m_s(self) -> float:
        """That of the path."""
        return self._path.speed_bound_m_s

    @property
    def turn_bound_rad_s(self) -> float:
        """That of the path."""
        return self._path.turn_bound_rad_s

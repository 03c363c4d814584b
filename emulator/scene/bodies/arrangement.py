"""Where bodies are at every instant, and what is known beforehand of how near they come and how fast they seem to go.

A body goes along its path in the world, or in the frame of an earlier one that it is fixed to. Ranges are looked at
beforehand, about once a second of the first minute.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Vector
from emulator.trajectory.pose import Pose, Trajectory
from emulator.trajectory.timescale import Timescale

__all__ = ["Arrangement", "Placed", "middle"]

_LOOKS = 64
_LOOK_S = 60.0


@dataclass(frozen=True, eq=False)
class Placed:
    """A body's path, which of the bodies it is fixed to (None: the world), and how far it reaches from its origin."""

    path: Trajectory
    parent: int | None
    radius_m: float


class Arrangement:
    """A camera and the bodies before it.

    Attributes
    ----------
    ranges_m : (bodies,), each body's closest range to the camera, from origin to origin.
    """

    def __init__(self, camera: Trajectory, bodies: Sequence[Placed], time: Timescale) -> None:
        self._camera, self._bodies = camera, bodies
        times = [time.scene_ns(round(k * _LOOK_S / _LOOKS * 1e9)) for k in range(_LOOKS)]
        own = [[body.path.pose(t) for body in bodies] for t in times]
        self._looks = [self._in_world(poses) for poses in own]
        self._eyes = np.array([camera.pose(t).position_m for t in times])
        self.ranges_m = _norms(_places(self._looks) - self._eyes[:, None]).min(axis=0)
        self._offsets_m = _norms(_places(own)).max(axis=0)

    def poses(self, scene_ns: int) -> list[Pose]:
        """Return each body's pose in the world."""
        return self._in_world([body.path.pose(scene_ns) for body in self._bodies])

    def poses_of(self, which: Collection[int]) -> Callable[[int], Mapping[int, Pose]]:
        """Return what gives the poses in the world of some bodies, by number, at a scene time in ns."""
        asked = sorted({j for k in which for j in self._ancestry(k)})

        def poses(scene_ns: int) -> Mapping[int, Pose]:
            found: dict[int, Pose] = {}
            for k in asked:
                body = self._bodies[k]
                own = body.path.pose(scene_ns)
                found[k] = own if body.parent is None else found[body.parent].after(own)
            return found

        return poses

    @property
    def distance_m(self) -> float:
        """The closest range of any body, less its radius."""
        return max(float(np.min(self.ranges_m - [body.radius_m for body in self._bodies])), 1e-3)

    def nearest_m(self, k: int, low: Vector, high: Vector) -> float:
        """Return how near the camera comes to a box in the frame of body k, between two of its corners, m."""
        poses = [look[k] for look in self._looks]
        own = [(eye - p.position_m) @ p.world_from_body for eye, p in zip(self._eyes, poses, strict=True)]
        beside = np.maximum(np.maximum(low - own, own - high), 0.0)
        return float(_norms(beside).min())

    @property
    def turn_bound_rad_s(self) -> float:
        """No point of a body is seen to change its direction faster, at the closest ranges."""
        return self._camera.turn_bound_rad_s + max(
            (self._camera.speed_bound_m_s + self._speed_bound_m_s(k)) / self._room_m(k)
            for k in range(len(self._bodies))
        )

    def radius_m(self, which: Sequence[int]) -> float:
        """Return the radius of a sphere about the middle of some bodies and around them all, at all looks."""
        return max(
            max(float(np.linalg.norm(pose.position_m - centre)) + radius_m for pose, radius_m in spheres)
            for spheres in ([(poses[k], self._bodies[k].radius_m) for k in which] for poses in self._looks)
            for centre in [middle(spheres)]
        )

    def _in_world(self, own: Sequence[Pose]) -> list[Pose]:
        """Return poses in the world, of poses each in the frame that the body is fixed to."""
        poses: list[Pose] = []
        for body, pose in zip(self._bodies, own, strict=True):
            poses.append(pose if body.parent is None else poses[body.parent].after(pose))
        return poses

    def _room_m(self, k: int) -> float:
        radius_m = self._bodies[k].radius_m
        return max(float(self.ranges_m[k]) - radius_m, 0.01 * radius_m)

    def _speed_bound_m_s(self, k: int) -> float:
        """Return a bound of the speeds of a body's points: each frame it stands in goes, and swings it around."""
        speed, arm_m = 0.0, self._bodies[k].radius_m
        for j in self._ancestry(k):
            path = self._bodies[j].path
            speed += path.speed_bound_m_s + path.turn_bound_rad_s * arm_m
            arm_m += float(self._offsets_m[j])
        return speed

    def _ancestry(self, k: int | None) -> Iterator[int]:
        """Yield a body and those that it is fixed to, one after another."""
        while k is not None:
            yield k
            k = self._bodies[k].parent


def middle(spheres: Sequence[tuple[Pose, float]]) -> Vector:
    """Return the middle of the box around spheres, each a pose and a radius in metres."""
    low = np.min([pose.position_m - radius for pose, radius in spheres], axis=0)
    high = np.max([pose.position_m + radius for pose, radius in spheres], axis=0)
    return np.asarray((low + high) / 2)


def _places(looks: Sequence[Sequence[Pose]]) -> npt.NDArray[np.float64]:
    """Return positions, (looks, bodies, 3)."""
    return np.array([[pose.position_m for pose in poses] for poses in looks])


def _norms(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(np.linalg.norm(vectors, axis=-1))

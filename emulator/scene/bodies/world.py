"""The bodies of a scene and its camera: shapes, paths, ranges and bounds of motion, computed before anything is drawn.

A body moves along its path in the world, or in the frame of an earlier one that it is fixed to. Ranges and apparent
speeds are sampled in advance over the whole of all paths, so detail depends on neither the time nor a run's length.

Bodies that never move against each other form a rigid group: they cast shadows on each other as one body, from one tree
of triangles. A body belongs to the group of the body that it is fixed to where its own path stands still; bodies that
stand still in the world are one group too. A group's frame is that of its first body.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from emulator.geometry.camera import Pinhole
from emulator.light import SceneError
from emulator.scene.bodies.grain import Octaves
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.models import load_bodies
from emulator.scene.bodies.regolith import cloud_grain, coarser, detailed, facet_size_m, grain_of
from emulator.scene.bodies.table import BodiesParameters, BodyTable, Clouds, Regolith
from emulator.trajectory.building import build_trajectories, build_trajectory
from emulator.trajectory.live import close_receivers, live_counts
from emulator.trajectory.parameters import FixedPath
from emulator.trajectory.pose import STILL, Pose, Timescale, Trajectory, TrajectoryError, instants_over
from firmware_protocol.events import Float32s, Floats

log = logging.getLogger(__name__)

_LOOKS = 64  # of each path


@dataclass(frozen=True, eq=False)
class PlacedBody:
    """A body's path, the number of the body that it is fixed to (None: the world), and its radius about its origin."""

    path: Trajectory
    parent: int | None
    radius_m: float


class Arrangement:
    """A camera and the bodies before it.

    `ranges_m`, (bodies,), is the closest range of each, from origin to origin, `median_ranges_m` that while it moves.
    """

    def __init__(self, camera: Trajectory, bodies: Sequence[PlacedBody], time: Timescale) -> None:
        self._camera, self._bodies = camera, bodies
        times = instants_over([camera, *(body.path for body in bodies)], time.scene_ns(0), _LOOKS)
        relative = [{k: body.path.pose(t) for k, body in enumerate(bodies)} for t in times]
        self._looks = [self._in_world(poses) for poses in relative]
        self._eyes = np.array([camera.pose(t).position_m for t in times])
        ranges_m = np.linalg.norm(_places(self._looks) - self._eyes[:, None], axis=-1)
        self._under_way = slice(int(np.searchsorted(times[1:], camera.span_ns[1], "right")) or None)
        self.ranges_m, self.median_ranges_m = ranges_m.min(axis=0), np.median(ranges_m[self._under_way], axis=0)
        self._offsets_m = np.linalg.norm(_places(relative), axis=-1).max(axis=0)

    def poses_of(self, bodies: Collection[int]) -> Callable[[int], Mapping[int, Pose]]:
        """Return a function from scene time in ns to the poses of some bodies in the world, by number."""
        numbers = sorted({j for k in bodies for j in self._ancestry(k)})
        return lambda scene_ns: self._in_world({k: self._bodies[k].path.pose(scene_ns) for k in numbers})

    def median_distance_m(self, k: int, vertices: Floats) -> float:
        """Return the median distance of the camera, while it moves, from the box around the vertices of body k, m."""
        poses = [look[k] for look in self._looks]
        eyes = [(eye - p.position_m) @ p.world_from_body for eye, p in zip(self._eyes, poses, strict=True)]
        beside = np.maximum(np.maximum(vertices.min(axis=0) - eyes, eyes - vertices.max(axis=0)), 0.0)
        return float(np.median(np.linalg.norm(beside, axis=-1)[self._under_way]))

    @property
    def turn_bound_rad_s(self) -> float:
        """Upper bound of the angular speed of all points of bodies as seen from the camera, at the closest ranges."""
        return self._camera.bounds.turn_rad_s + max(
            (self._camera.bounds.speed_m_s + self._speed_bound_m_s(k))
            / max(float(range_m) - body.radius_m, 0.01 * body.radius_m)
            for k, (range_m, body) in enumerate(zip(self.ranges_m, self._bodies, strict=True))
        )

    def _in_world(self, relative: Mapping[int, Pose]) -> dict[int, Pose]:
        """Return poses in the world, of poses each in the frame that the body is fixed to, by ascending number."""
        poses: dict[int, Pose] = {}
        for k, pose in relative.items():
            parent = self._bodies[k].parent
            poses[k] = pose if parent is None else poses[parent].after(pose)
        return poses

    def _speed_bound_m_s(self, k: int) -> float:
        """Return a bound of the speeds of a body's points: the speeds and rotations of all its frames are added."""
        speed, arm_m = 0.0, self._bodies[k].radius_m
        for j in self._ancestry(k):
            path = self._bodies[j].path
            speed += path.bounds.speed_m_s + path.bounds.turn_rad_s * arm_m
            arm_m += float(self._offsets_m[j])
        return speed

    def _ancestry(self, k: int | None) -> Iterator[int]:
        """Yield a body and the chain of bodies that it is fixed to."""
        while k is not None:
            yield k
            k = self._bodies[k].parent


def _places(looks: Sequence[Mapping[int, Pose]]) -> Floats:
    """Return positions, (looks, bodies, 3)."""
    return np.array([[pose.position_m for pose in poses.values()] for poses in looks])


class BodyWorld:
    """The bodies of `parameters` before `pinhole`, as every renderer needs them.

    Raises SceneError where a shape or a path cannot be used, the camera begins inside a body, or nothing is large
    enough to be seen.

    Attributes
    ----------
    parameters : with a body for each node of a model file.
    time : stream time to scene time.
    camera : the camera's path.
    meshes : the shape of each body, with its detail.
    grain : the octaves of its ground; None: it has no grain.
    inside : watch for light frames that are drawn from inside a body.
    paths : of each body.
    arrangement : poses and ranges.
    distance_m : the closest range of any body, less its radius.
    motion_bound_px_s : from the paths' speeds and turns, at the closest ranges.
    """

    def __init__(self, parameters: BodiesParameters, pinhole: Pinhole) -> None:
        self.parameters, self.meshes, self._notes = load_bodies(parameters)
        parameters, self.pinhole = self.parameters, pinhole
        self.time = Timescale(parameters.time_scale)
        try:
            self.camera, *self.paths = build_trajectories([parameters.camera, *(b.path for b in parameters.bodies)])
        except (TrajectoryError, OSError) as error:
            raise SceneError(f"scene: {error}") from error
        names, radii_m = [body.name for body in parameters.bodies], [mesh.radius_m for mesh in self.meshes]
        parents = [names.index(body.fixed_to) if body.fixed_to else None for body in parameters.bodies]
        placed = [PlacedBody(*of_body) for of_body in zip(self.paths, parents, radii_m, strict=True)]
        self.arrangement = Arrangement(self.camera, placed, self.time)
        self.distance_m = max(float(np.min(self.arrangement.ranges_m - radii_m)), 1e-3)
        in_a_corner = 1 + math.tan(pinhole.widest_rad) ** 2
        self.motion_bound_px_s = pinhole.focal_px * in_a_corner * self.arrangement.turn_bound_rad_s * self.time.factor
        self.grain: list[Octaves | None] = []
        for k, body in enumerate(parameters.bodies):
            mesh, pixel_m = self.meshes[k], self.metres_a_pixel(k)
            self.meshes[k] = detailed(mesh, body.detail, pixel_m)
            match body.detail:
                case Regolith():
                    self.grain.append(grain_of(mesh, body.detail, pixel_m))
                case Clouds():
                    self.grain.append(cloud_grain(self.meshes[k], body.detail, pixel_m))
                case _:
                    self.grain.append(None)
        self._as_seen: dict[int, Mesh] = {}
        self._require_visible()
        self.inside = InsideWatch(self)

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of poses received from outside, and of light frames from inside a body."""
        return live_counts(self.camera, *self.paths) | self.inside.counts

    def notes(self, first_frame: Float32s) -> tuple[str, ...]:
        """Return remarks on faults of the shapes, on detail that was left out, and on a black first frame."""
        black = () if first_frame.any() else ("the first light frame is black: the camera sees no sunlit side",)
        return (*self._notes, *black)

    def as_seen(self, k: int) -> Mesh:
        """Return the shape of body k with as much detail as is visible at its closest range."""
        if k not in self._as_seen:
            mesh, cell_m = self.meshes[k], self.parameters.detail_px * self.metres_a_pixel(k)
            seen = mesh if facet_size_m(mesh) > cell_m else coarser(mesh, cell_m)
            if seen is not mesh:
                name, facets = self.parameters.bodies[k].shape, f"{len(seen.faces)} of {len(mesh.faces)} facets"
                self._notes.append(f"{name}: {facets}: the others are too small to be seen")
            self._as_seen[k] = seen
        return self._as_seen[k]

    def metres_a_pixel(self, k: int, ranges_m: Floats | None = None) -> float:
        """Return the width of a pixel on body k at its closest range, m, or at others, (bodies,)."""
        range_m = float((self.arrangement.ranges_m if ranges_m is None else ranges_m)[k])
        return max(range_m - self.meshes[k].radius_m, 1e-6) / self.pinhole.focal_px

    def close(self) -> None:
        """Close the ports of live poses; a second call does nothing."""
        close_receivers(self.camera, *self.paths)

    def _require_visible(self) -> None:
        for body, mesh, range_m in zip(self.parameters.bodies, self.meshes, self.arrangement.ranges_m, strict=True):
            core_m = float(np.linalg.norm(mesh.vertices, axis=1).min())
            if range_m <= core_m:
                raise SceneError(
                    f"the camera comes within {range_m:g} m of the middle of {body.shape}, whose surface is at least "
                    f"{core_m:g} m from it: it would be inside. Move it out, or look at units_m"
                )
        shares = 2 * np.array([mesh.radius_m for mesh in self.meshes]) / self.arrangement.ranges_m
        across_px = float(shares.max()) * self.pinhole.focal_px
        if across_px < 2:
            raise SceneError(
                f"the largest body is {across_px:.2g} px across at its closest and would be lost "
                "between samples: go nearer, take a longer lens, or look at units_m"
            )


class InsideWatch:
    """Watch for a camera inside a body, where paths are not known before: a warning at the first time, and counts."""

    def __init__(self, world: BodyWorld) -> None:
        self._world, self._t_ns = world, -1
        self.counts = Counter[str]()
        self._groups = rigid_groups(world.parameters.bodies)
        self._last: dict[int, tuple[Floats, float, bool]] = {}  # of each body: place, way to its surface, inside it

    def look(self, t_ns: int, camera: Pose, firsts: Mapping[int, Pose]) -> None:
        """Look at the light frame of `t_ns`; `firsts` are the poses of the groups' first bodies, by number."""
        if t_ns == self._t_ns:
            return
        self._t_ns = t_ns
        for group in self._groups:
            first = firsts[group.members[0]]
            for k, pose in group.placed:
                in_group_m = (camera.position_m - first.position_m) @ first.world_from_body - pose.position_m
                if in_group_m @ in_group_m < self._world.meshes[k].radius_m ** 2:
                    self._look_at(k, in_group_m @ pose.world_from_body, camera)

    def _look_at(self, k: int, place_m: Floats, camera: Pose) -> None:
        """Look from a place in the frame of body k, near it; on the way to the surface nothing changes."""
        looked_m, way_m, is_inside = self._last.get(k, (place_m, 0.0, False))
        if float(np.linalg.norm(place_m - looked_m)) >= way_m:
            is_inside, way_m = enclosure(self._world.as_seen(k), place_m)
            self._last[k] = place_m, way_m, is_inside
        if not is_inside:
            return
        name = self._world.parameters.bodies[k].name or self._world.parameters.bodies[k].shape
        self.counts[count := f"light frames from inside {name}"] += 1
        if self.counts[count] == 1:
            place = ", ".join(f"{x:.6g}" for x in camera.position_m)
            at = f"at {self._t_ns * 1e-9:.6g} s the camera is inside the body {name}: it is at ({place}) m"
            middle_m = float(np.linalg.norm(place_m))
            log.warning("%s, %.4g m from its middle; give poses outside, or look at units_m", at, middle_m)


def enclosure(mesh: Mesh, place_m: Floats) -> tuple[bool, float]:
    """Return whether a mesh encloses a place in its frame, and a distance that its surface keeps at least, m.

    The sum of the facets' solid angles is 4 pi inside a closed surface, and 0 outside (van Oosterom and Strackee, IEEE
    Transactions on Biomedical Engineering 30, 1983); of an open one more than half of it counts as inside.
    """
    corners = mesh.vertices[mesh.faces] - place_m
    a, b, c = corners.transpose(1, 0, 2)
    la, lb, lc = np.linalg.norm(corners, axis=2).T
    volume = (a * np.cross(b, c)).sum(axis=1)
    spread = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    middles = corners.mean(axis=1, keepdims=True)
    reach_m = np.linalg.norm(corners - middles, axis=2).max(axis=1)
    way_m = float((np.linalg.norm(middles, axis=2)[:, 0] - reach_m).min())
    return abs(float(np.arctan2(volume, spread).sum())) > math.pi, way_m


@dataclass(frozen=True, eq=False)
class RigidGroup:
    """Bodies, by ascending number, and the pose of each in the frame of the first."""

    members: tuple[int, ...]
    poses: tuple[Pose, ...]

    @property
    def placed(self) -> tuple[tuple[int, Pose], ...]:
        """Each body's number with its pose."""
        return tuple(zip(self.members, self.poses, strict=True))


def rigid_groups(bodies: Sequence[BodyTable]) -> list[RigidGroup]:
    """Return the groups; each body is in one."""
    names = [body.name for body in bodies]
    anchors: list[int] = []  # of each body, the moving one that it stands on; -1: the world
    poses: list[Pose] = []  # of each body in the frame of its anchor
    members: dict[int, list[int]] = {}  # of each anchor
    for k, body in enumerate(bodies):
        anchor, pose = k, STILL
        if isinstance(body.path, FixedPath):
            anchor, pose = -1, build_trajectory(body.path).pose(0)
            if body.fixed_to:
                parent = names.index(body.fixed_to)
                anchor, pose = anchors[parent], poses[parent].after(pose)
        anchors.append(anchor)
        poses.append(pose)
        members.setdefault(anchor, []).append(k)
    firsts = [(ks, poses[ks[0]].inverse()) for ks in members.values()]
    return [RigidGroup(tuple(ks), tuple(first.after(poses[k]) for k in ks)) for ks, first in firsts]

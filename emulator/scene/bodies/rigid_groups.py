"""Bodies that never move against each other: they throw shadows on each other as one, from one tree of triangles.

A body belongs to the group of the one that it is fixed to where its own path stands still; bodies that stand still in
the world are one group too. A group's frame is that of its first body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from emulator.scene.bodies.table import BodyTable
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.parameters import FixedPath
from emulator.trajectory.pose import STILL, Pose

__all__ = ["RigidGroup", "rigid_groups"]


@dataclass(frozen=True, eq=False)
class RigidGroup:
    """Bodies, by number, and where each is in the frame of the first.

    Attributes
    ----------
    members : numbers of the bodies, ascending.
    poses : of each member, in the frame of the first.
    """

    members: tuple[int, ...]
    poses: tuple[Pose, ...]


def rigid_groups(bodies: Sequence[BodyTable]) -> list[RigidGroup]:
    """Return the groups; each body is in one."""
    anchors: list[tuple[int, Pose]] = []  # of each body, the moving one it stands on (-1: the world), its pose there
    for k, body in enumerate(bodies):
        anchors.append(_anchor(k, body, bodies, anchors))
    numbers = [anchor for anchor, _ in anchors]
    return [_group([k for k, n in enumerate(numbers) if n == one], anchors) for one in dict.fromkeys(numbers)]


def _anchor(
    k: int, body: BodyTable, bodies: Sequence[BodyTable], anchors: Sequence[tuple[int, Pose]]
) -> tuple[int, Pose]:
    if not isinstance(body.path, FixedPath):
        return k, STILL
    pose = build_trajectory(body.path).pose(0)
    if not body.fixed_to:
        return -1, pose
    names = [other.name for other in bodies]
    anchor, parent = anchors[names.index(body.fixed_to)]
    return anchor, parent.after(pose)


def _group(members: Sequence[int], anchors: Sequence[tuple[int, Pose]]) -> RigidGroup:
    first = anchors[members[0]][1].inverse()
    return RigidGroup(tuple(members), tuple(first.after(anchors[k][1]) for k in members))

"""The shadows that flat-shaded bodies of a rigid group throw on themselves and on each other, as polygons.

Each body's light is computed without them; a polygon is drawn a little nearer to the camera than the facet under it,
with the light that the facet has without the Sun (`shadow_polygons`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.lit_surface import Surface
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.rigid_groups import rigid_groups
from emulator.scene.bodies.shadow_polygons import Receivers, Room, blank_memories, blank_room, cast_polygons
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.bodies.triangle_tree import TriangleTree
from emulator.threads import Crew
from emulator.trajectory.pose import Pose

__all__ = ["Polygons", "SharpShadows", "Surroundings", "receivers_of", "with_narrow_penumbras"]

_FIRST_ROWS = 1024
_FIRST_SHADOWS = 256  # on one facet
_FACETS_A_PART, _MOST_PARTS = 300, 4  # of one body; a part takes 15 us to begin

Floats = npt.NDArray[np.float64]
Surroundings = tuple[Floats, Floats, Floats]
"""The Sun's unit direction, its rate and the camera's place, (3,) each, in the frame of a group."""


@dataclass(frozen=True, eq=False)
class Polygons:
    """Shadows on the bodies of a group, cut into triangles, in the frame of the group's first body.

    Attributes
    ----------
    body : number of the group's first body.
    corners : (n, 6), their places and velocities, m and m a second of stream time.
    radiance, rate : (n,), W m-2 sr-1 and that a second, following the corner.
    faces : (m, 3) int32, corners of each triangle, counter-clockwise as seen from outside; none overlaps another.
    over : (m,) int32, the facet below each triangle: facets of all bodies' surfaces are numbered one after another.
    """

    body: int
    corners: Floats
    radiance: Floats
    rate: Floats
    faces: npt.NDArray[np.int32]
    over: npt.NDArray[np.int32]

    @property
    def places_m(self) -> Floats:
        """Of the corners, (n, 3)."""
        return self.corners[:, :3]

    @property
    def velocities_m_s(self) -> Floats:
        """Of the corners, (n, 3)."""
        return self.corners[:, 3:]


def with_narrow_penumbras(parameters: BodiesParameters, meshes: Sequence[Mesh], widest_m: float) -> frozenset[int]:
    """Return the flat-shaded bodies in whose group a penumbra is at most so wide, half the group behind its edge."""
    found: set[int] = set()
    for group in rigid_groups(parameters.bodies):
        members = zip(group.members, group.poses, strict=True)
        points = np.concatenate([meshes[k].vertices @ pose.world_from_body.T + pose.position_m for k, pose in members])
        half_m = float(np.linalg.norm(np.ptp(points, axis=0))) / 2
        if 2 * math.tan(parameters.sun.radius_rad) * half_m <= widest_m:
            found.update(k for k in group.members if not parameters.bodies[k].smooth)
    return frozenset(found)


def receivers_of(surface: Surface, pose: Pose, first_facet: int = 0) -> Receivers:
    """Return the facets of a flat-shaded surface that have an area, in the frame in which the surface has the pose.

    Parameters
    ----------
    first_facet : its number among those of all bodies.
    """
    corners = (surface.vertices @ pose.world_from_body.T + pose.position_m)[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    kept = length > 1e-9 * longest**2
    corners, normals = corners[kept], normals[kept] / length[kept, None]
    offsets = (normals * corners.mean(axis=1)).sum(axis=1)
    planes = np.column_stack([normals, offsets])
    numbers = (first_facet + np.flatnonzero(kept)).astype(np.int32)
    return np.ascontiguousarray(corners.reshape(-1, 9)), planes, np.ascontiguousarray(surface.shades[kept]), numbers


class SharpShadows:
    """The shadows on some bodies of one group. Not for several threads at once.

    Parameters
    ----------
    tree : what throws shadows, in the frame of the group.
    receivers : facets of each body that gets them, see `receivers_of`.
    near_m : what reaches less high above a facet's plane throws none on it.
    crew : threads that share the facets; the shadows are the same to the last bit.
    """

    def __init__(
        self, body: int, tree: TriangleTree, receivers: Sequence[Receivers], near_m: float, crew: Crew | None = None
    ) -> None:
        self._body, self._tree, self._near_m, self._crew = body, tree, near_m, crew or Crew(1)
        self._shares = [_Share(k, part) for k, all_of in enumerate(receivers) for part in _parts(all_of)]
        self._rooms = [blank_room(_FIRST_SHADOWS) for _ in range(self._crew.threads)]

    def cast(self, darks: Sequence[tuple[Floats, Floats]], around: Surroundings) -> Polygons:
        """Return the shadows; `darks` has the light of each body's points without the Sun, and its rate."""

        def work(k: int, thread: int) -> None:
            share = self._shares[k]
            while not share.cast(self._tree, darks[share.body], around, self._near_m, self._rooms[thread]):
                if share.shadows > len(self._rooms[thread][1]):
                    self._rooms[thread] = blank_room(2 * share.shadows)

        self._crew.each(work, len(self._shares))
        rows = np.cumsum([0, *(share.rows for share in self._shares)])
        parts = [share.found for share in self._shares]
        places, glow = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        faces = np.concatenate([part[2] + np.int32(row) for part, row in zip(parts, rows, strict=False)])
        over = np.concatenate([part[3] for part in parts])
        return Polygons(self._body, places, glow[:, 0], glow[:, 1], faces, over)


class _Share:
    """Some facets of one body, and the shadows on them."""

    def __init__(self, body: int, receivers: Receivers) -> None:
        self.body, self._receivers = body, receivers
        self._memory = blank_memories(len(receivers[0]))
        self.rows = self._count = self.shadows = 0
        self._make_room(_FIRST_ROWS)

    @property
    def found(self) -> tuple[Floats, Floats, npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """The shadows' corners, their light, triangles, and the facets below."""
        return self._places[: self.rows], self._glow[: self.rows], self._faces[: self._count], self._over[: self._count]

    def cast(
        self, tree: TriangleTree, dark: tuple[Floats, Floats], around: Surroundings, near_m: float, room: Room
    ) -> bool:
        """Find the shadows; tell whether there was room for all of them."""
        out = self._places, self._glow, self._faces, self._over
        self.rows, self._count, self.shadows = cast_polygons(
            tree.arrays, self._receivers, dark, around, near_m, self._memory, room, out, (0, 0)
        )
        wanted, there = max(self.rows, self._count), len(self._places)
        if wanted > there:
            self._make_room(2 * wanted)
        return wanted <= there and self.shadows <= len(room[1])

    def _make_room(self, rows: int) -> None:
        self._places, self._glow = np.zeros((rows, 6)), np.zeros((rows, 2))
        self._faces, self._over = np.zeros((rows, 3), np.int32), np.zeros(rows, np.int32)


def _parts(receivers: Receivers) -> Iterator[Receivers]:
    """Yield the facets in parts of one after another, each work for one thread."""
    corners, planes, shades, numbers = receivers
    parts = min(max(len(corners) // _FACETS_A_PART, 1), _MOST_PARTS)
    for k in range(parts):
        part = slice(len(corners) * k // parts, len(corners) * (k + 1) // parts)
        yield corners[part], planes[part], shades[part], numbers[part]

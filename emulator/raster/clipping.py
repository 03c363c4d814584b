"""Facets that reach behind the camera, cut at the nearest depth.

A cut facet becomes one or two facets with corners of their own on the plane. Along its sides the new corners move with
the material, which leaves the motion of these sides across themselves as it is. New facets have no neighbours: their
sides are added to the sums one by one.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.raster.layout import Floats, Ints
from emulator.raster.topology import Topology
from emulator.raster.view import View

__all__ = ["clip"]


def clip(topology: Topology, view: View, nearest_m: float) -> tuple[Topology, View]:
    """Return topology and view with the visible parts of facets that `nearest_m` cuts at the end."""
    ahead = view.positions_m[: topology.vertices, 2] >= nearest_m
    inside = ahead[topology.faces]
    count = inside.sum(axis=1)
    one, two = np.flatnonzero(count == 1), np.flatnonzero(count == 2)
    if not len(one) and not len(two):
        return topology, view
    turn_one, turn_two = inside[one].argmax(axis=1), ((~inside[two]).argmax(axis=1) + 1) % 3
    vertices = _Corners(topology.vertices, np.hstack([view.positions_m, view.velocities_m_s]))
    entries = _Corners(topology.entries, np.column_stack([view.radiance, view.radiance_rate]))
    depth = view.positions_m[:, 2]
    faces: list[list[Ints]] = []
    shades: list[list[Ints]] = []
    for table, corners, out in ((topology.faces, vertices, faces), (topology.shades, entries, shades)):
        a, b, c = _turned(table[one], turn_one)
        za, zb, zc = (depth[k] for k in _turned(topology.faces[one], turn_one))
        out.append([a, corners.cut(a, b, za, zb, nearest_m), corners.cut(a, c, za, zc, nearest_m)])
        a, b, c = _turned(table[two], turn_two)
        za, zb, zc = (depth[k] for k in _turned(topology.faces[two], turn_two))
        behind_b, behind_a = corners.cut(b, c, zb, zc, nearest_m), corners.cut(a, c, za, zc, nearest_m)
        out.extend([[a, b, behind_b], [a, behind_b, behind_a]])
    added = np.concatenate([one, two, two])
    places = vertices.values
    places[topology.vertices :, 2] = nearest_m  # exactly, whatever rounding left
    extended = Topology(
        _longer(topology.faces, faces),
        _longer(topology.shades, shades),
        np.concatenate([topology.across, np.full((len(added), 3), -1, np.int32)]),
        np.concatenate([topology.smooth, np.zeros((len(added), 3), np.uint8)]),
        np.concatenate([topology.two_sided, topology.two_sided[added]]),
        len(places),
        len(entries.values),
        np.concatenate([_over_whole(topology.over, added), np.full(len(added), -1, np.int32)]),
    )
    return extended, View(places[:, :3], places[:, 3:], entries.values[:, 0], entries.values[:, 1])


class _Corners:
    """Values of corners, those of cuts behind the given ones."""

    def __init__(self, count: int, values: Floats) -> None:
        self.values = values[:count]

    def cut(self, near: Ints, far: Ints, z_near: Floats, z_far: Floats, depth_m: float) -> Ints:
        """Append values where the way from corner `near` to corner `far` passes `depth_m`; return their numbers."""
        share = ((depth_m - z_near) / (z_far - z_near))[:, None]
        first = len(self.values)
        self.values = np.concatenate([self.values, self.values[near] * (1 - share) + self.values[far] * share])
        return np.arange(first, len(self.values), dtype=np.int32)


def _over_whole(over: Ints, cut: Ints) -> Ints:
    """Return the facets below patches: a patch on a facet that is cut becomes a facet of its own."""
    return np.where(np.isin(over, cut), np.int32(-1), over)


def _turned(corners: Ints, first: npt.NDArray[np.intp]) -> tuple[Ints, Ints, Ints]:
    """Return the corners, (n,) each, that of the given place first."""
    rows = np.arange(len(corners))
    return corners[rows, first], corners[rows, (first + 1) % 3], corners[rows, (first + 2) % 3]


def _longer(table: Ints, added: list[list[Ints]]) -> Ints:
    return np.concatenate([table, *(np.column_stack(corners).astype(np.int32) for corners in added)])

"""Facets of surfaces and their neighbours, prepared once for all light frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.raster.layout import Bytes, Ints


@dataclass(frozen=True, eq=False)
class Topology:
    """Facets of one or several surfaces.

    Attributes
    ----------
    faces : (m, 3) int32, vertices of each facet, counter-clockwise as seen from outside.
    shades : (m, 3) int32, for each corner the entry of the radiance arrays; `faces` itself for smooth shading.
    across : (m, 3) int32, the facet behind side k, which runs from corner k to corner k + 1; -1 for none.
    smooth : (m, 3) uint8, 1 where both facets of that side share the entries of `shades` at both ends.
    two_sided : (m,) uint8, 1 where a facet is visible from behind too.
    vertices, entries : numbers of vertices and radiances that a view must have.
    over : (m,) int32, the facet on which a patch lies; -1 for a facet of a surface, the default. A patch is a part of
        its facet with other light, slightly nearer to the camera; patches on a facet do not overlap.
    """

    faces: Ints
    shades: Ints
    across: Ints
    smooth: Bytes
    two_sided: Bytes
    vertices: int
    entries: int
    over: Ints = field(default_factory=lambda: np.zeros(0, np.int32))

    def __post_init__(self) -> None:
        if len(self.over) != len(self.faces):
            object.__setattr__(self, "over", np.full(len(self.faces), -1, np.int32))


def prepare(faces: npt.ArrayLike, *, shades: npt.ArrayLike | None = None, two_sided: bool = False) -> Topology:
    """Return the topology of facets (m, 3), with `shades` (m, 3) where radiance is not one value a vertex."""
    corners = _corners(faces)
    entries = corners if shades is None else _corners(shades)
    if entries.shape != corners.shape:
        raise ValueError(f"shades have the shape {entries.shape}, faces {corners.shape}")
    across, smooth = _neighbours(corners, entries)
    sides = np.full(len(corners), two_sided, np.uint8)
    return Topology(corners, entries, across, smooth, sides, _count(corners), _count(entries))


def join(topologies: Sequence[Topology]) -> Topology:
    """Return one topology of several surfaces, whose vertices and radiances follow each other in a view."""
    if not topologies:
        return prepare(np.zeros((0, 3), np.int32))
    vertices, entries, facets = (
        np.cumsum([0, *sizes])
        for sizes in (
            [t.vertices for t in topologies],
            [t.entries for t in topologies],
            [len(t.faces) for t in topologies],
        )
    )
    across = [np.where(t.across < 0, -1, t.across + first) for t, first in zip(topologies, facets, strict=False)]
    return Topology(
        _stack([t.faces + first for t, first in zip(topologies, vertices, strict=False)]),
        _stack([t.shades + first for t, first in zip(topologies, entries, strict=False)]),
        _stack(across),
        np.concatenate([t.smooth for t in topologies]),
        np.concatenate([t.two_sided for t in topologies]),
        int(vertices[-1]),
        int(entries[-1]),
        _stack([np.where(t.over < 0, -1, t.over + k) for t, k in zip(topologies, facets, strict=False)]),
    )


def _stack(parts: list[npt.NDArray[np.integer]]) -> Ints:
    return np.ascontiguousarray(np.concatenate(parts), np.int32)


def _corners(faces: npt.ArrayLike) -> Ints:
    corners = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
    if corners.size and corners.min() < 0:
        raise ValueError("a facet names a vertex below 0")
    return corners


def _count(corners: Ints) -> int:
    return int(corners.max()) + 1 if corners.size else 0


def _neighbours(corners: Ints, shades: Ints) -> tuple[Ints, Bytes]:
    """Return `across`, `smooth`; sides that more than two facets share, or pass in one direction, have no neighbour."""
    start, end = corners.ravel().astype(np.int64), np.roll(corners, -1, axis=1).ravel().astype(np.int64)
    base = _count(corners)
    forward, backward = start * base + end, end * base + start
    across, smooth = np.full(start.size, -1, np.int32), np.zeros(start.size, np.uint8)
    order = np.argsort(forward, kind="stable")
    place = np.searchsorted(forward[order], backward)
    matches = np.zeros(start.size, bool)
    inside = place < start.size
    matches[inside] = forward[order[place[inside]]] == backward[inside]
    _, number, times = np.unique(forward, return_inverse=True, return_counts=True)
    alone = times[number] == 1
    side = np.flatnonzero(matches & alone)
    other = order[place[side]]
    side, other = side[alone[other]], other[alone[other]]
    across[side] = other // 3
    first, last = shades.ravel(), np.roll(shades, -1, axis=1).ravel()
    smooth[side] = (first[side] == last[other]) & (last[side] == first[other])
    return across.reshape(-1, 3), smooth.reshape(-1, 3)

r"""Facets of surfaces and their neighbours, prepared once; those of a light frame, with sides cut and with patches.

A facet has three corners 0, 1, 2, two points on each side that cut it in thirds, 3 to 8, and one within, 9. The sides
that are cut, one bit each, decide its parts; the first one has the facet's own row, the others follow behind all
surfaces:

    none (0)          0-1 (1)             0-1 and 1-2 (3)         all (7)

        2                 2                      2                      2
       / \               //\\                    / \                    / \
      /   \             / | \ \                 / . 6                  7---6
     /     \           / |   | \               / .  /|\                / \ / \
    /       \         / |     | \             / .  / | 5              8---9---5
   /         \       / |       | \           /.  /  |/ \             / \ / \ / \
  0-----------1     0--3-------4--1         0---3---4---1            0---3---4---1

Both facets of a side have the same points on it, so surfaces stay closed whatever is cut. Neighbours are found by the
thirds of sides: third h of side k is part of one side of one part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.raster.layout import entry
from emulator.sensor.numerics.compiled import kernel
from firmware_protocol.events import Bytes, Int32s


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

    faces: Int32s
    shades: Int32s
    across: Int32s
    smooth: Bytes
    two_sided: Bytes
    vertices: int
    entries: int
    over: Int32s = field(default_factory=lambda: np.zeros(0, np.int32))

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
    sizes = np.array([(0, 0, 0), *((t.vertices, t.entries, len(t.faces)) for t in topologies)])
    vertices, entries, facets = sizes.cumsum(axis=0).T
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


def _stack(parts: list[npt.NDArray[np.integer]]) -> Int32s:
    return np.ascontiguousarray(np.concatenate(parts), np.int32)


def _corners(faces: npt.ArrayLike) -> Int32s:
    corners = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
    if corners.size and corners.min() < 0:
        raise ValueError("a facet names a vertex below 0")
    return corners


def _count(corners: Int32s) -> int:
    return int(corners.max()) + 1 if corners.size else 0


def _neighbours(corners: Int32s, shades: Int32s) -> tuple[Int32s, Bytes]:
    """Return `across`, `smooth`; sides that more than two facets share, or pass in one direction, have no neighbour."""
    start, end = corners.ravel().astype(np.int64), np.roll(corners, -1, axis=1).ravel().astype(np.int64)
    key = np.minimum(start, end) * _count(corners) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    differs = np.diff(key[order], prepend=-1, append=-1) != 0  # from the one before
    pair = np.flatnonzero(differs[:-2] & ~differs[1:-1] & differs[2:])  # two facets, no more
    side, other = np.concatenate([order[[pair, pair + 1]], order[[pair + 1, pair]]], axis=1)
    opposite = start[side] == end[other]
    side, other = side[opposite], other[opposite]
    across, smooth = np.full(start.size, -1, np.int32), np.zeros(start.size, np.uint8)
    across[side] = other // 3
    first, last = shades.ravel(), np.roll(shades, -1, axis=1).ravel()
    smooth[side] = (first[side] == last[other]) & (last[side] == first[other])
    return across.reshape(-1, 3), smooth.reshape(-1, 3)


Part = tuple[int, int, int]


def _turned(parts: Sequence[Part], times: int) -> tuple[Part, ...]:
    """Return parts of a facet whose corner 0 is now called `times`."""
    names = np.concatenate([np.roll([0, 1, 2], -times), np.roll(np.arange(3, 9), -2 * times), [9]])
    return tuple((int(names[a]), int(names[b]), int(names[c])) for a, b, c in parts)


_ONE = (0, 3, 2), (3, 4, 2), (4, 1, 2)
_TWO = (4, 1, 5), (3, 4, 5), (3, 5, 6), (0, 3, 6), (0, 6, 2)
_ALL = (0, 3, 8), (3, 9, 8), (3, 4, 9), (4, 5, 9), (4, 1, 5), (8, 9, 7), (9, 6, 7), (9, 5, 6), (7, 6, 2)

PARTS: dict[int, tuple[Part, ...]] = {0: ((0, 1, 2),), 7: _ALL} | {
    sum(1 << (k + times) % 3 for k in range(sides)): _turned(parts, times)
    for sides, parts in ((1, _ONE), (2, _TWO))
    for times in range(3)
}
"""Points of the parts of a facet, counter-clockwise, by its sides that are cut: 1, 2 and 4 added."""

_COUNTS = np.array([len(PARTS[cut]) for cut in range(8)])
_POINTS, _BEHIND = np.zeros((8, 9, 3), np.int64), np.full((8, 9, 3), -1)  # of the parts; the part behind each side
_THIRDS = np.zeros((8, 3, 3, 2), np.int64)  # of each third of each side: the part, and which of its sides


def _fill_tables() -> None:
    for cut, parts in PARTS.items():
        sides = {(part[s], part[(s + 1) % 3]): (number, s) for number, part in enumerate(parts) for s in range(3)}
        _POINTS[cut, : len(parts)] = parts
        for (p, q), (number, s) in sides.items():
            _BEHIND[cut, number, s] = sides.get((q, p), (-1, 0))[0]
        for k in range(3):
            ends = [k, *([3 + 2 * k, 4 + 2 * k] if cut >> k & 1 else []), (k + 1) % 3]
            _THIRDS[cut, k] = [sides[end] for end in pairwise(ends)]  # the same one for all thirds of a whole side


_fill_tables()


@entry
def list_cut(between: Int32s, marked: Bytes, cuts: Bytes, firsts: Int32s, end: int) -> int:
    """Write which sides of each facet are cut, and the row of its second part; return the row behind the last one.

    Parameters
    ----------
    between : (m, 7), the points 3 to 9 of each facet; -1 for none.
    marked : (points,), 1 for those of the sides that are to be cut, and within facets with all three cut.
    cuts, firsts : (m,).
    end : the first row.
    """
    for f in range(len(between)):
        cut = 0
        for k in range(3):
            point = between[f, 2 * k]
            if point >= 0 and marked[point]:
                cut |= 1 << k
        cuts[f], firsts[f] = cut, end
        end += _COUNTS[cut] - 1
    return end


class Rows(NamedTuple):
    """Rows of a topology that change where sides are cut; see `Topology`."""

    faces: Int32s
    shades: Int32s
    across: Int32s
    smooth: Bytes


@kernel
def _row(f: int, part: int, firsts: Int32s) -> int:
    """Return the row of a part of facet f."""
    return firsts[f] + part - 1 if part > 0 else f


@entry
def write_parts(surfaces: Rows, between: Int32s, numbers: Int32s, cuts: Bytes, firsts: Int32s, out: Rows) -> None:
    """Replace the rows of facets with sides to cut by those of their parts.

    Parameters
    ----------
    between, cuts, firsts : of `list_cut`; the points are numbered as radiances are.
    numbers : (points,), vertices of the points.
    out : begins as `surfaces` does.
    """
    for f in range(len(between)):
        cut = cuts[f]
        if cut == 0:
            continue
        for part in range(_COUNTS[cut]):
            row = _row(f, part, firsts)
            for s in range(3):
                point = _POINTS[cut, part, s]
                if point < 3:
                    out.faces[row, s] = surfaces.faces[f, point]
                    out.shades[row, s] = surfaces.shades[f, point]
                else:
                    out.faces[row, s] = numbers[between[f, point - 3]]
                    out.shades[row, s] = between[f, point - 3]
                if _BEHIND[cut, part, s] >= 0:
                    out.across[row, s] = _row(f, _BEHIND[cut, part, s], firsts)
                    out.smooth[row, s] = 1
        for k in range(3):
            g: Any = np.int64(surfaces.across[f, k])
            j = 0
            # The same side of the facet behind it: two facets may share two sides.
            while g >= 0 and not (
                surfaces.across[g, j] == f and surfaces.faces[g, j] == surfaces.faces[f, (k + 1) % 3]
            ):
                j += 1
            for h in range(3):
                part, s = _THIRDS[cut, k, h, 0], _THIRDS[cut, k, h, 1]
                row = _row(f, part, firsts)
                out.smooth[row, s] = surfaces.smooth[f, k]
                if g < 0:
                    out.across[row, s] = -1
                else:
                    behind = _row(g, _THIRDS[cuts[g], j, 2 - h, 0], firsts)
                    out.across[row, s] = behind
                    out.across[behind, _THIRDS[cuts[g], j, 2 - h, 1]] = row


class Facets:
    """Topologies of the same surfaces for one light frame after the other, in arrays that are used again.

    Parameters
    ----------
    surfaces : of all light frames.
    between : (m, 7) int32, the radiances of points 3 to 9 of each facet; -1 where a side may not be cut. Their vertices
        follow those of `surfaces`, in ascending order, those alone that are marked.
    """

    def __init__(self, surfaces: Topology, between: Int32s | None = None) -> None:
        self._surfaces = self._room = surfaces
        self._between = between
        m = len(surfaces.faces)
        self._cuts, self._firsts = np.zeros(m, np.uint8), np.full(m, m, np.int32)
        self._end, self._points = m, 0
        self._is_between = np.zeros(surfaces.entries, np.uint8)
        if between is not None:
            self._is_between[between[between >= 0]] = 1

    @property
    def shades(self) -> Int32s:
        """The radiance of each corner, (rows, 3): of the surfaces, with the parts of facets at the end."""
        return self._room.shades[: self._end]

    def parts_of(self, first: int, last: int) -> tuple[int, int]:
        """Return the rows of the parts, but the first, of facets `first` to `last` - 1: the first row and the end."""
        m = len(self._firsts)
        ends = [int(self._firsts[k]) if k < m else self._end for k in (first, last)]
        return ends[0], ends[1]

    def cut(self, marked: Bytes) -> None:
        """Cut the sides whose points are marked, (radiances,) uint8; patches are forgotten."""
        t, between = self._surfaces, self._between
        if between is None:
            return
        self._end = int(list_cut(between, marked, self._cuts, self._firsts, len(t.faces)))
        self._make_room(self._end)
        room, m = self._room, len(t.faces)
        room.faces[:m] = t.faces
        room.shades[:m] = t.shades
        room.across[:m] = t.across
        room.smooth[:m] = t.smooth
        numbers = t.vertices - np.int32(1) + np.cumsum(marked & self._is_between, dtype=np.int32)
        self._points = int(numbers[-1]) + 1 - t.vertices
        write_parts(_rows(t), between, numbers, self._cuts, self._firsts, _rows(room))
        room.over[m : self._end] = -1

    def on(self, faces: Int32s, over: Int32s) -> Topology:
        """Return the topology with patches at the end; it is valid until the next call.

        `faces`, (n, 3), are the corners of patches, numbered from 0; their vertices and radiances follow all others.
        `over`, (n,), is the facet on which each lies, a row of `shades`.
        """
        t, m, end = self._surfaces, self._end, self._end + len(faces)
        self._make_room(end)
        room, vertices = self._room, t.vertices + self._points
        np.add(faces, np.int32(vertices), out=room.faces[m:end])
        np.add(faces, np.int32(t.entries), out=room.shades[m:end])
        room.across[m:end] = -1
        room.smooth[m:end] = 0
        room.over[m:end] = over
        count = int(faces.max()) + 1 if len(faces) else 0
        return Topology(
            room.faces[:end], room.shades[:end], room.across[:end], room.smooth[:end], room.two_sided[:end],
            vertices + count, t.entries + count, room.over[:end],
        )  # fmt: skip

    def _make_room(self, rows: int) -> None:
        """Make room for so many facets; those behind the surfaces are seen from one side."""
        if rows <= len(self._room.faces):
            return
        n = 2 * rows - len(self._room.faces)
        corners, smooth = np.zeros((n, 3), np.int32), np.zeros((n, 3), np.uint8)
        self._room = join([self._room, Topology(corners, corners, corners - 1, smooth, np.zeros(n, np.uint8), 0, 0)])


def _rows(t: Topology) -> Rows:
    return Rows(t.faces, t.shades, t.across, t.smooth)

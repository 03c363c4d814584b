r"""The facets of a light frame: those of the surfaces, some with sides cut in the middle, and patches on them.

A facet has three corners 0, 1, 2, and points 3, 4, 5 in the middle of its sides. The sides that are cut, one bit each,
decide its parts; the first one has the facet's own row, the others follow behind all surfaces:

    none (0)            0-1 (1)              0-1 and 1-2 (3)        all (7)

         2                   2                    2                      2
        / \                 /|\                  /|\                    / \
       /   \               / | \                / | 4                  5---4
      /     \             /  |  \              /  |/ \                / \ / \
     0-------1           0---3---1            0---3---1              0---3---1

Both facets of a side have the same point in its middle, so surfaces stay closed whatever is cut. Neighbours are found
by the halves of sides: half h of side k is part of one side of one part.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.raster.compiled import entry
from emulator.raster.layout import Bytes, Ints
from emulator.raster.topology import Topology

_Longs = npt.NDArray[np.int64]

PARTS: dict[int, tuple[tuple[int, int, int], ...]] = {
    0: ((0, 1, 2),),
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((1, 4, 0), (4, 2, 0)),
    3: ((3, 1, 4), (2, 0, 3), (2, 3, 4)),
    4: ((2, 5, 1), (5, 0, 1)),
    5: ((5, 0, 3), (1, 2, 5), (1, 5, 3)),
    6: ((4, 2, 5), (0, 1, 4), (0, 4, 5)),
    7: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}
"""Points of the parts of a facet, counter-clockwise, by its sides that are cut: 1, 2 and 4 added."""


def _tables() -> tuple[_Longs, _Longs, _Longs, _Longs]:
    """Return, by the sides that are cut: number of parts, their points, the part behind each of their sides, halves.

    Returns
    -------
    (8,); (8, 4, 3); (8, 4, 3), -1 behind a side of the facet; and (8, 3, 2, 2), of each half of each side the part and
    its side.
    """
    counts = np.array([len(PARTS[cut]) for cut in range(8)])
    points, behind, halves = np.zeros((8, 4, 3), np.int64), np.full((8, 4, 3), -1), np.zeros((8, 3, 2, 2), np.int64)
    for cut, parts in PARTS.items():
        sides = {(part[s], part[(s + 1) % 3]): (number, s) for number, part in enumerate(parts) for s in range(3)}
        points[cut, : len(parts)] = parts
        for (p, q), (number, s) in sides.items():
            behind[cut, number, s] = sides.get((q, p), (-1, 0))[0]
        for k in range(3):
            first, last = k, (k + 1) % 3
            middle = 3 + k if cut >> k & 1 else None
            ends = [(first, last)] * 2 if middle is None else [(first, middle), (middle, last)]
            halves[cut, k] = [sides[end] for end in ends]
    return counts, points, behind, halves


_COUNTS, _POINTS, _BEHIND, _HALVES = _tables()


@entry
def list_cut(middles: Ints, marked: Bytes, cuts: Bytes, firsts: Ints, end: int) -> int:
    """Write which sides of each facet are cut, and the row of its second part; return the row behind the last one.

    Parameters
    ----------
    middles : (m, 3), the point in the middle of each side; -1 for none.
    marked : (points,), 1 where the side of that point is to be cut.
    cuts, firsts : (m,).
    end : the first row.
    """
    for f in range(len(middles)):
        cut = 0
        for k in range(3):
            middle = middles[f, k]
            if middle >= 0 and marked[middle]:
                cut |= 1 << k
        cuts[f], firsts[f] = cut, end
        end += _COUNTS[cut] - 1
    return end


@entry
def write_parts(
    surfaces: tuple[Ints, Ints, Ints, Bytes],
    middles: Ints,
    numbers: Ints,
    cuts: Bytes,
    firsts: Ints,
    out: tuple[Ints, Ints, Ints, Bytes],
) -> None:
    """Replace the rows of facets with sides to cut by those of their parts.

    Parameters
    ----------
    surfaces, out : faces, shades, across and smooth of `Topology`; `out` begins as `surfaces` does.
    middles, cuts, firsts : of `list_cut`; the points are numbered as radiances are.
    numbers : (points,), vertices of the points.
    """
    faces, shades, across, smooth = surfaces
    for f in range(len(middles)):
        cut = cuts[f]
        if cut == 0:
            continue
        for part in range(_COUNTS[cut]):
            row = firsts[f] + part - 1 if part > 0 else f
            for s in range(3):
                point = _POINTS[cut, part, s]
                behind = _BEHIND[cut, part, s]
                if point < 3:
                    out[0][row, s] = faces[f, point]
                    out[1][row, s] = shades[f, point]
                else:
                    out[0][row, s] = numbers[middles[f, point - 3]]
                    out[1][row, s] = middles[f, point - 3]
                out[2][row, s] = firsts[f] + behind - 1 if behind > 0 else (f if behind == 0 else -1)
                out[3][row, s] = 1
        for k in range(3):
            g = across[f, k]
            j = 0
            # The same side of the facet behind it: two facets may share two sides.
            while g >= 0 and not (across[g, j] == f and faces[g, j] == faces[f, (k + 1) % 3]):
                j += 1
            for h in range(2):
                part, s = _HALVES[cut, k, h, 0], _HALVES[cut, k, h, 1]
                row = firsts[f] + part - 1 if part > 0 else f
                out[3][row, s] = smooth[f, k]
                if g < 0:
                    out[2][row, s] = -1
                    continue
                behind, t = _HALVES[cuts[g], j, 1 - h, 0], _HALVES[cuts[g], j, 1 - h, 1]
                there = firsts[g] + behind - 1 if behind > 0 else g
                out[2][row, s] = there
                out[2][there, t] = row


class Facets:
    """Topologies of the same surfaces for one light frame after the other, in arrays that are used again.

    Parameters
    ----------
    surfaces : of all light frames.
    middles : (m, 3) int32, the radiance of the point in the middle of each side that may be cut; -1 for others. Their
        vertices follow those of `surfaces`, in ascending order, those alone that are marked.
    """

    def __init__(self, surfaces: Topology, middles: Ints | None = None) -> None:
        self._surfaces = self._room = surfaces
        self._middles = middles
        m = len(surfaces.faces)
        self._cuts, self._firsts = np.zeros(m, np.uint8), np.full(m, m, np.int32)
        self._end, self._points = m, 0
        self._is_middle = np.zeros(surfaces.entries, np.uint8)
        if middles is not None:
            self._is_middle[middles[middles >= 0]] = 1

    @property
    def shades(self) -> Ints:
        """The radiance of each corner, (rows, 3): of the surfaces, with the parts of facets at the end."""
        return self._room.shades[: self._end]

    def parts_of(self, first: int, last: int) -> tuple[int, int]:
        """Return the rows of the parts, but the first, of facets `first` to `last` - 1: the first row and the end."""
        m = len(self._firsts)
        ends = [int(self._firsts[k]) if k < m else self._end for k in (first, last)]
        return ends[0], ends[1]

    def cut(self, marked: Bytes) -> None:
        """Cut the sides whose middle is marked, (radiances,) uint8; patches are forgotten."""
        t, middles = self._surfaces, self._middles
        if middles is None:
            return
        self._end = int(list_cut(middles, marked, self._cuts, self._firsts, len(t.faces)))
        self._make_room(self._end)
        room, m = self._room, len(t.faces)
        room.faces[:m], room.shades[:m], room.across[:m], room.smooth[:m] = _rows(t)
        numbers = t.vertices - np.int32(1) + np.cumsum(marked & self._is_middle, dtype=np.int32)
        self._points = int(numbers[-1]) + 1 - t.vertices
        write_parts(_rows(t), middles, numbers, self._cuts, self._firsts, _rows(room))
        room.over[m : self._end] = -1

    def on(self, faces: Ints, over: Ints) -> Topology:
        """Return the topology with patches at the end; it is valid until the next call.

        Parameters
        ----------
        faces : (n, 3), corners of patches, numbered from 0; their vertices and radiances follow all others.
        over : (n,), the facet on which each lies, a row of `shades`.
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
            room.faces[:end],
            room.shades[:end],
            room.across[:end],
            room.smooth[:end],
            room.two_sided[:end],
            vertices + count,
            t.entries + count,
            room.over[:end],
        )

    def _make_room(self, rows: int) -> None:
        """Make room for so many facets; those behind the surfaces are seen from one side."""
        if rows <= len(self._room.faces):
            return
        t, n = self._room, 2 * rows - len(self._room.faces)
        self._room = Topology(
            np.concatenate([t.faces, np.zeros((n, 3), np.int32)]),
            np.concatenate([t.shades, np.zeros((n, 3), np.int32)]),
            np.concatenate([t.across, np.full((n, 3), -1, np.int32)]),
            np.concatenate([t.smooth, np.zeros((n, 3), np.uint8)]),
            np.concatenate([t.two_sided, np.zeros(n, np.uint8)]),
            t.vertices,
            t.entries,
            np.concatenate([t.over, np.full(n, -1, np.int32)]),
        )


def _rows(t: Topology) -> tuple[Ints, Ints, Ints, Bytes]:
    return t.faces, t.shades, t.across, t.smooth

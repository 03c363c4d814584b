"""Heights of a piece of ground on square grids, and the light of its posts, level by level.

The grids are nested around one site, the finest one innermost:

    grid 0    posts 1 unit apart        on the lattice of the finest grid, whose post (0, 0) is the site
    grid 1    posts 2 units apart       twice as wide, in every direction
    grid j    posts 2^j units apart     ...

Where a finer grid lies in a coarser one, its posts and the coarser one's agree to the last bit: so the same place has
one height on all grids, and meshes over them fit together. A map from a file is one grid. Rows go north (+y), columns
east (+x); the site's height is 0.

The vertices of blocks of any level come from a `Pyramid`. Its level l has the posts whose lattice places are whole
multiples of 2^l, l as in `Quadtree`. A post has

    height      of the ground, the same on all levels
    b           cosine of incidence x visible share of the Sun x albedo
    b p, b q    slopes east and north, weighted by b: dark slopes send no light

Slopes p and q are differences over two posts. Between posts slopes, albedo and the height of the Sun over the horizon
are linear, and b is not: the edge of a shadow lies where the Sun crosses the horizon, which b at the posts alone would
move and blur by half their distance. So b is computed half way between posts too, and filtered to the posts of the
finest level there. This filter is that from each level to the next coarser one, (-1, 2, 6, 2, -1) / 8 along both axes,
the low pass of the 5/3 wavelet (Le Gall and Tabatabai 1988). It preserves means, and the linear function between the
coarse posts stays as close to the fine map as such a short filter allows. A mean over a square would blur it by as much
again.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from emulator.scene.terrain.box_moments import to_half
from emulator.scene.terrain.tile import BP, BPP, BPQ, BQ, BQQ, MOMENTS, B, P, Q
from emulator.threads import ThreadPool, available_threads
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Float32s, Floats, Int64s, UInt16s

_SOURCES = ("emulator.scene.terrain", "emulator.photometry", "emulator.raster.layout", "emulator.sensor.numerics")

entry = entry_of(*_SOURCES, fastmath={"contract"}, _nrt=False)
"""Compile a function for calls from Python, without allocation; see `numerics.compiled` for the options."""

map_entry = entry_of(*_SOURCES, error_model="python")
"""Compile a loop over a map, which may allocate; a division by zero raises."""

Heights = Float32s


@dataclass(frozen=True, eq=False)
class Ground:
    """Nested grids.

    Attributes
    ----------
    unit_m : distance of the finest grid's posts.
    heights_m : (grids, rows, columns) float32; rows - 1 and columns - 1 are multiples of 4 if there are several grids.
    notes : remarks for the user, a sentence each.
    albedo : as `heights_m`, of each post relative to the ground's law of reflection; None: 1 everywhere.
    """

    unit_m: float
    heights_m: Heights
    notes: tuple[str, ...] = ()
    albedo: Heights | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of each grid."""
        return self.heights_m.shape[1], self.heights_m.shape[2]

    @property
    def grids(self) -> int:
        """Their number."""
        return len(self.heights_m)

    def post_m(self, grid: int) -> float:
        """Return the distance of a grid's posts."""
        return self.unit_m * (1 << grid)

    def first(self, grid: int) -> tuple[int, int]:
        """Return the lattice place (x, y) of a grid's first post."""
        rows, columns = self.shape
        return -((columns - 1) // 2) << grid, -((rows - 1) // 2) << grid

    @property
    def half_m(self) -> float:
        """Distance from the site to the nearest edge of the largest grid."""
        return self.post_m(self.grids - 1) * ((min(self.shape) - 1) // 2)

    def curved(self, radius_m: float) -> Ground:
        """Return the ground on a sphere of `radius_m` that touches the map at the site: lower by r^2 / 2 R."""
        heights = self.heights_m.copy()
        for grid, z in enumerate(heights):
            x0, y0 = self.first(grid)
            x = (x0 + (np.arange(z.shape[1]) << grid)) * self.unit_m
            y = (y0 + (np.arange(z.shape[0]) << grid)) * self.unit_m
            z -= ((x * x + (y * y)[:, None]) / (2 * radius_m)).astype(np.float32)
        return dataclasses.replace(self, heights_m=heights)

    def height_m(self, x_m: float, y_m: float) -> float | None:
        """Return the ground's height at a place, linear between the finest posts; None off the map."""
        for grid in range(self.grids):
            at = [c / self.unit_m - first for c, first in zip((x_m, y_m), self.first(grid), strict=True)]
            column, row = (a / (1 << grid) for a in at)
            if 0 <= column <= self.shape[1] - 1 and 0 <= row <= self.shape[0] - 1:
                z, i, j = self.heights_m[grid], min(int(row), self.shape[0] - 2), min(int(column), self.shape[1] - 2)
                down, across = row - i, column - j
                low, high = (z[k, j] * (1 - across) + z[k, j + 1] * across for k in (i, i + 1))
                return float(low * (1 - down) + high * down)
        return None


def nested(unit_m: float, grids: list[Floats], notes: tuple[str, ...] = (), *, level: bool = True) -> Ground:
    """Return a ground of `grids`, (rows, columns) each, finest first: coarser ones take the finer ones' heights.

    `level` brings the site's height to 0.
    """
    heights = np.stack(grids).astype(np.float32)
    rows, columns = heights.shape[1:]
    if level:
        heights -= heights[0, (rows - 1) // 2, (columns - 1) // 2]
    for finer, coarser in itertools.pairwise(heights):
        inner = finer[::2, ::2]
        top, left = (rows - 1) // 4, (columns - 1) // 4
        coarser[top : top + len(inner), left : left + inner.shape[1]] = inner
    return Ground(unit_m, heights, notes)


SHADOWS = 2
RADII, ALBEDO = range(SHADOWS)
_BEYOND = 16  # rows of zeros after the last post: boxes of posts extend beyond a map of few posts

Halves = UInt16s
_Moments = Float32s


class Pyramid(NamedTuple):
    """Posts of all levels, level by level, row by row.

    Attributes
    ----------
    heights : (n,) float32, metres.
    moments : (MOMENTS n,) 16-bit floats as uint16, which compiled loops read: b, b p, b q, b p p, b p q, b q q, p, q.
    shadows : (SHADOWS n,), as the moments, of the levels that are grids: height of the Sun's middle over the horizon in
        its radii, and albedo.
    levels : (levels, 9): number of the first post, rows, columns; lattice place x, y of the first post, and of the last
        one less that; rows and columns by which half a post's numbers differ from its numbers on the next level.
    """

    heights: Heights
    moments: Halves
    shadows: Halves
    levels: Int64s


def build_pyramid(ground: Ground, sun_radii: Heights, sun: Floats, levels: int) -> Pyramid:
    """Return `levels` levels of `ground`, in the light of `sun`, (2, 3): towards it, and from its middle to its top.

    `sun_radii`, (grids, rows, columns), is the height of the Sun's middle over the horizon of each post, in its radii.
    """
    table = table_of(ground, levels)
    posts = int(table[-1, 0] + table[-1, 1] * table[-1, 2])
    heights = np.empty(posts, np.float32)
    moments = np.zeros((posts + _BEYOND * (table[:, 2].max() + 1)) * MOMENTS, np.uint16)
    shadows = np.empty(sun_radii.size * SHADOWS, np.uint16)
    finer_z, finer = np.empty((0, 0), np.float32), np.empty((0, 0, MOMENTS), np.float32)
    for level, (first, rows, columns) in enumerate(table[:, :3]):
        if level < ground.grids:
            z = ground.heights_m[level]
            albedo = np.ones((), np.float32) if ground.albedo is None else ground.albedo[level] / ground.albedo.max()
            lit = np.stack(np.broadcast_arrays(sun_radii[level], albedo), axis=-1)
            _write_halves(lit.reshape(-1), shadows[first * SHADOWS :])
            posts_moments = _moments_at_posts(z, ground.post_m(level), sun_radii[level], albedo, sun)
            if level:
                top, left = ((n - 1) // 4 for n in ground.shape)
                inner = posts_moments[top:, left:][: (len(finer) + 1) // 2, : (finer.shape[1] + 1) // 2]
                inner[1:-1, 1:-1] = _coarsened(finer)[1:-1, 1:-1]
        else:
            z, posts_moments = finer_z[_evens(len(finer_z))][:, _evens(finer_z.shape[1])], _coarsened(finer)
        heights[first : first + rows * columns] = z.ravel()
        _write_halves(posts_moments.reshape(-1), moments[first * MOMENTS :])
        finer_z, finer = z, posts_moments
    return Pyramid(heights, moments, shadows, table)


@map_entry
def _write_halves(numbers: Heights, out: Halves) -> None:
    """Write numbers as 16-bit floats to the first places of `out`; numpy takes 60 ns for each below 6e-5."""
    for k in range(len(numbers)):
        out[k] = to_half(numbers[k])


def _evens(posts: int) -> Int64s:
    """Return the numbers of the posts of a line that the next level has too; the last one's again at an odd end."""
    return np.minimum(2 * np.arange(posts // 2 + 1), posts - 1)


def table_of(ground: Ground, levels: int) -> Int64s:
    """Return the `levels` of a `Pyramid`."""
    rows, columns = ground.shape
    spans = columns - 1, rows - 1
    table = np.zeros((levels, 9), np.int64)
    offset = 0
    for level in range(levels):
        grid = min(level, ground.grids - 1)
        if level >= ground.grids:
            rows, columns = rows // 2 + 1, columns // 2 + 1
        inner = level + 1 < ground.grids
        shift = ((rows - 1) // 4, (columns - 1) // 4) if inner else (0, 0)
        table[level] = offset, rows, columns, *ground.first(grid), *(span << grid for span in spans), *shift
        offset += rows * columns
    return table


@map_entry
def sunlit(facing: float, raised: float, radii: float) -> float:
    """Return the mean cosine of incidence over the part of a disc above a straight horizon, times the share of that.

    `facing` is the cosine at its middle, `raised` the change to its top, `radii` the height of the middle above the
    horizon in its radii. The visible part stands higher than the middle, which counts where the Sun grazes the ground.
    """
    if abs(radii) >= 1.0:
        return max(facing, 0.0) if radii > 0.0 else 0.0
    chord = math.sqrt(1.0 - radii * radii)
    share = 0.5 + (radii * chord + math.asin(radii)) / math.pi
    return max(facing * share + raised * chord**3 * _RISE, 0.0)


_RISE = 2.0 / (3.0 * math.pi)  # share of a half disc times the height of its middle, in radii
_FIT = np.array([-0.125, 0.25, 0.75, 0.25, -0.125], np.float32)
_LIT = 6  # moments that light weights: the first ones
_BAND = 64  # rows that a thread takes at a time


def _moments_at_posts(z: Heights, post_m: float, sun_radii: Heights, albedo: Heights, sun: Floats) -> _Moments:
    """Return the moments of a grid's posts, (rows, columns, MOMENTS)."""
    north, east = np.gradient(z, post_m)
    fields = np.stack(np.broadcast_arrays(east, north, sun_radii, albedo))
    out, pool = np.zeros((*z.shape, MOMENTS), np.float32), ThreadPool(available_threads())
    out[:, :, P], out[:, :, Q] = east, north
    pool.each(lambda band, _: _add_light(fields, sun, _BAND * band, _BAND * (band + 1), out), -(-len(z) // _BAND))
    pool.close()
    return out


@map_entry
def _add_light(fields: Heights, sun: Floats, first: int, end: int, out: _Moments) -> None:
    """Write the moments that light weights, of the rows from `first` to before `end`, from light there and between.

    `fields` are slopes to the east and north, the height of the Sun in its radii, and albedo, (4, rows, columns).
    """
    rows, columns = fields.shape[1:]
    end = min(end, rows)
    posts, light = np.empty((4, columns), np.float32), np.empty((2, _LIT, columns + 1), np.float32)
    fitted = np.empty((_LIT, columns), np.float32)
    for line in range(2 * first - 2, 2 * end + 1):  # two a row; beyond the border the first and the last one go on
        i = min(max(line, 0), 2 * rows - 2) // 2
        below = i if line < 0 else min(i + line % 2, rows - 1)
        posts[:] = np.float32(0.5) * (fields[:, i] + fields[:, below])
        _write_light(posts, sun, light)
        _fit(light, fitted)
        for row in range(max((line - 1) // 2, first), min((line + 2) // 2, end - 1) + 1):
            weight = _FIT[line - 2 * row + 2]
            for j in range(columns):
                for k in range(_LIT):
                    out[row, j, k] += weight * fitted[k, j]


@map_entry
def _write_light(posts: Heights, sun: Floats, out: _Moments) -> None:
    """Write b and its moments on a line, at the posts and half way to the next, (2, moments, posts)."""
    last = posts.shape[1] - 1
    for j in range(last + 1):
        for after in range(2):
            n = min(j + after, last)
            p, q = np.float32(0.5) * (posts[0, j] + posts[0, n]), np.float32(0.5) * (posts[1, j] + posts[1, n])
            radii, albedo = 0.5 * (posts[2, j] + posts[2, n]), 0.5 * (posts[3, j] + posts[3, n])
            per_n = 1.0 / math.sqrt(1.0 + p * p + q * q)
            facing = (sun[0, 2] - p * sun[0, 0] - q * sun[0, 1]) * per_n
            raised = (sun[1, 2] - p * sun[1, 0] - q * sun[1, 1]) * per_n
            b = np.float32(albedo * sunlit(facing, raised, radii))
            out[after, B, j], out[after, BP, j], out[after, BQ, j] = b, b * p, b * q
            out[after, BPP, j], out[after, BPQ, j], out[after, BQQ, j] = b * p * p, b * p * q, b * q * q


@map_entry
def _fit(light: _Moments, out: _Moments) -> None:
    """Write the moments at the posts of a line, filtered from those at the posts and after each."""
    columns = out.shape[1]
    for k in range(_LIT):
        for j in range(columns):
            before, next_ = max(j - 1, 0), min(j + 1, columns - 1)
            between = light[1, k, before] if j else light[0, k, 0]
            out[k, j] = (
                _FIT[2] * light[0, k, j]
                + _FIT[1] * (between + light[1, k, j])
                + _FIT[0] * (light[0, k, before] + light[0, k, next_])
            )


@map_entry
def _coarsened(fine: _Moments) -> _Moments:
    """Return the moments of the posts of the next level, filtered along both axes."""
    rows, columns = fine.shape[:2]
    out = np.zeros((rows // 2 + 1, columns // 2 + 1, MOMENTS), np.float32)
    line = np.empty((columns, MOMENTS), np.float32)
    for i in range(len(out)):
        line[:] = 0.0
        for k in range(len(_FIT)):  # along the first axis; the line is then filtered along the other
            line += _FIT[k] * fine[min(max(2 * i + k - 2, 0), rows - 1)]
        for j in range(out.shape[1]):
            for k in range(len(_FIT)):
                for m in range(MOMENTS):
                    out[i, j, m] += _FIT[k] * line[min(max(2 * j + k - 2, 0), columns - 1), m]
    return out

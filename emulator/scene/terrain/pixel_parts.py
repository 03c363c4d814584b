"""Light of doubtful pixels from parts of their own: where the ground is seen edge-on, and where light changes much.

With d the pixel's direction, d = 1 along the boresight, and n . X = 1 the facet's plane from the camera, the visible
point is X = s d, s = 1 / (n . d). Its light is computed in these steps:

    footprint       the change of X within the plane for a pixel to the right and for one down
    parts           points half a post apart, from `samples` to 7 along each side of the pixel: equal on the screen, so
                    that slopes which face the camera count for their share of the light frame
    fine height     the map's height z above a part moves it along d to the point on the plane lifted by z - X_z; a
                    secant from there, as the ground under the moved ray has another height
    means           over the points: of b, b p, b q, and of b / (mu0 + mu), mu0 and mu the cosines of incidence and
                    emission. Slopes, albedo and the height of the Sun over the horizon are linear between posts; b is
                    not, and moments of posts, in which it is, blur the edge of a shadow by half of their distance

The law of reflection is evaluated once, at the mu0 of the mean slope and the mu at which b / (mu0 + mu) has its mean.

Where outlines pass, or footprints fail, parts are where 8 x `samples` rays through the pixel first meet the map, each
in a row of its own, a golden section of the pixel beside the one before. Where no outline passes, a ray begins a little
before the place where the one below it met the map, if it is above the ground there. It crosses the blocks of a
`Quadtree`. It passes one whose highest post lies below it whole, then tries a block twice as large, and looks into the
others: down to blocks of the finest grid there, whose cells between four posts it crosses one by one. Heights are
bilinear over a cell, so the height of the ray over the ground is quadratic along it, and its first root the place.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emulator.raster.layout import W, WHighest, WLowest
from emulator.scene.terrain import tile as t
from emulator.scene.terrain.box_moments import from_half
from emulator.scene.terrain.ground import ALBEDO, RADII, SHADOWS, Halves, sunlit
from emulator.scene.terrain.pixel_hits import (
    Fields,
    Grids,
    Posts,
    Sight,
    Table,
    find_posts,
    lowest_level,
    meet_map,
    write_levels,
)
from emulator.scene.terrain.pixel_law import GRAZING, Sunlight
from emulator.scene.terrain.quadtree import BLOCK
from emulator.scene.terrain.tile import MOMENTS, TILE, P, Q, Tile, set_triple, triple
from emulator.sensor.numerics.compiled import NONE, Real, kernel, lane
from firmware_protocol.events import Bytes, Float32s, Floats

Triple = tuple[float, float, float]


class Peaks(NamedTuple):
    """Highest posts of blocks, and a row for each level: rows, columns, first x and y, number of the first block."""

    heights: Floats
    levels: Table


class _Ray(NamedTuple):
    """A ray: its start and its change along it, in posts of the finest grid east and north, and in metres up."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


class _Parts(NamedTuple):
    """Division of a pixel.

    Attributes
    ----------
    middle : of the pixel on its facet, from the camera.
    eye : unit vector to it.
    lift : change of the middle for lifting the facet by a metre.
    right, down : change of the middle for a pixel to the right and for one down.
    columns, rows : number of parts across and down.
    from_depth : at which rays begin.
    """

    middle: Triple
    eye: Triple
    lift: Triple
    right: Triple
    down: Triple
    columns: float
    rows: float
    from_depth: float


COLUMN, SHARE, MEAN_B, MEAN_BP, MEAN_BQ, MEAN_REFLECTED, SEEN = range(7)
LINE_FIELDS = 7

OUTLINED = 2
"""In place of 1 for doubtful pixels: an outline passes in the pixel, or in one beside it."""

_FROM = 0.98  # of the least depth around: where rays begin
_BEFORE = 0.998  # of the way to where the ray below met the map
_APART, _MOST = 0.5, 7.0  # posts from a part to the next, as long as they are no more along a side
_RAYS, _GOLDEN = 8.0, 0.618034  # rays of a pixel over `samples`; share of a pixel from one ray to the next
_ZERO, _ONE, _GRAZING = np.float32(0.0), np.float32(1.0), np.float32(GRAZING)

_INSIDE = 1e-6  # posts: how far a place is moved along its ray to lie clearly in a cell
_FAR = 1e30
_FIRST = 2  # level at which blocks are tried first


@lane
def into_world(turn: Floats, x: float, y: float, z: float) -> Triple:
    """Return a direction in the world from one in camera axes."""
    return (
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
        turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z,
    )


@kernel
def part_means(
    row: int, first: int, last: int, by_rays: bool, doubtful: Bytes, sight: Sight, posts: Posts, peaks: Peaks,
    samples: float, sun: Sunlight, tile: Tile, line: Floats,
) -> None:  # fmt: skip
    """Write the means over the parts of a row's listed pixels, see the module docstring, and the share that is ground.

    Parameters
    ----------
    first, last : of the columns listed in `line`, and the one after the last.
    by_rays : parts are where rays through the pixel first meet the map; else near its facet.
    doubtful : of the row's pixels; OUTLINED where an outline passes.
    samples : least parts along each side of a pixel, and an eighth of its rays.
    """
    filled: int = NONE
    for k in range(first, last):
        for field in (MEAN_B, MEAN_BP, MEAN_BQ, MEAN_REFLECTED, SEEN):
            line[field, k] = 0.0
        column = int(line[COLUMN, k])
        parts = _by_rays(row, column, sight, samples) if by_rays else _divided(row, column, sight, posts.grids, samples)
        count = parts.columns * parts.rows
        line[SHARE, k] = 1.0 / count
        # Parts of one pixel after another fill tiles; a full tile is added to its pixels.
        for part in range(int(count)):
            _put(filled, k, part, parts, tile)
            tile.fields[t.NEXT * TILE + filled] = part > 0 and doubtful[column] < OUTLINED
            filled += 1
            if filled == TILE:
                _add_points(filled, by_rays, posts, peaks, sight.place, sun, tile, line)
                filled = NONE
    _add_points(filled, by_rays, posts, peaks, sight.place, sun, tile, line)


@lane
def _divided(row: int, column: int, sight: Sight, grids: Grids, samples: float) -> _Parts:
    """Return how a pixel is divided."""
    facet, turn = sight.facets[sight.owner[row, column]], sight.turn
    focal, middle_column, middle_row = sight.projection
    right, down = column + 0.5, row + 0.5
    x, y = (right - middle_column) / focal, (down - middle_row) / focal
    w0, wx, wy = facet[W], facet[W + 1], facet[W + 2]
    depth = 1.0 / min(max(w0 + wx * right + wy * down, facet[WLowest]), facet[WHighest])
    _, _, nz = into_world(turn, focal * wx, focal * wy, w0 + wx * middle_column + wy * middle_row)
    dx, dy, dz = into_world(turn, x, y, 1.0)
    per_d = -1.0 / math.sqrt(1.0 + x * x + y * y)
    # A step of a pixel moves the ray, and the depth at which it meets the facet: a and b, over the depth a pixel.
    across, along = focal * wx * depth, focal * wy * depth
    a = turn[0, 0] - across * dx, turn[0, 1] - across * dy, turn[0, 2] - across * dz
    b = turn[1, 0] - along * dx, turn[1, 1] - along * dy, turn[1, 2] - along * dz
    step, lift = depth / focal, depth * nz
    x, y = sight.place[0] + depth * dx, sight.place[1] + depth * dy
    per_post = step / (_APART * grids.unit_m * (1 << lowest_level(x, y, 0, grids)))
    wide, high = math.sqrt(a[0] * a[0] + a[1] * a[1]), math.sqrt(b[0] * b[0] + b[1] * b[1])
    return _Parts(
        (depth * dx, depth * dy, depth * dz),
        (dx * per_d, dy * per_d, dz * per_d),
        (lift * dx, lift * dy, lift * dz),
        (a[0] * step, a[1] * step, a[2] * step),
        (b[0] * step, b[1] * step, b[2] * step),
        max(min(math.ceil(per_post * wide), _MOST), samples),
        max(min(math.ceil(per_post * high), _MOST), samples),
        0.0,
    )


@lane
def _by_rays(row: int, column: int, sight: Sight, samples: float) -> _Parts:
    """Return the rays through a pixel, each in a row and a column of its own, as parts at depth 1."""
    turn = sight.turn
    focal, middle_column, middle_row = sight.projection
    x, y = (column + 0.5 - middle_column) / focal, (row + 0.5 - middle_row) / focal
    dx, dy, dz = into_world(turn, x, y, 1.0)
    per_d, per_px = -1.0 / math.sqrt(1.0 + x * x + y * y), 1.0 / focal
    return _Parts(
        (dx, dy, dz),
        (dx * per_d, dy * per_d, dz * per_d),
        (0.0, 0.0, 0.0),
        (turn[0, 0] * per_px, turn[0, 1] * per_px, turn[0, 2] * per_px),
        (turn[1, 0] * per_px, turn[1, 1] * per_px, turn[1, 2] * per_px),
        1.0,
        _RAYS * samples,
        _FROM * _nearest(row, column, sight),
    )


@lane
def _nearest(row: int, column: int, sight: Sight) -> float:
    """Return the least depth at a pixel's middle of the facets that it and its neighbours have."""
    height, width = sight.owner.shape
    highest = 1e-12
    for i in range(max(row - 1, 0), min(row + 2, height)):
        for j in range(max(column - 1, 0), min(column + 2, width)):
            if sight.owner[i, j] >= 0:
                facet = sight.facets[sight.owner[i, j]]
                w = facet[W] + facet[W + 1] * (column + 0.5) + facet[W + 2] * (row + 0.5)
                highest = max(highest, min(max(w, facet[WLowest]), facet[WHighest]))
    return 1.0 / highest


@lane
def _put(n: int, k: int, part: int, parts: _Parts, tile: Tile) -> None:
    """Write part `part` of the listed pixel k as number n of the tile."""
    s, middle, a, b = tile.fields, parts.middle, parts.right, parts.down
    line = part // int(parts.columns)
    right, down = (part - line * parts.columns + 0.5) / parts.columns - 0.5, (line + 0.5) / parts.rows - 0.5
    if parts.from_depth > 0.0:
        down = -down  # from below
        right = (line + 0.5) * _GOLDEN % 1.0 - 0.5
    s[t.X * TILE + n] = middle[0] + right * a[0] + down * b[0]
    s[t.Y * TILE + n] = middle[1] + right * a[1] + down * b[1]
    s[t.Z * TILE + n] = middle[2] + right * a[2] + down * b[2]
    set_triple(s, t.LIFT_X, n, parts.lift[0], parts.lift[1], parts.lift[2])
    set_triple(s, t.EYE_X, n, parts.eye[0], parts.eye[1], parts.eye[2])
    s[t.SIZE * TILE + n] = 0.0  # the finest posts there
    s[t.LIFTED * TILE + n] = parts.from_depth
    s[t.TAPS * TILE + n] = 1.0
    tile.places[t.PIXEL * TILE + n] = k


@kernel
def _add_points(
    count: int, by_rays: bool, posts: Posts, peaks: Peaks, place: Floats, sun: Sunlight, tile: Tile, line: Floats
) -> None:
    """Add b, b p, b q and b / (mu0 + mu) at the first `count` parts of a tile to their pixels."""
    s, places = tile.fields, tile.places
    if by_rays:
        first_hits(count, posts, peaks, place, s)
    write_levels(count, posts, 0, place, Fields(t.X, t.Y, t.SIZE), s, places)
    if not by_rays:
        meet_map(posts.heights, np.float32(place[2]), s, places)
    find_posts(s, places)
    (sx, sy, sz), (lx, ly, lz) = sun.disc
    for n in range(count):
        k = places[t.PIXEL * TILE + n]
        seen = line[SHARE, k] * s[t.TAPS * TILE + n]
        # Slopes, the height of the Sun over the horizon and albedo are linear between posts; light is not.
        south = np.int64(places[t.POST * TILE + n])
        north = south + np.int64(places[t.LEVEL_COLUMNS * TILE + n])
        u, v = s[t.WITHIN_X * TILE + n], s[t.WITHIN_Y * TILE + n]
        p = _between(posts.moments, MOMENTS, P, south, north, u, v)
        q = _between(posts.moments, MOMENTS, Q, south, north, u, v)
        radii = _between(posts.shadows, SHADOWS, RADII, south, north, u, v)
        albedo = _between(posts.shadows, SHADOWS, ALBEDO, south, north, u, v)
        ex, ey, ez = triple(s, t.EYE_X, n)
        per_n = _ONE / math.sqrt(_ONE + p * p + q * q)
        mu0 = (sz - p * sx - q * sy) * per_n
        b = seen * albedo * sunlit(mu0, (lz - p * lx - q * ly) * per_n, radii)
        line[MEAN_B, k] += b
        line[MEAN_BP, k] += b * p
        line[MEAN_BQ, k] += b * q
        line[MEAN_REFLECTED, k] += b / (max(mu0, _ZERO) + max((ez - p * ex - q * ey) * per_n, _GRAZING))
        line[SEEN, k] += seen


@lane
def _between(table: Halves, numbers: int, k: int, low: int, high: int, u: float, v: float) -> Real:
    """Return number k of a table of `numbers` a post, linear between four posts."""
    a, b = from_half(table[low * numbers + k]), from_half(table[(low + 1) * numbers + k])
    c, d = from_half(table[high * numbers + k]), from_half(table[(high + 1) * numbers + k])
    south = a + u * (b - a)
    return south + v * (c + u * (d - c) - south)


@kernel
def first_hits(count: int, posts: Posts, peaks: Peaks, place: Floats, s: Float32s) -> None:
    """Move places, given as directions from the camera at `place`, to where their rays first meet the map.

    Rays begin LIFTED from the camera, or with NEXT a little before the hit of the ray before; those below ground there
    begin nearer, in the end at the camera. Rays that meet nothing get TAPS 0.
    """
    per_m, before = 1.0 / posts.grids.unit_m, 0.0
    for k in range(count):
        x, y, z = triple(s, t.X, k)
        ray = _Ray(place[0] * per_m, place[1] * per_m, place[2], x * per_m, y * per_m, float(z))
        start = np.float64(s[t.LIFTED * TILE + k])
        along = 0.0
        for begin in (max(start, before if s[t.NEXT * TILE + k] > 0.0 else 0.0), start, 0.0):
            along = _way(ray, begin, posts, peaks)
            if along > begin:
                break
        before = _BEFORE * along if along < _FAR else 0.0
        s[t.TAPS * TILE + k] = 1.0 if along < _FAR else 0.0
        along = along if along < _FAR else 1.0
        set_triple(s, t.X, k, x * along, y * along, z * along)


@lane
def _side_end(start: float, change: float, low: float, high: float) -> float:
    """Return where a ray leaves the range from low to high along an axis."""
    return ((high if change > 0.0 else low) - start) / change if change != 0.0 else _FAR


@kernel
def _way(ray: _Ray, along: float, posts: Posts, peaks: Peaks) -> float:
    """Return how far along a ray the ground is first met from `along` on, _FAR for nowhere."""
    levels, grids = peaks.levels, posts.grids.grids
    last = len(levels) - 1
    inside = _INSIDE / max(abs(ray.dx), abs(ray.dy), 1e-12)
    level = min(_FIRST, last)
    while along < _FAR:
        x, y = ray.x + ray.dx * (along + inside), ray.y + ray.dy * (along + inside)
        size = float(BLOCK << level)
        i, j = math.floor((y - levels[level, 3]) / size), math.floor((x - levels[level, 2]) / size)
        if i < 0 or j < 0 or i >= levels[level, 0] or j >= levels[level, 1]:
            if level >= grids - 1:
                return _FAR
            level += 1
            continue
        left, low = levels[level, 2] + j * size, levels[level, 3] + i * size
        end = min(_side_end(ray.x, ray.dx, left, left + size), _side_end(ray.y, ray.dy, low, low + size))
        end = max(end, along + inside)
        peak = peaks.heights[levels[level, 4] + i * levels[level, 1] + j]
        if ray.z + ray.dz * (end if ray.dz < 0.0 else along) <= peak:
            finer = max(level - 1, 0)
            right, up = left + 0.5 * size - posts.levels[finer, 3], low + 0.5 * size - posts.levels[finer, 4]
            is_within = 0.0 < right < posts.levels[finer, 5] and 0.0 < up < posts.levels[finer, 6]
            if level >= grids or (level > 0 and is_within):
                level -= 1
                continue
            hit = _in_cells(ray, along, end, level, posts)
            if hit < _FAR:
                return float(hit)
        along = end
        level = min(level + 1, last)
    return _FAR


@kernel
def _in_cells(ray: _Ray, along: float, end: float, grid: int, posts: Posts) -> float:
    """Return how far along a ray the ground is met from `along` to `end`, where the ray is over cells of one grid."""
    first, rows, columns = posts.levels[grid, 0], posts.levels[grid, 1], posts.levels[grid, 2]
    # In posts of the grid, and the ways to the next sides of cells.
    per_post = 1.0 / (1 << grid)
    du, dv = ray.dx * per_post, ray.dy * per_post
    u0, v0 = (ray.x - posts.levels[grid, 3]) * per_post, (ray.y - posts.levels[grid, 4]) * per_post
    inside = _INSIDE / max(abs(ray.dx), abs(ray.dy), 1e-12)
    j, i = math.floor(u0 + du * (along + inside)), math.floor(v0 + dv * (along + inside))
    to_x, to_y = _side_end(u0, du, float(j), j + 1.0), _side_end(v0, dv, float(i), i + 1.0)
    per_x, per_y = abs(1.0 / du) if du != 0.0 else _FAR, abs(1.0 / dv) if dv != 0.0 else _FAR
    east, north = 1 if du > 0.0 else -1, 1 if dv > 0.0 else -1
    while along < end and 0 <= i < rows - 1 and 0 <= j < columns - 1:
        out = max(min(to_x, to_y), along)
        at = first + i * columns + j
        a, b = float(posts.heights[at]), float(posts.heights[at + 1])
        c, d = float(posts.heights[at + columns]), float(posts.heights[at + columns + 1])
        if min(ray.z + ray.dz * along, ray.z + ray.dz * out) <= max(max(a, b), max(c, d)):
            # The ray's height over the ground is quadratic along it.
            u, v, twist = u0 + du * along - j, v0 + dv * along - i, a - b - c + d
            above = ray.z + ray.dz * along - (a + (b - a) * u + (c - a) * v + twist * u * v)
            if above <= 0.0:
                return along
            rise = (b - a) * du + (c - a) * dv + twist * (u * dv + v * du)
            hit = _first_root(-twist * du * dv, ray.dz - rise, above)
            if hit <= out - along:
                return float(along + hit)
        along = out
        if to_x < to_y:
            j, to_x = j + east, to_x + per_x
        else:
            i, to_y = i + north, to_y + per_y
    return _FAR


@lane
def _first_root(c: float, b: float, above: float) -> float:
    """Return the least s > 0 at which above + b s + c s^2 is 0, above > 0; _FAR if there is none."""
    square = b * b - 4.0 * c * above
    if square < 0.0:
        return _FAR
    # Both roots without differences of like numbers: q / c and above / q.
    q = -0.5 * (b + math.copysign(math.sqrt(square), b))
    first, second = above / q if q != 0.0 else _FAR, q / c if c != 0.0 else _FAR
    return min(first if first > 0.0 else _FAR, second if second > 0.0 else _FAR)

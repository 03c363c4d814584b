"""Light of doubtful pixels from parts of their own: where the ground is seen edge-on, and where light changes much.

With d the pixel's direction, d = 1 along the boresight, and n . X = 1 the facet's plane from the camera, the visible
point is X = s d, s = 1 / (n . d). Its light is computed in these steps:

    footprint       the change of X within the plane for a pixel to the right and for one down
    parts           `samples` along the footprint's shorter side, and more where it is longer: parts of the pixel, equal
                    on the screen, so that slopes which face the camera count for their share of the light frame
    fine height     the map's height z above a part moves it along d to the point on the plane lifted by z - X_z; a
                    secant from there, as the ground under the moved ray has another height
    means           over a square of the ground around each part: of b, b p, b q, and of b / (mu0 + mu), mu0 and mu the
                    cosines of incidence and emission of the square's slope

The law of reflection is evaluated once, at the mu0 of the mean slope and the mu at which b / (mu0 + mu) has its mean.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emulator.raster.layout import Floats, W, WHighest, WLowest
from emulator.scene.terrain import tile as t
from emulator.scene.terrain.block_vertices import GRAZING
from emulator.scene.terrain.ground import BP, BQ, MOMENTS, B
from emulator.scene.terrain.pixel_boxes import box_means
from emulator.scene.terrain.pixel_hits import Fields, Posts, Sight, meet_first, meet_map, write_levels
from emulator.scene.terrain.tile import TILE, Floats32, Tile, set_triple, triple
from emulator.sensor.numerics.compiled import NONE, kernel, lane, vector_kernel

Triple = tuple[float, float, float]


class _Parts(NamedTuple):
    """Division of a pixel.

    Attributes
    ----------
    middle : of the pixel on its facet, from the camera.
    eye : unit vector to it.
    lift : change of the middle for lifting the facet by a metre.
    right, down : change of the middle for a pixel to the right and for one down.
    half_m : half the side of a part's square on the ground.
    columns, rows : number of parts across and down.
    reach_m : lifts of the facet within which the first hit is searched.
    """

    middle: Triple
    eye: Triple
    lift: Triple
    right: Triple
    down: Triple
    half_m: float
    columns: float
    rows: float
    reach_m: float


COLUMN, SHARE, MEAN_B, MEAN_BP, MEAN_BQ, MEAN_REFLECTED = range(6)
LINE_FIELDS = 6

_LONGEST = 6.0  # times the shorter side, the footprint's longer one
_SPARED = 0.9  # of a part: a footprint that is longer by less has no more of them
_REACH, _FARTHEST = 1.0, 24.0  # pixels: lifts of a facet within which first hits are searched, along the ground
_SQUARE_POSTS = 4.0  # along the side of a part's square
_TINY, _ZERO, _GRAZING = np.float32(1e-30), np.float32(0.0), np.float32(GRAZING)


@lane
def into_world(turn: Floats, x: float, y: float, z: float) -> Triple:
    """Return a direction in the world from one in camera axes."""
    return (
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
        turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z,
    )


@lane
def shorter_side(ax: float, ay: float, bx: float, by: float, ratio: float) -> float:
    """Return the length of the footprint's shorter side that a and b span, the longer one's over `ratio` at least."""
    # The sides are the roots of the eigenvalues of the spread.
    qxx, qxy, qyy = ax * ax + bx * bx, ax * ay + bx * by, ay * ay + by * by
    mean, apart = 0.5 * (qxx + qyy), math.sqrt(0.25 * (qxx - qyy) ** 2 + qxy * qxy)
    return math.sqrt(max(mean - apart, (mean + apart) * (1.0 / (ratio * ratio))))


@kernel
def part_means(
    row: int,
    first: int,
    last: int,
    edge_on: bool,
    sight: Sight,
    posts: Posts,
    top: int,
    samples: float,
    towards: Floats,
    tile: Tile,
    line: Floats,
) -> None:
    """Write the means of b, b p, b q and b / (mu0 + mu) over the parts of a row's listed pixels.

    Parameters
    ----------
    first, last : of the columns listed in `line`, and the one after the last.
    edge_on : the first hits of rays are searched; else one near the facet is taken.
    top : coarsest level.
    samples : parts of a pixel along the shorter side of its footprint.
    """
    per_m = 2.0 / (_SQUARE_POSTS * posts.grids.unit_m)
    filled: int = NONE
    for k in range(first, last):
        for field in (MEAN_B, MEAN_BP, MEAN_BQ, MEAN_REFLECTED):
            line[field, k] = 0.0
        column = int(line[COLUMN, k])
        parts = _divided(row, column, sight, samples)
        count = parts.columns * parts.rows
        line[SHARE, k] = 1.0 / count
        # Parts of one pixel after another fill tiles; a full tile is added to its pixels.
        for part in range(int(count)):
            _put(filled, k, part, parts, per_m, tile)
            filled += 1
            if filled == TILE:
                _finish(filled, edge_on, posts, top, sight.place, towards, tile, line)
                filled = NONE
    _finish(filled, edge_on, posts, top, sight.place, towards, tile, line)


@lane
def _divided(row: int, column: int, sight: Sight, samples: float) -> _Parts:
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
    shorter = shorter_side(a[0], a[1], b[0], b[1], _LONGEST)
    parts = samples / shorter
    return _Parts(
        (depth * dx, depth * dy, depth * dz),
        (dx * per_d, dy * per_d, dz * per_d),
        (lift * dx, lift * dy, lift * dz),
        (a[0] * step, a[1] * step, a[2] * step),
        (b[0] * step, b[1] * step, b[2] * step),
        0.5 * shorter * step / samples,
        max(math.ceil(parts * math.sqrt(a[0] * a[0] + a[1] * a[1]) - _SPARED), 1.0),
        max(math.ceil(parts * math.sqrt(b[0] * b[0] + b[1] * b[1]) - _SPARED), 1.0),
        step * min(_REACH, _FARTHEST / max(abs(lift) * math.sqrt(dx * dx + dy * dy), 1e-9)),
    )


@lane
def _put(n: int, k: int, part: int, parts: _Parts, per_m: float, tile: Tile) -> None:
    """Write part `part` of the listed pixel k as number n of the tile: one box without doubt."""
    s, middle, a, b = tile.fields, parts.middle, parts.right, parts.down
    line = part // int(parts.columns)
    right, down = (part - line * parts.columns + 0.5) / parts.columns - 0.5, (line + 0.5) / parts.rows - 0.5
    s[t.X * TILE + n] = middle[0] + right * a[0] + down * b[0]
    s[t.Y * TILE + n] = middle[1] + right * a[1] + down * b[1]
    s[t.Z * TILE + n] = middle[2] + right * a[2] + down * b[2]
    set_triple(s, t.LIFT_X, n, parts.lift[0], parts.lift[1], parts.lift[2])
    set_triple(s, t.EYE_X, n, parts.eye[0], parts.eye[1], parts.eye[2])
    s[t.HALF_X * TILE + n] = s[t.HALF_Y * TILE + n] = parts.half_m
    s[t.SIZE * TILE + n] = parts.half_m * per_m
    s[t.REACH * TILE + n] = parts.reach_m
    s[t.TAPS * TILE + n] = 1.0
    s[t.TAP_X * TILE + n] = s[t.TAP_Y * TILE + n] = 0.0
    s[t.DOUBT * TILE + n] = 0.0
    tile.places[t.PIXEL * TILE + n] = k


@kernel
def _finish(
    count: int, edge_on: bool, posts: Posts, top: int, place: Floats, towards: Floats, tile: Tile, line: Floats
) -> None:
    """Add the means over the squares around the first `count` parts of a tile to their pixels."""
    s, places, sums = tile.fields, tile.places, tile.sums
    write_levels(count, posts, top, place, Fields(t.X, t.Y, t.SIZE), s, places)
    up = np.float32(place[2])
    if edge_on:
        meet_first(posts.heights, up, s, places)
    else:
        meet_map(posts.heights, up, s, places)
    for k in range(TILE):
        s[t.MIDDLE_X * TILE + k], s[t.MIDDLE_Y * TILE + k] = s[t.X * TILE + k], s[t.Y * TILE + k]
        s[t.BOX_SIZE * TILE + k] = s[t.SIZE * TILE + k]
    box_means(count, posts, top, place, _SQUARE_POSTS, False, tile)
    _reflected(towards, s, sums)
    for n in range(count):
        k = places[t.PIXEL * TILE + n]
        share = line[SHARE, k]
        line[MEAN_B, k] += share * sums[n * MOMENTS + B]
        line[MEAN_BP, k] += share * sums[n * MOMENTS + BP]
        line[MEAN_BQ, k] += share * sums[n * MOMENTS + BQ]
        line[MEAN_REFLECTED, k] += share * s[t.FAST * TILE + n]


@vector_kernel
def _reflected(towards: Floats, s: Floats32, sums: Floats32) -> None:
    """Write b / (mu0 + mu) of the mean slope of each square."""
    sx, sy, sz = np.float32(towards[0]), np.float32(towards[1]), np.float32(towards[2])
    for k in range(TILE):
        b = max(sums[k * MOMENTS + B], _ZERO)
        bp, bq = sums[k * MOMENTS + BP], sums[k * MOMENTS + BQ]
        ex, ey, ez = triple(s, t.EYE_X, k)
        n = math.sqrt(b * b + bp * bp + bq * bq)
        lit = max(b * sz - bp * sx - bq * sy, _ZERO)
        seen = b * ez - bp * ex - bq * ey
        s[t.FAST * TILE + k] = b * n / max(lit + max(seen, _GRAZING * n), _TINY)

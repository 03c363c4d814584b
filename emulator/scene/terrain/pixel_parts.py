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

import numpy as np

from emulator.raster.layout import Floats, W, WHighest, WLowest
from emulator.scene.terrain.block_vertices import GRAZING
from emulator.scene.terrain.ground import BP, BQ, MOMENTS, B
from emulator.scene.terrain.pixel_boxes import box_means
from emulator.scene.terrain.pixel_hits import Posts, Screen, Sight, meet_first, meet_map, write_levels
from emulator.scene.terrain.tile import (
    BOX_SIZE,
    DOUBT,
    EYE_X,
    EYE_Y,
    EYE_Z,
    FAST,
    HALF_X,
    HALF_Y,
    LIFT_X,
    LIFT_Y,
    LIFT_Z,
    MIDDLE_X,
    MIDDLE_Y,
    PIXEL,
    REACH,
    SIZE,
    TAP_X,
    TAP_Y,
    TAPS,
    TILE,
    Floats32,
    Ints32,
    X,
    Y,
    Z,
)
from emulator.sensor.numerics.compiled import NONE, kernel, lane, vector_kernel

Triple = tuple[float, float, float]
_Plane = tuple[Triple, Triple, Triple, Triple, Triple, float, float, float, float]
"""A pixel's middle from the camera, unit vector to the eye, change of the middle for lifting the facet by a metre, for
a pixel to the right and for one down, half the side of a part's square, and how many parts across and down."""

COLUMN, SHARE, MEAN_B, MEAN_BP, MEAN_BQ, MEAN_REFLECTED = range(6)
LINE_FIELDS = 6

_MOST_LONG = 6.0  # times the shorter side, the footprint's longer one
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
def shorter_side(ax: float, ay: float, bx: float, by: float, most: float) -> float:
    """Return the length of the footprint's shorter side that a and b span, the longer one's over `most` at least."""
    qxx, qxy, qyy = ax * ax + bx * bx, ax * ay + bx * by, ay * ay + by * by
    mean, apart = 0.5 * (qxx + qyy), math.sqrt(0.25 * (qxx - qyy) ** 2 + qxy * qxy)
    return math.sqrt(max(mean - apart, (mean + apart) * (1.0 / (most * most))))


@kernel
def part_means(
    listed: tuple[int, int, int],
    edge_on: bool,
    sight: Sight,
    posts: Posts,
    top: int,
    samples: float,
    towards: Floats,
    room: tuple[Floats32, Ints32, Floats32, Floats],
    line: Floats,
) -> None:
    """Write the means of b, b p, b q and b / (mu0 + mu) over the parts of a row's listed pixels.

    Parameters
    ----------
    listed : row, first of its columns listed in `line`, and the one after the last.
    edge_on : the first hits of rays are searched; else one near the facet is taken.
    top : coarsest level.
    samples : parts of a pixel along the shorter side of its footprint.
    room : of `new_tile`.
    """
    s, places = room[:2]
    per_m = 2.0 / (_SQUARE_POSTS * posts.ground[0])
    filled: int = NONE
    row, first, last = listed
    for k in range(first, last):
        for field in (MEAN_B, MEAN_BP, MEAN_BQ, MEAN_REFLECTED):
            line[field, k] = 0.0
        column = int(line[COLUMN, k])
        plane = _plane(row, column, sight.facets[sight.owner[row, column]], sight.screen, sight.turn, samples)
        parts = plane[6] * plane[7]
        line[SHARE, k] = 1.0 / parts
        for part in range(int(parts)):
            _put(filled, k, part, plane, per_m, s, places)
            filled += 1
            if filled == TILE:
                _finish(filled, edge_on, posts, top, sight.place, towards, room, line)
                filled = NONE
    _finish(filled, edge_on, posts, top, sight.place, towards, room, line)


@lane
def _plane(row: int, column: int, facet: Floats, screen: Screen, turn: Floats, samples: float) -> _Plane:
    """Return a pixel's middle on its facet, its direction and changes; see `_Plane`."""
    focal, cx, cy = screen
    right, down = column + 0.5, row + 0.5
    x, y = (right - cx) / focal, (down - cy) / focal
    w0, wx, wy = facet[W], facet[W + 1], facet[W + 2]
    far = 1.0 / min(max(w0 + wx * right + wy * down, facet[WLowest]), facet[WHighest])
    _, _, nz = into_world(turn, focal * wx, focal * wy, w0 + wx * cx + wy * cy)
    dx, dy, dz = into_world(turn, x, y, 1.0)
    per_d = -1.0 / math.sqrt(1.0 + x * x + y * y)
    across, along = focal * wx * far, focal * wy * far
    a = turn[0, 0] - across * dx, turn[0, 1] - across * dy, turn[0, 2] - across * dz
    b = turn[1, 0] - along * dx, turn[1, 1] - along * dy, turn[1, 2] - along * dz
    step, lift = far / focal, far * nz
    shorter = shorter_side(a[0], a[1], b[0], b[1], _MOST_LONG)
    parts = samples / shorter
    return (
        (far * dx, far * dy, far * dz),
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
def _put(n: int, k: int, part: int, plane: _Plane, per_m: float, s: Floats32, places: Ints32) -> None:
    """Write part `part` of the listed pixel k as number n of the tile."""
    middle, eye, lift, a, b, half, columns, rows, reach = plane
    line = part // int(columns)
    right, down = (part - line * columns + 0.5) / columns - 0.5, (line + 0.5) / rows - 0.5
    s[X * TILE + n] = middle[0] + right * a[0] + down * b[0]
    s[Y * TILE + n] = middle[1] + right * a[1] + down * b[1]
    s[Z * TILE + n] = middle[2] + right * a[2] + down * b[2]
    s[LIFT_X * TILE + n], s[LIFT_Y * TILE + n], s[LIFT_Z * TILE + n] = lift
    s[EYE_X * TILE + n], s[EYE_Y * TILE + n], s[EYE_Z * TILE + n] = eye
    s[HALF_X * TILE + n] = s[HALF_Y * TILE + n] = half
    s[SIZE * TILE + n] = half * per_m
    s[REACH * TILE + n] = reach
    s[TAPS * TILE + n], s[TAP_X * TILE + n], s[TAP_Y * TILE + n], s[DOUBT * TILE + n] = 1.0, 0.0, 0.0, 0.0
    places[PIXEL * TILE + n] = k


@kernel
def _finish(
    count: int,
    edge_on: bool,
    posts: Posts,
    top: int,
    place: Floats,
    towards: Floats,
    room: tuple[Floats32, Ints32, Floats32, Floats],
    line: Floats,
) -> None:
    """Add the means over the squares around the first `count` parts of a tile to their pixels."""
    s, places, sums, _ = room
    table = posts.levels, posts.ground, top
    write_levels(count, table, place, (X, Y, SIZE), s, places)
    up = np.float32(place[2])
    if edge_on:
        meet_first(posts.heights, up, s, places)
    else:
        meet_map(posts.heights, up, s, places)
    for k in range(TILE):
        s[MIDDLE_X * TILE + k], s[MIDDLE_Y * TILE + k] = s[X * TILE + k], s[Y * TILE + k]
        s[BOX_SIZE * TILE + k] = s[SIZE * TILE + k]
    box_means(count, posts.moments, table, place, _SQUARE_POSTS, False, s, places, sums)
    _reflected(towards, s, sums)
    for n in range(count):
        k = places[PIXEL * TILE + n]
        share = line[SHARE, k]
        line[MEAN_B, k] += share * sums[n * MOMENTS + B]
        line[MEAN_BP, k] += share * sums[n * MOMENTS + BP]
        line[MEAN_BQ, k] += share * sums[n * MOMENTS + BQ]
        line[MEAN_REFLECTED, k] += share * s[FAST * TILE + n]


@vector_kernel
def _reflected(towards: Floats, s: Floats32, sums: Floats32) -> None:
    """Write b / (mu0 + mu) of the mean slope of each square."""
    sx, sy, sz = np.float32(towards[0]), np.float32(towards[1]), np.float32(towards[2])
    for k in range(TILE):
        b, bp, bq = max(sums[k * MOMENTS + B], _ZERO), sums[k * MOMENTS + BP], sums[k * MOMENTS + BQ]
        n = math.sqrt(b * b + bp * bp + bq * bq)
        lit = max(b * sz - bp * sx - bq * sy, _ZERO)
        seen = b * s[EYE_Z * TILE + k] - bp * s[EYE_X * TILE + k] - bq * s[EYE_Y * TILE + k]
        s[FAST * TILE + k] = b * n / max(lit + max(seen, _GRAZING * n), _TINY)

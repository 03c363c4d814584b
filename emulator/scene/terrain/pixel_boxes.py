"""Means of the ground's moments over the footprints of pixels, from one box or more each.

The hits of a pixel's four corners give its footprint: the middle C and the mean sides A and B, right and down. Seen
from above its spread is m = A A' + B B', with the eigenvalues l1 >= l2, l2 raised to l1 / 144, and the major axis v.
Boxes lie along the axes of the map, so

    one box        where |m12| < 0.12 l2 and l1 < 2.56 l2: half sides sqrt(m11) / 2, sqrt(m22) / 2
    n boxes        else, in a line along v, n = max(2, floor(sqrt(l1 / l2) + 0.65)): with the spread
                   S = min(l1 (1 - 1 / n^2), l1 - l2) they are sqrt(S / (n^2 - 1)) apart, half sides
                   sqrt(m11 - S vx^2) / 2 and sqrt(m22 - S vy^2) / 2, whose squares are l2 / 4 at least

have the spread of the footprint. They are taken from the finest level on which they are at most 8 posts long, and mixed
with those of the next one in the last tenth of the level's range.

A pixel is doubtful where this does not hold: where the ground is seen edge-on, where the corners' hits do not span a
parallelogram, and where its own facet has other corners than its neighbours' facets.
"""

from __future__ import annotations

import math

import numpy as np

from emulator.raster.layout import Floats
from emulator.scene.terrain.box_moments import MOST_POSTS, add_box, add_box_and_rate
from emulator.scene.terrain.ground import MOMENTS, Halves
from emulator.scene.terrain.pixel_hits import Screen, Table, clamp, write_levels
from emulator.scene.terrain.tile import (
    ABOVE_W,
    ABOVE_X,
    ABOVE_Y,
    ABOVE_Z,
    AXIS,
    BOX_SIZE,
    BOX_U,
    BOX_V,
    CORNER_W,
    DOUBT,
    EYE_X,
    EYE_Y,
    EYE_Z,
    FIRST_X,
    FIRST_Y,
    HALF_U,
    HALF_V,
    HALF_X,
    HALF_Y,
    LAST_X,
    LAST_Y,
    LEVEL,
    LEVEL_COLUMNS,
    LEVEL_FIRST,
    LEVEL_ROWS,
    LONGER,
    MIDDLE_X,
    MIDDLE_Y,
    MOVE_X,
    MOVE_Y,
    NEXT,
    OWN_ACROSS,
    OWN_DOWN,
    OWN_W,
    PER_M,
    RATES,
    SHORTER,
    SPREAD_X,
    SPREAD_XY,
    SPREAD_Y,
    STEP_U,
    STEP_V,
    TAP_X,
    TAP_Y,
    TAPS,
    TILE,
    WEIGHT,
    Floats32,
    Ints32,
    X,
    Y,
    Z,
)
from emulator.sensor.numerics.compiled import lane, vector_kernel

_BLEND = 0.9  # of a level's range: where the next one begins to be mixed in

_f = np.float32
_TINY, _ZERO, _QUARTER, _HALF, _ONE, _TWO = (_f(v) for v in (1e-20, 0.0, 0.25, 0.5, 1.0, 2.0))
_LONGEST2 = _f(1.0 / 144.0)
_LEAN, _ROUND2, _ROUNDED = _f(0.12), _f(2.56), _f(0.65)
_EDGE_ON2, _TWIST2 = _f(0.1**2), _f(0.5**2)
_LEAST, _MOST_HALF = _f(0.01), _f(0.5 * (MOST_POSTS - 2))  # half sides of a box in posts
_BLENDED = _f(_BLEND / (1.0 - _BLEND))


@vector_kernel
def footprints(at: tuple[int, int], screen: Screen, turn: Floats, unit: float, s: Floats32) -> None:
    """Write the boxes of a row of pixels, unit vectors to the eye, and whether they are doubtful."""
    _eyes(at, screen, turn, s)
    _sides(s)
    _boxes(_f(2.0 / (unit * (MOST_POSTS - 2))), s)


@vector_kernel
def _eyes(at: tuple[int, int], screen: Screen, turn: Floats, s: Floats32) -> None:
    """Write unit vectors from the pixels' middles to the eye."""
    per_focal = _f(1.0 / screen[0])
    y = (at[0] + 0.5 - screen[2]) / screen[0]
    first = _f((at[1] + 0.5 - screen[1]) / screen[0])
    ax, ay, az = _f(turn[0, 0]), _f(turn[0, 1]), _f(turn[0, 2])
    bx, by, bz = _f(turn[1, 0] * y + turn[2, 0]), _f(turn[1, 1] * y + turn[2, 1]), _f(turn[1, 2] * y + turn[2, 2])
    for k in range(TILE):
        x = first + _f(np.int32(k)) * per_focal
        dx, dy, dz = ax * x + bx, ay * x + by, az * x + bz
        per_d = -_ONE / math.sqrt(dx * dx + dy * dy + dz * dz)
        s[EYE_X * TILE + k], s[EYE_Y * TILE + k], s[EYE_Z * TILE + k] = dx * per_d, dy * per_d, dz * per_d


@vector_kernel
def _sides(s: Floats32) -> None:
    """Write the footprints' middles and spreads, and doubt where they are seen edge-on or twisted."""
    for k in range(TILE):
        x00, y00, z00 = s[ABOVE_X * TILE + k], s[ABOVE_Y * TILE + k], s[ABOVE_Z * TILE + k]
        x01, y01, z01 = s[ABOVE_X * TILE + k + 1], s[ABOVE_Y * TILE + k + 1], s[ABOVE_Z * TILE + k + 1]
        x10, y10, z10 = s[X * TILE + k], s[Y * TILE + k], s[Z * TILE + k]
        x11, y11, z11 = s[X * TILE + k + 1], s[Y * TILE + k + 1], s[Z * TILE + k + 1]
        s[MIDDLE_X * TILE + k] = _QUARTER * (x00 + x01 + x10 + x11)
        s[MIDDLE_Y * TILE + k] = _QUARTER * (y00 + y01 + y10 + y11)
        rx, ry, rz = _HALF * (x01 - x00 + x11 - x10), _HALF * (y01 - y00 + y11 - y10), _HALF * (z01 - z00 + z11 - z10)
        lx, ly, lz = _HALF * (x10 - x00 + x11 - x01), _HALF * (y10 - y00 + y11 - y01), _HALF * (z10 - z00 + z11 - z01)
        m11, m12, m22 = rx * rx + lx * lx, rx * ry + lx * ly, ry * ry + ly * ly
        mean, slant = _HALF * (m11 + m22), _HALF * (m11 - m22)
        apart = math.sqrt(slant * slant + m12 * m12)
        longer = max(mean + apart, _TINY)
        shorter = max(mean - apart, longer * _LONGEST2)
        s[SPREAD_X * TILE + k], s[SPREAD_XY * TILE + k], s[SPREAD_Y * TILE + k] = m11, m12, m22
        s[LONGER * TILE + k], s[SHORTER * TILE + k] = longer, shorter
        # Half the difference of m11 and m22 over that of the eigenvalues: the cosine of twice the major axis' angle.
        s[AXIS * TILE + k] = slant / max(apart, _TINY)
        nx, ny, nz = ry * lz - rz * ly, rz * lx - rx * lz, rx * ly - ry * lx
        facing = nx * s[EYE_X * TILE + k] + ny * s[EYE_Y * TILE + k] + nz * s[EYE_Z * TILE + k]
        tx, ty, tz = x00 - x01 - x10 + x11, y00 - y01 - y10 + y11, z00 - z01 - z10 + z11
        edge_on = _EDGE_ON2 * (nx * nx + ny * ny + nz * nz) - facing * facing
        twisted = tx * tx + ty * ty + tz * tz - _TWIST2 * shorter
        s[DOUBT * TILE + k] = _ONE if max(edge_on, twisted) > _ZERO else _ZERO


@vector_kernel
def _boxes(per_m: float, s: Floats32) -> None:
    """Write the boxes of footprints; `per_m` brings half a side to a share of the longest one in level 0."""
    for k in range(TILE):
        m11, m12, m22 = s[SPREAD_X * TILE + k], s[SPREAD_XY * TILE + k], s[SPREAD_Y * TILE + k]
        l1, l2 = s[LONGER * TILE + k], s[SHORTER * TILE + k]
        lean = max(abs(m12) - _LEAN * l2, l1 - _ROUND2 * l2)
        n = max(_f(np.int32(math.sqrt(l1 / l2) + _ROUNDED)), _TWO)
        spread = min(l1 - l1 / (n * n), l1 - l2)
        n = n if lean >= _ZERO else _ONE
        spread = spread if lean >= _ZERO else _ZERO
        vx2 = min(max(_HALF + _HALF * s[AXIS * TILE + k], _ZERO), _ONE)
        vy2 = _ONE - vx2
        half_x = _HALF * math.sqrt(max(m11 - spread * vx2, _QUARTER * l2))
        half_y = _HALF * math.sqrt(max(m22 - spread * vy2, _QUARTER * l2))
        tap2 = spread / max(n * n - _ONE, _ONE)
        tap_y = math.sqrt(tap2 * vy2)
        s[TAPS * TILE + k] = n
        s[TAP_X * TILE + k] = math.sqrt(tap2 * vx2)
        s[TAP_Y * TILE + k] = -tap_y if m12 < _ZERO else tap_y
        s[HALF_X * TILE + k], s[HALF_Y * TILE + k] = half_x, half_y
        s[BOX_SIZE * TILE + k] = max(half_x, half_y) * per_m


@vector_kernel
def mismatches(focal: float, s: Floats32) -> None:
    """Make pixels doubtful whose facet has other corners than the neighbours' facets."""
    per_focal = _f(0.5 / focal)
    for k in range(TILE):
        w, across, down = s[OWN_W * TILE + k], s[OWN_ACROSS * TILE + k], s[OWN_DOWN * TILE + k]
        across, down = _HALF * across, _HALF * down
        bound = abs(across) + abs(down) + w * per_focal
        worst = max(
            abs(w + across - down - s[ABOVE_W * TILE + k + 1]),
            abs(w - across + down - s[CORNER_W * TILE + k]),
            abs(w + across + down - s[CORNER_W * TILE + k + 1]),
        )
        if worst > bound:
            s[DOUBT * TILE + k] = _ONE


@vector_kernel
def box_means(
    count: int,
    moments: Halves,
    posts: tuple[Table, tuple[float, int, float], int],
    place: Floats,
    longest: float,
    moving: bool,
    s: Floats32,
    places: Ints32,
    sums: Floats32,
) -> None:
    """Write the means of the moments over the boxes of `count` pixels that are not doubtful, MOMENTS each.

    Parameters
    ----------
    posts, place : of `write_levels`.
    longest : side of a box, posts; BOX_SIZE is the side over it.
    moving : the rates of the means are written too, from RATES on, for boxes that move by MOVE_X and MOVE_Y.
    """
    write_levels(count, posts, place, (MIDDLE_X, MIDDLE_Y, BOX_SIZE), s, places)
    _windows(_f(2.0 / (longest * (1.0 - _BLEND))), s)
    _add_boxes(count, moving, moments, s, places, sums)
    for k in range(count):
        part = s[NEXT * TILE + k]
        if part > 0.0 and s[DOUBT * TILE + k] <= 0.0:
            _add_next((k, part, moving), moments, posts[0], posts[1][0], place, s, places, sums)


@vector_kernel
def _windows(per_blend: float, s: Floats32) -> None:
    """Write the boxes in posts of their level, and the share of the next one."""
    for k in range(TILE):
        per_m, n = s[PER_M * TILE + k], s[TAPS * TILE + k]
        half_u = min(max(s[HALF_X * TILE + k] * per_m, _LEAST), _MOST_HALF)
        half_v = min(max(s[HALF_Y * TILE + k] * per_m, _LEAST), _MOST_HALF)
        step_u, step_v = s[TAP_X * TILE + k] * per_m, s[TAP_Y * TILE + k] * per_m
        back = _HALF * (n - _ONE)
        s[BOX_U * TILE + k] = s[FIRST_X * TILE + k] + s[MIDDLE_X * TILE + k] * per_m - back * step_u
        s[BOX_V * TILE + k] = s[FIRST_Y * TILE + k] + s[MIDDLE_Y * TILE + k] * per_m - back * step_v
        s[HALF_U * TILE + k], s[HALF_V * TILE + k] = half_u, half_v
        s[STEP_U * TILE + k], s[STEP_V * TILE + k] = step_u, step_v
        part = min(max(max(s[HALF_X * TILE + k], s[HALF_Y * TILE + k]) * per_m * per_blend - _BLENDED, _ZERO), _ONE)
        s[NEXT * TILE + k] = part
        s[WEIGHT * TILE + k] = (_ONE - part) / (n * half_u * half_v)
        s[LAST_X * TILE + k] = max(s[LAST_X * TILE + k] - half_u, half_u)
        s[LAST_Y * TILE + k] = max(s[LAST_Y * TILE + k] - half_v, half_v)


@vector_kernel
def _add_boxes(count: int, moving: bool, moments: Halves, s: Floats32, places: Ints32, sums: Floats32) -> None:
    """Write the means over boxes, times their weights."""
    for k in range(count):
        for n in range(MOMENTS):
            sums[k * MOMENTS + n] = sums[RATES + k * MOMENTS + n] = 0.0
        if s[DOUBT * TILE + k] > 0.0:
            continue
        first, columns = np.int64(places[LEVEL_FIRST * TILE + k]), np.int64(places[LEVEL_COLUMNS * TILE + k])
        half_u, half_v = s[HALF_U * TILE + k], s[HALF_V * TILE + k]
        last_u, last_v = s[LAST_X * TILE + k], s[LAST_Y * TILE + k]
        u, v, weight = s[BOX_U * TILE + k], s[BOX_V * TILE + k], s[WEIGHT * TILE + k]
        level = first, columns, np.int64(places[LEVEL_ROWS * TILE + k])
        move = s[MOVE_X * TILE + k] * s[PER_M * TILE + k], s[MOVE_Y * TILE + k] * s[PER_M * TILE + k]
        for _ in range(np.int32(s[TAPS * TILE + k])):
            box = clamp(u, half_u, last_u), clamp(v, half_v, last_v), half_u, half_v, weight
            if moving:
                add_box_and_rate(moments, level, (*box, *move), sums, k * MOMENTS)
            else:
                add_box(moments, level, box, sums, k * MOMENTS)
            u, v = u + s[STEP_U * TILE + k], v + s[STEP_V * TILE + k]


@lane
def _add_next(
    which: tuple[int, float, bool],
    moments: Halves,
    levels: Table,
    unit: float,
    place: Floats,
    s: Floats32,
    places: Ints32,
    sums: Floats32,
) -> None:
    """Add the means over the boxes of a pixel on the next level, times `part`; which: pixel, `part`, `moving`."""
    k, part, moving = which
    level = places[LEVEL * TILE + k] + 1
    rows, columns = levels[level, 1], levels[level, 2]
    per_unit = 1.0 / (1 << level)
    u = (place[0] / unit - levels[level, 3]) * per_unit + s[MIDDLE_X * TILE + k] * per_unit / unit
    v = (place[1] / unit - levels[level, 4]) * per_unit + s[MIDDLE_Y * TILE + k] * per_unit / unit
    half_u, half_v, n = 0.5 * s[HALF_U * TILE + k], 0.5 * s[HALF_V * TILE + k], s[TAPS * TILE + k]
    last_u, last_v = max(columns - 1.001 - half_u, half_u), max(rows - 1.001 - half_v, half_v)
    step_u, step_v = 0.5 * s[STEP_U * TILE + k], 0.5 * s[STEP_V * TILE + k]
    u, v = u - 0.5 * (n - 1.0) * step_u, v - 0.5 * (n - 1.0) * step_v
    weight = part / (n * half_u * half_v)
    move = _f(s[MOVE_X * TILE + k] * per_unit / unit), _f(s[MOVE_Y * TILE + k] * per_unit / unit)
    for _ in range(np.int32(n)):
        at_u, at_v = _f(clamp(u, half_u, last_u)), _f(clamp(v, half_v, last_v))
        box = at_u, at_v, _f(half_u), _f(half_v), _f(weight)
        if moving:
            add_box_and_rate(moments, (levels[level, 0], columns, rows), (*box, *move), sums, k * MOMENTS)
        else:
            add_box(moments, (levels[level, 0], columns, rows), box, sums, k * MOMENTS)
        u, v = u + step_u, v + step_v

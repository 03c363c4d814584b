"""Means of the ground's moments over the footprints of pixels, from one box or more each.

The hits of a pixel's four corners give its footprint: the middle C and the mean sides A and B, right and down. Seen
from above its spread is m = A A' + B B', with the eigenvalues l1 >= l2, l2 raised to l1 / 144, and the major axis v.
Boxes lie along the axes of the map, so

    one box        where |m12| < 0.12 l2 and l1 < 2.56 l2: half sides sqrt(m11) / 2, sqrt(m22) / 2
    n boxes        else, in a line along v, n = max(2, floor(sqrt(l1 / l2) + 0.65)): with the spread
                   S = min(l1 (1 - 1 / n^2), l1 - l2) they are sqrt(S / (n^2 - 1)) apart, half sides
                   sqrt(m11 - S vx^2) / 2 and sqrt(m22 - S vy^2) / 2, whose squares are l2 / 4 at least

have the spread of the footprint. They are taken from the finest level on which they are at most 4 posts long, and mixed
with those of the next one in the last tenth of the level's range. One box is enough where a footprint is shorter than
the distance of posts.

A pixel is doubtful where this does not hold: where the ground is seen edge-on, where the corners' hits do not span a
parallelogram, and where its own facet has other corners than its neighbours' facets.
"""

from __future__ import annotations

import math

import numpy as np

from emulator.scene.terrain import tile as t
from emulator.scene.terrain.box_moments import MOST_POSTS, add_box
from emulator.scene.terrain.ground import Halves
from emulator.scene.terrain.pixel_hits import Fields, Posts, Projection, clamp, write_levels
from emulator.scene.terrain.tile import MOMENTS, RATES, TILE, Tile, set_triple, triple
from emulator.sensor.numerics.compiled import lane, vector_kernel
from firmware_protocol.events import Float32s, Floats, Int32s

LONGEST = MOST_POSTS - 2.0
"""Side of a box, posts; BOX_SIZE is the side over it."""

_BLEND = 0.9  # of a level's range: where the next one begins to be mixed in

_f = np.float32
_TINY, _ZERO, _QUARTER, _HALF, _ONE, _TWO = (_f(v) for v in (1e-20, 0.0, 0.25, 0.5, 1.0, 2.0))
_LONGEST2 = _f(1.0 / 144.0)
_SHORT2 = _f(1.0**2)  # posts along the longer axis
_LEAN, _ROUND2, _ROUNDED = _f(0.12), _f(2.56), _f(0.65)
_EDGE_ON2, _TWIST2 = _f(0.1**2), _f(0.5**2)
_LEAST, _MOST_HALF = _f(0.01), _f(0.5 * LONGEST)  # half sides of a box in posts
_PER_BLEND, _BLENDED = _f(2.0 / (LONGEST * (1.0 - _BLEND))), _f(_BLEND / (1.0 - _BLEND))


@vector_kernel
def footprints(row: int, first: int, projection: Projection, turn: Floats, unit_m: float, s: Float32s) -> None:
    """Write the boxes of a row of pixels from column `first` on, unit vectors to the eye, and which are doubtful."""
    _eyes(row, first, projection, turn, s)
    _sides(s)
    _boxes(_f(2.0 / (unit_m * LONGEST)), s)


@vector_kernel
def _eyes(row: int, first: int, projection: Projection, turn: Floats, s: Float32s) -> None:
    """Write unit vectors from the pixels' middles to the eye."""
    focal = projection.focal_px
    per_focal = _f(1.0 / focal)
    y = (row + 0.5 - projection.row) / focal
    x_first = _f((first + 0.5 - projection.column) / focal)
    # A direction in the world is linear in the column: a x + b along the row.
    ax, ay, az = _f(turn[0, 0]), _f(turn[0, 1]), _f(turn[0, 2])
    bx = _f(turn[1, 0] * y + turn[2, 0])
    by = _f(turn[1, 1] * y + turn[2, 1])
    bz = _f(turn[1, 2] * y + turn[2, 2])
    for k in range(TILE):
        x = x_first + _f(np.int32(k)) * per_focal
        dx, dy, dz = ax * x + bx, ay * x + by, az * x + bz
        per_d = -_ONE / math.sqrt(dx * dx + dy * dy + dz * dz)
        set_triple(s, t.EYE_X, k, dx * per_d, dy * per_d, dz * per_d)


@vector_kernel
def _sides(s: Float32s) -> None:
    """Write the footprints' middles and spreads, and doubt where they are seen edge-on or twisted."""
    for k in range(TILE):
        # Hits of the corners, 0 and 1 above and below, left and right.
        x00, y00, z00 = triple(s, t.ABOVE_X, k)
        x01, y01, z01 = triple(s, t.ABOVE_X, k + 1)
        x10, y10, z10 = triple(s, t.X, k)
        x11, y11, z11 = triple(s, t.X, k + 1)
        s[t.MIDDLE_X * TILE + k] = _QUARTER * (x00 + x01 + x10 + x11)
        s[t.MIDDLE_Y * TILE + k] = _QUARTER * (y00 + y01 + y10 + y11)
        s[t.MIDDLE_Z * TILE + k] = _QUARTER * (z00 + z01 + z10 + z11)
        # Mean sides to the right and down, and their spread as seen from above with its eigenvalues.
        rx, ry, rz = _HALF * (x01 - x00 + x11 - x10), _HALF * (y01 - y00 + y11 - y10), _HALF * (z01 - z00 + z11 - z10)
        lx, ly, lz = _HALF * (x10 - x00 + x11 - x01), _HALF * (y10 - y00 + y11 - y01), _HALF * (z10 - z00 + z11 - z01)
        m11, m12, m22 = rx * rx + lx * lx, rx * ry + lx * ly, ry * ry + ly * ly
        mean, slant = _HALF * (m11 + m22), _HALF * (m11 - m22)
        apart = math.sqrt(slant * slant + m12 * m12)
        longer = max(mean + apart, _TINY)
        shorter = max(mean - apart, longer * _LONGEST2)
        set_triple(s, t.SPREAD_X, k, m11, m12, m22)
        s[t.LONGER * TILE + k] = longer
        s[t.SHORTER * TILE + k] = shorter
        # Half the difference of m11 and m22 over that of the eigenvalues: the cosine of twice the major axis' angle.
        s[t.AXIS * TILE + k] = slant / max(apart, _TINY)
        # Edge-on: the footprint's normal is nearly across the direction to the eye.
        nx, ny, nz = ry * lz - rz * ly, rz * lx - rx * lz, rx * ly - ry * lx
        set_triple(s, t.ACROSS_X, k, nx, ny, nz)
        ex, ey, ez = triple(s, t.EYE_X, k)
        facing = nx * ex + ny * ey + nz * ez
        edge_on = _EDGE_ON2 * (nx * nx + ny * ny + nz * nz) - facing * facing
        # Twisted: the diagonals' middles are apart.
        tx, ty, tz = x00 - x01 - x10 + x11, y00 - y01 - y10 + y11, z00 - z01 - z10 + z11
        twisted = tx * tx + ty * ty + tz * tz - _TWIST2 * shorter
        s[t.DOUBT * TILE + k] = _ONE if max(edge_on, twisted) > _ZERO else _ZERO


@vector_kernel
def _boxes(per_m: float, s: Float32s) -> None:
    """Write the boxes of footprints; `per_m` brings half a side to a share of the longest one in level 0."""
    for k in range(TILE):
        m11, m12, m22 = triple(s, t.SPREAD_X, k)
        l1, l2 = s[t.LONGER * TILE + k], s[t.SHORTER * TILE + k]
        # One box where the footprint is round or lies along the map's axes, else n in a line with the spread S.
        lean = max(abs(m12) - _LEAN * l2, l1 - _ROUND2 * l2)
        n = max(_f(np.int32(math.sqrt(l1 / l2) + _ROUNDED)), _TWO)
        spread = min(l1 - l1 / (n * n), l1 - l2)
        n = n if lean >= _ZERO else _ONE
        spread = spread if lean >= _ZERO else _ZERO
        # What the line does not spread, each box does, along both axes of the map.
        vx2 = min(max(_HALF + _HALF * s[t.AXIS * TILE + k], _ZERO), _ONE)
        vy2 = _ONE - vx2
        half_x = _HALF * math.sqrt(max(m11 - spread * vx2, _QUARTER * l2))
        half_y = _HALF * math.sqrt(max(m22 - spread * vy2, _QUARTER * l2))
        tap2 = spread / max(n * n - _ONE, _ONE)
        tap_y = math.sqrt(tap2 * vy2)
        s[t.TAPS * TILE + k] = n
        s[t.TAP_X * TILE + k] = math.sqrt(tap2 * vx2)
        s[t.TAP_Y * TILE + k] = -tap_y if m12 < _ZERO else tap_y
        s[t.HALF_X * TILE + k], s[t.HALF_Y * TILE + k] = half_x, half_y
        s[t.BOX_SIZE * TILE + k] = max(half_x, half_y) * per_m


@vector_kernel
def mismatches(focal: float, s: Float32s) -> None:
    """Make pixels doubtful whose facet has other corners than the neighbours' facets."""
    per_focal = _f(0.5 / focal)
    for k in range(TILE):
        w = s[t.OWN_W * TILE + k]
        across, down = _HALF * s[t.OWN_ACROSS * TILE + k], _HALF * s[t.OWN_DOWN * TILE + k]
        # 1 / depth of the own facet at three corners against that of the facets which own these, within half a pixel.
        bound = abs(across) + abs(down) + w * per_focal
        worst = max(
            abs(w + across - down - s[t.ABOVE_W * TILE + k + 1]),
            abs(w - across + down - s[t.CORNER_W * TILE + k]),
            abs(w + across + down - s[t.CORNER_W * TILE + k + 1]),
        )
        if worst > bound:
            s[t.DOUBT * TILE + k] = _ONE


@vector_kernel
def box_means(count: int, posts: Posts, top: int, place: Floats, tile: Tile) -> None:
    """Write the means of the moments over the boxes of `count` pixels that are not doubtful, MOMENTS each.

    The rates of the means are written from RATES on: boxes move by MOVE_X and MOVE_Y. `top`, `place` : of
    `write_levels`.
    """
    s = tile.fields
    write_levels(count, posts, top, place, Fields(t.MIDDLE_X, t.MIDDLE_Y, t.BOX_SIZE), s, tile.places)
    _windows(s)
    _add_boxes(count, posts.moments, s, tile.places, tile.sums)
    for k in range(count):
        if s[t.NEXT * TILE + k] > 0.0 and s[t.DOUBT * TILE + k] <= 0.0:
            _add_next(k, posts, place, s, tile.places, tile.sums)


@vector_kernel
def _windows(s: Float32s) -> None:
    """Write the boxes in posts of their level, and the share of the next one."""
    for k in range(TILE):
        per_m, (m11, _, m22) = s[t.PER_M * TILE + k], triple(s, t.SPREAD_X, k)
        short = s[t.LONGER * TILE + k] * per_m * per_m < _SHORT2
        n = _ONE if short else s[t.TAPS * TILE + k]
        half_x = _HALF * math.sqrt(m11) if short else s[t.HALF_X * TILE + k]
        half_y = _HALF * math.sqrt(m22) if short else s[t.HALF_Y * TILE + k]
        half_u = min(max(half_x * per_m, _LEAST), _MOST_HALF)
        half_v = min(max(half_y * per_m, _LEAST), _MOST_HALF)
        step_u, step_v = s[t.TAP_X * TILE + k] * per_m, s[t.TAP_Y * TILE + k] * per_m
        back = _HALF * (n - _ONE)  # steps from the line's middle to its first box
        s[t.BOX_U * TILE + k] = s[t.FIRST_X * TILE + k] + s[t.MIDDLE_X * TILE + k] * per_m - back * step_u
        s[t.BOX_V * TILE + k] = s[t.FIRST_Y * TILE + k] + s[t.MIDDLE_Y * TILE + k] * per_m - back * step_v
        s[t.HALF_U * TILE + k], s[t.HALF_V * TILE + k] = half_u, half_v
        s[t.TAPS * TILE + k] = n
        s[t.STEP_U * TILE + k], s[t.STEP_V * TILE + k] = step_u, step_v
        # The sums over boxes are taken with the weight half_u half_v times the mean (`add_box`).
        part = min(max(max(half_x, half_y) * per_m * _PER_BLEND - _BLENDED, _ZERO), _ONE)
        s[t.NEXT * TILE + k] = part
        s[t.WEIGHT * TILE + k] = (_ONE - part) / (n * half_u * half_v)
        s[t.LAST_X * TILE + k] = max(s[t.LAST_X * TILE + k] - half_u, half_u)
        s[t.LAST_Y * TILE + k] = max(s[t.LAST_Y * TILE + k] - half_v, half_v)


@vector_kernel
def _add_boxes(count: int, moments: Halves, s: Float32s, places: Int32s, sums: Float32s) -> None:
    """Write the means over boxes, times their weights."""
    for k in range(count):
        for n in range(MOMENTS):
            sums[k * MOMENTS + n] = sums[RATES + k * MOMENTS + n] = 0.0
        if s[t.DOUBT * TILE + k] > 0.0:
            continue
        level = (
            np.int64(places[t.LEVEL_FIRST * TILE + k]),
            np.int64(places[t.LEVEL_COLUMNS * TILE + k]),
            np.int64(places[t.LEVEL_ROWS * TILE + k]),
        )
        half_u, half_v = s[t.HALF_U * TILE + k], s[t.HALF_V * TILE + k]
        last_u, last_v = s[t.LAST_X * TILE + k], s[t.LAST_Y * TILE + k]
        u, v = s[t.BOX_U * TILE + k], s[t.BOX_V * TILE + k]
        weight = s[t.WEIGHT * TILE + k]
        move = s[t.MOVE_X * TILE + k] * s[t.PER_M * TILE + k], s[t.MOVE_Y * TILE + k] * s[t.PER_M * TILE + k]
        for _ in range(np.int32(s[t.TAPS * TILE + k])):
            box = clamp(u, half_u, last_u), clamp(v, half_v, last_v), half_u, half_v, weight
            add_box(moments, level, (*box, *move), sums, k * MOMENTS)
            u, v = u + s[t.STEP_U * TILE + k], v + s[t.STEP_V * TILE + k]


@lane
def _add_next(k: int, posts: Posts, place: Floats, s: Float32s, places: Int32s, sums: Float32s) -> None:
    """Add the means over the boxes of pixel k on the next level, times NEXT: as `_windows` and `_add_boxes` do."""
    levels, unit = posts.levels, posts.grids.unit_m
    level = places[t.LEVEL * TILE + k] + 1
    rows, columns = levels[level, 1], levels[level, 2]
    per_unit = 1.0 / (1 << level)
    # The next level's posts are twice as far apart.
    half_u, half_v = 0.5 * s[t.HALF_U * TILE + k], 0.5 * s[t.HALF_V * TILE + k]
    step_u, step_v = 0.5 * s[t.STEP_U * TILE + k], 0.5 * s[t.STEP_V * TILE + k]
    last_u, last_v = max(columns - 1.001 - half_u, half_u), max(rows - 1.001 - half_v, half_v)
    n = s[t.TAPS * TILE + k]
    u = (place[0] / unit - levels[level, 3]) * per_unit + s[t.MIDDLE_X * TILE + k] * per_unit / unit
    v = (place[1] / unit - levels[level, 4]) * per_unit + s[t.MIDDLE_Y * TILE + k] * per_unit / unit
    u, v = u - 0.5 * (n - 1.0) * step_u, v - 0.5 * (n - 1.0) * step_v
    weight = s[t.NEXT * TILE + k] / (n * half_u * half_v)
    move = _f(s[t.MOVE_X * TILE + k] * per_unit / unit), _f(s[t.MOVE_Y * TILE + k] * per_unit / unit)
    for _ in range(np.int32(n)):
        at_u, at_v = _f(clamp(u, half_u, last_u)), _f(clamp(v, half_v, last_v))
        box = at_u, at_v, _f(half_u), _f(half_v), _f(weight)
        add_box(posts.moments, (levels[level, 0], columns, rows), (*box, *move), sums, k * MOMENTS)
        u, v = u + step_u, v + step_v

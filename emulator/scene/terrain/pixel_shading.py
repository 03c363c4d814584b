"""Light of the fine map in each pixel, where facets are larger than a pixel.

The renderer says which facet lies at the middle of a pixel. With d = (x, y, 1) the pixel's direction and n . X = 1 the
facet's plane, both in camera axes, the point seen is X = d / (n . d), and P(v) = v - d (n . v) / (n . d) moves along
the ground with the pixel fixed. So from the plane alone:

    footprint of the pixel      P(right) / focal length, P(down) / focal length, both times depth
    how the ground passes       -P(velocity of the material point)

Normals and sunlit shares are taken from the two levels of the `Pyramid` next to the footprint's smaller side, at
several places along its larger side; their rates follow from the slopes between posts. The radiance and its rate come of
them as for vertices (see `block_vertices`).

Where an outline passes through the pixel, the exact light of the facets is kept, and the difference between fine and
facet's light at the middle is added in proportion to how far the outline is from the middle (`Owners.whole`), so that
light is steady in time.

What makes it fast: planes instead of vertices, posts of a level side by side, and one loop over a row for the law.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import numpy.typing as npt

from emulator.photometry.reflection_kernels import reflect
from emulator.raster.layout import Floats as Float64s
from emulator.raster.layout import G, Ints, L, Pictures, W, WHighest, WLowest
from emulator.scene.terrain.block_vertices import LATER_S, around, grazing

__all__ = ["ROW_FIELDS", "shade_rows"]

ROW_FIELDS = 11
_MOST_PLACES = 8
_SHARP = 1.0  # distance of the chosen level's posts over the footprint

Posts = npt.NDArray[np.float32]
Table = npt.NDArray[np.int64]


@numba.njit(nogil=True, error_model="numpy")
def _add_place(
    posts: Posts, levels: Table, level: int, unit: float, at: tuple[float, float, float, float], share: float, total: Float64s
) -> None:
    """Add `share` of east, north, b and their rates at a place that moves, x, y, vx, vy, to `total`, (6,)."""
    rows, columns = levels[level, 1], levels[level, 2]
    per_m = 1.0 / (unit * (1 << level))
    x = min(max(at[0] * per_m - levels[level, 3] / (1 << level), 0.0), columns - 1.0001)
    y = min(max(at[1] * per_m - levels[level, 4] / (1 << level), 0.0), rows - 1.0001)
    j, i = int(x), int(y)
    u, v = x - j, y - i
    moved_u, moved_v = at[2] * per_m, at[3] * per_m
    low = levels[level, 0] + i * columns + j
    high = low + columns
    for k in range(3):
        a, b = posts[low, k + 1], posts[low + 1, k + 1]
        c, d = posts[high, k + 1], posts[high + 1, k + 1]
        top, bottom = a + (b - a) * u, c + (d - c) * u
        total[k] += share * (top + (bottom - top) * v)
        total[k + 3] += share * (((b - a) * (1.0 - v) + (d - c) * v) * moved_u + (bottom - top) * moved_v)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def shade_rows(
    rows: tuple[int, int, int],
    owners: tuple[Ints, Pictures],
    facets: Float64s,
    screen: tuple[float, float, float],
    camera: tuple[Float64s, Float64s, Float64s, Float64s],
    posts: Posts,
    levels: Table,
    ground: tuple[float, int, float],
    sun: tuple[Float64s, float, int, Float64s, Float64s],
    scratch: Float64s,
    light: Pictures,
    rate: Pictures,
) -> None:
    """Write light and rate of the rows first, first + step ... before last.

    Parameters
    ----------
    rows : first, last, step.
    owners : of `raster.Owners`.
    facets : of `Renderer.facets`.
    screen : focal length in pixels, column and row of the boresight.
    camera : place and velocity in the world (3,), camera_from_world (3, 3) and its rate, a second.
    posts, levels : of a `Pyramid`.
    ground : unit in metres, how many grids, posts from their middle to their side.
    sun : see `block_vertices`.
    scratch : (11, width + 1).
    """
    focal, cx, cy = screen
    place, moving, turn, turning = camera
    towards, irradiance, kind, law, ambient = sun
    unit, grids, half = ground
    owner, whole = owners
    spin = turning @ turn.T
    drift = -(turn @ moving)
    last_level = len(levels) - 2
    total = np.zeros(6)
    for row in range(rows[0], rows[1], rows[2]):
        count = 0
        y = (row + 0.5 - cy) / focal
        for column in range(light.shape[1]):
            f = owner[row, column]
            if f < 0 or whole[row, column] <= 0.0:
                continue
            x = (column + 0.5 - cx) / focal
            w0, wx, wy = facets[f, W], facets[f, W + 1], facets[f, W + 2]
            nx, ny, nz = focal * wx, focal * wy, w0 + wx * cx + wy * cy
            w = min(max(w0 + wx * (column + 0.5) + wy * (row + 0.5), facets[f, WLowest]), facets[f, WHighest])
            s = 1.0 / w
            # In the world, the direction, its rate, and what P takes from a displacement.
            dx = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0]
            dy = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1]
            dz = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2]
            tx = turning[0, 0] * x + turning[1, 0] * y + turning[2, 0]
            ty = turning[0, 1] * x + turning[1, 1] * y + turning[2, 1]
            tz = turning[0, 2] * x + turning[1, 2] * y + turning[2, 2]
            across, down = nx * s, ny * s
            step = s / focal
            ax, ay = (turn[0, 0] - across * dx) * step, (turn[0, 1] - across * dy) * step
            bx, by = (turn[1, 0] - down * dx) * step, (turn[1, 1] - down * dy) * step
            px, py, pz = x * s, y * s, s
            vx = spin[0, 0] * px + spin[0, 1] * py + spin[0, 2] * pz + drift[0]
            vy = spin[1, 0] * px + spin[1, 1] * py + spin[1, 2] * pz + drift[1]
            vz = spin[2, 0] * px + spin[2, 1] * py + spin[2, 2] * pz + drift[2]
            off = (nx * vx + ny * vy + nz * vz) * s
            moved_x = off * dx - (turn[0, 0] * vx + turn[1, 0] * vy + turn[2, 0] * vz)
            moved_y = off * dy - (turn[0, 1] * vx + turn[1, 1] * vy + turn[2, 1] * vz)
            here_x, here_y = place[0] + s * dx, place[1] + s * dy
            # The footprint's sides, and the longer one's direction.
            qxx, qxy, qyy = ax * ax + bx * bx, ax * ay + bx * by, ay * ay + by * by
            mean, apart = 0.5 * (qxx + qyy), math.sqrt(0.25 * (qxx - qyy) ** 2 + qxy * qxy)
            longer, shorter = math.sqrt(mean + apart), math.sqrt(max(mean - apart, 0.0))
            level = 0
            most = max(abs(here_x), abs(here_y)) / unit
            while level < grids - 1 and most > (half - 2.0) * (1 << level):
                level += 1
            finest = unit * (1 << level)
            places = min(max(math.ceil(longer / max(shorter, finest) - 0.1), 1.0), _MOST_PLACES)
            size = max(_SHARP * max(shorter, longer / places), finest)
            fine = min(math.log2(size / unit), last_level + 0.0)
            level = max(level, int(fine))
            part = max(fine - level, 0.0)
            ux, uy = qxy, mean + apart - qxx
            length = math.sqrt(ux * ux + uy * uy)
            if length > 1e-12 * longer * longer:
                ux, uy = ux / length * longer, uy / length * longer
            elif qxx >= qyy:
                ux, uy = longer, 0.0
            else:
                ux, uy = 0.0, longer
            total[:] = 0.0
            for k in range(int(places)):
                along = (k + 0.5) / places - 0.5
                at = (here_x + along * ux, here_y + along * uy, moved_x, moved_y)
                _add_place(posts, levels, level, unit, at, (1.0 - part) / places, total)
                if part > 0.0:
                    _add_place(posts, levels, level + 1, unit, at, part / places, total)
            per_d = -1.0 / math.sqrt(1.0 + x * x + y * y)
            scratch[10, count] = column
            for when in range(2):
                t = when * LATER_S
                east, north = total[0] + t * total[3], total[1] + t * total[4]
                lit = max(total[2] + t * total[5], 0.0)
                up = math.sqrt(max(1.0 - east * east - north * north, 0.0))
                ex, ey, ez = (dx + t * tx) * per_d, (dy + t * ty) * per_d, (dz + t * tz) * per_d
                mu0 = max(east * towards[0] + north * towards[1] + up * towards[2], lit, 1e-6)
                gx, gy, gz = ex - towards[0], ey - towards[1], ez - towards[2]
                scratch[5 * when, count] = mu0
                scratch[5 * when + 1, count] = grazing(east * ex + north * ey + up * ez)
                scratch[5 * when + 2, count] = gx * gx + gy * gy + gz * gz
                scratch[5 * when + 3, count] = lit / mu0 * irradiance
                scratch[5 * when + 4, count] = around(ambient, ez)
            count += 1
        _write_row(row, count, (kind, law), owners, facets, scratch, light, rate)


@numba.njit(nogil=True, error_model="numpy")
def _write_row(
    row: int,
    count: int,
    law: tuple[int, Float64s],
    owners: tuple[Ints, Pictures],
    facets: Float64s,
    scratch: Float64s,
    light: Pictures,
    rate: Pictures,
) -> None:
    """Write the light and rate of `count` pixels of a row from their angles."""
    owner, whole = owners
    now, later = scratch[0], scratch[5]  # written over: the law reads each place before it writes it
    reflect(law[0], law[1], scratch[0], scratch[1], scratch[2], count, now)
    reflect(law[0], law[1], scratch[5], scratch[6], scratch[7], count, later)
    for k in range(count):
        column = int(scratch[10, k])
        value = now[k] * scratch[3, k] + scratch[4, k]
        changing = (later[k] * scratch[8, k] + scratch[9, k] - value) / LATER_S
        share = whole[row, column]
        if share < 1.0:
            f = owner[row, column]
            x, y = column + 0.5, row + 0.5
            value = light[row, column] + share * (value - facets[f, L] - facets[f, L + 1] * x - facets[f, L + 2] * y)
            changing = rate[row, column] + share * (
                changing - facets[f, G] - facets[f, G + 1] * x - facets[f, G + 2] * y
            )
        light[row, column], rate[row, column] = max(value, 0.0), changing

"""Light of the fine map in each pixel, where facets are larger than a pixel.

The renderer gives the facet at the middle of each pixel. With d the pixel's direction, d = 1 along the boresight, and
n . X = 1 the facet's plane from the camera, the visible point is X = s d, s = 1 / (n . d). Its light is computed in
these steps:

    footprint       the change of X within the plane for a pixel to the right and for one down
    parts           `samples` along the footprint's shorter side, and more where it is longer: parts of the pixel, equal
                    on the screen, so that slopes which face the camera count for their share of the light frame
    fine height     the map's height z above a part moves it along d to the point on the plane lifted by z - X_z; a
                    secant from there, as the ground under the moved ray has another height
    means           over a square of the ground around each part (`footprint`): of b = cosine of incidence x visible
                    share of the Sun, of the slopes east and north, p and q, weighted by b: dark slopes send no light,
                    and of b / (mu0 + mu), mu0 and mu the cosines of incidence and emission of the square's slope

The law of reflection is evaluated once, at the mu0 of the mean slope and the mu at which b / (mu0 + mu) has its mean.
In laws of Lommel-Seeliger's kind it is this factor that changes most from slope to slope where the ground is seen at a
slant: with the mu of the mean slope the light was 2 % too dark near the horizon. Lambert's law has no mu.

Where an outline passes through the pixel, the exact light of the facets is used, and the difference between fine and
facet's light at the middle is added in proportion to the distance of the outline from the middle (`Owners.whole`), so
that light is continuous in time.

Three measures make it fast: planes instead of vertices, the four numbers of a post side by side, and loops over a row
that become vectors: one for footprints, one for angles, one for the law. Only the means are computed pixel by pixel.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.photometry.reflection_kernels import reflect
from emulator.raster.layout import Float32s, Ints, L, W, WHighest, WLowest
from emulator.scene.terrain.block_vertices import around, grazing
from emulator.scene.terrain.compiled import entry
from emulator.scene.terrain.footprint import POSTS, Posts, Table, level_for, means, shorter_side
from emulator.sensor.numerics.compiled import NONE, lane, vector_kernel

__all__ = ["ROW_FIELDS", "shade_rows"]

_MU0, _MU, _CHORD2, _SUNLIGHT, _AROUND, _COLUMN = range(6)
_X, _Y, _Z, _AX, _AY, _AZ, _BX, _BY, _BZ, _LIFT_X, _LIFT_Y, _ACROSS, _DOWN, _SIDE = range(6, 20)
_LIFT_Z, _EX, _EY, _EZ, _B, _BP, _BQ, _REFLECTED = range(20, 28)
ROW_FIELDS = 28
_MOST_LONG = 12.0  # times the shorter side, the footprint's longer one
_SPARED = 0.9  # of a part: a footprint that is longer by less has no more of them
_STEEPEST = 10.0
_TINY = 1e-9
_BLEND = 0.9  # of a level's range: where the next one begins to be mixed in

Floats = npt.NDArray[np.float64]
Triple = tuple[float, float, float]


@lane
def _into_world(turn: Floats, x: float, y: float, z: float) -> Triple:
    return (
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
        turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z,
    )


@entry
def shade_rows(
    rows: tuple[int, int, int],
    owners: tuple[Ints, Float32s],
    facets: Floats,
    screen: Triple,
    camera: tuple[Floats, Floats],
    posts: Posts,
    levels: Table,
    ground: tuple[float, int, float],
    samples: float,
    sun: tuple[Floats, float, int, Floats, Floats],
    scratch: Floats,
    light: Float32s,
) -> None:
    """Write the light of the rows first, first + step ... before last.

    Parameters
    ----------
    rows : first, last, step.
    owners : of `raster.Owners`.
    facets : of `Renderer.facets`.
    screen : focal length in pixels, column and row of the boresight.
    camera : place in the world (3,), camera_from_world (3, 3).
    posts, levels : of a `Pyramid`, the posts as (4 n,).
    ground : unit in metres, how many grids, posts from their middle to their side.
    samples : parts of a pixel along the shorter side of its footprint.
    sun : see `block_vertices`.
    scratch : (ROW_FIELDS, width + 1).
    """
    top_level = len(levels) - 2
    while top_level > 0 and min(levels[top_level + 1, 1], levels[top_level + 1, 2]) < POSTS:
        top_level -= 1
    for row in range(rows[0], rows[1], rows[2]):
        count = _list(row, owners, scratch)
        _footprints(row, count, owners[0], facets, screen, camera, samples, scratch)
        _means(count, posts, levels, ground, top_level, sun[0], scratch)
        _angles(count, sun, scratch)
        _write(row, count, (sun[2], sun[3]), owners, facets, scratch, light)


@lane
def _list(row: int, owners: tuple[Ints, Float32s], scratch: Floats) -> int:
    """List the columns of a row's pixels with ground in them; return how many."""
    owner, whole = owners
    count: int = NONE
    for column in range(owner.shape[1]):
        scratch[_COLUMN, count] = column
        count += owner[row, column] >= 0 and whole[row, column] > 0.0
    return count


@vector_kernel
def _footprints(
    row: int,
    count: int,
    owner: Ints,
    facets: Floats,
    screen: Triple,
    camera: tuple[Floats, Floats],
    samples: float,
    scratch: Floats,
) -> None:
    """Write the pixels' middles on the ground, their change for a pixel to the right and down, and counts of parts."""
    focal, cx, cy = screen
    place, turn = camera
    per_focal = 1.0 / focal
    y = (row + 0.5 - cy) * per_focal
    for k in range(count):
        at = scratch[_COLUMN, k]
        f = owner[row, int(at)]
        x = (at + 0.5 - cx) * per_focal
        w0, wx, wy = facets[f, W], facets[f, W + 1], facets[f, W + 2]
        s = 1.0 / min(max(w0 + wx * (at + 0.5) + wy * (row + 0.5), facets[f, WLowest]), facets[f, WHighest])
        _, _, nz = _into_world(turn, focal * wx, focal * wy, w0 + wx * cx + wy * cy)
        dx, dy, dz = _into_world(turn, x, y, 1.0)
        per_d = -1.0 / math.sqrt(1.0 + x * x + y * y)
        scratch[_EX, k], scratch[_EY, k], scratch[_EZ, k] = dx * per_d, dy * per_d, dz * per_d
        step = s * per_focal
        across, along = focal * wx * s, focal * wy * s
        ax, ay, az = turn[0, 0] - across * dx, turn[0, 1] - across * dy, turn[0, 2] - across * dz
        bx, by, bz = turn[1, 0] - along * dx, turn[1, 1] - along * dy, turn[1, 2] - along * dz
        shorter = shorter_side(ax, ay, bx, by, _MOST_LONG)
        parts = samples / shorter
        scratch[_X, k], scratch[_Y, k], scratch[_Z, k] = place[0] + s * dx, place[1] + s * dy, place[2] + s * dz
        scratch[_AX, k], scratch[_AY, k], scratch[_AZ, k] = ax * step, ay * step, az * step
        scratch[_BX, k], scratch[_BY, k], scratch[_BZ, k] = bx * step, by * step, bz * step
        lift = s * nz
        scratch[_LIFT_X, k], scratch[_LIFT_Y, k], scratch[_LIFT_Z, k] = lift * dx, lift * dy, lift * dz
        scratch[_ACROSS, k] = parts * math.sqrt(ax * ax + ay * ay) - _SPARED
        scratch[_DOWN, k] = parts * math.sqrt(bx * bx + by * by) - _SPARED
        scratch[_SIDE, k] = shorter * step / samples


@lane
def _means(
    count: int,
    posts: Posts,
    levels: Table,
    ground: tuple[float, int, float],
    top_level: int,
    sun: Floats,
    scratch: Floats,
) -> None:
    """Write the means of b, b p, b q and b / (mu0 + mu) over each pixel's parts."""
    unit, grids, half = ground
    lowest, level = NONE, NONE
    inner, per_size = (half - POSTS - 1.0) * unit, 1.0 / ((POSTS - 2) * unit)
    for k in range(count):
        x, y = scratch[_X, k], scratch[_Y, k]
        # Neighbours have the same levels nearly everywhere.
        lowest = level_for(max(abs(x), abs(y)) / inner, lowest, 0, grids - 1) if inner > 0.0 else grids - 1
        size = scratch[_SIDE, k] * per_size
        level = level_for(size, level, lowest, top_level)
        filled = size / (1 << level)
        part = min(max((filled - _BLEND) * (1.0 / (1.0 - _BLEND)), 0.0), 1.0)
        b, bp, bq, reflected = means(
            posts,
            levels,
            level,
            part,
            unit,
            (x, y, scratch[_Z, k]),
            (scratch[_AX, k], scratch[_AY, k], scratch[_AZ, k]),
            (scratch[_BX, k], scratch[_BY, k], scratch[_BZ, k]),
            (scratch[_LIFT_X, k], scratch[_LIFT_Y, k], scratch[_LIFT_Z, k]),
            (max(math.ceil(scratch[_ACROSS, k]), 1.0), max(math.ceil(scratch[_DOWN, k]), 1.0)),
            scratch[_SIDE, k],
            (sun[0], sun[1], sun[2]),
            (scratch[_EX, k], scratch[_EY, k], scratch[_EZ, k]),
        )
        scratch[_B, k], scratch[_BP, k], scratch[_BQ, k], scratch[_REFLECTED, k] = b, bp, bq, reflected


@vector_kernel
def _angles(count: int, sun: tuple[Floats, float, int, Floats, Floats], scratch: Floats) -> None:
    """Write the inputs of the law of reflection, sunlight by the cosine of incidence, and the ambient light."""
    towards, ambient = sun[0], sun[4]
    for k in range(count):
        b = max(scratch[_B, k], 0.0)
        per_b = 1.0 / max(b, _TINY)
        p = min(max(scratch[_BP, k] * per_b, -_STEEPEST), _STEEPEST)
        q = min(max(scratch[_BQ, k] * per_b, -_STEEPEST), _STEEPEST)
        up = 1.0 / math.sqrt(1.0 + p * p + q * q)
        ex, ey, ez = scratch[_EX, k], scratch[_EY, k], scratch[_EZ, k]
        mu0 = max((towards[2] - p * towards[0] - q * towards[1]) * up, b, 1e-6)
        gx, gy, gz = ex - towards[0], ey - towards[1], ez - towards[2]
        scratch[_MU0, k] = mu0
        scratch[_MU, k] = grazing(b / max(scratch[_REFLECTED, k], _TINY) - mu0)
        scratch[_CHORD2, k] = gx * gx + gy * gy + gz * gz
        scratch[_SUNLIGHT, k] = b / mu0 * sun[1]
        scratch[_AROUND, k] = around(ambient, ez)


@vector_kernel
def _write(
    row: int,
    count: int,
    law: tuple[int, Floats],
    owners: tuple[Ints, Float32s],
    facets: Floats,
    scratch: Floats,
    light: Float32s,
) -> None:
    """Write the light of `count` pixels of a row from their angles."""
    owner, whole = owners
    now = scratch[_MU0]  # written over: the law reads each place before it writes it
    reflect(law[0], law[1], scratch[_MU0], scratch[_MU], scratch[_CHORD2], count, now)
    for k in range(count):
        column = int(scratch[_COLUMN, k])
        value = now[k] * scratch[_SUNLIGHT, k] + scratch[_AROUND, k]
        share = whole[row, column]
        if share < 1.0:
            f = owner[row, column]
            x, y = column + 0.5, row + 0.5
            here = light[row, column]
            value = here + share * (value - facets[f, L] - facets[f, L + 1] * x - facets[f, L + 2] * y)
            value = max(value, (1.0 - share) * here)  # a pixel with an outline contains the light behind it too
        light[row, column] = value

"""Light of the fine map in each pixel, where facets are larger than a pixel.

    corners of pixels       places on the fine map                                  `pixel_hits`
    footprints              means of the ground's moments, from one box or more     `pixel_boxes`
    means                   light, and as they move its time derivative             `pixel_law`
    doubtful pixels         light from parts of their own                           `pixel_parts`

Doubtful are pixels that `pixel_boxes` finds, and those with an outline of facets in them or beside them: facets have
other outlines than the map. Parts have also those around which light changes by more than its mean: at borders of
shadows the heights within the pixel decide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emulator.photometry.reflection_kernels import reflect
from emulator.scene.terrain import pixel_parts as parts
from emulator.scene.terrain import tile as t
from emulator.scene.terrain.box_moments import MOST_POSTS
from emulator.scene.terrain.ground import entry
from emulator.scene.terrain.pixel_boxes import box_means, footprints, mismatches
from emulator.scene.terrain.pixel_hits import Posts, Sight, Table, corner_hits, keep_row
from emulator.scene.terrain.pixel_law import GRAZING, Motion, Sunlight, around, footprint_moves, light_rate, mean_light
from emulator.scene.terrain.pixel_parts import Peaks, into_world, part_means
from emulator.scene.terrain.tile import TILE, Tile
from emulator.sensor.numerics.compiled import NONE, lane, vector_kernel
from firmware_protocol.events import Bytes, Float32s, Floats, Int32s

_PIXELS = TILE - 1
_STEEPEST = 10.0
_TINY = 1e-9
_LEAST_SHARE, _MOST_SHARE = 0.5, 2.0  # of the light of the footprint, that of its parts, for the rate

_LOW, _HIGH, _TOTAL, _RANGE, _MEAN, _VALUE, _LEAST = range(t.MEANS, t.MEANS + 7)  # after the law's inputs
ROW_FIELDS = t.MEANS + 7


class Smooth(NamedTuple):
    """Pictures from footprints, (height, width): light of the ground, doubtful pixels (1, OUTLINED), rate of light."""

    light: Float32s
    doubtful: Bytes
    rate: Float32s


@lane
def top_level(levels: Table) -> int:
    """Return the coarsest level of which boxes are taken."""
    top = len(levels) - 2
    while top > 0 and min(levels[top + 1, 1], levels[top + 1, 2]) < MOST_POSTS:
        top -= 1
    return top


@entry
def shade_rows(
    rows: tuple[int, int], sight: Sight, motion: Motion, posts: Posts, sun: Sunlight, tile: Tile, out: Smooth
) -> None:
    """Write the light of rows first to last, which pixels are doubtful, and the rate of light.

    `motion` is that of `footprint_moves`.
    """
    s, places, unit_m = tile.fields, tile.places, posts.grids.unit_m
    top = top_level(posts.levels)
    for first in range(0, sight.owner.shape[1], _PIXELS):
        columns = min(_PIXELS, sight.owner.shape[1] - first)
        corner_hits(rows[0], first, sight, posts, s, places)
        for row in range(rows[0], rows[1]):
            # The row of corners below; those of the row before are now above.
            keep_row(s)
            corner_hits(row + 1, first, sight, posts, s, places)
            footprints(row, first, sight.projection, sight.turn, unit_m, s)
            mismatches(sight.projection.focal_px, s)
            footprint_moves(motion, s)
            box_means(columns, posts, top, sight.place, tile)
            mean_light(sun, tile)
            light_rate(sun, tile)
            _keep(row, first, columns, sight.owner, s, out)


@lane
def _keep(row: int, first: int, columns: int, owner: Int32s, s: Float32s, out: Smooth) -> None:
    """Write a row's light, which pixels are doubtful, and the rate of light where it is right."""
    for k in range(columns):
        seen = owner[row, first + k] >= 0
        doubtful = seen and s[t.DOUBT * TILE + k] > 0.0
        out.light[row, first + k] = s[t.FAST * TILE + k] if seen else np.float32(0.0)
        out.doubtful[row, first + k] = doubtful
        out.rate[row, first + k] = s[t.RATE * TILE + k] if seen and not doubtful else np.float32(0.0)


@entry
def shade_doubtful(
    rows: tuple[int, int], sight: Sight, coverage: Float32s, posts: Posts, peaks: Peaks, samples: float, least: float,
    sun: Sunlight, tile: Tile, s: Floats, line: Floats, smooth: Smooth, light: Float32s, rate: Float32s,
) -> None:  # fmt: skip
    """Write the light frame's rows first to last, doubtful pixels from parts, and the others' rate of light.

    Pixels with an outline in them or beside them become doubtful.

    Parameters
    ----------
    coverage : of `raster.Owners`.
    samples : parts of a pixel along the shorter side of its footprint.
    least : mean of the light frame from which changes count.
    s, line : (ROW_FIELDS, width + 2), (LINE_FIELDS of `pixel_parts`, width + 2), room.
    smooth : from `shade_rows`.
    """
    for row in range(rows[0], rows[1]):
        _changes(row, smooth.light, s)
        _add_outlines(row, coverage, s[_LEAST], smooth.doubtful[row])
        doubtful, count = _list_columns(row, sight.owner, smooth.doubtful[row], least, s, line)
        # Elsewhere the first hit of a ray is the one near the facet.
        for first, last in ((NONE, doubtful), (doubtful, count)):
            by_rays = first < doubtful
            part_means(row, first, last, by_rays, smooth.doubtful[row], sight, posts, peaks, samples, sun, tile, line)
        _angles(row, count, sight, sun, line, s)
        reflect(sun.law, sun.law_parameters, s[t.MU0], s[t.MU], s[t.CHORD2], count, s[t.MU0])
        for k in range(count):
            s[_VALUE, int(line[parts.COLUMN, k])] = s[t.MU0, k] * s[t.SUNLIGHT, k] + s[t.AROUND, k]
        for column in range(sight.owner.shape[1]):
            if sight.owner[row, column] >= 0 or smooth.doubtful[row, column] > 0:
                light[row, column] = s[_VALUE, column]
            # The rate of the logarithm is that of the footprint's light.
            change = s[_VALUE, column] / max(smooth.light[row, column], _TINY)
            rate[row, column] = min(max(change, _LEAST_SHARE), _MOST_SHARE) * smooth.rate[row, column]


@vector_kernel
def _changes(row: int, values: Float32s, s: Floats) -> None:
    """Write least, greatest and mean light of each pixel and its neighbours, and its light."""
    height, width = values.shape
    # Over three rows first, then over three columns of these.
    above, now, below = values[max(row - 1, 0)], values[row], values[min(row + 1, height - 1)]
    for k in range(width):
        s[_LOW, k + 1] = min(min(above[k], below[k]), now[k])
        s[_HIGH, k + 1] = max(max(above[k], below[k]), now[k])
        s[_TOTAL, k + 1] = above[k] + now[k] + below[k]
        s[_VALUE, k] = now[k]
    for field in (_LOW, _HIGH, _TOTAL):
        s[field, 0], s[field, width + 1] = s[field, 1], s[field, width]
    for k in range(width):
        low = min(min(s[_LOW, k], s[_LOW, k + 1]), s[_LOW, k + 2])
        high = max(max(s[_HIGH, k], s[_HIGH, k + 1]), s[_HIGH, k + 2])
        s[_RANGE, k] = high - low
        s[_MEAN, k] = (s[_TOTAL, k] + s[_TOTAL, k + 1] + s[_TOTAL, k + 2]) * (1.0 / 9.0)


@lane
def _add_outlines(row: int, coverage: Float32s, least: Floats, doubtful: Bytes) -> None:
    """Make the pixels of a row OUTLINED that have an outline in them or in a neighbour; `least` is room."""
    height, width = coverage.shape
    above, below = coverage[max(row - 1, 0)], coverage[min(row + 1, height - 1)]
    for k in range(width):
        least[k] = min(min(above[k], below[k]), coverage[row, k])
    for k in range(width):
        if min(min(least[max(k - 1, 0)], least[min(k + 1, width - 1)]), least[k]) < 1.0:
            doubtful[k] = parts.OUTLINED


@lane
def _list_columns(row: int, owner: Int32s, doubtful: Bytes, least: float, s: Floats, line: Floats) -> tuple[int, int]:
    """List a row's doubtful pixels, then the others around which light changes much; return the ends of both lists."""
    count: int = NONE
    for column in range(len(doubtful)):
        line[parts.COLUMN, count] = column
        count += doubtful[column] > 0
    last = count
    for column in range(len(doubtful)):
        line[parts.COLUMN, count] = column
        changing = (doubtful[column] == 0) & (s[_RANGE, column] > max(s[_MEAN, column], least))
        count += changing & (owner[row, column] >= 0)
    return last, count


@lane
def _angles(row: int, count: int, sight: Sight, sun: Sunlight, line: Floats, s: Floats) -> None:
    """Write the inputs of the law of reflection for the listed pixels."""
    sun_x, sun_y, sun_z = sun.disc[0, 0], sun.disc[0, 1], sun.disc[0, 2]
    focal, middle_column, middle_row = sight.projection
    for k in range(count):
        # The mean slope, weighted by b.
        b = max(line[parts.MEAN_B, k], 0.0)
        per_b = 1.0 / max(b, _TINY)
        p = min(max(line[parts.MEAN_BP, k] * per_b, -_STEEPEST), _STEEPEST)
        q = min(max(line[parts.MEAN_BQ, k] * per_b, -_STEEPEST), _STEEPEST)
        up = 1.0 / math.sqrt(1.0 + p * p + q * q)
        x, y = (int(line[parts.COLUMN, k]) + 0.5 - middle_column) / focal, (row + 0.5 - middle_row) / focal
        dx, dy, dz = into_world(sight.turn, x, y, 1.0)
        per_d = -1.0 / math.sqrt(1.0 + x * x + y * y)
        ex, ey, ez = dx * per_d, dy * per_d, dz * per_d
        mu0 = max((sun_z - p * sun_x - q * sun_y) * up, b, 1e-6)
        gx, gy, gz = ex - sun_x, ey - sun_y, ez - sun_z
        s[t.MU0, k] = mu0
        s[t.MU, k] = max(b / max(line[parts.MEAN_REFLECTED, k], _TINY) - mu0, GRAZING)
        s[t.CHORD2, k] = gx * gx + gy * gy + gz * gz
        s[t.SUNLIGHT, k] = b / mu0 * sun.irradiance_w_m2
        s[t.AROUND, k] = line[parts.SEEN, k] * around(sun.ambient, ez)

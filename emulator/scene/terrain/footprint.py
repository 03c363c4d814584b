"""Means of the ground's light and slopes over the footprint of a pixel.

The mean over a square of a function that is linear between posts is exact: a post at t posts from the square's middle
has the weight (I(r - t) - I(-r - t)) / 2 r along each axis, r half its side and I the integral of the hat function.
Squares lie along the axes of the map. They are taken from a level of the `Pyramid` on which they are at most POSTS - 2
posts long: on a coarser one the light of the finest details that a pixel resolves would be lost.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.scene.terrain.box_sums import POSTS, box_sums
from emulator.scene.terrain.ground import FIELDS, Pyramid
from emulator.sensor.numerics.compiled import lane

__all__ = ["POSTS", "Posts", "Table", "level_for", "means", "padded", "shorter_side"]

_LEAST = 0.01  # of a post's distance: half a square's side

Floats = npt.NDArray[np.float64]
Posts = npt.NDArray[np.float32]
Table = npt.NDArray[np.int64]
Pair = tuple[float, float]
Triple = tuple[float, float, float]
Means = tuple[float, float, float, float]


def padded(pyramid: Pyramid) -> Posts:
    """Return the posts in one array, (4 n,), padded at its end for squares that extend beyond a map of few posts."""
    beyond = FIELDS * POSTS * (int(pyramid.levels[:, 2].max()) + 1)
    return np.concatenate([pyramid.posts.reshape(-1), np.zeros(beyond, np.float32)])


@lane
def shorter_side(ax: float, ay: float, bx: float, by: float, most: float) -> float:
    """Return the length of the footprint's shorter side that a and b span, the longer one's over `most` at least."""
    qxx, qxy, qyy = ax * ax + bx * bx, ax * ay + bx * by, ay * ay + by * by
    mean, apart = 0.5 * (qxx + qyy), math.sqrt(0.25 * (qxx - qyy) ** 2 + qxy * qxy)
    return math.sqrt(max(mean - apart, (mean + apart) * (1.0 / (most * most))))


@lane
def level_for(size: float, level: int, lowest: int, top: int) -> int:
    """Return the finest level, lowest to top, whose 2^level is not below `size`; the search begins at `level`."""
    level = min(max(level, lowest), max(top, lowest))
    while level < top and size > (1 << level):
        level += 1
    while level > lowest and size <= (1 << (level - 1)):
        level -= 1
    return level


@lane
def means(
    posts: Posts,
    levels: Table,
    level: int,
    part: float,
    unit: float,
    at: Triple,
    across: Triple,
    down: Triple,
    lift: Triple,
    counts: Pair,
    side: float,
    sun: Triple,
    eye: Triple,
) -> Means:
    """Return the means of b, b p, b q and b / (mu0 + mu) over a pixel's parts, `part` of them from the next level.

    Parameters
    ----------
    posts : (4 n,): height, b p, b q, b of each; see `Pyramid`.
    at : the pixel's middle on its facet, in the world, metres.
    across, down : change of `at` for a pixel to the right and for one down.
    lift : motion of the point where a part's ray meets the facet for each metre that the facet is lifted, as a share.
    counts : of parts, across and down.
    side : of the square around a part, metres.
    sun, eye : unit vectors towards them.
    """
    b, bp, bq, reflected = 0.0, 0.0, 0.0, 0.0
    for more in range(2):
        weight = part if more == 1 else 1.0 - part
        if weight > 0.0:
            bb, pp, qq, rr = _means(posts, levels, level + more, unit, at, across, down, lift, counts, side, sun, eye)
            b, bp, bq, reflected = b + weight * bb, bp + weight * pp, bq + weight * qq, reflected + weight * rr
    return b, bp, bq, reflected


@lane
def _means(
    posts: Posts,
    levels: Table,
    level: int,
    unit: float,
    at: Triple,
    across: Triple,
    down: Triple,
    lift: Triple,
    counts: Pair,
    side: float,
    sun: Triple,
    eye: Triple,
) -> Means:
    columns, rows = levels[level, 2], levels[level, 1]
    per_unit = 1.0 / (1 << level)
    per_m = per_unit / unit
    x, y = at[0] * per_m - levels[level, 3] * per_unit, at[1] * per_m - levels[level, 4] * per_unit
    half = min(max(0.5 * side * per_m, _LEAST), 0.5 * (POSTS - 2))
    scalars = (
        np.float32(x),
        np.float32(y),
        np.float32(at[2]),
        np.float32(across[0] * per_m),
        np.float32(across[1] * per_m),
        np.float32(across[2]),
        np.float32(down[0] * per_m),
        np.float32(down[1] * per_m),
        np.float32(down[2]),
        np.float32(lift[0] * per_m),
        np.float32(lift[1] * per_m),
        np.float32(lift[2]),
        np.float32(counts[0]),
        np.float32(1.0 / counts[0]),
        np.float32(1.0 / counts[1]),
        np.float32(half),
        np.float32(columns - 1.0001),
        np.float32(rows - 1.0001),
        np.float32(max(columns - 1.0 - half, half)),
        np.float32(max(rows - 1.0 - half, half)),
        np.float32(sun[0]),
        np.float32(sun[1]),
        np.float32(sun[2]),
        np.float32(eye[0]),
        np.float32(eye[1]),
        np.float32(eye[2]),
    )
    count = counts[0] * counts[1]
    whole = FIELDS * levels[level, 0], FIELDS * columns, columns, rows, int(count)
    bp, bq, b, reflected = box_sums(posts, scalars, whole)
    share = 0.25 / (half * half * count)
    return b * share, bp * share, bq * share, reflected * share

"""Light of the fine map in each pixel, where facets are larger than a pixel.

The renderer says which facet lies at the middle of a pixel. With d the pixel's direction, d = 1 along the boresight,
and n . X = 1 the facet's plane from the camera, the point seen is X = s d, s = 1 / (n . d). From there:

    footprint of the pixel      what a pixel to the right and one down add to X within the plane
    fine height                 the map's height z above X moves the point along d to where the plane, lifted by
                                z - X_z, is met: s becomes s (1 + (z - X_z) n_z)
    how the ground passes       V = v + s' d + s d', with v the camera's velocity and s' such that V lies in the map's
                                slope: what the pixel sees next

Normals and sunlit shares are means over one or two places across the footprint's shorter side and so many along the
longer one that their distances are alike, from the two levels of the `Pyramid` next to half that distance. Their rates
come from V and the slopes between posts. Radiance and its rate come of them as for vertices (see `block_vertices`).

Where an outline passes through the pixel, the exact light of the facets is kept, and the difference between fine and
facet's light at the middle is added in proportion to how far the outline is from the middle (`Owners.whole`), so that
light is steady in time.

What makes it fast: planes instead of vertices, the four numbers of a post side by side, and one loop over a row for
the law.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.photometry.reflection_kernels import reflect
from emulator.raster.layout import G, Ints, L, Pictures, W, WHighest, WLowest
from emulator.scene.terrain.block_vertices import LATER_S, around, grazing
from emulator.scene.terrain.compiled import entry
from emulator.sensor.numerics.compiled import lane, vector_kernel

__all__ = ["ROW_FIELDS", "shade_rows"]

ROW_FIELDS = 11
_MOST_PLACES = 16.0  # along the footprint's longer side
_ONE_PLACE = 0.7  # of the finest posts' distance: for a footprint's shorter side below it one place across will do
_SHARP = 0.5  # distance of the chosen levels' posts over the footprint's shorter side
_FARTHEST = 0.2  # of the distance: the fine map moves a point no farther
_FACING = -1e-3  # slopes that the camera sees from behind move as if they were seen this grazing

Floats = npt.NDArray[np.float64]
Posts = npt.NDArray[np.float32]
Table = npt.NDArray[np.int64]
Pair = tuple[float, float]
Triple = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]


@lane
def _corner(levels: Table, level: int, unit: float, x_m: float, y_m: float) -> tuple[int, int, float, float]:
    """Return the posts before a place, in its row and in the next, and its share of the way to the next ones."""
    size = 1 << level
    x = min(max((x_m / unit - levels[level, 3]) / size, 0.0), levels[level, 2] - 1.0001)
    y = min(max((y_m / unit - levels[level, 4]) / size, 0.0), levels[level, 1] - 1.0001)
    j, i = int(x), int(y)
    low = levels[level, 0] + i * levels[level, 2] + j
    return low, low + levels[level, 2], x - j, y - i


@lane
def _field(posts: Posts, low: int, high: int, k: int, u: float, v: float) -> Triple:
    """Return a field between four posts and its slopes along rows and columns, a post."""
    a, b, c, d = posts[low, k], posts[low + 1, k], posts[high, k], posts[high + 1, k]
    top, bottom = b - a, d - c
    along = top + (bottom - top) * v
    left = a + (c - a) * v
    return left + along * u, along, (c - a) + (bottom - top) * u


@lane
def _height(posts: Posts, levels: Table, level: int, part: float, unit: float, x_m: float, y_m: float) -> Triple:
    """Return the map's height and its slopes, east and north, `part` of them from the next level."""
    low, high, u, v = _corner(levels, level, unit, x_m, y_m)
    z, east, north = _field(posts, low, high, 0, u, v)
    per_m = 1.0 / (unit * (1 << level))
    east, north = east * per_m, north * per_m
    if part > 0.0:
        low, high, u, v = _corner(levels, level + 1, unit, x_m, y_m)
        z1, east1, north1 = _field(posts, low, high, 0, u, v)
        east, north = east + part * (0.5 * per_m * east1 - east), north + part * (0.5 * per_m * north1 - north)
        z += part * (z1 - z)
    return z, east, north


@lane
def _sheen(
    posts: Posts,
    levels: Table,
    level: int,
    unit: float,
    weight: float,
    at: Pair,
    moved: Pair,
    sides: tuple[Pair, Pair],
    counts: Pair,
) -> Six:
    """Return the means of east, north and b over a footprint with the given sides, and their rates, times `weight`."""
    per_m = 1.0 / (unit * (1 << level))
    offset, columns = levels[level, 0], levels[level, 2]
    most_x, most_y = columns - 1.0001, levels[level, 1] - 1.0001
    per_unit = 1.0 / (1 << level)
    x0, y0 = at[0] * per_m - levels[level, 3] * per_unit, at[1] * per_m - levels[level, 4] * per_unit
    x_along, y_along = sides[0][0] * per_m / counts[0], sides[0][1] * per_m / counts[0]
    x_aside, y_aside = sides[1][0] * per_m / counts[1], sides[1][1] * per_m / counts[1]
    zero = np.float32(0.0)
    e, n, b, e_x, n_x, b_x, e_y, n_y, b_y = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for i in range(int(counts[0])):
        along = i + 0.5 - 0.5 * counts[0]
        for j in range(int(counts[1])):
            aside = j + 0.5 - 0.5 * counts[1]
            x = min(max(x0 + along * x_along + aside * x_aside, 0.0), most_x)
            y = min(max(y0 + along * y_along + aside * y_aside, 0.0), most_y)
            column, row = int(x), int(y)
            u, v = np.float32(x - column), np.float32(y - row)
            low = offset + row * columns + column
            high = low + columns
            ea, na, ba = posts[low, 1], posts[low, 2], posts[low, 3]
            eb, nb, bb = posts[low + 1, 1] - ea, posts[low + 1, 2] - na, posts[low + 1, 3] - ba
            ec, nc, bc = posts[high, 1] - ea, posts[high, 2] - na, posts[high, 3] - ba
            ed = posts[high + 1, 1] - ea - eb - ec
            nd = posts[high + 1, 2] - na - nb - nc
            bd = posts[high + 1, 3] - ba - bb - bc
            es, ns, bs = eb + ed * v, nb + nd * v, bb + bd * v
            e, n, b = e + (ea + ec * v + es * u), n + (na + nc * v + ns * u), b + (ba + bc * v + bs * u)
            e_x, n_x, b_x = e_x + es, n_x + ns, b_x + bs
            e_y, n_y, b_y = e_y + (ec + ed * u), n_y + (nc + nd * u), b_y + (bc + bd * u)
    share = weight / (counts[0] * counts[1])
    mx, my = moved[0] * per_m * share, moved[1] * per_m * share
    return (
        float(e * share),
        float(n * share),
        float(b * share),
        float(e_x * mx + e_y * my),
        float(n_x * mx + n_y * my),
        float(b_x * mx + b_y * my),
    )


@lane
def _sides(ax: float, ay: float, bx: float, by: float) -> tuple[float, float, float, float]:
    """Return the lengths of the sides of the footprint that a and b span, longer one first, and its direction."""
    qxx, qxy, qyy = ax * ax + bx * bx, ax * ay + bx * by, ay * ay + by * by
    mean, apart = 0.5 * (qxx + qyy), math.sqrt(0.25 * (qxx - qyy) ** 2 + qxy * qxy)
    ux, uy = (apart + 0.5 * (qxx - qyy), qxy) if qxx >= qyy else (qxy, apart - 0.5 * (qxx - qyy))
    length = math.sqrt(ux * ux + uy * uy)
    if length > 0.0:
        ux, uy = ux / length, uy / length
    else:
        ux, uy = 1.0, 0.0
    return math.sqrt(mean + apart), math.sqrt(max(mean - apart, 0.0)), ux, uy


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
    owners: tuple[Ints, Pictures],
    facets: Floats,
    screen: Triple,
    camera: tuple[Floats, Floats, Floats, Floats],
    posts: Posts,
    levels: Table,
    ground: tuple[float, int, float],
    sun: tuple[Floats, float, int, Floats, Floats],
    scratch: Floats,
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
    camera : of `CameraMotion.figures`.
    posts, levels : of a `Pyramid`.
    ground : unit in metres, how many grids, posts from their middle to their side.
    sun : see `block_vertices`.
    scratch : (11, width + 1).
    """
    focal, cx, cy = screen
    place, moving, turn, turning = camera
    ambient = sun[4]
    unit, grids, half = ground
    owner, whole = owners
    top_level = len(levels) - 2
    for row in range(rows[0], rows[1], rows[2]):
        count = 0
        y = (row + 0.5 - cy) / focal
        for column in range(light.shape[1]):
            f = owner[row, column]
            if f < 0 or whole[row, column] <= 0.0:
                continue
            x = (column + 0.5 - cx) / focal
            w0, wx, wy = facets[f, W], facets[f, W + 1], facets[f, W + 2]
            w = min(max(w0 + wx * (column + 0.5) + wy * (row + 0.5), facets[f, WLowest]), facets[f, WHighest])
            s = 1.0 / w
            nx, ny = focal * wx, focal * wy
            _, _, nz = _into_world(turn, nx, ny, w0 + wx * cx + wy * cy)
            dx, dy, dz = _into_world(turn, x, y, 1.0)
            tx, ty, tz = _into_world(turning, x, y, 1.0)
            step, across, down = s / focal, nx * s, ny * s
            longer, shorter, ux, uy = _sides(
                (turn[0, 0] - across * dx) * step,
                (turn[0, 1] - across * dy) * step,
                (turn[1, 0] - down * dx) * step,
                (turn[1, 1] - down * dy) * step,
            )
            level = 0
            from_site = max(abs(place[0] + s * dx), abs(place[1] + s * dy)) / unit
            while level < grids - 1 and from_site > (half - 2.0) * (1 << level):
                level += 1
            finest = unit * (1 << level)
            places = min(max(math.ceil(longer / max(0.5 * shorter, _ONE_PLACE * finest) - 0.1), 1.0), _MOST_PLACES)
            size = max(_SHARP * max(shorter, 2.0 * longer / places), finest)
            fine = min(math.log2(size / unit), float(top_level))
            level = max(level, int(fine))
            part = min(max(2.0 * (fine - level) - 0.5, 0.0), 1.0)
            z, east, north = _height(posts, levels, level, part, unit, place[0] + s * dx, place[1] + s * dy)
            lifted = (z - place[2] - s * dz) * nz
            s *= 1.0 + min(max(lifted, -_FARTHEST), _FARTHEST)
            at = (place[0] + s * dx, place[1] + s * dy)
            vx, vy, vz = moving[0] + s * tx, moving[1] + s * ty, moving[2] + s * tz
            going = (east * vx + north * vy - vz) / min(dz - east * dx - north * dy, _FACING)
            moved = (vx + going * dx, vy + going * dy)
            sides = ((ux * longer, uy * longer), (-uy * shorter, ux * shorter))
            counts = (places, 2.0 if shorter > _ONE_PLACE * finest else 1.0)
            e, n, b, de, dn, db = _sheen(posts, levels, level, unit, 1.0 - part, at, moved, sides, counts)
            if part > 0.0:
                more = _sheen(posts, levels, level + 1, unit, part, at, moved, sides, counts)
                e, n, b, de, dn, db = (e + more[0], n + more[1], b + more[2], de + more[3], dn + more[4], db + more[5])
            per_d = -1.0 / math.sqrt(1.0 + x * x + y * y)
            scratch[10, count] = column
            for when in range(2):
                t = when * LATER_S
                eye = ((dx + t * tx) * per_d, (dy + t * ty) * per_d, (dz + t * tz) * per_d)
                _angles(e + t * de, n + t * dn, b + t * db, eye, sun, scratch, 5 * when, count)
                scratch[5 * when + 4, count] = around(ambient, eye[2])
            count += 1
        _write_row(row, count, (sun[2], sun[3]), owners, facets, scratch, light, rate)


@lane
def _angles(
    east: float,
    north: float,
    lit: float,
    eye: Triple,
    sun: tuple[Floats, float, int, Floats, Floats],
    scratch: Floats,
    k: int,
    at: int,
) -> None:
    """Write mu0, mu, the squared chord between Sun and eye, and what the law's value is to be multiplied by."""
    towards = sun[0]
    up = math.sqrt(max(1.0 - east * east - north * north, 0.0))
    shone = max(lit, 0.0)
    mu0 = max(east * towards[0] + north * towards[1] + up * towards[2], shone, 1e-6)
    gx, gy, gz = eye[0] - towards[0], eye[1] - towards[1], eye[2] - towards[2]
    scratch[k, at] = mu0
    scratch[k + 1, at] = grazing(east * eye[0] + north * eye[1] + up * eye[2])
    scratch[k + 2, at] = gx * gx + gy * gy + gz * gz
    scratch[k + 3, at] = shone / mu0 * sun[1]


@vector_kernel
def _write_row(
    row: int,
    count: int,
    law: tuple[int, Floats],
    owners: tuple[Ints, Pictures],
    facets: Floats,
    scratch: Floats,
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
            here = light[row, column]
            value = here + share * (value - facets[f, L] - facets[f, L + 1] * x - facets[f, L + 2] * y)
            value = max(value, (1.0 - share) * here)  # an outline's pixel holds what lies behind it too
            changing = rate[row, column] + share * (
                changing - facets[f, G] - facets[f, G + 1] * x - facets[f, G + 2] * y
            )
        light[row, column], rate[row, column] = value, changing

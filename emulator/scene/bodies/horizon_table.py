"""The horizon around each point of a rigid surface, made once, and the Sun's share above it at any instant.

For each point a table holds the sine of the horizon's elevation above the tangent plane in AZIMUTHS directions, exact
there and linear in between. Directions are spaced evenly along |x| + |y| = 1 around the normal, 4.3 to 7.2 degrees
apart, so no arc tangent is needed. The Sun's disc is cut by the straight line that the horizon makes near the Sun's
azimuth, tilted as it is: a penumbra has its true width, and no shadow edge is a step in time.

The horizon is the highest obstacle in each direction. Light that falls in below an obstacle is lost: where a surface
overhangs, the table is too dark (`lost_light` measures it, and `Lighting` traces bodies for which it matters). Shadow
edges that run along the azimuth, and obstacles narrower than the spacing, are right to the spacing only.

Three measures make it fast: one traversal of the tree of triangles for each point, which skips boxes below the tangent
plane; the highest obstacle in a direction is on an edge, so each edge raises the few directions that it spans;
triangles that show their inside to the point are skipped, as their edges belong to others too or are hidden.
"""

from __future__ import annotations

import hashlib
import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.cast_shadow import Frame, Point, TriangleTree, after, axes_around, covered, seen_above
from emulator.scene.bodies.compiled import allocating_entry, entry, kernel
from emulator.scene.files import Kind, Progress, cached_array

AZIMUTHS = 64
_FULL = 65535.0  # the number that stands for a sine of 1
_CHUNK = 2048  # points between two reports of progress
_TRIALS = 20_000

Floats = npt.NDArray[np.float64]
Horizons = npt.NDArray[np.uint16]


def horizon_table(tree: TriangleTree, points: Floats, normals: Floats, name: str = "a body") -> Horizons:
    """Return the horizons' sines in 1 / 65535, (points, AZIMUTHS), from the cache where it has them."""
    digest = hashlib.sha256()
    for array in (tree.corners, points, normals):
        digest.update(array.tobytes())
    made_from = (AZIMUTHS, digest.hexdigest())
    return cached_array("horizons", made_from, lambda: _make(tree, points, normals, name), Kind(np.uint16, 2))


def _make(tree: TriangleTree, points: Floats, normals: Floats, name: str) -> Horizons:
    out = np.zeros((len(points), AZIMUTHS), np.uint16)
    progress = Progress(f"horizons of {name}")
    parts = [slice(first, first + _CHUNK) for first in range(0, len(points), _CHUNK)]
    progress(0, len(parts))
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # the kernel releases the GIL
        work = pool.map(lambda part: _look_around(tree, points[part], normals[part], out[part]), parts)
        for done, _ in enumerate(work, 1):
            progress(done, len(parts))
    return out


def lost_light(tree: TriangleTree, points: Floats, normals: Floats, table: Horizons, tangent: float) -> float:
    """Return the share of (point, Sun above its plane) pairs that are dark by the table and in full light in fact.

    Pairs are drawn from a fixed seed, directions evenly over the half sphere.
    """
    random = np.random.default_rng(1)
    chosen = random.integers(0, len(points), _TRIALS).astype(np.int32)
    suns = random.normal(size=(_TRIALS, 3))
    suns /= np.linalg.norm(suns, axis=1, keepdims=True)
    suns *= np.where((suns * normals[chosen]).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return float(_count_lost(tree, points, normals, table, chosen, suns, tangent)) / _TRIALS


@kernel
def _direction(j: int) -> tuple[float, float]:
    """Return the unit direction of azimuth number j in the tangent plane."""
    at = 4.0 * j / AZIMUTHS
    quarter = int(at)
    f = at - quarter
    x, y = 1.0 - f, f
    length = math.sqrt(x * x + y * y)
    x, y = x / length, y / length
    if quarter == 0:
        return x, y
    if quarter == 1:
        return -y, x
    if quarter == 2:
        return -x, -y
    return y, -x


@kernel
def _azimuth(x: float, y: float) -> float:
    """Return the position of a direction of the tangent plane among the azimuths, 0 to AZIMUTHS; not for the normal."""
    at = y / (abs(x) + abs(y))
    if x < 0.0:
        at = 2.0 - at
    elif y < 0.0:
        at = 4.0 + at
    return at * (AZIMUTHS / 4)


@kernel
def _raise(ax, ay, az, bx, by, bz, directions, slopes) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
    """Raise the horizon to an edge from a to b, coordinates along the axes around the normal."""
    if az <= 0.0 and bz <= 0.0:
        return
    if abs(ax) + abs(ay) <= 0.0 or abs(bx) + abs(by) <= 0.0:
        return
    first, last = _azimuth(ax, ay), _azimuth(bx, by)
    if ax * by - ay * bx < 0.0:  # counter-clockwise order
        first, last = last, first
    if last < first:
        last += AZIMUTHS
    for j in range(math.ceil(first), int(last) + 1):
        # Where the edge crosses the half plane of this azimuth.
        x, y = directions[j % AZIMUTHS, 0], directions[j % AZIMUTHS, 1]
        p, q = ay * x - ax * y, by * x - bx * y
        t = p / (p - q) if p != q else 0.0
        t = min(max(t, 0.0), 1.0)
        distance = x * (ax + t * (bx - ax)) + y * (ay + t * (by - ay))
        height = az + t * (bz - az)
        if distance > 0.0 and height > slopes[j % AZIMUTHS] * distance:
            slopes[j % AZIMUTHS] = height / distance


@kernel
def _raise_all(tree: TriangleTree, point: Floats, axes: Frame, directions: Floats, slopes: Floats) -> None:
    """Write the tangents of the horizon around a point, (AZIMUTHS,), at least 0."""
    boxes, starts, corners, planes = tree
    ux, uy, uz, vx, vy, vz, nx, ny, nz = axes
    leaves, node = len(starts) - 1, 1
    slopes[:] = 0.0
    while True:
        x, y, z = boxes[node, 0] - point[0], boxes[node, 1] - point[1], boxes[node, 2] - point[2]
        hx, hy, hz = boxes[node, 3], boxes[node, 4], boxes[node, 5]
        # Boxes below the tangent plane hold no horizon; of the others' triangles, those that show their outside.
        if x * nx + y * ny + z * nz + hx * abs(nx) + hy * abs(ny) + hz * abs(nz) > 0.0:
            if node < leaves:
                node *= 2
                continue
            for k in range(starts[node - leaves], starts[node - leaves + 1]):
                if planes[k, 0] * point[0] + planes[k, 1] * point[1] + planes[k, 2] * point[2] < planes[k, 3]:
                    continue
                # Around the corners, and to the first again; each but the first ends an edge.
                px = py = pz = 0.0
                for i in range(4):
                    j = 3 * (i % 3)
                    x, y, z = corners[k, j] - point[0], corners[k, j + 1] - point[1], corners[k, j + 2] - point[2]
                    a, b, c = x * ux + y * uy + z * uz, x * vx + y * vy + z * vz, x * nx + y * ny + z * nz
                    if i > 0:
                        _raise(px, py, pz, a, b, c, directions, slopes)
                    px, py, pz = a, b, c
        node = after(node)
        if node == 1:
            return


@allocating_entry
def _look_around(tree: TriangleTree, points: Floats, normals: Floats, out: Horizons) -> None:
    """Write the table; a point whose normal is 0 or not a number has a horizon of 0."""
    directions, slopes = np.empty((AZIMUTHS, 2)), np.empty(AZIMUTHS)
    for j in range(AZIMUTHS):
        directions[j, 0], directions[j, 1] = _direction(j)
    for i in range(len(points)):
        axes = axes_around(normals[i, 0], normals[i, 1], normals[i, 2])
        _raise_all(tree, points[i], axes, directions, slopes)
        for j in range(AZIMUTHS):
            out[i, j] = int(slopes[j] / math.sqrt(1.0 + slopes[j] * slopes[j]) * _FULL + 0.5)


@kernel
def _near(table: Horizons, k: int, tx: float, ty: float) -> tuple[float, float]:
    """Return the sine of the horizon of point k at an azimuth, and how much it rises from one azimuth to the next."""
    at = _azimuth(tx, ty)
    j = min(int(at), AZIMUTHS - 1)
    low, high = table[k, j] * (1.0 / _FULL), table[k, (j + 1) % AZIMUTHS] * (1.0 / _FULL)
    return low + (at - j) * (high - low), high - low


@kernel
def _above(table: Horizons, k: int, sun: Point, radius: float) -> tuple[float, float]:
    """Return the height of the Sun's centre above the horizon of point k in solar radii, and the cosine of its tilt.

    The Sun's direction is along the axes around the normal, the radius in rad. Values far outside -1 to 1 have the
    right sign only: the difference of the sines is at most that of the angles, which avoids square roots for nearly all
    points.
    """
    tx, ty, up = sun
    around = abs(tx) + abs(ty)
    if not around > 1e-9:
        return 9.0, 1.0
    sine, rise = _near(table, k, tx, ty)
    # The line of the horizon near this azimuth, seen from the Sun's centre, rises by this tangent squared.
    level2, cosine2 = tx * tx + ty * ty, max(1.0 - sine * sine, 1e-6)
    tilt2 = rise * rise * (AZIMUTHS * AZIMUTHS / 16.0) * level2 / (cosine2 * (around * around) * (around * around))
    apart = up - sine
    if apart * apart > 4.0 * radius * radius * (1.0 + tilt2):
        return math.copysign(9.0, apart), 1.0
    upright = 1.0 / math.sqrt(1.0 + tilt2)
    return (up * math.sqrt(cosine2) - math.sqrt(level2) * sine) * upright / radius, upright


@entry
def dim_below(
    table: Horizons,
    normals: Floats,
    chosen: npt.NDArray[np.int32],
    count: int,
    suns: Floats,
    radius: float,
    cosines: Floats,
    shares: Floats,
) -> None:
    """Write the sunlit shares of chosen points, and raise the cosines of incidence to the mean over the visible part.

    Parameters
    ----------
    chosen, count : numbers of points, (count,) used.
    suns : (2, 3), unit, now and an instant later.
    radius : of the Sun, rad.
    cosines, shares : (2, count), now and an instant later.
    """
    for i in range(count):
        k = chosen[i]
        axes = axes_around(normals[k, 0], normals[k, 1], normals[k, 2])
        for m in range(2):
            up = cosines[m, i]
            x, upright = _above(table, k, _along(axes, suns[m, 0], suns[m, 1], suns[m, 2]), radius)
            shares[m, i], lift = seen_above(x)
            if lift != 0.0:
                cosines[m, i] += radius * lift * upright * math.sqrt(max(1.0 - up * up, 0.0))
            elif m == 0 and abs(x) > 1.01:  # in full light or dark, and so an instant later
                shares[1, i] = shares[0, i]
                break


@kernel
def _along(axes: Frame, x: float, y: float, z: float) -> Point:
    """Return a direction along the axes of a frame."""
    ux, uy, uz, vx, vy, vz, nx, ny, nz = axes
    return x * ux + y * uy + z * uz, x * vx + y * vy + z * vz, x * nx + y * ny + z * nz


@entry
def _count_lost(
    tree: TriangleTree,
    points: Floats,
    normals: Floats,
    table: Horizons,
    chosen: npt.NDArray[np.int32],
    suns: Floats,
    tangent: float,
) -> int:
    """Return how many pairs of a chosen point and a Sun are dark by the table, and not covered at all in fact."""
    lost = 0
    for i in range(len(chosen)):
        k = chosen[i]
        axes = axes_around(normals[k, 0], normals[k, 1], normals[k, 2])
        sx, sy, sz = suns[i, 0], suns[i, 1], suns[i, 2]
        x, _ = _above(table, k, _along(axes, sx, sy, sz), tangent)
        if x <= -1.0:
            lost += covered(tree, (points[k, 0], points[k, 1], points[k, 2]), (sx, sy, sz), tangent, 0.0, 1.0) == 0.0
    return lost

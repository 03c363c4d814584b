"""Compiled loops of `lighting`: which points are seen, the angles of light there, and radiance with its rate.

All is computed at an instant and a moment later, so short that the difference is the derivative to seven digits: the
laws need no derivatives of their own. Points that no facet shows to the camera, and dark ones without ambient light,
are left out at the first test; they are 60 to 80 % of a closed body's.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.photometry.reflection_kernels import reflect
from emulator.scene.bodies.compiled import entry
from emulator.scene.bodies.solar_disc import seen_above

__all__ = ["choose", "dim_at_plane", "glow"]

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int32]


@entry
def choose(
    surface: tuple[Floats, Floats, Floats], suns: Floats, eyes: Floats, lowest: float, chosen: Numbers, angles: Floats
) -> int:
    """Write which points matter and their angles; return how many.

    Parameters
    ----------
    surface : points, normals, lean of a `Surface`.
    suns, eyes : (2, 3) unit directions, and m, now and an instant later.
    lowest : points with a cosine of incidence that is not above this are left out.
    chosen : (n,), numbers of points.
    angles : (6, n), cosines of incidence and of emission and squared chords from Sun to eye, of now and of later.
    """
    points, normals, lean = surface
    count = 0
    for k in range(len(points)):
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        if not nx * suns[0, 0] + ny * suns[0, 1] + nz * suns[0, 2] > lowest:
            continue
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        dx, dy, dz = eyes[0, 0] - x, eyes[0, 1] - y, eyes[0, 2] - z
        facing, range2 = nx * dx + ny * dy + nz * dz, dx * dx + dy * dy + dz * dz
        if not (facing > 0.0 or facing * facing < lean[k] * lean[k] * range2):
            continue
        chosen[count] = k
        count += 1
    for i in range(count):
        k = chosen[i]
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        for m in range(2):
            sx, sy, sz = suns[m, 0], suns[m, 1], suns[m, 2]
            dx, dy, dz = eyes[m, 0] - points[k, 0], eyes[m, 1] - points[k, 1], eyes[m, 2] - points[k, 2]
            near = 1.0 / math.sqrt(max(dx * dx + dy * dy + dz * dz, 1e-300))
            dx, dy, dz = dx * near, dy * near, dz * near
            angles[m, i] = nx * sx + ny * sy + nz * sz
            angles[2 + m, i] = nx * dx + ny * dy + nz * dz
            angles[4 + m, i] = min((sx - dx) ** 2 + (sy - dy) ** 2 + (sz - dz) ** 2, 4.0)
    return count


@entry
def dim_at_plane(count: int, radius: float, cosines: Floats, shares: Floats) -> None:
    """Write the Sun's share above the tangent planes, and lift the cosines of incidence to its mean; see `solar_disc`.

    Parameters
    ----------
    radius : of the Sun, rad.
    cosines, shares : (2, count), now and an instant later.
    """
    for i in range(count):
        for m in range(2):
            shares[m, i], lift = seen_above(cosines[m, i] / radius)
            cosines[m, i] += radius * lift


@entry
def glow(
    law: tuple[int, Floats],
    light: tuple[float, float, float],
    chosen: Numbers,
    count: int,
    angles: Floats,
    shares: Floats,
    room: Floats,
    out: Floats,
) -> None:
    """Write radiance, W m-2 sr-1, and its rate, a second, of the chosen points.

    Parameters
    ----------
    light : irradiance of the Sun and ambient light, W/m2; seconds between now and later.
    angles : of `choose`; shares : (2, n).
    room : (3, n), overwritten.
    out : (2, points).
    """
    kind, parameters = law
    sun, ambient, between_s = light
    for m in range(2):
        reflect(kind, parameters, angles[m], angles[2 + m], angles[4 + m], count, room[m])
        for i in range(count):
            room[m, i] *= sun * shares[m, i]
    if ambient > 0.0:
        for m in range(2):
            for i in range(count):
                angles[m, i] = abs(angles[2 + m, i])
                angles[4 + m, i] = 0.0
            reflect(kind, parameters, angles[m], angles[m], angles[4 + m], count, room[2])
            for i in range(count):
                room[m, i] += ambient * room[2, i]
    for i in range(count):
        k = chosen[i]
        out[0, k] = room[0, i]
        out[1, k] = (room[1, i] - room[0, i]) / between_s

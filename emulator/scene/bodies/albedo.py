"""Relative albedo at the corners of facets: of a planet with clouds, and by a texture.

A planet like the Earth from space has oceans, land and clouds at the vertices of a round body:

    ocean 0.05, land 0.12 to 0.28, ice 0.6 beyond 68 degrees, thick cloud 0.7      (Henderson-Sellers and Wilson 1983)

29 % is land. Clouds lie in belts: much at the equator and beyond 45 degrees, little at 25 degrees. Albedo is relative:
`with_albedo` scales it to a mean of 1 over the surface, so the body's reflectance is that of the whole body, 0.3 for
the Earth. Open water, the share of ocean without cloud or ice, has the glint of the Sun too (`Water`), 0.012 more; air
before the ground adds 0.03 (`air_light`), most at the limb. Left out: air above the limb, some 30 km high, what it
scatters more than once (a fifth more), colours, and any real geography.

The patterns are noise (`grain.fractal_noise`).

Light is computed at the corners of facets, so a texture becomes the albedo of corners, and facets are divided where it
varies:

    a facet is divided   while a plane over it leaves more than 5 % (rms) of the texture, at ten places and around each,
                         and its longest side is above 2 pixels; those with most of the remainder and area first
    which sides          those longer than half of its longest, in pixels; facets beside it are cut too, without gaps
    value at a corner    mean over the size of a facet, taken a third of the way into the facet, so that nothing comes
                         from beyond a seam; the mean of all facets with that corner and the same place in the texture

Means come from a pyramid of images, each half as large as the one before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from emulator.photometry.reflectance import Water
from emulator.scene.bodies.gltf import CLAMP, MIRROR, REPEAT
from emulator.scene.bodies.grain import fractal_noise
from emulator.scene.bodies.lit_surface import cut_facets, split_sides
from emulator.scene.bodies.mesh import Mesh, facet_vectors
from emulator.scene.bodies.table import Clouds
from firmware_protocol.events import Float32s, Floats, Int64s


def smooth_step(x: Floats) -> Floats:
    """Return 0 below 0, 1 above 1, smooth between."""
    x = np.clip(x, 0, 1)
    return np.asarray(x * x * (3 - 2 * x))


def with_albedo(mesh: Mesh, albedo: Floats) -> Mesh:
    """Return a mesh with the albedo of its vertices, (n,) of any scale: its mean over the area becomes 1."""
    at_corners = albedo[mesh.faces]
    return replace(mesh, albedo=at_corners / mean_albedo(replace(mesh, albedo=at_corners)))


def mean_albedo(mesh: Mesh) -> float:
    """Return the mean over the area; albedo is linear over facets."""
    if mesh.albedo is None:
        return 1.0
    areas = np.linalg.norm(facet_vectors(mesh.vertices, mesh.faces), axis=1)
    return float((areas * mesh.albedo.mean(axis=1)).sum() / areas.sum())


_UNEVEN = 0.05
_DARKEST = 0.02  # of the mean of the texture: what is darker is even
_LEAST_PX = 2.0
_INWARD = 1 / 3
_PLACES = np.array([(a, b, 3 - a - b) for a in range(4) for b in range(4 - a)]) / 3 * 0.8 + 0.2 / 3
"""Shares of the corners at ten places of a facet, (10, 3)."""
_FLAT = _PLACES @ np.linalg.pinv(_PLACES)
"""The values of ten places on the plane that fits them best, from their values."""

_Image = Float32s


@dataclass(frozen=True, eq=False)
class Texture:
    """Luminance over the coordinates u, to the right, and v, down, from 0 to 1.

    Attributes
    ----------
    image : (height, width) float32, both powers of two.
    wraps : of WRAPS, along u and v.
    """

    image: _Image
    wraps: tuple[int, int] = (REPEAT, REPEAT)

    @cached_property
    def _levels(self) -> list[_Image]:
        """The image and its square, (height, width, 2), each time half as large."""
        levels = [np.stack([self.image, self.image**2], axis=2)]
        while max(levels[-1].shape[:2]) > 1:
            last = levels[-1]
            rows, columns = (2 if side > 1 else 1 for side in last.shape[:2])
            shape = (last.shape[0] // rows, rows, last.shape[1] // columns, columns, 2)
            levels.append(last.reshape(shape).mean(axis=(1, 3)))
        return levels

    @property
    def mean(self) -> float:
        """The mean of the image."""
        return float(self._levels[-1][0, 0, 0])

    def in_pixels(self, uv: Floats) -> Floats:
        """Return coordinates (..., 2) in pixels of the image."""
        return uv * (self.image.shape[1], self.image.shape[0])

    def around(self, uv: Floats, size_px: Floats) -> tuple[Floats, Floats]:
        """Return mean and standard deviation over about `size_px` (n,) around the places `uv` (n, 2)."""
        levels = np.clip(np.ceil(np.log2(np.maximum(size_px, 1.0))), 0, len(self._levels) - 1).astype(int)
        values = np.empty((len(uv), 2))
        for k in np.unique(levels):
            chosen = levels == k
            values[chosen] = self._between(self._levels[k], uv[chosen])
        return values[:, 0], np.sqrt(np.maximum(values[:, 1] - values[:, 0] ** 2, 0.0))

    def _between(self, level: _Image, uv: Floats) -> Floats:
        """Return the values of one level, (n, 2), in straight lines between its pixels."""
        height, width, _ = level.shape
        u, v = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
        left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        columns = [_wrapped(left + k, width, self.wraps[0]) for k in (0, 1)]
        rows = [_wrapped(top + k, height, self.wraps[1]) for k in (0, 1)]
        fu, fv = (u - left)[:, None], (v - top)[:, None]
        upper, lower = (level[row, columns[0]] * (1 - fu) + level[row, columns[1]] * fu for row in rows)
        return np.asarray(upper * (1 - fv) + lower * fv)


def _wrapped(index: Int64s, count: int, wrap: int) -> Int64s:
    if wrap == CLAMP:
        return np.clip(index, 0, count - 1)
    if wrap == MIRROR:
        index = index % (2 * count)
        return np.minimum(index, 2 * count - 1 - index)
    return index % count


def painted(mesh: Mesh, uv: Floats, texture: Texture, most_facets: int) -> tuple[Mesh, float, bool]:
    """Divide a mesh by its texture.

    Parameters
    ----------
    uv : (m, 3, 2) of the corners of its facets.
    most_facets : number of facets, beyond which no facet is divided.

    Returns
    -------
    mesh : with the albedo of its corners, whose mean over the surface is 1; None where the texture is black.
    mean : luminance, the mean over the surface.
    is_whole : True: all facets are even; false: `most_facets` ended the division.
    """
    while len(chosen := _uneven(mesh, uv, texture)):
        room = (most_facets - len(mesh.faces)) // 6  # a facet becomes four, and each of its neighbours two
        if room < most_facets // 100:
            break
        mesh, uv = _divided(mesh, uv, texture, chosen[:room])
    values = _at_corners(mesh, uv, texture)
    mean = mean_albedo(replace(mesh, albedo=values))
    albedo = values / mean if mean > 0 else None
    return replace(mesh, albedo=albedo), mean, not len(chosen)


def _sides_px(uv: Floats, texture: Texture) -> Floats:
    """Return the lengths of sides, from corner k to k + 1, (m, 3)."""
    along = texture.in_pixels(np.roll(uv, -1, axis=1) - uv)
    return np.asarray(np.hypot(along[..., 0], along[..., 1]))


def _uneven(mesh: Mesh, uv: Floats, texture: Texture) -> Int64s:
    """Return the facets on which the texture varies, those with most of it first."""
    longest = _sides_px(uv, texture).max(axis=1)
    count = len(_PLACES)
    mean, deviation = texture.around((_PLACES @ uv).reshape(-1, 2), np.repeat(longest / 3, count))
    mean, within = mean.reshape(-1, count), (deviation**2).reshape(-1, count).mean(axis=1)
    left = np.sqrt(within + ((mean - mean @ _FLAT) ** 2).mean(axis=1))
    area = np.linalg.norm(facet_vectors(mesh.vertices, mesh.faces), axis=1)
    varies = left > _UNEVEN * np.maximum(mean.mean(axis=1), _DARKEST * texture.mean)
    order = np.argsort(-area * left, kind="stable")
    return np.asarray(order[(varies & (longest > _LEAST_PX))[order]])


def _divided(mesh: Mesh, uv: Floats, texture: Texture, chosen: Int64s) -> tuple[Mesh, Floats]:
    lengths = _sides_px(uv, texture)
    split = np.zeros(mesh.faces.shape, bool)
    split[chosen] = lengths[chosen] > 0.5 * lengths[chosen].max(axis=1, keepdims=True)
    start, end = mesh.faces.astype(np.int64), np.roll(mesh.faces, -1, axis=1).astype(np.int64)
    number = np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end)
    split = np.isin(number, number[split])  # each side that one of its facets divides
    middle = (uv + np.roll(uv, -1, axis=1)) / 2
    parts = [cut_facets(uv[..., k], middle[..., k], split) for k in range(2)]
    return split_sides(mesh, split), np.stack(parts, axis=2)


def _at_corners(mesh: Mesh, uv: Floats, texture: Texture) -> Floats:
    """Return the luminance at the corners of facets, (m, 3)."""
    inside = (uv + _INWARD * (uv.mean(axis=1, keepdims=True) - uv)).reshape(-1, 2)
    size_px = np.repeat(_sides_px(uv, texture).max(axis=1) / 2, 3)
    values, _ = texture.around(inside, size_px)
    key = np.column_stack([mesh.faces.ravel(), np.round(texture.in_pixels(uv).reshape(-1, 2) * 64)])
    _, number = np.unique(key, axis=0, return_inverse=True)
    sums = np.bincount(number.ravel(), values) / np.bincount(number.ravel())
    return np.asarray(sums[number.ravel()].reshape(-1, 3))


_LAND = 0.29
_OCEAN, _ICE, _CLOUD = 0.05, 0.6, 0.7
_ICE_SINE = 0.93
_MOST_FACETS, _TOO_LARGE = 100_000, 4 / math.sqrt(3) / 1.5**2  # sides are 1.5 times as long as they should be
_LINEAR_WITHIN = 0.02  # of the glint's height, by a straight line over a facet: h^2 / (4 s) over h radians of the globe


def clouded(mesh: Mesh, p: Clouds, facet_m: float) -> Mesh:
    """Return a round body with facets of about `facet_m`, or as its glint needs, and albedo and water of a planet."""
    radius_m = float(np.linalg.norm(mesh.vertices, axis=1).mean())
    facet_m = min(facet_m, radius_m * math.sqrt(4 * _LINEAR_WITHIN * Water(p.wind_m_s).slope2))
    round_ = _round(mesh, radius_m)
    while facet_m**2 < _TOO_LARGE * round_.area_m2 / len(round_.faces) and 4 * len(round_.faces) <= _MOST_FACETS:
        round_ = _round(split_sides(round_, np.ones(round_.faces.shape, bool)), radius_m)
    albedo, water, cover = _albedo_and_water(round_.vertices / radius_m, p)
    return replace(with_albedo(round_, albedo), water=water[round_.faces], rough=cover[round_.faces])


def _round(mesh: Mesh, radius_m: float) -> Mesh:
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return replace(mesh, vertices=radius_m * normals, normals=normals)


def _albedo_and_water(places: Floats, p: Clouds) -> tuple[Floats, Floats, Floats]:
    """Return the albedo at places on the unit sphere, of any mean, and the shares of open water and of cloud."""
    height = fractal_noise(places, 1.6, 0.04, 0.6, 3 * p.seed)
    dryness = 0.5 + 0.25 * fractal_noise(places, 0.8, 0.1, 0.5, 3 * p.seed + 1)
    land = smooth_step((height - np.quantile(height, 1 - _LAND)) / 0.1)
    ground = _OCEAN + land * (0.07 + 0.16 * np.clip(dryness, 0, 1))
    ice = smooth_step((np.abs(places[:, 2]) + 0.02 * height - _ICE_SINE) / 0.03)
    ground = ground + ice * (_ICE - ground)
    cover = _cover(places, p)
    return ground + cover * (_CLOUD - ground), (1 - land) * (1 - ice) * (1 - cover), cover


def _cover(places: Floats, p: Clouds) -> Floats:
    """Return the share of thick cloud, 0 to 1: streaks that run east and west, swirled by a slower noise."""
    swirl = np.stack([fractal_noise(places, 0.9, 0.2, 0.5, 3 * p.seed + 5 + k) for k in range(3)], axis=1)
    stretched = (places + 0.12 * swirl) * (1.0, 1.0, 1.7)
    density = fractal_noise(stretched, 0.7, 0.015, 0.68, 3 * p.seed + 2)
    latitude = np.arcsin(np.clip(places[:, 2], -1, 1))
    belts = 0.7 * np.cos(4.5 * latitude) - 0.9 * np.exp(-(((np.abs(latitude) - 0.45) / 0.2) ** 2))
    density = density + 0.5 * belts + 0.6 * np.sin(latitude) ** 4
    return smooth_step((density - np.quantile(density, 1 - p.cloud_cover)) / 1.4)

"""Facets divided where a texture varies, and the albedo at their corners.

Light is computed at the corners of facets, so a texture becomes the albedo of corners:

    a facet is divided   while a plane over it leaves more than 5 % (rms) of the texture, at ten places and around each,
                         and its longest side is above 2 pixels; those with most of the remainder and area first
    which sides          those longer than half of its longest, in pixels; facets beside it are cut too, without gaps
    value at a corner    mean over the size of a facet, taken a third of the way into the facet, so that nothing comes
                         from beyond a seam; the mean of all facets with that corner and the same place in the texture

Means come from a pyramid of images, each half as large as the one before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.clouds import mean_albedo
from emulator.scene.bodies.lit_surface import cut_facets, split_sides
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.textures import CLAMP, MIRROR, REPEAT

_UNEVEN = 0.05
_DARKEST = 0.02  # of the mean of the texture: what is darker is even
_LEAST_PX = 2.0
_INWARD = 1 / 3
_PLACES = np.array([(a, b, 3 - a - b) for a in range(4) for b in range(4 - a)]) / 3 * 0.8 + 0.2 / 3
"""Shares of the corners at ten places of a facet, (10, 3)."""
_FLAT = _PLACES @ np.linalg.pinv(_PLACES)
"""The values of ten places on the plane that fits them best, from their values."""

_Floats = npt.NDArray[np.float64]
_Image = npt.NDArray[np.float32]


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
    def _levels(self) -> list[npt.NDArray[np.float32]]:
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

    def in_pixels(self, uv: _Floats) -> _Floats:
        """Return coordinates (..., 2) in pixels of the image."""
        return uv * (self.image.shape[1], self.image.shape[0])

    def around(self, uv: _Floats, size_px: _Floats) -> tuple[_Floats, _Floats]:
        """Return mean and standard deviation over about `size_px` (n,) around the places `uv` (n, 2)."""
        levels = np.clip(np.ceil(np.log2(np.maximum(size_px, 1.0))), 0, len(self._levels) - 1).astype(int)
        found = np.empty((len(uv), 2))
        for k in np.unique(levels):
            chosen = levels == k
            found[chosen] = self._between(self._levels[k], uv[chosen])
        return found[:, 0], np.sqrt(np.maximum(found[:, 1] - found[:, 0] ** 2, 0.0))

    def _between(self, level: npt.NDArray[np.float32], uv: _Floats) -> _Floats:
        """Return the values of one level, (n, 2), in straight lines between its pixels."""
        height, width, _ = level.shape
        u, v = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
        left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        columns = [_wrapped(left + k, width, self.wraps[0]) for k in (0, 1)]
        rows = [_wrapped(top + k, height, self.wraps[1]) for k in (0, 1)]
        fu, fv = (u - left)[:, None], (v - top)[:, None]
        upper, lower = (level[row, columns[0]] * (1 - fu) + level[row, columns[1]] * fu for row in rows)
        return np.asarray(upper * (1 - fv) + lower * fv)


def _wrapped(index: npt.NDArray[np.int64], count: int, wrap: int) -> npt.NDArray[np.int64]:
    if wrap == CLAMP:
        return np.clip(index, 0, count - 1)
    if wrap == MIRROR:
        index = index % (2 * count)
        return np.minimum(index, 2 * count - 1 - index)
    return index % count


def painted(mesh: Mesh, uv: _Floats, texture: Texture, most: int) -> tuple[Mesh, float, bool]:
    """Divide a mesh by its texture.

    Parameters
    ----------
    uv : (m, 3, 2) of the corners of its facets.
    most : number of facets, beyond which no facet is divided.

    Returns
    -------
    mesh : with the albedo of its corners, whose mean over the surface is 1; None where the texture is black.
    mean : luminance, the mean over the surface.
    is_whole : True: all facets are even; false: `most` ended the division.
    """
    while len(chosen := _uneven(mesh, uv, texture)):
        room = (most - len(mesh.faces)) // 6  # a facet becomes four, and each of its neighbours two
        if room < most // 100:
            break
        mesh, uv = _divided(mesh, uv, texture, chosen[:room])
    values = _at_corners(mesh, uv, texture)
    mean = mean_albedo(replace(mesh, albedo=values))
    albedo = values / mean if mean > 0 else None
    return replace(mesh, albedo=albedo), mean, not len(chosen)


def _sides_px(uv: _Floats, texture: Texture) -> _Floats:
    """Return the lengths of sides, from corner k to k + 1, (m, 3)."""
    along = texture.in_pixels(np.roll(uv, -1, axis=1) - uv)
    return np.asarray(np.hypot(along[..., 0], along[..., 1]))


def _uneven(mesh: Mesh, uv: _Floats, texture: Texture) -> npt.NDArray[np.int64]:
    """Return the facets on which the texture varies, those with most of it first."""
    longest = _sides_px(uv, texture).max(axis=1)
    count = len(_PLACES)
    mean, deviation = texture.around((_PLACES @ uv).reshape(-1, 2), np.repeat(longest / 3, count))
    mean, within = mean.reshape(-1, count), (deviation**2).reshape(-1, count).mean(axis=1)
    left = np.sqrt(within + ((mean - mean @ _FLAT) ** 2).mean(axis=1))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    varies = left > _UNEVEN * np.maximum(mean.mean(axis=1), _DARKEST * texture.mean)
    order = np.argsort(-area * left, kind="stable")
    return np.asarray(order[(varies & (longest > _LEAST_PX))[order]])


def _divided(mesh: Mesh, uv: _Floats, texture: Texture, chosen: npt.NDArray[np.int64]) -> tuple[Mesh, _Floats]:
    lengths = _sides_px(uv, texture)
    split = np.zeros(mesh.faces.shape, bool)
    split[chosen] = lengths[chosen] > 0.5 * lengths[chosen].max(axis=1, keepdims=True)
    split = _on_both_sides(mesh, split)
    middle = (uv + np.roll(uv, -1, axis=1)) / 2
    parts = [cut_facets(uv[..., k], middle[..., k], split) for k in range(2)]
    return split_sides(mesh, split), np.stack(parts, axis=2)


def _on_both_sides(mesh: Mesh, split: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the mask with each side that one of its facets divides."""
    start, end = mesh.faces.astype(np.int64), np.roll(mesh.faces, -1, axis=1).astype(np.int64)
    number = np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end)
    return np.isin(number, number[split])


def _at_corners(mesh: Mesh, uv: _Floats, texture: Texture) -> _Floats:
    """Return the luminance at the corners of facets, (m, 3)."""
    inside = (uv + _INWARD * (uv.mean(axis=1, keepdims=True) - uv)).reshape(-1, 2)
    size_px = np.repeat(_sides_px(uv, texture).max(axis=1) / 2, 3)
    values, _ = texture.around(inside, size_px)
    key = np.column_stack([mesh.faces.ravel(), np.round(texture.in_pixels(uv).reshape(-1, 2) * 64)])
    _, number = np.unique(key, axis=0, return_inverse=True)
    sums = np.bincount(number.ravel(), values) / np.bincount(number.ravel())
    return np.asarray(sums[number.ravel()].reshape(-1, 3))

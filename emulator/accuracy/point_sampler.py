"""Light by point samples: a z-buffer with many samples a pixel, in float64. The reference for renderers.

It shares no code with what it judges, knows no rates and no coverage, and is slow: each facet is tested against every
sample in its box, and the light of a pixel is the mean of its samples. Depth and light are interpolated linearly in
1/z, as perspective has it. Facets are seen from both sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import entry_of

__all__ = ["PointSampler", "clipped"]

_Floats = npt.NDArray[np.float64]
_compiled: Callable[[Callable[..., Any]], Callable[..., Any]] = entry_of(__name__)


class PointSampler:
    """Draws triangles by `samples` x `samples` points a pixel.

    Parameters
    ----------
    size : (width, height), pixels.
    focal_px : focal length over pixel pitch; the boresight is the middle of the picture.
    """

    def __init__(self, size: tuple[int, int], focal_px: float, samples: int) -> None:
        self._size, self._samples = size, samples
        self._focal = focal_px * samples
        shape = size[1] * samples, size[0] * samples
        self._nearness, self._light = np.zeros(shape), np.zeros(shape)

    def draw(self, parts: Iterable[tuple[_Floats, _Floats]]) -> npt.NDArray[np.float32]:
        """Return the mean light of each pixel, (height, width) float32.

        Parameters
        ----------
        parts : of the scene, each as corners, (facets, 3, 3) m in camera axes (x right, y down, z along the boresight),
            and light at the corners, (facets, 3).
        """
        middle = self._size[0] * self._samples / 2, self._size[1] * self._samples / 2
        self._nearness[:] = 0.0
        self._light[:] = 0.0
        for corners_m, light in parts:
            _fill(*clipped(corners_m, light), (self._focal, *middle), self._nearness, self._light)
        out = np.empty((self._size[1], self._size[0]), np.float32)
        _average(self._light, self._samples, out)
        return out


def clipped(corners_m: _Floats, light: _Floats, nearest_m: float = 1e-3) -> tuple[_Floats, _Floats]:
    """Return the parts of facets beyond `nearest_m` along the boresight, (n, 3, 3), and the light at their corners."""
    before = corners_m[:, :, 2] > nearest_m
    whole = before[:, 0] & before[:, 1] & before[:, 2]
    cut = (before[:, 0] | before[:, 1] | before[:, 2]) & ~whole
    if whole.all():
        return corners_m, light
    parts = [_cut(*facet, nearest_m) for facet in zip(corners_m[cut], light[cut], strict=True)]
    more = [part for one in parts for part in one]
    if not more:
        return corners_m[whole], light[whole]
    corners, lights = (np.array(values) for values in zip(*more, strict=True))
    return np.concatenate((corners_m[whole], corners)), np.concatenate((light[whole], lights))


def _cut(corners: _Floats, light: _Floats, nearest_m: float) -> list[tuple[_Floats, _Floats]]:
    """Return the triangles that are left of one facet, after Sutherland and Hodgman."""
    polygon: list[_Floats] = []
    points = np.column_stack((corners, light))
    for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
        if a[2] > nearest_m:
            polygon.append(a)
        if (a[2] > nearest_m) != (b[2] > nearest_m):
            polygon.append(a + (b - a) * (nearest_m - a[2]) / (b[2] - a[2]))
    fan = [np.array([polygon[0], polygon[k], polygon[k + 1]]) for k in range(1, len(polygon) - 1)]
    return [(part[:, :3], part[:, 3]) for part in fan]


@_compiled
def _fill(corners: _Floats, light: _Floats, screen: tuple[float, float, float], nearest: _Floats, out: _Floats) -> None:
    rows, columns = nearest.shape
    focal, middle_x, middle_y = screen
    for f in range(corners.shape[0]):
        wa, wb, wc = 1 / corners[f, 0, 2], 1 / corners[f, 1, 2], 1 / corners[f, 2, 2]
        ax, ay = corners[f, 0, 0] * wa * focal + middle_x, corners[f, 0, 1] * wa * focal + middle_y
        bx, by = corners[f, 1, 0] * wb * focal + middle_x, corners[f, 1, 1] * wb * focal + middle_y
        cx, cy = corners[f, 2, 0] * wc * focal + middle_x, corners[f, 2, 1] * wc * focal + middle_y
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0 or not math.isfinite(area):
            continue
        top, bottom = max(0, math.ceil(min(ay, by, cy) - 0.5)), min(rows - 1, math.floor(max(ay, by, cy) - 0.5))
        left, right = max(0, math.ceil(min(ax, bx, cx) - 0.5)), min(columns - 1, math.floor(max(ax, bx, cx) - 0.5))
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                a = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                b = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                c = 1.0 - a - b
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                near = a * wa + b * wb + c * wc
                if near > nearest[row, column]:
                    nearest[row, column] = near
                    seen = a * wa * light[f, 0] + b * wb * light[f, 1] + c * wc * light[f, 2]
                    out[row, column] = seen / near


@_compiled
def _average(samples: _Floats, side: int, out: npt.NDArray[np.float32]) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            total = 0.0
            for i in range(row * side, (row + 1) * side):
                for j in range(column * side, (column + 1) * side):
                    total += samples[i, j]
            out[row, column] = total / (side * side)

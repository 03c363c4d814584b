"""Points of light spread over pixels by a Gaussian, with the exact share of each pixel.

With s = sigma sqrt(2) and a point at x, pixel j (from j to j + 1) gets

    w_j = (erf((j + 1 - x) / s) - erf((j - x) / s)) / 2
    dw_j/dx = g(j - x) - g(j + 1 - x),    g(u) = e^(-(u/s)^2) / (s sqrt pi)

of it, times the same in y: no light is lost or made wherever the point lies between the pixels. Sampling the Gaussian
at pixel centres instead would make a drifting star twinkle, by 0.82 to 1.65 at sigma 0.3, and so fire false events.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.light import Light
from firmware_protocol.compiled import entry_of

__all__ = ["REACH_SIGMAS", "boxes_of", "clear", "splat"]

REACH_SIGMAS = 4.0
"""Where the Gaussian is cut off; what is beyond is 6e-5 of the light on each side."""

_MOST = 256
_entry = entry_of(__name__, error_model="python")

Floats = npt.NDArray[np.float64]
Boxes = npt.NDArray[np.int64]
"""(n, 4) int64: first and last row, first and last column, the last ones not included."""


@_entry
def _shares(x: float, first: int, n: int, sigma: float, share: Floats, slope: Floats) -> None:
    """Write w_j and dw_j/dx of pixels first to first + n."""
    s = sigma * math.sqrt(2.0)
    scale = 1.0 / (s * math.sqrt(math.pi))
    u = (first - x) / s
    erf_before, g_before = math.erf(u), math.exp(-u * u) * scale
    for j in range(n):
        u = (first + j + 1 - x) / s
        erf_after, g_after = math.erf(u), math.exp(-u * u) * scale
        share[j], slope[j] = 0.5 * (erf_after - erf_before), g_before - g_after
        erf_before, g_before = erf_after, g_after


@_entry
def _reach(sigma: float) -> tuple[int, int]:
    """Return how many pixels a point reaches before its own, and how many in all."""
    reach = math.ceil(REACH_SIGMAS * sigma) + 1
    return reach, min(2 * reach + 1, _MOST)


@_entry
def boxes_of(points: Floats, sigma: float, size: tuple[int, int], boxes: Boxes) -> None:
    """Write where `splat` draws points in a picture of `size` = (width, height), a box each; empty if outside."""
    reach, n = _reach(sigma)
    for k in range(points.shape[0]):
        left, top = math.floor(points[k, 0]) - reach, math.floor(points[k, 1]) - reach
        boxes[k, 0], boxes[k, 1] = min(max(top, 0), size[1]), min(max(top + n, 0), size[1])
        boxes[k, 2], boxes[k, 3] = min(max(left, 0), size[0]), min(max(left + n, 0), size[0])


@_entry
def clear(boxes: Boxes, sky: np.float32, light: Light, rate: Light) -> None:
    """Write an empty sky into the boxes of a picture and of its time derivative, which may have no pixels."""
    for k in range(boxes.shape[0]):
        for row in range(boxes[k, 0], boxes[k, 1]):
            light[row, boxes[k, 2] : boxes[k, 3]] = sky
            if rate.size:
                rate[row, boxes[k, 2] : boxes[k, 3]] = np.float32(0)


@_entry
def splat(points: Floats, sigma: float, light: Light, rate: Light) -> None:
    """Add points to a picture and to its time derivative.

    Parameters
    ----------
    points : (n, 5) float64: column, row (0.5: the middle of the first pixel), light, px/s along columns and rows.
    sigma : of the Gaussian, pixels.
    light, rate : (height, width) float32, added to; `rate` may have no pixels.
    """
    height, width = light.shape
    reach, n = _reach(sigma)
    across, across_slope, down, down_slope = np.empty(_MOST), np.empty(_MOST), np.empty(_MOST), np.empty(_MOST)
    for k in range(points.shape[0]):
        x, y, flux = points[k, 0], points[k, 1], points[k, 2]
        left, top = math.floor(x) - reach, math.floor(y) - reach
        if left >= width or top >= height or left + n <= 0 or top + n <= 0:
            continue
        _shares(x, left, n, sigma, across, across_slope)
        _shares(y, top, n, sigma, down, down_slope)
        for j in range(max(0, -top), min(n, height - top)):
            row = light[top + j]
            for i in range(max(0, -left), min(n, width - left)):
                row[left + i] += np.float32(flux * across[i] * down[j])
            if rate.size:
                change = rate[top + j]
                for i in range(max(0, -left), min(n, width - left)):
                    by_x = points[k, 3] * across_slope[i] * down[j]
                    change[left + i] += np.float32(flux * (by_x + points[k, 4] * across[i] * down_slope[j]))

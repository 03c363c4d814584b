"""Craters and boulders: how many of each size, and their shapes.

Craters, fresh, with r the distance from the middle in radii (Pike 1977; McGetchin 1973):

    inside   z = 0.2 D (r^2 - 1) + 0.04 D          depth / diameter 0.2, the rim 0.04 D above the ground
    outside  z = 0.04 D r^-3                        ejecta; drawn to r = 3, where it is brought to nothing

An old crater is a shrunken one: all heights times age, even between 0.25 and 1, so depth / diameter is 0.05 to 0.2.
How many: N(> D) = 0.046 D^-2 per m2, the steady state where they are 3 % of geometric saturation, 1.54 D^-2
(Gault 1970; Moore et al. 1980; Minton et al. 2019). So D = D1 (1 - u (1 - (D1 / D2)^2))^(-1/2) between D1 and D2.

Boulders are half ellipsoids, half as high as wide. The share of the ground under those larger than D is
F(> D) = k e^(-q D), q = 1.79 + 0.152 / k, D in metres (Golombek and Rapp 1997), hence N(> D) = 4 / pi times the
integral of q k e^(-q x) / x^2 from D.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import numpy.typing as npt

__all__ = ["boulder_sizes", "crater_sizes", "height_of_crater", "raise_boulders", "sink_craters"]

Floats = npt.NDArray[np.float64]

DEPTH, RIM, REACH = 0.2, 0.04, 3.0
_EDGE = RIM / REACH**3


def crater_sizes(rng: np.random.Generator, density: float, limits_m: tuple[float, float], area_m2: float) -> Floats:
    """Draw the diameters of the craters between two limits on an area, the largest first, as they are overlaid."""
    low, high = limits_m
    expected = density * (low**-2 - high**-2) * area_m2
    u = rng.random(rng.poisson(expected))
    return np.asarray(np.sort(low * (1 - u * (1 - (low / high) ** 2)) ** -0.5)[::-1])


def boulder_sizes(rng: np.random.Generator, cover: float, limits_m: tuple[float, float], area_m2: float) -> Floats:
    """Draw the diameters of the boulders between two limits on an area."""
    if cover == 0:
        return np.empty(0)
    q = 1.79 + 0.152 / cover
    sizes = np.geomspace(*limits_m, 257)
    middle = np.sqrt(sizes[1:] * sizes[:-1])
    per_m2 = 4 / math.pi * q * cover * np.exp(-q * middle) / middle**2 * np.diff(sizes)
    cumulative = np.concatenate([[0.0], np.cumsum(per_m2)])
    u = rng.random(rng.poisson(cumulative[-1] * area_m2)) * cumulative[-1]
    return np.asarray(np.interp(u, cumulative, sizes))


@numba.njit(cache=True, nogil=True)
def height_of_crater(r: float, diameter: float) -> float:
    """Return the height of a fresh crater's profile `r` radii from its middle."""
    if r < 1.0:
        return (DEPTH * (r * r - 1.0) + RIM) * diameter
    if r < REACH:
        return (RIM / r**3 - _EDGE * (r - 1.0) / (REACH - 1.0)) * diameter
    return 0.0


@numba.njit(cache=True, nogil=True)
def sink_craters(heights: Floats, places: Floats, diameters: Floats, ages: Floats) -> None:
    """Add craters to (rows, columns) `heights`; places (n, 2) row and column, diameters in posts, ages 0 to 1.

    Heights and diameters are in the same unit, that is in distances of posts.
    """
    rows, columns = heights.shape
    for k in range(len(diameters)):
        radius = 0.5 * diameters[k]
        y, x, reach = places[k, 0], places[k, 1], REACH * radius
        for i in range(max(0, math.ceil(y - reach)), min(rows, math.floor(y + reach) + 1)):
            for j in range(max(0, math.ceil(x - reach)), min(columns, math.floor(x + reach) + 1)):
                r = math.sqrt((i - y) ** 2 + (j - x) ** 2) / radius
                heights[i, j] += ages[k] * height_of_crater(r, diameters[k])


@numba.njit(cache=True, nogil=True)
def raise_boulders(heights: Floats, places: Floats, diameters: Floats) -> None:
    """Add boulders, as `sink_craters` does craters."""
    rows, columns = heights.shape
    for k in range(len(diameters)):
        radius = 0.5 * diameters[k]
        y, x = places[k, 0], places[k, 1]
        for i in range(max(0, math.ceil(y - radius)), min(rows, math.floor(y + radius) + 1)):
            for j in range(max(0, math.ceil(x - radius)), min(columns, math.floor(x + radius) + 1)):
                r2 = ((i - y) ** 2 + (j - x) ** 2) / (radius * radius)
                if r2 < 1.0:
                    heights[i, j] += radius * math.sqrt(1.0 - r2)

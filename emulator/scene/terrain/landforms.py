"""Craters and boulders: how many of each size, and their shapes.

Craters, fresh, with r the distance from the middle in radii (Pike 1977; McGetchin 1973):

    inside   z = 0.2 D (r^2 - 1) + 0.04 D          depth / diameter 0.2, the rim 0.04 D above the ground
    outside  z = 0.04 D r^-3                        ejecta; drawn to r = 3, where it is brought to nothing

An old crater is a worn one: depth times age, the rim times age squared as it goes first, and the floor is filled up to
a share of the depth. Ages run from 0.12 to 1, most craters old: depth / diameter is 0.024 to 0.2. Outlines are circles
with a second and a third harmonic of a few per cent. Some craters of one size stand in chains, as secondary ones do.
How many: N(> D) = 0.046 D^-2 per m2, the steady state where they are 3 % of geometric saturation, 1.54 D^-2
(Gault 1970; Moore et al. 1980; Minton et al. 2019). So D = D1 (1 - u (1 - (D1 / D2)^2))^(-1/2) between D1 and D2.

Boulders are the upper parts of convex bodies with flat sides, up to half as high as wide. The share of the ground under
those larger than D is F(> D) = k e^(-q D), q = 1.79 + 0.152 / k, D in metres (Golombek and Rapp 1997), hence N(> D) =
4 / pi times the integral of q k e^(-q x) / x^2 from D.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.scene.terrain.compiled import map_entry

__all__ = [
    "boulder_sizes",
    "brighten",
    "crater_places",
    "crater_shapes",
    "crater_sizes",
    "height_of_boulder",
    "height_of_crater",
    "raise_boulders",
    "sink_craters",
]

Floats = npt.NDArray[np.float64]

DEPTH, RIM, REACH = 0.2, 0.04, 3.0
YOUNG, BRIGHTER = 0.8, 0.3  # craters younger than this are brighter, by at most this
SIDES = 7  # of a boulder
_TANGENT = math.sqrt(math.pi / (SIDES * math.tan(math.pi / SIDES)))  # of the polygon with a circle's area
_CHAIN = 8  # craters


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


def crater_shapes(rng: np.random.Generator, count: int) -> Floats:
    """Draw ages, floors, and outlines, (count, 6), as `sink_craters` takes them."""
    shapes = rng.random((count, 6))
    shapes[:, 0] = 0.12 + 0.88 * shapes[:, 0] ** 1.5
    shapes[:, 1] = 0.5 * shapes[:, 1] * (1 - shapes[:, 0])
    shapes[:, 2] *= 0.08
    shapes[:, 4] *= 0.06
    shapes[:, 3::2] *= 2 * math.pi
    return shapes


def crater_places(rng: np.random.Generator, diameters: Floats, side: float) -> Floats:
    """Draw the places of craters on a square, (n, 2); one in thirty stands in a chain of craters of about its size."""
    places = rng.random((len(diameters), 2)) * side
    for first in rng.integers(0, max(len(diameters) - _CHAIN, 1), len(diameters) // (30 * _CHAIN)):
        turn, bent = rng.uniform(0, 2 * math.pi), rng.normal(0, 0.15, _CHAIN)
        links = diameters[first : first + _CHAIN]
        turns = turn + np.cumsum(bent[: len(links)])
        steps = (rng.uniform(0.9, 2.0, len(links)) * links)[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
        places[first : first + _CHAIN] = places[first] + np.cumsum(steps, axis=0)
    return places


@map_entry
def height_of_crater(r: float, diameter: float, age: float, floor: float) -> float:
    """Return the height of a crater's profile `r` radii from its middle; age 1 and floor 0 for a fresh one."""
    rim = RIM * age * age
    if r < 1.0:
        return (DEPTH * age * (max(r * r, floor) - 1.0) + rim) * diameter
    if r < REACH:
        return (rim / r**3 - rim / REACH**3 * (r - 1.0) / (REACH - 1.0)) * diameter
    return 0.0


@map_entry
def sink_craters(heights: Floats, places: Floats, diameters: Floats, shapes: Floats) -> None:
    """Add craters to (rows, columns) `heights`; places (n, 2) row and column, diameters in posts.

    Heights and diameters are in the same unit, that is in distances of posts. `shapes` are (n, 6): age, 0 to 1; share
    of the depth that is filled; amplitude and phase of the outline's second harmonic, and of its third.
    """
    rows, columns = heights.shape
    for k in range(len(diameters)):
        radius = 0.5 * diameters[k]
        age, floor, second, turned, third, turned3 = shapes[k]
        y, x, reach = places[k, 0], places[k, 1], REACH * radius * (1.0 + second + third)
        for i in range(max(0, math.ceil(y - reach)), min(rows, math.floor(y + reach) + 1)):
            for j in range(max(0, math.ceil(x - reach)), min(columns, math.floor(x + reach) + 1)):
                r = math.sqrt((i - y) ** 2 + (j - x) ** 2) / radius
                if second + third > 0.0:
                    turn = math.atan2(i - y, j - x)
                    r /= 1.0 + second * math.cos(2.0 * turn + turned) + third * math.cos(3.0 * turn + turned3)
                heights[i, j] += height_of_crater(r, diameters[k], age, floor)


@map_entry
def brighten(albedo: Floats, places: Floats, diameters: Floats, ages: Floats) -> None:
    """Multiply relative albedo, (rows, columns), by up to 1.3 in and around young craters; see `sink_craters`."""
    rows, columns = albedo.shape
    for k in range(len(diameters)):
        young = (ages[k] - YOUNG) / (1.0 - YOUNG)
        if young <= 0.0:
            continue
        y, x, reach = places[k, 0], places[k, 1], 1.25 * diameters[k]
        for i in range(max(0, math.ceil(y - reach)), min(rows, math.floor(y + reach) + 1)):
            for j in range(max(0, math.ceil(x - reach)), min(columns, math.floor(x + reach) + 1)):
                near = 1.0 - ((i - y) ** 2 + (j - x) ** 2) / (reach * reach)
                if near > 0.0:
                    albedo[i, j] *= 1.0 + BRIGHTER * young * near * near


@map_entry
def raise_boulders(heights: Floats, places: Floats, diameters: Floats, lots: Floats) -> None:
    """Add boulders, as `sink_craters` does craters; `lots` are (n, 4) numbers between 0 and 1 for their sides."""
    rows, columns = heights.shape
    for k in range(len(diameters)):
        radius = 0.5 * diameters[k]
        y, x = places[k, 0], places[k, 1]
        reach = 1.6 * radius
        for i in range(max(0, math.ceil(y - reach)), min(rows, math.floor(y + reach) + 1)):
            for j in range(max(0, math.ceil(x - reach)), min(columns, math.floor(x + reach) + 1)):
                high = height_of_boulder((j - x) / radius, (i - y) / radius, lots[k])
                if high > 0.0:
                    heights[i, j] += radius * high


@map_entry
def height_of_boulder(x: float, y: float, lots: Floats) -> float:
    """Return the height in radii, at a place in radii: the lowest of a tilted top and SIDES sides, 0 beyond them.

    The sides meet the ground around a circle's area, drawn longer one way by up to 1.3 and as much narrower.
    """
    longer = 1.0 + 0.3 * lots[1]
    turn = 2.0 * math.pi * lots[0]
    u, v = (x * math.cos(turn) + y * math.sin(turn)) / longer, (y * math.cos(turn) - x * math.sin(turn)) * longer
    high = 0.55 + 0.45 * lots[2] + 0.5 * (lots[3] - 0.5) * u
    for k in range(SIDES):
        lot = (lots[k % 4] * (k + 7.0) * 3.7) % 1.0
        at = 2.0 * math.pi * k / SIDES
        high = min(high, (0.8 + 1.8 * lot) * (_TANGENT - u * math.cos(at) - v * math.sin(at)))
    return float(high)

"""A synthetic ridge near the lunar south pole: relief, craters and boulders on nested grids.

Relief is a fractional Brownian surface: its heights differ by v(r) = C r^H over a distance r, root mean square, which
is a power spectrum S(k) = A k^-(2 H + 2), k in cycles a metre, with

    v(r)^2 = 2 integral of S(k) (1 - J0(2 pi k r)) d2k    so    A = C^2 / (4 pi (2 pi)^(2 H) I)
    I = integral from 0 of x^(-2 H - 1) (1 - J0(x)) dx = Gamma(1 - H) / (2^(2 H + 1) H Gamma(1 + H))

H = 0.95 in the lunar highlands (Rosenburg et al. 2011). Each grid has the detail that its posts can represent: a finer
one takes the coarser one's middle, twice as dense by cubic interpolation, and adds the octave of relief between the two
Nyquist frequencies, and the octave of craters and of boulders that are 6 to 12 of its posts wide, faded to zero towards
its border. All of it is drawn by a generator of its own for each grid and kind, so a map is the same to the last bit
for a seed (and a build of numpy).

The ridge is 5 km above a base of 15 x 15 km for Malapert (LROC): here a Gaussian across, its crest along x, on which
the site lies.

Craters, fresh, with r the distance from the middle in radii (Pike 1977; McGetchin 1973):

    inside   z = 0.2 D (r^2 - 1) + 0.04 D          depth / diameter 0.2, the rim 0.04 D above the ground
    outside  z = 0.04 D r^-3                        ejecta; drawn to r = 3, where it is faded to zero

An old crater is eroded: depth times age, the rim times age squared as it erodes first, and the floor is filled up to
a share of the depth. Ages run from 0.12 to 1, most craters old: depth / diameter is 0.024 to 0.2. Outlines are circles
with a second and a third harmonic of a few per cent. Some craters of one size stand in chains, as secondary ones do.
Their number: N(> D) = 0.046 D^-2 per m2, the steady state where they are 3 % of geometric saturation, 1.54 D^-2
(Gault 1970; Moore et al. 1980; Minton et al. 2019). So D = D1 (1 - u (1 - (D1 / D2)^2))^(-1/2) between D1 and D2.

Boulders are the upper parts of convex bodies with flat sides, up to half as high as wide. The share of the ground under
those larger than D is F(> D) = k e^(-q D), q = 1.79 + 0.152 / k, D in metres (Golombek and Rapp 1997), hence N(> D) =
4 / pi times the integral of q k e^(-q x) / x^2 from D.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from emulator.scene.terrain.ground import Ground, Heights, map_entry, nested
from emulator.scene.terrain.table import Ridge
from firmware_protocol.events import Floats

DEPTH, RIM, REACH = 0.2, 0.04, 3.0
YOUNG, BRIGHTER = 0.8, 0.3  # craters younger than this are brighter, by at most this
SIDES = 7  # of a boulder
_TANGENT = math.sqrt(math.pi / (SIDES * math.tan(math.pi / SIDES)))  # of the polygon with a circle's area
_CHAIN = 8  # craters


def crater_sizes(rng: np.random.Generator, density: float, low_m: float, high_m: float, area_m2: float) -> Floats:
    """Draw the diameters of the craters between two limits on an area, the largest first, as they are overlaid."""
    expected = density * (low_m**-2 - high_m**-2) * area_m2
    u = rng.random(rng.poisson(expected))
    return np.asarray(np.sort(low_m * (1 - u * (1 - (low_m / high_m) ** 2)) ** -0.5)[::-1])


def boulder_sizes(rng: np.random.Generator, cover: float, low_m: float, high_m: float, area_m2: float) -> Floats:
    """Draw the diameters of the boulders between two limits on an area."""
    if cover == 0:
        return np.empty(0)
    q = 1.79 + 0.152 / cover
    sizes = np.geomspace(low_m, high_m, 257)
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
                closeness = 1.0 - ((i - y) ** 2 + (j - x) ** 2) / (reach * reach)
                if closeness > 0.0:
                    albedo[i, j] *= 1.0 + BRIGHTER * young * closeness * closeness


@map_entry
def raise_boulders(heights: Floats, places: Floats, diameters: Floats, lots: Floats) -> None:
    """Add boulders, as `sink_craters` adds craters; `lots` are (n, 4) random numbers from 0 to 1 for their sides."""
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


HURST = 0.95
_LEAST_POSTS = 6.0  # across a crater or a boulder: smaller ones have no shape on the grid
_OCTAVE = 2.0
_LARGEST_SHARE = 1 / 12  # of the map, a crater
_RELIEF, _CRATERS, _BOULDERS, _ALBEDO = range(4)
_DARKEST, _BRIGHTEST = 0.4, 1.8  # of the mean
_SLOPE_OVER_M = 10.0
_FADED_SHARE = 0.25  # of a finer grid's half side, at its border


def make_ridge(p: Ridge, progress: Callable[[int, int], None] = lambda done, of: None) -> Ground:
    """Return the map of `p`; `progress` is called with the number of grids that are done, and of all."""
    count = _count(p)
    grids: list[Floats] = []
    for k in range(count):
        progress(k, count)
        post_m = _post_m(p, k)
        detail = _detail(p, k, post_m)
        grids.append(detail + _ridge(p, post_m) if k == 0 else _twice_as_dense(grids[-1]) + detail * _fading(p.posts))
    progress(count, count)
    return nested(post_m, grids[::-1])


def make_albedo(p: Ridge) -> Heights:
    """Return the albedo of the posts of `make_ridge`, (grids, rows, columns), finest first; the map's mean is 1.

    All octaves of wavelengths have the same amplitude; young craters and their ejecta are brighter.
    """
    grids: list[Floats] = []
    for k in range(_count(p)):
        post_m = _post_m(p, k)
        noise = fractal(np.random.default_rng([p.seed, k, _ALBEDO]), p.posts, post_m, *_band(k, post_m), 1.0)
        octaves = math.log2(p.posts / 2) if k == 0 else 1.0
        share = p.albedo_rms * math.sqrt(octaves / (_count(p) + math.log2(p.posts / 2)))
        detail = 1 + share * np.pad(noise / max(float(noise.std()), 1e-30), (0, 1), mode="wrap")
        places, diameters, shapes = _craters(p, k, post_m)
        if p.albedo_rms > 0:
            brighten(detail, places, diameters, shapes[:, 0])
        grids.append(detail if k == 0 else _twice_as_dense(grids[-1]) * (1 + (detail - 1) * _fading(p.posts)))
    clipped = [np.clip(grid / grids[0].mean(), _DARKEST, _BRIGHTEST) for grid in grids]
    return nested(1.0, clipped[::-1], level=False).heights_m


def _count(p: Ridge) -> int:
    return 1 + max(0, math.ceil(math.log2(p.size_m / p.posts / p.finest_m)))


def _post_m(p: Ridge, grid: int) -> float:
    return p.size_m / p.posts / (1 << grid)


def _band(grid: int, post_m: float) -> tuple[float, float]:
    return (0.0 if grid == 0 else 0.25 / post_m, 0.5 / post_m)


def _widest_m(p: Ridge, grid: int, post_m: float) -> float:
    octave_m = _OCTAVE * _LEAST_POSTS * post_m
    return max(octave_m, p.size_m * _LARGEST_SHARE) if grid == 0 else octave_m


def fractal(
    rng: np.random.Generator, posts: int, post_m: float, above_per_m: float, upto_per_m: float, rough: float
) -> Floats:
    """Return a periodic fractional Brownian surface, (posts, posts) m.

    Its frequencies are above `above_per_m`, up to `upto_per_m`; `rough` is C of the module docstring, in m^(1 - H).
    """
    across = np.fft.fftfreq(posts, post_m)
    k = np.hypot(across[:, None], np.fft.rfftfreq(posts, post_m))
    inside = (k > above_per_m) & (k <= upto_per_m)
    spectrum = np.zeros_like(k)
    h = HURST
    integral = math.gamma(1 - h) / (2 ** (2 * h + 1) * h * math.gamma(1 + h))
    strength = rough**2 / (4 * math.pi * (2 * math.pi) ** (2 * h) * integral)  # A of the module's first lines
    spectrum[inside] = strength * k[inside] ** (-2 * h - 2)
    white = np.fft.rfft2(rng.standard_normal((posts, posts)))
    return np.fft.irfft2(white * np.sqrt(spectrum) / post_m, (posts, posts))


def _craters(p: Ridge, grid: int, post_m: float) -> tuple[Floats, Floats, Floats]:
    """Return a grid's craters: places and diameters in posts, and shapes."""
    rng = np.random.default_rng([p.seed, grid, _CRATERS])
    low_m, high_m = _LEAST_POSTS * post_m, _widest_m(p, grid, post_m)
    diameters = crater_sizes(rng, p.crater_density, low_m, high_m, (p.posts * post_m) ** 2) / post_m
    return crater_places(rng, diameters, p.posts), diameters, crater_shapes(rng, len(diameters))


def _detail(p: Ridge, grid: int, post_m: float) -> Floats:
    """Return the detail that a grid adds, (posts + 1, posts + 1) m."""
    rough = math.tan(math.radians(p.slope_deg)) * _SLOPE_OVER_M ** (1 - HURST)
    relief = fractal(np.random.default_rng([p.seed, grid, _RELIEF]), p.posts, post_m, *_band(grid, post_m), rough)
    heights = np.pad(relief, (0, 1), mode="wrap") / post_m
    low_m, high_m = _LEAST_POSTS * post_m, _widest_m(p, grid, post_m)
    sink_craters(heights, *_craters(p, grid, post_m))
    rng = np.random.default_rng([p.seed, grid, _BOULDERS])
    boulders = boulder_sizes(rng, p.boulder_cover, low_m, high_m, (p.posts * post_m) ** 2) / post_m
    places, lots = rng.random((len(boulders), 2)) * p.posts, rng.random((len(boulders), 4))
    raise_boulders(heights, places, boulders, lots)
    return heights * post_m


def _ridge(p: Ridge, post_m: float) -> Floats:
    """Return the ridge alone, (posts + 1, posts + 1) m: a tenth of its height is left at the edge of its base."""
    if p.ridge_m == 0:
        return np.zeros((p.posts + 1, p.posts + 1))
    place = (np.arange(p.posts + 1) - p.posts // 2) * post_m
    sigma_m = 1.5 * p.ridge_m / math.sqrt(math.log(10))
    across = np.exp(-((place / sigma_m) ** 2))
    return np.asarray(p.ridge_m * across[:, None] * np.exp(-((place / (1.5 * sigma_m)) ** 4)))


def _twice_as_dense(coarse: Floats) -> Floats:
    """Return the middle half of (n + 1, n + 1) heights on (n + 1, n + 1) posts."""
    quarter = (len(coarse) - 1) // 4
    middle = coarse[quarter - 1 : -quarter + 1, quarter - 1 : -quarter + 1]
    return _denser(_denser(middle).T).T


def _denser(a: Floats) -> Floats:
    """Put rows half way between rows, by Catmull and Rom's cubic; the first and the last row only help."""
    out = np.empty((2 * len(a) - 5, a.shape[1]))
    out[::2] = a[1:-1]
    out[1::2] = (9 * (a[1:-2] + a[2:-1]) - a[:-3] - a[3:]) / 16
    return out


def _fading(posts: int) -> Floats:
    """Return 1 in the middle of a grid and 0 on its border, smoothly, (posts + 1, posts + 1)."""
    to_border = 1 - np.abs(np.linspace(-1, 1, posts + 1))
    x = np.clip(to_border / _FADED_SHARE, 0, 1)
    ramp = x * x * (3 - 2 * x)
    return np.minimum(ramp[:, None], ramp)

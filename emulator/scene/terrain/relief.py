"""A ridge near the lunar south pole, made up: relief, craters and boulders on a nest of grids.

Relief is a fractional Brownian surface: its heights differ by v(r) = C r^H over a distance r, root mean square, which
is a power spectrum S(k) = A k^-(2 H + 2), k in cycles a metre, with

    v(r)^2 = 2 integral of S(k) (1 - J0(2 pi k r)) d2k    so    A = C^2 / (4 pi (2 pi)^(2 H) I)
    I = integral from 0 of x^(-2 H - 1) (1 - J0(x)) dx = Gamma(1 - H) / (2^(2 H + 1) H Gamma(1 + H))

H = 0.95 in the lunar highlands (Rosenburg et al. 2011). Each grid has what its posts can hold: a finer one takes the
coarser one's middle, twice as dense by cubic interpolation, and adds the octave of relief between the two Nyquist
frequencies, the octave of craters and of boulders that are 6 to 12 of its posts wide, brought to nothing towards
its border. All of it is drawn by a generator of its own for each grid and kind, so a map is the same to the last bit
for a seed (and a build of numpy).

The ridge is 5 km above a base of 15 x 15 km for Malapert (LROC): here a Gaussian across, its crest along x, on which
the site lies.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from emulator.scene.terrain.ground import Ground, nested
from emulator.scene.terrain.landforms import (
    boulder_sizes,
    brighten,
    crater_places,
    crater_shapes,
    crater_sizes,
    raise_boulders,
    sink_craters,
)
from emulator.scene.terrain.table import Ridge

__all__ = ["HURST", "fractal", "make_albedo", "make_ridge"]

Floats = npt.NDArray[np.float64]

HURST = 0.95
_LEAST_POSTS = 6.0  # across a crater or a boulder: smaller ones are no shape any more
_OCTAVE = 2.0
_LARGEST_SHARE = 1 / 12  # of the map, a crater
_RELIEF, _CRATERS, _BOULDERS, _ALBEDO = range(4)
_DARKEST, _BRIGHTEST = 0.4, 1.8  # of the mean
_SLOPE_OVER_M = 10.0
_FADED_SHARE = 0.25  # of a finer grid's half side, at its border


def make_ridge(p: Ridge, told: Callable[[int, int], None] = lambda done, of: None) -> Ground:
    """Return the map of `p`; `told` hears how many grids are done, of how many."""
    count = _count(p)
    grids: list[Floats] = []
    for k in range(count):
        told(k, count)
        post_m = _post_m(p, k)
        detail = _detail(p, k, post_m)
        grids.append(detail + _ridge(p, post_m) if k == 0 else _twice_as_dense(grids[-1]) + detail * _fading(p.posts))
    told(count, count)
    return nested(post_m, grids[::-1])


def make_albedo(p: Ridge) -> npt.NDArray[np.float32]:
    """Return the albedo of the posts of `make_ridge`, (grids, rows, columns), finest first; the map's mean is 1.

    Each octave of wavelengths adds as much as any other; young craters and what they threw out are brighter.
    """
    grids: list[Floats] = []
    for k in range(_count(p)):
        post_m = _post_m(p, k)
        noise = fractal(np.random.default_rng([p.seed, k, _ALBEDO]), p.posts, post_m, _band(k, post_m), 1.0)
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


def fractal(rng: np.random.Generator, posts: int, post_m: float, band: tuple[float, float], rough: float) -> Floats:
    """Return a periodic fractional Brownian surface, (posts, posts) m, of frequencies `band`[0] < k <= `band`[1].

    `rough` is C of the module's first lines, in m^(1 - H).
    """
    across = np.fft.fftfreq(posts, post_m)
    k = np.hypot(across[:, None], np.fft.rfftfreq(posts, post_m))
    inside = (k > band[0]) & (k <= band[1])
    spectrum = np.zeros_like(k)
    spectrum[inside] = _strength(rough) * k[inside] ** (-2 * HURST - 2)
    white = np.fft.rfft2(rng.standard_normal((posts, posts)))
    return np.fft.irfft2(white * np.sqrt(spectrum) / post_m, (posts, posts))


def _strength(rough: float) -> float:
    """Return A of the module's first lines."""
    h = HURST
    integral = math.gamma(1 - h) / (2 ** (2 * h + 1) * h * math.gamma(1 + h))
    return float(rough**2 / (4 * math.pi * (2 * math.pi) ** (2 * h) * integral))


def _craters(p: Ridge, grid: int, post_m: float) -> tuple[Floats, Floats, Floats]:
    """Return a grid's craters: places and diameters in posts, and shapes."""
    rng = np.random.default_rng([p.seed, grid, _CRATERS])
    limits_m = _LEAST_POSTS * post_m, _widest_m(p, grid, post_m)
    diameters = crater_sizes(rng, p.crater_density, limits_m, (p.posts * post_m) ** 2) / post_m
    return crater_places(rng, diameters, p.posts), diameters, crater_shapes(rng, len(diameters))


def _detail(p: Ridge, grid: int, post_m: float) -> Floats:
    """Return what a grid adds, (posts + 1, posts + 1) m."""
    rough = math.tan(math.radians(p.slope_deg)) * _SLOPE_OVER_M ** (1 - HURST)
    relief = fractal(np.random.default_rng([p.seed, grid, _RELIEF]), p.posts, post_m, _band(grid, post_m), rough)
    heights = np.pad(relief, (0, 1), mode="wrap") / post_m
    area_m2, limits_m = (p.posts * post_m) ** 2, (_LEAST_POSTS * post_m, _widest_m(p, grid, post_m))
    sink_craters(heights, *_craters(p, grid, post_m))
    rng = np.random.default_rng([p.seed, grid, _BOULDERS])
    boulders = boulder_sizes(rng, p.boulder_cover, limits_m, area_m2) / post_m
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

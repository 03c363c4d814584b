"""Fixed stars from the Hipparcos catalogue, and points of light spread over pixels.

Directions are unit vectors along the axes of the ICRS, moved by proper motion from J1991.25 to the requested epoch.
Light is counted in the Sun's band (see `photometry.reflectance`): a star of magnitude V gives

    E = 530 W/m2 * 10^(-0.4 (V + 26.74))

The catalogue holds Hp and B-V. V - Hp is a function of B-V: Bessell 2000, PASP 112, 961, table 2 (for dwarfs from B to
G and giants of K and M; good to 0.02 mag, and to 0.1 for the reddest variable stars). The detectors of Hipparcos were
not linear for the brightest stars: Hp of Sirius is 0.37 mag too faint, that of Canopus 0.14. So the V of stars brighter
than 0.5 is that of the Bright Star Catalogue (Hoffleit and Warren 1991, CDS V/50), see `_BRIGHTEST`; so is the V of
alpha Centauri B, whose Hp holds light of A.

A point of light is spread over pixels by a Gaussian, with the exact share of each pixel (`splat`). With
s = sigma sqrt(2) and a point at x, pixel j (from j to j + 1) gets

    w_j = (erf((j + 1 - x) / s) - erf((j - x) / s)) / 2
    dw_j/dx = g(j - x) - g(j + 1 - x),    g(u) = e^(-(u/s)^2) / (s sqrt pi)

of it, times the same in y: no light is lost or made wherever the point lies between the pixels. Sampling the Gaussian
at pixel centres instead would make a drifting star twinkle, by 0.82 to 1.65 at sigma 0.3, and so fire false events.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emulator.light import Light
from emulator.photometry.reflectance import SUN_W_M2
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Floats, Int64s

SUN_V = -26.74
FAINTEST_V = 6.8
"""Visual magnitude to which the included catalogue is complete."""

_FILE = Path(__file__).parent / "data" / "hipparcos.npz"
_EPOCH = 1991.25
_MAS_RAD = np.pi / 180 / 3600 / 1000

_B_V = (
    -0.219, -0.179, -0.139, -0.095, -0.048, -0.005, 0.04, 0.083, 0.13, 0.179, 0.227, 0.275, 0.325, 0.374, 0.42,
    0.465, 0.505, 0.549, 0.59, 0.632, 0.674, 0.715, 0.756, 0.796, 0.837, 0.878, 0.919, 0.958, 0.996, 1.034,
    1.072, 1.111, 1.151, 1.19, 1.228, 1.266, 1.305, 1.344, 1.384, 1.423, 1.462, 1.501, 1.541, 1.58, 1.619, 1.658,
)  # fmt: skip
_V_MINUS_HP = (
    0.066, 0.051, 0.036, 0.021, 0.006, -0.011, -0.025, -0.038, -0.048, -0.058, -0.069, -0.079, -0.087, -0.094,
    -0.101, -0.108, -0.114, -0.12, -0.127, -0.131, -0.134, -0.137, -0.142, -0.147, -0.151, -0.155, -0.158,
    -0.157, -0.16, -0.162, -0.164, -0.166, -0.166, -0.165, -0.164, -0.161, -0.157, -0.153, -0.148, -0.143,
    -0.137, -0.131, -0.125, -0.119, -0.112, -0.106,
)  # fmt: skip
"""Bessell's table, its colours BT-VT turned into B-V; beyond its ends the nearest entry holds."""

_BRIGHTEST_HP = 1.3
_BRIGHTEST = np.array([
    # right ascension and declination, degrees (ICRS, J1991.25), and V
    (101.289, -16.713, -1.46),  # Sirius
    (95.988, -52.696, -0.72),  # Canopus
    (213.918, 19.187, -0.04),  # Arcturus
    (219.920, -60.835, -0.01),  # alpha Centauri A
    (219.914, -60.839, 1.33),  # alpha Centauri B
    (279.234, 38.783, 0.03),  # Vega
    (79.172, 45.999, 0.08),  # Capella
    (78.634, -8.202, 0.12),  # Rigel
    (114.827, 5.228, 0.38),  # Procyon
    (24.429, -57.237, 0.46),  # Achernar
    (88.793, 7.407, 0.50),  # Betelgeuse
])  # fmt: skip


@dataclass(frozen=True, eq=False)
class Stars:
    """Stars by brightness, brightest first.

    Attributes
    ----------
    directions : (n, 3) unit vectors, ICRS.
    magnitudes : (n,) in the catalogue's band.
    sun_magnitude : the Sun's in that band.
    """

    directions: Floats
    magnitudes: Floats
    sun_magnitude: float

    def __len__(self) -> int:
        return len(self.magnitudes)


def irradiance_w_m2(magnitude: Floats | float, sun_magnitude: float = SUN_V) -> Floats:
    """Return the light of stars of a magnitude, visual unless `sun_magnitude` is of another band, 400 to 700 nm."""
    return np.asarray(SUN_W_M2 * 10 ** (-0.4 * (np.asarray(magnitude) - sun_magnitude)))


def load_stars(faintest_v: float = FAINTEST_V, epoch_year: float = 2026.0) -> Stars:
    """Return the catalogue's stars down to `faintest_v`."""
    with np.load(_FILE) as table:
        columns = {name: table[name].astype(np.float64) for name in table.files}
    v_mag = _v_mag(columns)
    order = np.argsort(v_mag, kind="stable")
    order = order[v_mag[order] <= faintest_v]
    ra, dec, pm_ra, pm_dec = (columns[name][order] for name in ("ra_rad", "dec_rad", "pm_ra_mas_a", "pm_dec_mas_a"))
    return Stars(moved(ra, dec, pm_ra, pm_dec, epoch_year - _EPOCH), v_mag[order], SUN_V)


def moved(ra: Floats, dec: Floats, pm_ra_mas_a: Floats, pm_dec_mas_a: Floats, years: float) -> Floats:
    """Return the directions, (n, 3), of stars at `ra` and `dec` (rad) after `years` of proper motion.

    The motion in right ascension is times cos dec.
    """
    east = np.column_stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)])
    north = np.column_stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    at = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    by = (pm_ra_mas_a[:, None] * east + pm_dec_mas_a[:, None] * north) * _MAS_RAD * years
    return np.asarray((at + by) / np.linalg.norm(at + by, axis=1, keepdims=True))


def _v_mag(columns: dict[str, Floats]) -> Floats:
    """Return the visual magnitudes of the catalogue's stars, (n,)."""
    v_mag = columns["hp_mag"] + np.interp(columns["b_v_mag"], _B_V, _V_MINUS_HP)
    ra, dec = np.radians(_BRIGHTEST[:, 0]), np.radians(_BRIGHTEST[:, 1])
    bright = np.flatnonzero(columns["hp_mag"] < _BRIGHTEST_HP)
    for ra_star, dec_star, v in zip(ra, dec, _BRIGHTEST[:, 2], strict=True):
        east = (columns["ra_rad"][bright] - ra_star) * np.cos(dec_star)
        nearest = bright[np.argmin(np.hypot(east, columns["dec_rad"][bright] - dec_star))]
        v_mag[nearest] = v
    return np.asarray(v_mag)


_REACH_SIGMAS = 4.0  # at least; 6e-5 of the light lies beyond it on each side
_LEAST_LIGHT = 1e-7  # of a pixel: less is left out, even before the dark current of a cooled sensor, some 1e-5

_MOST = 256
_entry = entry_of(__name__, error_model="python")

Boxes = Int64s
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
def boxes_of(points: Floats, sigma: float, size: tuple[int, int], boxes: Boxes) -> None:
    """Write the boxes in which `splat` draws points on a frame of `size` = (width, height); empty if outside."""
    for k in range(points.shape[0]):
        x, y = points[k, 0], points[k, 1]
        peak = points[k, 2] / (2.0 * math.pi * sigma * sigma)
        wings = math.sqrt(2.0 * math.log(peak / _LEAST_LIGHT)) if peak > _LEAST_LIGHT else 0.0
        reach = min(sigma * max(_REACH_SIGMAS, wings), 0.5 * _MOST - 1.0)
        boxes[k, 0] = min(max(math.floor(y - reach), 0), size[1])
        boxes[k, 1] = min(max(math.floor(y + reach) + 1, 0), size[1])
        boxes[k, 2] = min(max(math.floor(x - reach), 0), size[0])
        boxes[k, 3] = min(max(math.floor(x + reach) + 1, 0), size[0])


@_entry
def clear(boxes: Boxes, sky: np.float32, light: Light, rate: Light) -> None:
    """Write an empty sky into the boxes of a light frame and of its time derivative, which may have no pixels."""
    for k in range(boxes.shape[0]):
        for row in range(boxes[k, 0], boxes[k, 1]):
            light[row, boxes[k, 2] : boxes[k, 3]] = sky
            if rate.size:
                rate[row, boxes[k, 2] : boxes[k, 3]] = np.float32(0)


@_entry
def splat(points: Floats, sigma: float, boxes: Boxes, light: Light, rate: Light) -> None:
    """Add points to a light frame and to its time derivative, each in its box of `boxes_of`.

    Parameters
    ----------
    points : (n, 5) float64: column, row (0.5: the middle of the first pixel), light, px/s along columns and rows.
    sigma : of the Gaussian, pixels.
    light, rate : (height, width) float32, added to; `rate` may have no pixels.
    """
    across, across_slope = np.empty(_MOST), np.empty(_MOST)
    down, down_slope = np.empty(_MOST), np.empty(_MOST)
    for k in range(points.shape[0]):
        flux, top, left = points[k, 2], boxes[k, 0], boxes[k, 2]
        rows = boxes[k, 1] - top
        columns = boxes[k, 3] - left
        if rows <= 0 or columns <= 0:
            continue
        _shares(points[k, 0], left, columns, sigma, across, across_slope)
        _shares(points[k, 1], top, rows, sigma, down, down_slope)
        for j in range(rows):
            line = light[top + j]
            for i in range(columns):
                line[left + i] += np.float32(flux * across[i] * down[j])
            if rate.size:
                change = rate[top + j]
                for i in range(columns):
                    by_x = points[k, 3] * across_slope[i] * down[j]
                    change[left + i] += np.float32(flux * (by_x + points[k, 4] * across[i] * down_slope[j]))

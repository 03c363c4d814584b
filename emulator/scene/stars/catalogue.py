"""The fixed stars: directions and brightness from the Hipparcos catalogue.

Directions are unit vectors on the ICRS's axes, moved by proper motion from J1991.25 to the epoch asked for. Light is
counted in the Sun's band (see `photometry.sun`): a star of magnitude V gives

    E = 530 W/m2 * 10^(-0.4 (V + 26.74))

with V = Hp - 0.16 (B-V) (Hp is some 0.1 fainter than V for Sun-like stars; for red ones this is good to a tenth of a
magnitude, which is less than what a pixel's own colour response leaves open).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from emulator.photometry.sun import SUN_W_M2

__all__ = ["FAINTEST_V", "SUN_V", "Stars", "irradiance_w_m2", "load_stars"]

SUN_V = -26.74
FAINTEST_V = 6.8
"""To where the catalogue in the program is complete."""

_FILE = Path(__file__).parent / "data" / "hipparcos.npz"
_EPOCH = 1991.25
_MAS_RAD = np.pi / 180 / 3600 / 1000

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Stars:
    """Stars by brightness, brightest first.

    Attributes
    ----------
    directions : (n, 3) unit vectors, ICRS.
    v_mag : (n,) visual magnitudes.
    """

    directions: Floats
    v_mag: Floats

    def __len__(self) -> int:
        return len(self.v_mag)


def irradiance_w_m2(v_mag: Floats | float) -> Floats:
    """Return the light of stars of visual magnitude `v_mag`, 400 to 700 nm."""
    return np.asarray(SUN_W_M2 * 10 ** (-0.4 * (np.asarray(v_mag) - SUN_V)))


def load_stars(faintest_v: float = FAINTEST_V, epoch_year: float = 2026.0) -> Stars:
    """Return the catalogue's stars down to `faintest_v`."""
    with np.load(_FILE) as table:
        columns = {name: table[name].astype(np.float64) for name in table.files}
    v_mag = columns["hp_mag"] - 0.16 * columns["b_v_mag"]
    kept = v_mag <= faintest_v
    ra, dec = columns["ra_rad"][kept], columns["dec_rad"][kept]
    years = epoch_year - _EPOCH
    east = np.column_stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)])
    north = np.column_stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    at = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    moved = (columns["pm_ra_mas_a"][kept, None] * east + columns["pm_dec_mas_a"][kept, None] * north) * _MAS_RAD * years
    directions = at + moved
    order = np.argsort(v_mag[kept], kind="stable")
    return Stars((directions / np.linalg.norm(directions, axis=1, keepdims=True))[order], v_mag[kept][order])

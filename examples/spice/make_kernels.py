"""Kernels of a published fly-by: NEAR at Eros, 23 December 1998.

    python make_kernels.py [FOLDER]

writes near.tls (leap seconds) and near-eros.bsp into FOLDER, by default beside this file. The spacecraft passed the
centre of Eros at 3827 km at 18:41:23 UTC, with 965 m/s (NSSDCA, spacecraft 1996-008A). The gravity of Eros changes that
by less than a millimetre a second, so the path is a straight line; its plane is chosen here: along x, at a distance
along -z. Kernels of the mission itself take the place of these without any other change.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import spiceypy as spice

CLOSEST_UTC, CLOSEST_KM, SPEED_KM_S = "1998-12-23T18:41:23", 3827.0, 0.965
NEAR, EROS = -93, 2000433
HALF_S = 7200.0

# The leap seconds from 1996 to 1999; NAIF's own file, naif0012.tls, has all of them.
LEAP_SECONDS = r"""KPL/LSK
\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996 1.99096871D-7 )
DELTET/DELTA_AT = ( 30, @1996-JAN-1, 31, @1997-JUL-1, 32, @1999-JAN-1 )
\begintext
"""


def make(folder: Path) -> None:
    """Write both kernels."""
    (folder / "near.tls").write_text(LEAP_SECONDS)
    spk = folder / "near-eros.bsp"
    spk.unlink(missing_ok=True)
    with spice.KernelPool(str(folder / "near.tls")):
        closest_s = spice.str2et(CLOSEST_UTC)
    times_s = closest_s + np.linspace(-HALF_S, HALF_S, 9)
    states = [[SPEED_KM_S * (t_s - closest_s), 0.0, -CLOSEST_KM, SPEED_KM_S, 0.0, 0.0] for t_s in times_s]
    handle = spice.spkopn(str(spk), "NEAR at Eros", 0)
    spice.spkw13(handle, NEAR, EROS, "J2000", times_s[0], times_s[-1], "fly-by", 3, len(times_s), states, times_s)
    spice.spkcls(handle)


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)

"""Hazard of a pixel's next event: first passage of the noisy comparator to one of its two thresholds.

The noise n of the comparator is shot noise that has passed the receptor's pole, of rate a1, which follows the light,
and a fixed pole of rate a2 behind it:

    n'' + (a1 + a2) n' + a1 a2 n = xi        rms sigma = rms sqrt(a2 / (a1 + a2)), rms of the slope sigma sqrt(a1 a2)

It is known at a pixel's last reset: value n_r and slope n'_r. At a time s later its mean m and the slope m' of the mean
follow from the decays e1, e2 of both poles, and so do its variance V, the covariance C of value and slope, and the
slope's variance W, all in units of sigma^2 (k = a1 a2, r = 1 / (a2 - a1)):

    p11 = (a2 e1 - a1 e2) r    p12 = (e1 - e2) r         m  = p11 n_r + p12 n'_r       V = 1 - p11^2 - k p12^2
    p21 = -k p12               p22 = (a2 e2 - a1 e1) r   m' = p21 n_r + p22 n'_r       C = k (a1 + a2) p12^2
                                                                                       W = k - p21^2 - k p22^2

The noise less its mean, in its own deviations, has unit variance and a slope that is independent of it, of rms s, with
s^2 = (W - C^2 / V) / V. A threshold at the distance x ahead of the signal w lies c deviations away; nu is its speed of
approach in units of s:

    ON   c = (x - m) / (sigma sqrt V)    nu = ( (w' + m') / (sigma sqrt V) + c C / V) / s
    OFF  c = (x + m) / (sigma sqrt V)    nu = (-(w' + m') / (sigma sqrt V) + c C / V) / s
    hazard = s phi(c) (phi(nu) + nu Phi(nu)) D(c, nu, b)

The product before D is Rice's rate of crossings, which is exact. D, the share of crossings that are first ones, comes
from a Fokker-Planck equation (`tables`); the poles enter by b alone, here a1 a2 (a1 + a2) / (V s^3), which is (a1 + a2)
/ sqrt(a1 a2) long after the reset. Near both thresholds a factor F of two distances includes passages to the other.

Poles that differ by more than b = 8 act as one, of the time 1 / a1 + 1 / a2, whose thresholds lie farther by

    (kappa^4 + .375)^(-1/4) / b deviations,    kappa = (c + nu) / b, or 0 if that is below 0

that is, for a slow approach, by about Milne's length, the distance at which a diffusing density behind an absorbing
wall would vanish, and less the faster it is. A sensor that has one pole only has no such shift. One pole of rate g has,
with e = e^(-g s), m = n_r e and V = 1 - e^2,

    ON   c = (x - m) / (sigma sqrt V)    nu =  sqrt V (w' / g - m) / sigma + c e^2      hazard = H(c, nu) g / V

and H from a table of the same kind. Method and tables: noise of a first passage by Siegert (Phys. Rev. 81, 1951), Rice
(Bell System Tech. J. 23, 1944) and Marshall and Watson (J. Phys. A 18, 1985) for Milne's length.

This module has the tables; `integral` looks hazards up in them, `moments` has the noise since a reset.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import numpy.typing as npt

_Float32s = npt.NDArray[np.float32]

TABLES = Path(__file__).with_name("data") / "hazards.npz"
"""The tables, see `tables`."""

# The tables that are used as they are, one after another in a flat array: names in the file, and first indices.
_SIZES = {"one_pair": 53 * 53, "two_speed": 7 * 105 * 65, "two_pair": 7 * 25 * 25, "exit": 57 * 65}
ONE_PAIR, SPEED, TWO_PAIR, EXIT = (sum(list(_SIZES.values())[:k]) for k in range(len(_SIZES)))
LEAST_RATIO = 0.125
"""sqrt(a1 a2) / (a1 + a2), that is 1 / b, below which two poles act as one."""


@functools.cache
def hazard_tables() -> _Float32s:
    """Return the tables that are used as they are, in one flat array; G is in `integral_tables`."""
    with np.load(TABLES) as file:
        return np.concatenate([np.asarray(file[name], np.float32).reshape(-1) for name in _SIZES])

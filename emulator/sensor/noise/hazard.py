"""Hazard of a pixel's next event, the first passage of the noisy comparator to a threshold, and its integral.

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
from a Fokker-Planck equation (`hazards.npz`); the poles enter by b alone, here a1 a2 (a1 + a2) / (V s^3), which is
(a1 + a2) / sqrt(a1 a2) long after the reset. Near both thresholds a factor F of two distances includes passages to
the other.

Poles that differ by more than b = 8 act as one, of the time 1 / a1 + 1 / a2, whose thresholds lie farther by

    (kappa^4 + .375)^(-1/4) / b deviations,    kappa = (c + nu) / b, or 0 if that is below 0

that is, for a slow approach, by about Milne's length, the distance at which a diffusing density behind an absorbing
wall would vanish, and less the faster it is. A sensor that has one pole only has no such shift. One pole of rate g has,
with e = e^(-g s), m = n_r e and V = 1 - e^2,

    ON   c = (x - m) / (sigma sqrt V)    nu =  sqrt V (w' / g - m) / sigma + c e^2      hazard = H(c, nu) g / V

and H from a table of the same kind. Method and tables: noise of a first passage by Siegert (Phys. Rev. 81, 1951), Rice
(Bell System Tech. J. 23, 1944) and Marshall and Watson (J. Phys. A 18, 1985) for Milne's length.

Along a part at one speed, nu ds is -dc, so that the integral of a hazard s (1 + |nu|) G(c; nu) needs no time but the
distances at both ends:

    from c0 to c1        (K(near) - K(far)) (1 + |nu|) / |nu|        K(c; nu) = integral of G from c to infinity

An event comes where the integral since the last reset reaches a number that is drawn from an exponential distribution
(time change of a point process, Meyer 1971). Along an approach that is the c at which K has the value that is left.

    G, K    (SLICES, 65, 105)    over nu / (1 + |nu|) = -1 + j / 32 and c = -4 + i / 8, times sqrt(2 pi) e^(c^2 / 2)
    C       (SLICES, 65, 141)    the inverse of K: c + 4 by ln K = -32 + i / 4

Slice k of 0 to 48 is two poles of 1/b = 1/8 + k / 128, the nearest is taken; slice 49 is one pole. Derived from
`hazards.npz` when a process begins, in .2 s. The factor F and exit speeds follow as they are in that file.

Accuracy: .2 % of a hazard by the nearest slice; .3 % between entries.

Fast because an entry is a gather in a vector loop (`columns`), and because the Gaussian is divided out of the tables.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.columns import Packed, fetch, packed
from emulator.sensor.numerics.compiled import Real, lane
from emulator.sensor.numerics.elementary import exponential, natural_log

_Float32s = npt.NDArray[np.float32]

TABLES = Path(__file__).with_name("data") / "hazards.npz"
"""The tables, made by `tests/emulator/sensor/noise/hazard_tables.py`."""

LEAST_RATIO = 0.125
"""sqrt(a1 a2) / (a1 + a2), that is 1 / b, below which two poles act as one."""

# Those that are used as they are: names in the file, and sizes.
_OTHERS = {"one_pair": 53 * 53, "two_speed": 7 * 105 * 65, "two_pair": 7 * 25 * 25, "exit": 57 * 65}

SLICES, _SPEEDS = 50, 65
_PLACES, _LOGS = 105, 141
_PER_RATIO = 8  # slices between two ratios of the tables of hazards
_FINE = 16  # steps of the integration between two entries
_LEAST_LOG, _A_LOG = -32.0, 4.0
_FIRST_PLACE, _A_DEVIATION = -4.0, 8.0

_ZERO, _HALF, _ONE, _TWO, _FOUR, _SIX, _EIGHT, _NINE = (np.float32(x) for x in (0, 0.5, 1, 2, 4, 6, 8, 9))
_INVERSE_ROOT = np.float32(1 / math.sqrt(2 * math.pi))
_FADES = np.float32(0.375)  # fitted to the tables of two poles at b = 8, within 1.2 % of the hazard for c of 0 to 5
_PAIR_SUM, _PAIR_FAR = np.float32(10), np.float32(5.4)  # deviations up to which the factor of two thresholds counts
_QUARTER = np.float32(0.25)
FARTHEST = np.float32(7.5)
"""Deviations of a threshold beyond which a part adds nothing: 1e-12 of a passage in a time constant."""

CERTAIN = np.float32(1e9)
"""An integral that no drawn number reaches."""

ONE_POLE = np.float32(6.5)
"""Places along 1/b from which on a noise has one pole, see `Noise` in `moments`."""

_G, _K = np.float32(0), np.float32(SLICES * _SPEEDS * _PLACES)
_C = np.float32(2 * SLICES * _SPEEDS * _PLACES)
_HAZARDS = 2 * SLICES * _SPEEDS * _PLACES + SLICES * _SPEEDS * _LOGS
_ONE_PAIR, _SPEED, _TWO_PAIR, _EXIT = (np.float32(_HAZARDS + sum([*_OTHERS.values()][:k])) for k in range(len(_OTHERS)))
_ROW, _ROW_OF_LOGS = np.float32(_PLACES), np.float32(_LOGS)
_ROWS = np.float32(_SPEEDS)
_LAST, _LAST_LOG = np.float32(_PLACES - 1.01), np.float32(_LOGS - 1.01)
_LAST_SPEED = np.float32(_SPEEDS - 1.002)
_ONE_POLE_SLICE = np.float32(SLICES - 1)
_THIRTY_TWO = np.float32(32)
_LEAST_K, _NO_INTEGRAL = np.float32(1e-30), 1e-300
_FAST_EXIT, _SLOW_EXIT = np.float32(7.9), np.float32(-5.99)


@functools.cache
def integral_tables() -> Packed:
    """Return the tables G, K and C, and those that are used as they are, in one flat array."""
    with np.load(TABLES) as file:
        as_stored = [np.asarray(file[name], np.float32).reshape(-1) for name in _OTHERS]
        two, single = np.asarray(file["two"], np.float64), np.asarray(file["one"], np.float64)[::2]
    entries = np.concatenate([two, single[None]]).transpose(0, 2, 1)  # (8, speeds, places), the last of one pole
    fine = np.arange((_PLACES - 1) * _FINE + 1)
    i = np.minimum(fine // _FINE, _PLACES - 2)
    share = fine / _FINE - i
    c = _FIRST_PLACE + fine / (_FINE * _A_DEVIATION)
    gauss = np.where(c > 0, np.exp(-(c**2) / 2), np.maximum(1, -c / 4)) / math.sqrt(2 * math.pi)
    density = (entries[..., i] * (1 - share) + entries[..., i + 1] * share) * gauss
    beyond = density[..., -1:] / c[-1] * (1 - c[-1] ** -2)  # of a Gaussian tail
    below = (density[..., 1:] + density[..., :-1]) * (0.5 / (_FINE * _A_DEVIATION))
    k = np.concatenate([np.cumsum(below[..., ::-1], -1)[..., ::-1], np.zeros_like(beyond)], -1) + beyond
    scaled = k[..., ::_FINE] / np.where(c > 0, np.exp(-(c**2) / 2), 1.0)[::_FINE] * math.sqrt(2 * math.pi)
    logs = _LEAST_LOG + np.arange(_LOGS) / _A_LOG
    inverse = np.array(
        [[np.interp(logs, np.log(np.maximum(row[::-1], _NO_INTEGRAL)), c[::-1]) for row in of_ratio] for of_ratio in k]
    )
    tables = [_finer(table).ravel() for table in (entries, scaled, inverse - _FIRST_PLACE)]
    return packed(np.concatenate([*tables, *as_stored]))


def _finer(table: npt.NDArray[np.float64]) -> _Float32s:
    """Return a table by slices from one by ratios, the last of one pole."""
    at = np.arange(SLICES - 1) / _PER_RATIO
    i = np.minimum(at.astype(int), 5)
    share = (at - i)[:, None, None]
    two = table[i] * (1 - share) + table[i + 1] * share
    return np.concatenate([two, table[-1:]]).astype(np.float32)


@lane
def _between(tables: Packed, at: Real, row: Real, f: Real, g: Real) -> Real:
    """Return a table between four entries: shares f to the next entry from the one at `at`, and g to the next row."""
    below = at + row
    (a0, a1), (b0, b1) = fetch(tables, at), fetch(tables, below)
    a, b = a0 + (a1 - a0) * f, b0 + (b1 - b0) * f
    return a + (b - a) * g


@lane
def _entry(tables: Packed, first: Real, row: Real, last: Real, k: Real, rho: Real, x: Real, needed: Real) -> Real:  # noqa: PLR0913, PLR0917
    """Return a table in slice k at the speed nu / (1 + |nu|) and the place x of its rows; any if not `needed`."""
    x = min(max(x, _ZERO), last)
    y = min(max(rho * _THIRTY_TWO + _THIRTY_TWO, _ZERO), _LAST_SPEED)
    i, j = np.floor(x), np.floor(y)
    # What is not needed is read in one place: the tables are larger than the caches.
    at = first + (k * _ROWS + j) * row + i if needed else _ZERO
    return _between(tables, at, row, x - i, y - j)


@lane
def gaussian(c: Real) -> Real:
    """Return e^(-c^2 / 2) / sqrt(2 pi); that at 0 for a signal beyond the threshold."""
    closeness = min(max(c, _ZERO), _NINE)
    return _INVERSE_ROOT * exponential(-_HALF * closeness * closeness)


@lane
def slice_of(z: Real) -> Real:
    """Return the slice of a place along 1/b."""
    return np.floor(z * _EIGHT + _HALF) if z < ONE_POLE else _ONE_POLE_SLICE


@lane
def rho_of(nu: Real) -> Real:
    """Return nu / (1 + |nu|)."""
    return nu / (_ONE + abs(nu))


@lane
def farther(c: Real, nu: Real, apart: Real) -> Real:
    """Return the deviations by which the threshold of two poles that act as one lies farther."""
    kappa = max((c + nu) * apart, _ZERO)
    kappa *= kappa
    return apart / np.sqrt(np.sqrt(kappa * kappa + _FADES))


@lane
def integral_beyond(tables: Packed, k: Real, rho: Real, c: Real, needed: Real) -> Real:
    """Return K(c) in slice k; 0 if not `needed`."""
    value = _entry(tables, _K, _ROW, _LAST, k, rho, (c + _FOUR) * _EIGHT, needed) * gaussian(c)
    return value if needed else _ZERO


@lane
def density_or_integral(tables: Packed, is_integral: Real, k: Real, rho: Real, c: Real, needed: Real) -> Real:
    """Return K(c) or G(c) in slice k, by one look-up; any number if not `needed`."""
    first = _K if is_integral else _G
    return _entry(tables, first, _ROW, _LAST, k, rho, (c + _FOUR) * _EIGHT, needed) * gaussian(c)


@lane
def place_of(tables: Packed, k: Real, rho: Real, integral: Real, needed: Real) -> Real:
    """Return the c at which K has a value; any number if not `needed`."""
    log = natural_log(max(integral, _LEAST_K))
    return _entry(tables, _C, _ROW_OF_LOGS, _LAST_LOG, k, rho, (log + _THIRTY_TWO) * _FOUR, needed) - _FOUR


@lane
def steeper_beyond(c: Real) -> Real:
    """Return the factor of a hazard where the tables end, well beyond the threshold."""
    return max(_ONE, -_QUARTER * c)


@lane
def rate_of(tables: Packed, k: Real, apart: Real, c: Real, nu: Real, needed: Real) -> Real:
    """Return the hazard of a threshold over s; 0 beyond FARTHEST, and if not `needed`."""
    at, counts = c + farther(c, nu, apart), needed & (c < FARTHEST)
    value = _entry(tables, _G, _ROW, _LAST, k, rho_of(nu), (at + _FOUR) * _EIGHT, counts) * gaussian(at)
    value *= (_ONE + abs(nu)) * steeper_beyond(at)
    return value if counts else _ZERO


@lane
def pair_factors(tables: Packed, a: Real, b: Real, z: Real, share: Real, needed: Real) -> tuple[Real, Real]:
    """Return the factors F of the fluxes through thresholds at a and b deviations, of that at a and of that at b.

    A `share` of them counts. They are 1 where one of the thresholds is far, and if not `needed`.
    """
    count = needed & (a + b < _PAIR_SUM) & (max(a, b) < _PAIR_FAR)
    single = z > ONE_POLE
    nodes, per_deviation = np.float32(53) if single else np.float32(25), _EIGHT if single else _FOUR
    of_ratio = _TWO_PAIR + np.float32(625) * np.floor(min(max(z + _HALF, _ZERO), _SIX))
    first, last = _ONE_PAIR if single else of_ratio, nodes - np.float32(1.001)
    x, y = min(max((a + _HALF) * per_deviation, _ZERO), last), min(max((b + _HALF) * per_deviation, _ZERO), last)
    i, j = np.floor(x), np.floor(y)
    f, g = x - i, y - j
    of_a, of_b = (first + i * nodes + j if count else _ZERO), (first + j * nodes + i if count else _ZERO)
    f_a, f_b = _between(tables, of_a, nodes, g, f), _between(tables, of_b, nodes, f, g)
    return (_ONE + (f_a - _ONE) * share if count else _ONE), (_ONE + (f_b - _ONE) * share if count else _ONE)


@lane
def exit_speed(tables: Packed, nu: Real, c: Real, share: Real, z: Real) -> Real:
    """Return the speed at which noise leaves through a threshold, less the threshold's own, in units of s.

    Its density is u phi(u - nu), that of crossings, stretched to the mean of first ones. `share` is random, in (0, 1).
    """
    x, y = (min(max(nu, _SLOW_EXIT), _FAST_EXIT) + _SIX) * _FOUR, min(share * np.float32(64), _LAST_SPEED)
    i, j = np.floor(x), np.floor(y)
    density = _between(tables, _EXIT + i * _ROWS + j, _ROWS, y - j, x - i)
    # The stretch is smooth: between two distances, in the nearest speed and ratio.
    speed = np.floor(min(rho_of(nu) * _THIRTY_TWO + np.float32(32.5), np.float32(64)))
    place = min(max(c * _EIGHT + _THIRTY_TWO, _ZERO), _LAST)
    i = np.floor(place)
    at = _SPEED + (np.floor(min(z + _HALF, _SIX)) * _ROW + i) * _ROWS + speed
    (s0, _), (s1, _) = fetch(tables, at), fetch(tables, at + _ROWS)
    return nu + _ONE / nu if nu > _FAST_EXIT else density * (s0 + (s1 - s0) * (place - i))

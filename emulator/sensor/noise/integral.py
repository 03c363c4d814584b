"""Look-ups of hazards and of their integrals, for loops over columns of pixels, in float32.

The hazard of a threshold at c deviations, approached at the speed nu, is s (1 + |nu|) G(c; nu) (`hazard`). Along a part
at one speed, nu ds is -dc, so that its integral needs no time but the distances at both ends:

    from c0 to c1        (K(near) - K(far)) (1 + |nu|) / |nu|        K(c; nu) = integral of G from c to infinity

An event comes where the integral since the last reset reaches a number that is drawn from an exponential distribution.
Along an approach that is the c at which K has the value that is left: the inverse of K, a table too.

    G, K    (SLICES, 65, 105)    over nu / (1 + |nu|) = -1 + j / 32 and c = -4 + i / 8, times sqrt(2 pi) e^(c^2 / 2)
    C       (SLICES, 65, 141)    c by ln K = -32 + i / 4

Slice k of 0 to 48 is two poles of 1/b = 1/8 + k / 128 (`hazard`), the nearest is taken; slice 49 is one pole. Derived
from `hazards.npz` when a process begins, in .2 s. Behind them follow the tables of `hazard` themselves.

Accuracy: .2 % of a hazard by the nearest slice; .3 % between entries. Source of the law: first passages as a point
process with a hazard, whose integral at the passages is exponential (time change of a point process, Meyer 1971).

Fast because an entry is a gather in a vector loop (`columns`), and because the Gaussian is divided out of the tables.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise import hazard
from emulator.sensor.numerics.columns import fetch, fetch_next
from emulator.sensor.numerics.compiled import Real, lane
from emulator.sensor.numerics.elementary import exponential, natural_log

_Float32s = npt.NDArray[np.float32]

SLICES, _SPEEDS = 50, 65
_PLACES, _LOGS = 105, 141
_PER_RATIO = 8  # slices between two ratios of the tables of hazards
_FINE = 16  # steps of the integration between two entries
_LEAST_LOG, _A_LOG = -32.0, 4.0
_FIRST_PLACE, _A_DEVIATION = -4.0, 8.0

_ZERO, _HALF, _ONE, _TWO, _FOUR, _SIX, _EIGHT, _NINE = (np.float32(x) for x in (0, 0.5, 1, 2, 4, 6, 8, 9))
_INVERSE_ROOT = np.float32(1 / math.sqrt(2 * math.pi))
_FADES = np.float32(0.375)  # see `hazard`
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
_ONE_PAIR, _TWO_PAIR, _SPEED, _EXIT = (
    np.float32(_HAZARDS + first) for first in (hazard.ONE_PAIR, hazard.TWO_PAIR, hazard.SPEED, hazard.EXIT)
)
_ROW, _ROW_OF_LOGS = np.float32(_PLACES), np.float32(_LOGS)
_ROWS = np.float32(_SPEEDS)
_LAST, _LAST_LOG = np.float32(_PLACES - 1.01), np.float32(_LOGS - 1.01)
_LAST_SPEED = np.float32(_SPEEDS - 1.002)
_ONE_POLE_SLICE = np.float32(SLICES - 1)
_THIRTY_TWO = np.float32(32)
_LEAST_K, _NO_INTEGRAL = np.float32(1e-30), 1e-300
_FAST_EXIT, _SLOW_EXIT = np.float32(7.9), np.float32(-5.99)


@functools.cache
def integral_tables() -> _Float32s:
    """Return the tables G, K and C, and those of `hazard`, in one flat array."""
    with np.load(hazard.TABLES) as file:
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
    tables = [_finer(table).ravel() for table in (entries, scaled, inverse)]
    return np.concatenate([*tables, hazard.hazard_tables()])


def _finer(table: npt.NDArray[np.float64]) -> _Float32s:
    """Return a table by slices from one by ratios, the last of one pole."""
    at = np.arange(SLICES - 1) / _PER_RATIO
    i = np.minimum(at.astype(int), 5)
    share = (at - i)[:, None, None]
    two = table[i] * (1 - share) + table[i + 1] * share
    return np.concatenate([two, table[-1:]]).astype(np.float32)


@lane
def _between(tables: _Float32s, at: Real, row: Real, f: Real, g: Real) -> Real:
    """Return a table between four entries: shares f to the next entry from the one at `at`, and g to the next row."""
    below = at + row
    a0, a1 = fetch(tables, at), fetch_next(tables, at)
    b0, b1 = fetch(tables, below), fetch_next(tables, below)
    a, b = a0 + (a1 - a0) * f, b0 + (b1 - b0) * f
    return a + (b - a) * g


@lane
def _entry(tables: _Float32s, first: Real, row: Real, last: Real, k: Real, rho: Real, x: Real, needed: Real) -> Real:  # noqa: PLR0913, PLR0917
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
    """Return the deviations by which the threshold of two poles that act as one lies farther, see `hazard`."""
    kappa = max((c + nu) * apart, _ZERO)
    kappa *= kappa
    return apart / np.sqrt(np.sqrt(kappa * kappa + _FADES))


@lane
def integral_beyond(tables: _Float32s, k: Real, rho: Real, c: Real, needed: Real) -> Real:
    """Return K(c) in slice k; 0 if not `needed`."""
    value = _entry(tables, _K, _ROW, _LAST, k, rho, (c + _FOUR) * _EIGHT, needed) * gaussian(c)
    return value if needed else _ZERO


@lane
def density_or_integral(tables: _Float32s, is_integral: Real, k: Real, rho: Real, c: Real, needed: Real) -> Real:
    """Return K(c) or G(c) in slice k, by one look-up; any number if not `needed`."""
    first = _K if is_integral else _G
    return _entry(tables, first, _ROW, _LAST, k, rho, (c + _FOUR) * _EIGHT, needed) * gaussian(c)


@lane
def place_of(tables: _Float32s, k: Real, rho: Real, integral: Real, needed: Real) -> Real:
    """Return the c at which K has a value; any number if not `needed`."""
    log = natural_log(max(integral, _LEAST_K))
    return _entry(tables, _C, _ROW_OF_LOGS, _LAST_LOG, k, rho, (log + _THIRTY_TWO) * _FOUR, needed)


@lane
def steeper_beyond(c: Real) -> Real:
    """Return the factor of a hazard where the tables end, well beyond the threshold."""
    return max(_ONE, -_QUARTER * c)


@lane
def rate_of(tables: _Float32s, k: Real, apart: Real, c: Real, nu: Real, needed: Real) -> Real:
    """Return the hazard of a threshold over s; 0 beyond FARTHEST, and if not `needed`."""
    at, counts = c + farther(c, nu, apart), needed & (c < FARTHEST)
    value = _entry(tables, _G, _ROW, _LAST, k, rho_of(nu), (at + _FOUR) * _EIGHT, counts) * gaussian(at)
    value *= (_ONE + abs(nu)) * steeper_beyond(at)
    return value if counts else _ZERO


@lane
def pair_factors(tables: _Float32s, a: Real, b: Real, z: Real, share: Real, needed: Real) -> tuple[Real, Real]:
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
def exit_speed(tables: _Float32s, nu: Real, c: Real, share: Real, z: Real) -> Real:
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
    s0, s1 = fetch(tables, at), fetch(tables, at + _ROWS)
    return nu + _ONE / nu if nu > _FAST_EXIT else density * (s0 + (s1 - s0) * (place - i))

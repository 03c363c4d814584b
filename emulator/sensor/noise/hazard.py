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

Fast because the tables are nearly bilinear once their Gaussian is divided out: one exponential and two to eight entries
a threshold, in float32; and because a threshold farther than 9.5 deviations costs a comparison.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import Real, inlined, kernel, lane
from emulator.sensor.numerics.elementary import exponential

_Float32s = npt.NDArray[np.float32]

TABLES = Path(__file__).with_name("data") / "hazards.npz"
"""The tables, see `tables`."""

# The tables one after another in a flat array: their names in the file and their first indices.
_SIZES = {
    "one": 209 * 65, "one_start": 65, "one_pair": 53 * 53, "two": 7 * 105 * 65, "two_speed": 7 * 105 * 65,
    "two_pair": 7 * 25 * 25, "exit": 57 * 65,
}  # fmt: skip
_ONE, _START, ONE_PAIR, _TWO, SPEED, TWO_PAIR, EXIT = (
    sum(list(_SIZES.values())[:k]) for k in range(len(_SIZES))
)  # fmt: skip
_ROW = 65  # entries along nu
_SLICE = 105 * _ROW  # entries of one b

FARTHEST = 9.5
"""Deviations of a threshold beyond which it counts as unreachable: one passage in 10^12 years."""

BEYOND = -4.0
"""Deviations by which the signal lies beyond a threshold that is certain to have fired."""

LEAST_RATIO = 0.125
"""sqrt(a1 a2) / (a1 + a2), that is 1 / b, below which two poles act as one."""

_FADES = 0.375  # fitted to the tables of two poles at b = 8, within 1.2 % of the hazard for c of 0 to 5
_INVERSE_ROOT = np.float32(1 / math.sqrt(2 * math.pi))
_F0, _F1 = np.float32(0), np.float32(1)
_SETTLED = 10.0  # time constants of the slower pole after which the reset is forgotten
_SHORT = 2e-3  # (a1 + a2) s below which the variances are taken from their series
_UNRESOLVED = 40.0  # of a square of deviations: a factor of e^20
_NEVER_HZ = 1e11  # rad/s: a pole that fast is none


@functools.cache
def hazard_tables() -> _Float32s:
    """Return all tables in one flat array."""
    with np.load(TABLES) as file:
        return np.concatenate([np.asarray(file[name], np.float32).reshape(-1) for name in _SIZES])


class Noise(NamedTuple):
    """The noise of a pixel in a light."""

    sigma: Real  # rms at the comparator, ln units
    a1: Real  # rates of the poles, 1/s; the same where the pixel has one pole
    a2: Real
    rate: Real  # sqrt(a1 a2), or that of the one pole, 1/s
    ratio: Real  # 1 / b; 0: one pole
    apart: Real  # 1 / b of two poles that act as one; 0: one pole


@lane
def noise_of(a1: Real, a2: Real, rms: Real, high: Real = 0.0) -> Noise:
    """Return the noise of a receptor of rate a1, in front of a fixed pole of rate a2; 0: no such pole.

    Behind a high-pass of rate `high` it is that of two poles with the same variance, the same variance of its slope and
    the same density at high frequencies, which is exact on short times.
    """
    if a1 > _NEVER_HZ:  # no receptor: the rms is that behind the fixed pole
        a1, a2 = a2, 0.0
    if a2 == 0.0:
        return Noise(rms * math.sqrt(a1 / (a1 + high)), a1 + high, a1 + high, a1 + high, 0.0, 0.0)
    total, product = a1 + a2, a1 * a2
    sigma = rms * math.sqrt(a2 / total)
    if high > 0.0:
        sigma *= math.sqrt(product / ((high + a1) * (high + a2)))
        product += high * total
        half = max(0.5 * (total + high - a1 * a2 * high / product), math.sqrt(product))
        total, a2 = 2 * half, half + math.sqrt(max(half * half - product, 0.0))
        a1 = product / a2
    rate = math.sqrt(product)
    ratio = rate / total
    if ratio < LEAST_RATIO:
        return Noise(sigma, a1, a2, product / total, 0.0, ratio)
    return Noise(sigma, a1, a2, rate, ratio, 0.0)


@inlined
def _index(x: Real) -> np.uint64:
    """Return a whole number as an index; unsigned, which avoids the test for negative indices."""
    return np.uint64(np.int64(x))


@inlined
def _cell(table: _Float32s, at: Real, row: int, f: Real, g: Real) -> Real:
    """Return a table between four entries: the one at `at`, shares f to the next row and g to the next entry."""
    k, below = np.uint64(at), np.uint64(at) + np.uint64(row)
    step = np.uint64(1)
    low = table[k] + (table[k + step] - table[k]) * g
    high = table[below] + (table[below + step] - table[below]) * g
    return low + (high - low) * f


@lane
def _of_one_pole(c: Real, nu: Real, tables: _Float32s) -> Real:
    """Return the hazard of one pole, in units of its rate."""
    steep = _F1 + abs(nu)
    y = (nu / steep + _F1) * np.float32(32)
    x = (min(max(c, np.float32(-3.99)), np.float32(8.99)) + np.float32(4)) * np.float32(16)
    j, i = _index(min(y, np.float32(63.99))), _index(x)
    value = _cell(tables, np.uint64(_ONE) + i * np.uint64(_ROW) + j, _ROW, x - np.float32(i), y - np.float32(j))
    return value * steep * _INVERSE_ROOT * _gaussian(c)


@lane
def _gaussian(c: Real) -> Real:
    """Return e^(-c^2 / 2), 1 for a signal beyond the threshold, and more than that where the tables end."""
    short = max(c, _F0)
    value: Real = exponential(np.float32(-0.5) * short * short) * max(_F1, c * np.float32(-0.25))
    return value


@lane
def _of_two_poles(c: Real, nu: Real, ratio: Real, first: int, tables: _Float32s) -> Real:
    """Return an entry of the tables of two poles that begin at `first`."""
    steep = _F1 + abs(nu)
    y = (nu / steep + _F1) * np.float32(32)
    x = (min(max(c, np.float32(-3.99)), np.float32(8.99)) + np.float32(4)) * np.float32(8)
    z = (min(max(ratio, np.float32(LEAST_RATIO)), np.float32(0.4999)) - np.float32(LEAST_RATIO)) * np.float32(16)
    i, j = _index(x), _index(min(y, np.float32(63.99)))
    k = _index(z)
    at = np.uint64(first) + k * np.uint64(_SLICE) + i * np.uint64(_ROW) + j
    f, g = x - np.float32(i), y - np.float32(j)
    low, high = _cell(tables, at, _ROW, f, g), _cell(tables, at + np.uint64(_SLICE), _ROW, f, g)
    return low + (high - low) * (z - np.float32(k))


class Hazard(NamedTuple):
    """The hazards of a pixel at an instant, and what a reset needs to know."""

    on: float  # 1/s
    off: float
    c_on: float  # deviations to the thresholds
    c_off: float
    nu_on: float  # speeds of approach, in units of `slope`
    nu_off: float
    mean_slope: float  # m', ln units a second
    deviation: float  # sqrt V
    pull: float  # C / V
    slope: float  # s, 1/s


class Distance(NamedTuple):
    """The signal at an instant."""

    on: float  # from the signal to the thresholds, ln units; below 0 beyond them
    off: float
    speed: float  # of the signal, ln units a second
    narrowing: float  # rate at which sigma shrinks: -(d sigma / dt) / sigma, 1/s


@lane
def _pair(a: float, b: float, first: int, nodes: int, per_unit: float, tables: _Float32s) -> float:
    """Return F for thresholds at a and b deviations, the flux through a."""
    x = min(max((a + 0.5) * per_unit, 0.0), nodes - 1.001)
    y = min(max((b + 0.5) * per_unit, 0.0), nodes - 1.001)
    i, j = np.int64(x), np.int64(y)
    return float(_cell(tables, first + i * nodes + j, nodes, x - i, y - j))


@lane
def _farther(c: float, nu: float, apart: float) -> float:
    """Return the deviations by which the threshold of two poles that act as one lies farther, see above."""
    if apart == 0.0:
        return 0.0
    kappa = max((c + nu) * apart, 0.0)
    return apart / math.sqrt(math.sqrt(kappa * kappa * kappa * kappa + _FADES))


@lane
def _one_pole(s: float, d: Distance, n_r: float, noise: Noise, tables: _Float32s) -> Hazard:
    """Return the hazards of a pixel of one pole at a time s after its reset."""
    e = math.exp(-s * noise.rate) if s * noise.rate < _SETTLED else 0.0
    v = 1.0 - e * e
    deviation = math.sqrt(v)
    per_sigma = 1.0 / (noise.sigma * deviation)
    m = n_r * e
    c_on, c_off = (d.on - m) * per_sigma, (d.off + m) * per_sigma
    rise = (d.speed / noise.rate - m) * v * per_sigma
    nu_on = rise + c_on * (e * e + v * d.narrowing / -noise.rate)
    nu_off = c_off * (e * e + v * d.narrowing / -noise.rate) - rise
    rate = noise.rate / v
    on = off = 0.0
    shift_on, shift_off = _farther(c_on, nu_on, noise.apart), _farther(c_off, nu_off, noise.apart)
    if c_on < FARTHEST:
        on = rate * _of_one_pole(np.float32(c_on + shift_on), np.float32(nu_on), tables)
        if e > 0.05 and 0 < c_on < 7.9:
            on *= 1 + e * _start(c_on, tables)
    if c_off < FARTHEST:
        off = rate * _of_one_pole(np.float32(c_off + shift_off), np.float32(nu_off), tables)
        if e > 0.05 and 0 < c_off < 7.9:
            off *= 1 + e * _start(c_off, tables)
    if c_on + c_off < 8 and max(c_on, c_off) < 4.5:
        share = v * v / (1 + rise * rise)
        on *= 1 + (_pair(c_on, c_off, ONE_PAIR, 53, 8.0, tables) - 1) * share
        off *= 1 + (_pair(c_off, c_on, ONE_PAIR, 53, 8.0, tables) - 1) * share
    return Hazard(on, off, c_on, c_off, nu_on, nu_off, -noise.rate * m, deviation, noise.rate * e * e / v, rate)


@lane
def _start(c: float, tables: _Float32s) -> float:
    """Return the share by which the start of the noise at its reset raises the hazard of one pole."""
    x = c * 8
    i = np.int64(x)
    return float(tables[_START + i] + (tables[_START + i + 1] - tables[_START + i]) * (x - i))


class Transition(NamedTuple):
    """Transition of value and slope of the noise over a time, and their covariance over sigma^2."""

    p11: float
    p12: float
    p21: float
    p22: float
    v: float
    c: float
    w: float


@lane
def transition(s: float, noise: Noise) -> Transition:
    """Return the transition of two poles over a time s > 0."""
    # Equal poles are a limit of the formulas: a millionth apart is near enough, and keeps their digits.
    a1, a2 = noise.a1, noise.a2
    if abs(a2 - a1) < 1e-4 * a1:
        a2 = a1 * 1.0001
    e1, e2 = math.exp(-a1 * s), math.exp(-a2 * s)
    r = 1 / (a2 - a1)
    k = a1 * a2
    total = a1 + a2
    p12 = (e1 - e2) * r
    p11 = (a2 * e1 - a1 * e2) * r
    p21 = -k * p12
    p22 = (a2 * e2 - a1 * e1) * r
    x = total * s
    v = 1 - p11 * p11 - k * p12 * p12
    w = k - p21 * p21 - k * p22 * p22
    if x < _SHORT:  # differences of nearly equal numbers
        v = 2 * k * total * s * s * s / 3 * (1 - 0.75 * x)
        w = 2 * k * x * (1 - x)
    return Transition(p11, p12, p21, p22, v, k * total * p12 * p12, w)


@lane
def _matters(c: float, other: float, nu: float) -> bool:
    """Return whether a threshold at c adds to the hazard of the other one, approached at speed nu, in float32."""
    receding = min(nu, 0.0)
    return c < FARTHEST and (c < 0 or c * c < other * abs(other) + receding * receding + _UNRESOLVED)


@lane
def _two_poles(s: float, d: Distance, n_r: float, v_r: float, noise: Noise, tables: _Float32s) -> Hazard:
    """Return the hazards of a pixel of two poles at a time s after its reset."""
    m = m_slope = pull = 0.0
    deviation = inverse = 1.0
    slope = noise.rate
    ratio = noise.ratio
    if s * min(noise.a1, noise.a2) < _SETTLED:
        t = transition(s, noise)
        m, m_slope = t.p11 * n_r + t.p12 * v_r, t.p21 * n_r + t.p22 * v_r
        deviation = math.sqrt(t.v)
        inverse = 1 / deviation
        pull = t.c * inverse * inverse
        slope = math.sqrt(max(t.w - t.c * pull, 1e-30)) * inverse
        ratio = t.v * slope * slope * slope / (noise.a1 * noise.a2 * (noise.a1 + noise.a2))
    per_sigma = inverse / noise.sigma
    per_slope = 1 / slope
    c_on, c_off = (d.on - m) * per_sigma, (d.off + m) * per_sigma
    rise = (d.speed + m_slope) * per_sigma
    nearer = pull - d.narrowing
    nu_on, nu_off = (rise + c_on * nearer) * per_slope, (c_off * nearer - rise) * per_slope
    on = off = 0.0
    if _matters(c_on, c_off, nu_off):
        on = slope * _two(c_on, nu_on, ratio, tables)
    if _matters(c_off, c_on, nu_on):
        off = slope * _two(c_off, nu_off, ratio, tables)
    if c_on + c_off < 10 and max(c_on, c_off) < 5.4:
        share = deviation * deviation * deviation * deviation / (1 + rise * rise * per_slope * per_slope)
        nearest = int(min(max((ratio - LEAST_RATIO) * 16 + 0.5, 0.0), 6.0))
        first = TWO_PAIR + 625 * nearest
        on *= 1 + (_pair(c_on, c_off, first, 25, 4.0, tables) - 1) * share
        off *= 1 + (_pair(c_off, c_on, first, 25, 4.0, tables) - 1) * share
    return Hazard(on, off, c_on, c_off, nu_on, nu_off, m_slope, deviation, pull, slope)


@lane
def _two(c: float, nu: float, ratio: float, tables: _Float32s) -> float:
    """Return the hazard of a threshold, in units of s."""
    at, speed = np.float32(c), np.float32(nu)
    value = _of_two_poles(at, speed, np.float32(ratio), _TWO, tables)
    return np.float64(value * (_F1 + abs(speed)) * _INVERSE_ROOT * _gaussian(at))


@lane
def hazard(s: float, d: Distance, n_r: float, v_r: float, noise: Noise, tables: _Float32s) -> Hazard:
    """Return the hazards of a pixel at a time s > 0 after its reset, s.

    `n_r` and `v_r` are value and slope of its noise at the reset, ln units and ln units a second.
    """
    h: Hazard = _two_poles(s, d, n_r, v_r, noise, tables) if noise.ratio > 0.0 else _one_pole(s, d, n_r, noise, tables)
    return h


@kernel
def exit_speed(nu: float, c: float, share: float, ratio: float, tables: _Float32s) -> float:
    """Return the speed at which the noise leaves through a threshold, less the threshold's own, in units of s.

    Its density is u phi(u - nu), that of crossings, stretched to the mean of first ones. `share` is random, in (0, 1).
    """
    if nu > 7.9:
        return nu + 1 / nu
    x, y = (max(nu, -5.99) + 6) * 4, share * 64
    i, j = np.int64(x), np.int64(y)
    stretch = _of_two_poles(np.float32(c), np.float32(nu), np.float32(ratio), SPEED, tables)
    return float(_cell(tables, EXIT + i * _ROW + j, _ROW, x - i, y - j) * stretch)

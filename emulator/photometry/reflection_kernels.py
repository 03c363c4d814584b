"""The laws of reflection for compiled loops: the formulas of `photometry.reflectance` in the chord between Sun and eye.

With unit vectors s to the Sun and e to the eye, q = |s - e|^2 holds the phase angle g without loss near opposition:

    cos g = 1 - q / 2        tan(g / 2) = sqrt(q / (4 - q))        cos(g / 2) = sqrt(1 - q / 4)

For speed there is one loop for each law over compact arrays, without branches, calls or powers where the law has none,
so the compiler computes several points at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from emulator.photometry.reflectance import Glossy, Hapke, Lambert, LommelSeeliger, LunarLambert, Reflectance
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Floats


class Law(NamedTuple):
    """Number of a law, and its parameters: (4,), followed by tables where a law has some."""

    kind: int
    parameters: Floats


_LAMBERT, _SEELIGER, _LUNAR, _HAPKE, _GLOSSY = range(5)
_TINY = 1e-12
_CHORDS = 8193  # of a table: linear interpolation misses exp(-0.9 g) by 1e-8 up to 150 degrees


def law_of(law: Reflectance) -> Law:
    """Return a law as the kernels take it."""
    match law:
        case Lambert():
            return Law(_LAMBERT, np.array([law.albedo / math.pi, 0, 0, 0]))
        case LommelSeeliger():
            return Law(_SEELIGER, np.array([law.single_scattering_albedo / (4 * math.pi), law.asymmetry, 0, 0]))
        case LunarLambert():
            return Law(_LUNAR, _lunar_table(law))
        case Hapke():
            parameters = [law.single_scattering_albedo, law.asymmetry, law.surge, law.surge_width]
            return Law(_HAPKE, np.array(parameters))
        case Glossy():
            lobe = law.shine * (law.sharpness + 8) / (8 * math.pi)
            return Law(_GLOSSY, np.array([law.albedo / math.pi, lobe, law.sharpness, 0]))


@numba.njit(error_model="numpy")
def _henyey_greenstein(chord2: float, b: float) -> float:
    inner = (1.0 + b) * (1.0 + b) - b * chord2
    return (1.0 - b * b) / (inner * math.sqrt(inner))


@numba.njit(error_model="numpy")
def _seeliger(p: Floats, mu0: Floats, mu: Floats, chord2: Floats, count: int, out: Floats) -> None:
    share, b = p[0], p[1]
    for i in range(count):
        lit = max(mu0[i], 0.0)
        out[i] = share * _henyey_greenstein(chord2[i], b) * lit / max(lit + abs(mu[i]), _TINY)


def _lunar_table(law: LunarLambert) -> Floats:
    """Return the law's two factors that depend on the phase angle, by the chord: Seeliger's and Lambert's."""
    g = 2 * np.arcsin(np.linspace(0, 2, _CHORDS) / 2)
    seen_straight = np.ones(_CHORDS)
    total = law.reflect(seen_straight, seen_straight, g)  # S + L, as S 2 mu0 / (mu0 + mu) is S here
    seeliger = 2 * (total - law.reflect(seen_straight, 1e9 * seen_straight, g))
    return np.concatenate([np.zeros(4), seeliger, total - seeliger / 2])


@numba.njit(error_model="numpy")
def _lunar(p: Floats, mu0: Floats, mu: Floats, chord2: Floats, count: int, out: Floats) -> None:
    for i in range(count):
        lit = max(mu0[i], 0.0)
        at = math.sqrt(min(chord2[i], 4.0)) * (0.5 * (_CHORDS - 1))
        k = min(int(at), _CHORDS - 2)
        part = at - k
        k += 4
        seeliger = p[k] + (p[k + 1] - p[k]) * part
        lambert = p[k + _CHORDS] + (p[k + 1 + _CHORDS] - p[k + _CHORDS]) * part
        out[i] = lit * (seeliger / max(lit + abs(mu[i]), _TINY) + lambert)


@numba.njit(error_model="numpy")
def _hapke(p: Floats, mu0: Floats, mu: Floats, chord2: Floats, count: int, out: Floats) -> None:
    w, b = p[0], p[1]
    surge, width = p[2], p[3]
    gamma, share = math.sqrt(1.0 - w), w / (4.0 * math.pi)
    for i in range(count):
        lit, seen = max(mu0[i], 0.0), abs(mu[i])
        half = math.sqrt(chord2[i] / max(4.0 - chord2[i], 1e-30))
        once = (1.0 + surge * width / (width + half)) * _henyey_greenstein(chord2[i], b)
        often = (1.0 + 2.0 * lit) * (1.0 + 2.0 * seen) / ((1.0 + 2.0 * lit * gamma) * (1.0 + 2.0 * seen * gamma))
        out[i] = share * lit / max(lit + seen, _TINY) * (once + often - 1.0)


@numba.njit(error_model="numpy")
def _glossy(p: Floats, mu0: Floats, mu: Floats, chord2: Floats, count: int, out: Floats) -> None:
    even, lobe, sharpness = p[0], p[1], p[2]
    rim = math.exp(-60.0 / sharpness)  # beside it the lobe is below 1e-26 of its height: no power is computed there
    for i in range(count):
        lit = max(mu0[i], 0.0)
        if not lit > 0.0:
            out[i] = 0.0
            continue
        between = max(math.sqrt(max(1.0 - 0.25 * chord2[i], 0.0)), 1e-6)
        halfway = min((lit + abs(mu[i])) / (2.0 * between), 1.0)
        glint = math.exp(sharpness * math.log(halfway)) if halfway > rim else 0.0
        out[i] = lit * (even + lobe * glint)


@entry_of("emulator.photometry")
def reflect(kind: int, p: Floats, mu0: Floats, mu: Floats, chord2: Floats, count: int, out: Floats) -> None:
    """Write r, 1/sr, of `count` points by a `Law`, `kind` and `p`.

    `mu0`, `mu` and `chord2` are (count,) cosines of incidence and emission, and q of the module docstring, 0 to 4.
    """
    if kind == _LAMBERT:
        for i in range(count):
            out[i] = p[0] * max(mu0[i], 0.0)
    elif kind == _SEELIGER:
        _seeliger(p, mu0, mu, chord2, count, out)
    elif kind == _LUNAR:
        _lunar(p, mu0, mu, chord2, count, out)
    elif kind == _HAPKE:
        _hapke(p, mu0, mu, chord2, count, out)
    else:
        _glossy(p, mu0, mu, chord2, count, out)

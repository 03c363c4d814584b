"""Light of pixels from the means of the ground's moments.

With b the cosine of incidence x visible share of the Sun x albedo, the slopes p and q weighted by b have the means p
and q and the covariances V. With s and e the directions to the Sun and the eye and n = (-p, -q, 1),

    n = |n|    wl = max(e . n, 0.02 |n|)    S = max(s . n, 0)    G = S + wl

Ground that faces the eye covers more of the pixel: b counts by wl / wb within 1/2 to 2, wb = e . (-P, -Q, 1) of the
mean slopes P, Q. The mean of 1 / (mu0 + mu), weighted by b, is n w1 / (G wl) to the second order of the slopes'
deviations,

    w1 = wl - cov(wl, G) / G + wl var(G) / G^2

within 0.3 to 3 wl. The law of reflection is evaluated once, at the mu0 of the mean slope and the mu at which
1 / (mu0 + mu) has this mean. In laws of Lommel-Seeliger's kind it is this factor that changes most from slope to slope
where the ground is seen at a slant: with the mu of the mean slope the light was 2 % too dark near the horizon.
Lambert's law has no mu.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.photometry.reflection_kernels import reflect
from emulator.scene.terrain.block_vertices import around
from emulator.scene.terrain.ground import BP, BPP, BPQ, BQ, BQQ, MOMENTS, B, P, Q
from emulator.scene.terrain.tile import (
    AROUND,
    CHORD2,
    EYE_X,
    EYE_Y,
    EYE_Z,
    FAST,
    MU,
    MU0,
    SUNLIGHT,
    TILE,
    Floats32,
)
from emulator.sensor.numerics.compiled import vector_kernel

_f = np.float32
_TINY, _ZERO, _HALF, _ONE, _TWO, _LEAST = (_f(v) for v in (1e-9, 0.0, 0.5, 1.0, 2.0, 0.02))
_SMALLEST, _LARGEST = _f(0.3), _f(3.0)
_STEEPEST = _f(10.0)

Floats = npt.NDArray[np.float64]
Sunlight = tuple[Floats, float, int, Floats, Floats]
"""Direction (3,), irradiance, law and its parameters, radiance of the ambient light by the height of the eye."""


@vector_kernel
def mean_light(sun: Sunlight, s: Floats32, sums: Floats32, inputs: Floats) -> None:
    """Write the light of a row's pixels."""
    _angles(sun[0], s, sums, inputs)
    _ambient(sun[4], s, inputs)
    now = inputs[MU0]  # written over: the law reads each place before it writes it
    reflect(sun[2], sun[3], inputs[MU0], inputs[MU], inputs[CHORD2], TILE, now)
    for k in range(TILE):
        s[FAST * TILE + k] = now[k] * inputs[SUNLIGHT, k] * sun[1] + inputs[AROUND, k]


@vector_kernel
def _angles(towards: Floats, s: Floats32, sums: Floats32, inputs: Floats) -> None:
    """Write the inputs of the law of reflection, and sunlight by the cosine of incidence."""
    sx, sy, sz = _f(towards[0]), _f(towards[1]), _f(towards[2])
    for k in range(TILE):
        ex, ey, ez = s[EYE_X * TILE + k], s[EYE_Y * TILE + k], s[EYE_Z * TILE + k]
        b = max(sums[k * MOMENTS + B], _ZERO)
        per_b = _ONE / max(b, _TINY)
        p, q = sums[k * MOMENTS + BP] * per_b, sums[k * MOMENTS + BQ] * per_b
        p, q = min(max(p, -_STEEPEST), _STEEPEST), min(max(q, -_STEEPEST), _STEEPEST)
        pp = max(sums[k * MOMENTS + BPP] * per_b - p * p, _ZERO)
        qq = max(sums[k * MOMENTS + BQQ] * per_b - q * q, _ZERO)
        pq = sums[k * MOMENTS + BPQ] * per_b - p * q
        n = math.sqrt(_ONE + p * p + q * q)
        wl = max(ez - ex * p - ey * q, _LEAST * n)
        lit = max(sz - sx * p - sy * q, _ZERO)
        both = lit + wl
        wb = max(ez - ex * sums[k * MOMENTS + P] - ey * sums[k * MOMENTS + Q], _LEAST)
        gx, gy = sx + ex, sy + ey
        varied = gx * gx * pp + _TWO * gx * gy * pq + gy * gy * qq
        shared = ex * gx * pp + (ex * gy + ey * gx) * pq + ey * gy * qq
        per_both = _ONE / both
        w1 = wl + (wl * varied * per_both - shared) * per_both
        w1 = min(max(w1, _SMALLEST * wl), _LARGEST * wl)
        b *= min(max(wl / wb, _HALF), _TWO)
        mu0 = max(lit / n, b, _TINY)
        cx, cy, cz = ex - sx, ey - sy, ez - sz
        inputs[MU0, k] = mu0
        inputs[MU, k] = max(both * wl / (n * w1) - mu0, _LEAST)
        inputs[CHORD2, k] = cx * cx + cy * cy + cz * cz
        inputs[SUNLIGHT, k] = b / mu0


@vector_kernel
def _ambient(table: Floats, s: Floats32, inputs: Floats) -> None:
    for k in range(TILE):
        inputs[AROUND, k] = around(table, s[EYE_Z * TILE + k])

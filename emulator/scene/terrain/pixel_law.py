"""Light of pixels from the means of the ground's moments, and its time derivative.

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

The time derivative comes from the motion of footprints over ground that stands still. A pixel looks in the direction d,
fixed in the camera, d = 1 along the boresight. At s d from the camera it meets the ground, with the normal n of its
footprint. The camera moves with v and turns, so that directions change by the antisymmetric matrix T; the place on the
ground moves with

    u = v + T (s d)        m = u - e (n . u) / (n . e)        e from the place to the eye

and the boxes of the footprint with it. Their means have exact rates (`add_box_and_rate`), and e turns with T e. The law
of light is evaluated a second time at the means and the direction of a moment later, in which the place moves by a
share of the footprint: so the difference is far above rounding, whatever the motion. The size of the footprint is taken
as constant: it changes by some per cent a second.

Doubtful pixels have no such means. Their light goes with the ground on the screen: the rate is the gradient of the
light frame, by differences of sixth order, along the motion of the ground, which is that of the nearer side where the
pixel's middle sees it. Of all other pixels too it would be a rate, but one that is wrong by 8 to 10 % of its rms, four
times as much, as light of pixels is too sharp for differences between them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emulator.photometry.reflection_kernels import reflect
from emulator.raster.layout import W, WHighest, WLowest
from emulator.scene.terrain import tile as t
from emulator.scene.terrain.ground import entry
from emulator.scene.terrain.pixel_hits import Sight
from emulator.scene.terrain.tile import BP, BPP, BPQ, BQ, BQQ, MOMENTS, TILE, B, P, Q, set_triple, triple
from emulator.sensor.numerics.compiled import lane, vector_kernel
from firmware_protocol.events import Bytes, Float32s, Floats

_f = np.float32
_TINY, _ZERO, _QUARTER, _HALF, _ONE, _TWO = (_f(v) for v in (1e-9, 0.0, 0.25, 0.5, 1.0, 2.0))
_SMALLEST, _LARGEST = _f(0.3), _f(3.0)
_STEEPEST = _f(10.0)
_SHARE = _f(1.0 / 16.0)  # of the footprint's shorter side, moved in the moment
_SLOWEST = _f(1e-20)  # m/s
_LONGEST_S = _f(0.01)
_NEAR, _NEXT, _FAR = 3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0  # differences over 2, 4 and 6 pixels

GRAZING = 0.02
"""Least cosine of emission: the laws of reflection are not valid for smaller ones."""

_GRAZING = _f(GRAZING)


class Sunlight(NamedTuple):
    """Light on the ground.

    Attributes
    ----------
    disc : of the Sun, (2, 3): towards its middle, unit, and from there to its top.
    irradiance_w_m2 : on a surface that faces it.
    law, law_parameters : a `reflection_kernels.Law`.
    ambient : radiance of the ambient light by the height of the eye's direction.
    """

    disc: Floats
    irradiance_w_m2: float
    law: int
    law_parameters: Floats
    ambient: Floats


@lane
def around(table: Floats, height: float) -> float:
    """Return the radiance of the ambient light from a table by the height of the eye's direction."""
    at = min(max(height, GRAZING), 1.0) * (len(table) - 1)
    low = min(int(at), len(table) - 2)
    return float(table[low] + (table[low + 1] - table[low]) * (at - low))


class Motion(NamedTuple):
    """Velocities of points, linear in their places: turning @ place + velocity, (3, 3) and (3,), a second."""

    turning: Floats
    velocity: Floats


@vector_kernel
def mean_light(sun: Sunlight, tile: t.Tile) -> None:
    """Write the light of a row's pixels."""
    s, inputs = tile.fields, tile.inputs
    _angles(sun.disc[0], s, tile.sums, inputs)
    for k in range(TILE):
        inputs[t.AROUND, k] = around(sun.ambient, s[t.EYE_Z * TILE + k])
    now = inputs[t.MU0]  # written over: the law reads each place before it writes it
    reflect(sun.law, sun.law_parameters, inputs[t.MU0], inputs[t.MU], inputs[t.CHORD2], TILE, now)
    for k in range(TILE):
        s[t.FAST * TILE + k] = now[k] * inputs[t.SUNLIGHT, k] * sun.irradiance_w_m2 + inputs[t.AROUND, k]


@vector_kernel
def _angles(towards: Floats, s: Float32s, sums: Float32s, inputs: Floats) -> None:
    """Write the inputs of the law of reflection, and sunlight by the cosine of incidence."""
    sx, sy, sz = _f(towards[0]), _f(towards[1]), _f(towards[2])
    for k in range(TILE):
        ex, ey, ez = triple(s, t.EYE_X, k)
        # Mean slopes weighted by b, and their covariances.
        b = max(sums[k * MOMENTS + B], _ZERO)
        per_b = _ONE / max(b, _TINY)
        p = min(max(sums[k * MOMENTS + BP] * per_b, -_STEEPEST), _STEEPEST)
        q = min(max(sums[k * MOMENTS + BQ] * per_b, -_STEEPEST), _STEEPEST)
        pp = max(sums[k * MOMENTS + BPP] * per_b - p * p, _ZERO)
        qq = max(sums[k * MOMENTS + BQQ] * per_b - q * q, _ZERO)
        pq = sums[k * MOMENTS + BPQ] * per_b - p * q
        n = math.sqrt(_ONE + p * p + q * q)
        wl = max(ez - ex * p - ey * q, _GRAZING * n)
        lit = max(sz - sx * p - sy * q, _ZERO)
        lit_and_seen = lit + wl  # G
        wb = max(ez - ex * sums[k * MOMENTS + P] - ey * sums[k * MOMENTS + Q], _GRAZING)
        # var(G) and cov(wl, G), as G and wl are linear in the slopes, and with them w1.
        gx, gy = sx + ex, sy + ey
        variance = gx * gx * pp + _TWO * gx * gy * pq + gy * gy * qq
        covariance = ex * gx * pp + (ex * gy + ey * gx) * pq + ey * gy * qq
        per_g = _ONE / lit_and_seen
        w1 = wl + (wl * variance * per_g - covariance) * per_g
        w1 = min(max(w1, _SMALLEST * wl), _LARGEST * wl)
        b *= min(max(wl / wb, _HALF), _TWO)
        mu0 = max(lit / n, b, _TINY)
        cx, cy, cz = ex - sx, ey - sy, ez - sz
        inputs[t.MU0, k] = mu0
        inputs[t.MU, k] = max(lit_and_seen * wl / (n * w1) - mu0, _GRAZING)
        inputs[t.CHORD2, k] = cx * cx + cy * cy + cz * cz
        inputs[t.SUNLIGHT, k] = b / mu0


@vector_kernel
def footprint_moves(motion: Motion, s: Float32s) -> None:
    """Write the rates of footprints and of directions to the eye, and each pixel's moment.

    `motion` is that of places that turn with the camera, relative to it, in the world.
    """
    vx, vy, vz = _f(motion.velocity[0]), _f(motion.velocity[1]), _f(motion.velocity[2])
    txy, txz, tyz = _f(motion.turning[0, 1]), _f(motion.turning[0, 2]), _f(motion.turning[1, 2])  # antisymmetric
    for k in range(TILE):
        mx, my, mz = s[t.MIDDLE_X * TILE + k], s[t.MIDDLE_Y * TILE + k], s[t.MIDDLE_Z * TILE + k]
        nx, ny, nz = triple(s, t.ACROSS_X, k)
        # u, and its part along the ground, m.
        ux, uy, uz = vx + txy * my + txz * mz, vy + tyz * mz - txy * mx, vz - txz * mx - tyz * my
        ex, ey, ez = triple(s, t.EYE_X, k)
        facing = nx * ex + ny * ey + nz * ez
        along = (nx * ux + ny * uy + nz * uz) / (facing if facing != _ZERO else _ONE)
        move_x, move_y = ux - along * ex, uy - along * ey
        s[t.MOVE_X * TILE + k], s[t.MOVE_Y * TILE + k] = move_x, move_y
        set_triple(s, t.EYE_RATE_X, k, txy * ey + txz * ez, tyz * ez - txy * ex, -txz * ex - tyz * ey)
        moved = math.sqrt(move_x * move_x + move_y * move_y) + _SLOWEST
        s[t.MOMENT_S * TILE + k] = min(_SHARE * math.sqrt(s[t.SHORTER * TILE + k]) / moved, _LONGEST_S)


@vector_kernel
def light_rate(sun: Sunlight, tile: t.Tile) -> None:
    """Write the rate of light, from `mean_light` at the means of a moment later; moments and eyes are moved there."""
    s, sums = tile.fields, tile.sums
    for k in range(TILE):
        moment = s[t.MOMENT_S * TILE + k]
        for n in range(MOMENTS):
            sums[k * MOMENTS + n] += moment * sums[t.RATES + k * MOMENTS + n]
        s[t.RATE * TILE + k] = s[t.FAST * TILE + k]
    for k in range(TILE):
        moment = s[t.MOMENT_S * TILE + k]
        ex, ey, ez = triple(s, t.EYE_X, k)
        rx, ry, rz = triple(s, t.EYE_RATE_X, k)
        set_triple(s, t.EYE_X, k, ex + moment * rx, ey + moment * ry, ez + moment * rz)
    mean_light(sun, tile)
    for k in range(TILE):
        now, later = s[t.RATE * TILE + k], s[t.FAST * TILE + k]
        s[t.FAST * TILE + k] = now
        s[t.RATE * TILE + k] = (later - now) / s[t.MOMENT_S * TILE + k]


@entry
def rate_of_doubtful(
    rows: tuple[int, int], sight: Sight, motion: Motion, doubtful: Bytes, light: Float32s, rate: Float32s
) -> None:
    """Write the rate of doubtful pixels of rows first to last, from the light frame and the motion of the ground.

    `motion` is that of ground points in camera axes; `doubtful` is of `Smooth`.
    """
    owner, facets = sight.owner, sight.facets
    focal, middle_column, middle_row = sight.projection
    m, c = motion
    for row in range(rows[0], rows[1]):
        for column in range(owner.shape[1]):
            f = owner[row, column]
            if doubtful[row, column] == 0 or f < 0:
                continue
            # The point's velocity times w, in camera axes, and from it the motion on the screen.
            x, y = (column + 0.5 - middle_column) / focal, (row + 0.5 - middle_row) / focal
            w = facets[f, W] + facets[f, W + 1] * (column + 0.5) + facets[f, W + 2] * (row + 0.5)
            w = min(max(w, facets[f, WLowest]), facets[f, WHighest])
            ahead = m[2, 0] * x + m[2, 1] * y + m[2, 2] + w * c[2]
            right = focal * (m[0, 0] * x + m[0, 1] * y + m[0, 2] + w * c[0] - x * ahead)
            down = focal * (m[1, 0] * x + m[1, 1] * y + m[1, 2] + w * c[1] - y * ahead)
            rate[row, column] = -right * _slope(light[row], column) - down * _slope(light[:, column], row)


@lane
def _slope(light: Float32s, k: int) -> float:
    """Return the change of light a pixel at pixel k of a line; the light goes on evenly beyond its ends."""
    last = light.size - 1
    change: float = _NEAR * (light[min(k + 1, last)] - light[max(k - 1, 0)])
    change += _NEXT * (light[min(k + 2, last)] - light[max(k - 2, 0)])
    change += _FAR * (light[min(k + 3, last)] - light[max(k - 3, 0)])
    return change

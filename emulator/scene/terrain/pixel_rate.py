"""Time derivative of the light of pixels, from the motion of their footprints over ground that stands still.

A pixel looks in the direction d, fixed in the camera, d = 1 along the boresight. At s d from the camera it meets the
ground, with the normal n of its footprint. The camera moves with v and turns, so that directions change by the
antisymmetric matrix T; the place on the ground moves with

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

import numpy as np

from emulator.raster.layout import Bytes, Float32s, Floats, W, WHighest, WLowest
from emulator.scene.terrain.compiled import entry
from emulator.scene.terrain.ground import MOMENTS
from emulator.scene.terrain.pixel_hits import Sight
from emulator.scene.terrain.pixel_law import Sunlight, mean_light
from emulator.scene.terrain.tile import (
    ABOVE_X,
    ABOVE_Y,
    ABOVE_Z,
    EYE_RATE_X,
    EYE_RATE_Y,
    EYE_RATE_Z,
    EYE_X,
    EYE_Y,
    EYE_Z,
    FAST,
    MOMENT_S,
    MOVE_X,
    MOVE_Y,
    RATE,
    RATES,
    SHORTER,
    TILE,
    Floats32,
    X,
    Y,
    Z,
)
from emulator.sensor.numerics.compiled import lane, vector_kernel

_f = np.float32
_TINY, _ZERO, _QUARTER, _ONE = _f(1e-20), _f(0.0), _f(0.25), _f(1.0)
_SHARE = _f(1.0 / 16.0)  # of the footprint's shorter side, moved in the moment
_LONGEST_S = _f(0.01)
_NEAR, _NEXT, _FAR = 3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0  # differences over 2, 4 and 6 pixels


@vector_kernel
def footprint_moves(motion: tuple[Floats, Floats], s: Floats32) -> None:
    """Write the rates of footprints and of directions to the eye, and each pixel's moment.

    Parameters
    ----------
    motion : the camera's velocity (3,); rate of a direction fixed in the camera, over the direction, (3, 3).
    """
    v, t = motion
    vx, vy, vz = _f(v[0]), _f(v[1]), _f(v[2])
    txy, txz, tyz = _f(t[0, 1]), _f(t[0, 2]), _f(t[1, 2])
    for k in range(TILE):
        x00, y00, z00 = s[ABOVE_X * TILE + k], s[ABOVE_Y * TILE + k], s[ABOVE_Z * TILE + k]
        x01, y01, z01 = s[ABOVE_X * TILE + k + 1], s[ABOVE_Y * TILE + k + 1], s[ABOVE_Z * TILE + k + 1]
        x10, y10, z10 = s[X * TILE + k], s[Y * TILE + k], s[Z * TILE + k]
        x11, y11, z11 = s[X * TILE + k + 1], s[Y * TILE + k + 1], s[Z * TILE + k + 1]
        mx, my, mz = x00 + x01 + x10 + x11, y00 + y01 + y10 + y11, z00 + z01 + z10 + z11
        rx, ry, rz = x01 - x00 + x11 - x10, y01 - y00 + y11 - y10, z01 - z00 + z11 - z10
        lx, ly, lz = x10 - x00 + x11 - x01, y10 - y00 + y11 - y01, z10 - z00 + z11 - z01
        nx, ny, nz = ry * lz - rz * ly, rz * lx - rx * lz, rx * ly - ry * lx
        ux = vx + _QUARTER * (txy * my + txz * mz)
        uy = vy + _QUARTER * (tyz * mz - txy * mx)
        uz = vz - _QUARTER * (txz * mx + tyz * my)
        ex, ey, ez = s[EYE_X * TILE + k], s[EYE_Y * TILE + k], s[EYE_Z * TILE + k]
        facing = nx * ex + ny * ey + nz * ez
        along = (nx * ux + ny * uy + nz * uz) / (facing if facing != _ZERO else _ONE)
        move_x, move_y = ux - along * ex, uy - along * ey
        s[MOVE_X * TILE + k], s[MOVE_Y * TILE + k] = move_x, move_y
        s[EYE_RATE_X * TILE + k] = txy * ey + txz * ez
        s[EYE_RATE_Y * TILE + k] = tyz * ez - txy * ex
        s[EYE_RATE_Z * TILE + k] = -txz * ex - tyz * ey
        moved = math.sqrt(move_x * move_x + move_y * move_y) + _TINY
        s[MOMENT_S * TILE + k] = min(_SHARE * math.sqrt(s[SHORTER * TILE + k]) / moved, _LONGEST_S)


@vector_kernel
def light_rate(sun: Sunlight, s: Floats32, sums: Floats32, inputs: Floats) -> None:
    """Write the rate of light, from `mean_light` at the means of a moment later; moments and eyes are moved there."""
    for k in range(TILE):
        moment = s[MOMENT_S * TILE + k]
        for n in range(MOMENTS):
            sums[k * MOMENTS + n] += moment * sums[RATES + k * MOMENTS + n]
        s[RATE * TILE + k] = s[FAST * TILE + k]
    for k in range(TILE):
        moment = s[MOMENT_S * TILE + k]
        s[EYE_X * TILE + k] += moment * s[EYE_RATE_X * TILE + k]
        s[EYE_Y * TILE + k] += moment * s[EYE_RATE_Y * TILE + k]
        s[EYE_Z * TILE + k] += moment * s[EYE_RATE_Z * TILE + k]
    mean_light(sun, s, sums, inputs)
    for k in range(TILE):
        now, later = s[RATE * TILE + k], s[FAST * TILE + k]
        s[FAST * TILE + k] = now
        s[RATE * TILE + k] = (later - now) / s[MOMENT_S * TILE + k]


@entry
def rate_of_doubtful(
    rows: tuple[int, int],
    sight: Sight,
    motion: tuple[Floats, Floats],
    doubtful: Bytes,
    out: tuple[Float32s, Float32s],
) -> None:
    """Write the rate of doubtful pixels of rows first to last, from the light frame and the motion of the ground.

    Parameters
    ----------
    motion : rate of a ground point's place over the place, in camera axes, (3, 3), and the rate of all, (3,).
    doubtful : of `shade_rows`, 1 for doubtful pixels.
    out : light, and its rate.
    """
    owner, facets, (focal, cx, cy), _, _ = sight
    (m, c), (light, rate) = motion, out
    for row in range(rows[0], rows[1]):
        for column in range(owner.shape[1]):
            f = owner[row, column]
            if doubtful[row, column] == 0 or f < 0:
                continue
            x, y = (column + 0.5 - cx) / focal, (row + 0.5 - cy) / focal
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

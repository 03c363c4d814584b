"""Light of an image between its pixels.

An image is given by the mean light of each pixel. Between pixels it is the Catmull-Rom cubic, held within the four
pixels around the place, so that it makes no darkness below the darkest and no light above the brightest.

That cubic spreads an edge over two pixels more. Before a black sky the logarithm of light sees it: a pixel next to the
edge begins to change as soon as the edge moves, not when the edge arrives. So where light beside a pixel is below a
tenth of that on its other side, the pixel is two parts with a straight edge between them:

    +-------+   dark light, the least of 3 x 3 pixels, in the share 1 - c of the pixel
    |  / / /|   bright light, the greatest of 3 x 3, in the share c, so that the mean is that of the pixel
    | / / / |   the edge is at right angles to the gradient of the 3 x 3 pixels
    +-------+

and light at a place is the mean over one pixel around it, in closed form: right for straight edges between two even
surfaces. (In fluid dynamics the reconstruction is called PLIC: Youngs, 1982, Time-dependent multi-material flow with
large fluid distortion.) A bright pixel with darkness two pixels away is one part, as the edge is in its neighbour. A
slope of light that goes down to black, as at the terminator of a body, is no edge: light goes on rising over 5 x 5
pixels. There the cubic stays, and between both kinds of pixels the two are mixed.

The kernel is fast because it looks for edges only where the sixteen pixels of the cubic have light and near darkness.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import kernel

_Floats = npt.NDArray[np.float32]
_DARK_SHARE = 0.1
_PLATEAU = 1.5
_LEAST_SLANT = 1e-4


@kernel
def bounded(value: float, most: int) -> int:
    """Return the index below `value`, 0 to `most`; 0 for a NaN."""
    return int(min(max(value, 0.0), most)) if value == value else 0


@kernel
def _taps(f: float) -> tuple[float, float, float, float]:
    return (
        ((-0.5 * f + 1.0) * f - 0.5) * f, (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f, (0.5 * f - 0.5) * f * f,
    )  # fmt: skip


@kernel
def _slopes(f: float) -> tuple[float, float, float, float]:
    return (-1.5 * f + 2.0) * f - 0.5, (4.5 * f - 5.0) * f, (-4.5 * f + 4.0) * f + 0.5, (1.5 * f - 1.0) * f


@kernel
def sampled(image: _Floats, y: float, x: float) -> tuple[float, float, float]:
    """Return the value at a point, and its derivatives along rows and columns; at (r, c) the value of that pixel."""
    last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
    row, column = bounded(y, last_row), bounded(x, last_column)
    fy, fx = min(max(y - row, 0.0), 1.0), min(max(x - column, 0.0), 1.0)
    ty, tx, dy, dx = _taps(fy), _taps(fx), _slopes(fy), _slopes(fx)
    value = down = across = 0.0
    low, high, dark, bright = math.inf, -math.inf, math.inf, -math.inf
    for j in range(4):
        r = min(max(row + j - 1, 0), last_row)
        line = slope = 0.0
        for i in range(4):
            c = min(max(column + i - 1, 0), last_column)
            sample = image[r, c]
            line += tx[i] * sample
            slope += dx[i] * sample
            dark, bright = min(dark, sample), max(bright, sample)
            if 1 <= i <= 2 and 1 <= j <= 2:
                low, high = min(low, sample), max(high, sample)
        value += ty[j] * line
        down += dy[j] * line
        across += ty[j] * slope
    held = min(max(value, low), high)
    if dark > _DARK_SHARE * bright or bright <= 0.0:
        return held, down, across
    if held != value:
        down = across = 0.0
    return _with_edges(image, (row, column), (fy, fx), (held, down, across))


@kernel
def _with_edges(image: _Floats, at: Any, f: Any, cubic: Any) -> tuple[float, float, float]:
    """Return value and derivatives at the shares `f` behind the pixel `at`, with its straight edges."""
    share = share_down = share_across = 0.0
    value = down = across = 0.0
    for j in range(2):
        tall, to_down = (f[0], 1.0) if j else (1.0 - f[0], -1.0)
        for i in range(2):
            wide, to_right = (f[1], 1.0) if i else (1.0 - f[1], -1.0)
            edge = _edge(image, at[0] + j, at[1] + i)
            if edge[0]:
                share += tall * wide
                share_down += to_down * wide
                share_across += to_right * tall
            mean, line_y, line_x = _parts(edge, (0.0 if j else f[0], 0.0 if i else f[1]), (tall, wide), f)
            value += mean
            down += to_down * line_y
            across += to_right * line_x
    return (
        cubic[0] + share * (value - cubic[0]),
        cubic[1] + share * (down - cubic[1]) + share_down * (value - cubic[0]),
        cubic[2] + share * (across - cubic[2]) + share_across * (value - cubic[0]),
    )


@kernel
def _edge(image: _Floats, row: int, column: int) -> Any:
    """Return whether a pixel is in two parts, dark and bright light, and its edge.

    The dark part is ny v + nx u <= d, with v and u from 0 to 1 down and to the right, back where n is negative;
    |ny| + |nx| = 1.
    """
    last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
    row, column = min(row, last_row), min(column, last_column)
    dark, bright, darkest, far = math.inf, -math.inf, math.inf, -math.inf
    gy = gx = 0.0
    for j in range(-2, 3):
        r = min(max(row + j, 0), last_row)
        for i in range(-2, 3):
            sample = image[r, min(max(column + i, 0), last_column)]
            darkest, far = min(darkest, sample), max(far, sample)
            if -1 <= j <= 1 and -1 <= i <= 1:
                dark, bright = min(dark, sample), max(bright, sample)
                gy += j * (2 - i * i) * sample
                gx += i * (2 - j * j) * sample
    own = image[row, column]
    steep = abs(gy) + abs(gx)
    if own <= dark or steep == 0.0:
        return own <= _DARK_SHARE * bright, own, own, 0.5, 0.5, 0.0
    if darkest > _DARK_SHARE * bright or far > _PLATEAU * bright:
        return False, own, own, 0.5, 0.5, 0.0
    if dark > _DARK_SHARE * bright:
        return True, own, own, 0.5, 0.5, 0.0
    ny, nx = gy / steep, gx / steep
    return True, dark, bright, ny, nx, _offset((bright - own) / (bright - dark), min(abs(ny), abs(nx)))


@kernel
def _offset(area: float, least: float) -> float:
    """Return d of the half plane that holds `area` of a pixel; `least` is the smaller component of its normal."""
    m = max(least, _LEAST_SLANT)
    corner = 0.5 * m / (1.0 - m)
    if area <= corner:
        return math.sqrt(2.0 * area * m * (1.0 - m))
    if area >= 1.0 - corner:
        return 1.0 - math.sqrt(2.0 * (1.0 - area) * m * (1.0 - m))
    return area * (1.0 - m) + 0.5 * m


@kernel
def _squared(value: float) -> float:
    return value * value if value > 0.0 else 0.0


@kernel
def _parts(edge: Any, low: Any, size: Any, f: Any) -> tuple[float, float, float]:
    """Return light over a rectangle of a pixel, and along its borders at v = f[0] and u = f[1].

    The rectangle begins at `low` and has the height and width `size`.
    """
    _, dark, bright, ny, nx, d = edge
    (v, u), (tall, wide), (at_v, at_u) = low, size, f
    if bright == dark:
        return dark * tall * wide, dark * wide, dark * tall
    if ny < 0.0:
        v, at_v = 1.0 - v - tall, 1.0 - at_v
    if nx < 0.0:
        u, at_u = 1.0 - u - wide, 1.0 - at_u
    ny = min(max(abs(ny), _LEAST_SLANT), 1.0 - _LEAST_SLANT)
    nx = 1.0 - ny
    left = d - ny * v - nx * u
    area = _squared(left) - _squared(left - nx * wide) - _squared(left - ny * tall)
    area = (area + _squared(left - nx * wide - ny * tall)) / (2.0 * nx * ny)
    along_y = min(max((d - ny * at_v - nx * u) / nx, 0.0), wide)
    along_x = min(max((d - nx * at_u - ny * v) / ny, 0.0), tall)
    step = bright - dark
    return bright * tall * wide - step * area, bright * wide - step * along_y, bright * tall - step * along_x

"""Effects of a lens on a light frame, pixel by pixel, in linear light.

    blur      separable Gaussian, each tap the Gaussian's share of a pixel (erf), the frame's edge repeated
    bend      bilinear look-up of the frame without distortion at positions computed once
    scale     each pixel times its own factor

Blur and scale process a part of the frame only, (first row, last row, first column, last column): the rest is black, or
was processed before.

The loops run over rows of float32 and become vectors; look-ups do not, and cost about 3 ns a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from firmware_protocol.compiled import entry_of

_Float32s = npt.NDArray[np.float32]
Part = tuple[int, int, int, int]
"""Rows and columns of a light frame: first row, last row, first column, last column, the last ones not included."""

_REACH_SIGMAS = 3.5
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False, "fastmath": {"contract"}}
_entry = entry_of(__name__, error_model="python")
_blur_entry = entry_of(__name__, error_model="python", fastmath={"contract", "reassoc"})
_loop: Callable[[Callable[..., None]], Any] = njit(**_OPTIONS)  # counts no references, which would slow loops down
_STRIP = 48  # rows that are blurred together: they stay in the second-level cache


def gaussian_taps(sigma_px: float) -> _Float32s:
    """Return the shares of a Gaussian that fall on pixels -n to n, (2 n + 1,) float32, their sum 1."""
    n = max(1, math.ceil(_REACH_SIGMAS * sigma_px))
    edges = np.array([math.erf((k - 0.5) / (sigma_px * math.sqrt(2))) for k in range(-n, n + 2)])
    shares = np.diff(edges)
    return np.asarray(shares / shares.sum(), np.float32)


class Bilinear:
    """Positions between the pixels of a frame of `size` = (width, height), at columns and rows (height, width).

    Column 0.5 is the middle of the first pixel; positions beyond the frame are moved to its edge.
    """

    def __init__(self, columns: npt.NDArray[np.float64], rows: npt.NDArray[np.float64], size: tuple[int, int]) -> None:
        width, height = size
        x = np.clip(columns - 0.5, 0, width - 1)
        y = np.clip(rows - 0.5, 0, height - 1)
        x0, y0 = np.minimum(x.astype(np.int32), max(width - 2, 0)), np.minimum(y.astype(np.int32), max(height - 2, 0))
        self.first = np.asarray(y0 * width + x0, np.int32)
        self.along = np.asarray(x - x0, np.float32)
        self.down = np.asarray(y - y0, np.float32)
        self.width = width


def blur(picture: _Float32s, taps: _Float32s, rows: _Float32s, out: _Float32s, part: Part) -> None:
    """Write `picture`, (height, width), blurred into `out`, in `part`; `rows` is a third array for the rows' passes.

    The light must be valid within the taps' width around the part.
    """
    reach, height = taps.size // 2, picture.shape[0]
    first_row, last_row, first, last = part
    _blur_rows(picture, taps, (max(0, first_row - reach), min(height, last_row + reach), first, last), rows, 0)
    _blur_columns(rows, taps, part, out)


@_entry
def scale(picture: _Float32s, factor: _Float32s, part: Part, out: _Float32s) -> None:
    """Write picture * factor into `out`, all (height, width), in `part`."""
    first_row, last_row, first, last = part
    for y in range(first_row, last_row):
        row, by, to = picture[y, first:last], factor[y, first:last], out[y, first:last]
        for x in range(to.size):
            to[x] = row[x] * by[x]


@_entry
def _bend(
    picture: _Float32s, places: tuple[npt.NDArray[np.int32], _Float32s, _Float32s], width: int, out: _Float32s
) -> None:
    for row in range(out.shape[0]):
        first, along, down, to = places[0][row], places[1][row], places[2][row], out[row]
        for column in range(to.size):
            i, x, y = first[column], along[column], down[column]
            upper = picture[i] + x * (picture[i + 1] - picture[i])
            lower = picture[i + width] + x * (picture[i + width + 1] - picture[i + width])
            to[column] = upper + y * (lower - upper)


def bend(picture: _Float32s, places: Bilinear, out: _Float32s) -> None:
    """Look a contiguous `picture` up at `places` into `out`, both 2-D and at least 2 x 2 pixels."""
    _bend(picture.reshape(-1), (places.first, places.along, places.down), places.width, out)


@_blur_entry
def _blur_rows(picture: _Float32s, taps: _Float32s, part: Part, out: _Float32s, top: int) -> None:
    """Write the pass along rows of `part`, that of row y to row y - top."""
    width = picture.shape[1]
    reach = taps.size // 2
    first_row, last_row, left, right = part
    for y in range(first_row, last_row):
        row, to = picture[y], out[y - top]
        for x in range(left, right):
            to[x] = np.float32(0)
        for k in range(taps.size):
            tap, shift = taps[k], k - reach
            # Columns whose neighbour lies within the frame; beyond, the frame's edge is repeated.
            first = min(max(left, -shift), right)
            last = max(min(right, width - shift), first)
            for x in range(left, first):
                to[x] += tap * row[0]
            near, here = row[first + shift : last + shift], to[first:last]
            for x in range(last - first):
                here[x] += tap * near[x]
            for x in range(last, right):
                to[x] += tap * row[width - 1]


@_blur_entry
def _blur_columns(picture: _Float32s, taps: _Float32s, part: Part, out: _Float32s) -> None:
    height = picture.shape[0]
    reach = taps.size // 2
    first_row, last_row, left, right = part
    for y in range(first_row, last_row):
        to = out[y, left:right]
        for x in range(right - left):
            to[x] = np.float32(0)
        for k in range(taps.size):
            tap, row = taps[k], picture[min(max(y + k - reach, 0), height - 1), left:right]
            for x in range(right - left):
                to[x] += tap * row[x]


@_loop
def _add_four(
    taps: tuple[np.float32, np.float32, np.float32, np.float32],
    rows: tuple[_Float32s, _Float32s, _Float32s, _Float32s],
    out: _Float32s,
) -> None:
    """Add four weighted rows to `out`, in their order."""
    a, b, c, d = taps
    first, second, third, fourth = rows
    for x in range(out.size):
        out[x] = (((out[x] + a * first[x]) + b * second[x]) + c * third[x]) + d * fourth[x]


@_loop
def _blur_along(row: _Float32s, taps: _Float32s, columns: tuple[int, int], line: _Float32s, out: _Float32s) -> None:
    """Write the pass along a row; `line` is a work array for the row with its ends repeated."""
    first, last = columns
    reach, n = taps.size // 2, last - first
    before, after = max(reach - first, 0), max(last + reach - row.size, 0)
    whole = n + 2 * reach
    for x in range(before):
        line[x] = row[0]
    inner, near = line[before : whole - after], row[first - reach + before : last + reach - after]
    for x in range(inner.size):
        inner[x] = near[x]
    for x in range(whole - after, whole):
        line[x] = row[row.size - 1]
    out[:] = np.float32(0)
    for k in range(0, taps.size - 3, 4):
        four = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        _add_four(
            four, (line[k : k + n], line[k + 1 : k + 1 + n], line[k + 2 : k + 2 + n], line[k + 3 : k + 3 + n]), out
        )
    for k in range(taps.size // 4 * 4, taps.size):
        tap, shifted = taps[k], line[k : k + n]
        for x in range(n):
            out[x] += tap * shifted[x]


@_loop
def _blur_and_scale(
    picture: _Float32s, taps: _Float32s, factor: _Float32s, part: Part, strip: _Float32s, out: _Float32s
) -> None:
    height, reach, size = picture.shape[0], taps.size // 2, taps.size
    first_row, last_row, left, right = part
    n = right - left
    ends, line = strip[-1], strip[-2, :n]
    for begin in range(first_row, last_row, _STRIP):
        end = min(begin + _STRIP, last_row)
        top, bottom = max(0, begin - reach), min(height, end + reach) - 1
        for y in range(top, bottom + 1):
            _blur_along(picture[y], taps, (left, right), ends, strip[y - top, :n])
        for y in range(begin, end):
            above = y - reach
            line[:] = np.float32(0)
            for k in range(0, size - 3, 4):
                i, j = min(max(above + k, 0), height - 1) - top, min(max(above + k + 1, 0), height - 1) - top
                m, o = min(max(above + k + 2, 0), height - 1) - top, min(max(above + k + 3, 0), height - 1) - top
                four = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
                _add_four(four, (strip[i, :n], strip[j, :n], strip[m, :n], strip[o, :n]), line)
            for k in range(size // 4 * 4, size):
                tap, row = taps[k], strip[min(max(above + k, 0), height - 1) - top, :n]
                for x in range(n):
                    line[x] += tap * row[x]
            by, to = factor[y, left:right], out[y, left:right]
            for x in range(n):
                to[x] = line[x] * by[x]


@_entry
def blur_and_scale(
    picture: _Float32s, taps: _Float32s, factor: _Float32s, part: Part, strip: _Float32s, out: _Float32s
) -> None:
    """Write the result of `blur` followed by `scale`, to the last bit, in less than half of their time.

    Parameters
    ----------
    strip : of `strip_for`, overwritten.
    """
    _blur_and_scale(picture, taps, factor, part, strip, out)


def strip_for(width: int, taps: _Float32s) -> _Float32s:
    """Return a work array for the rows of `blur_and_scale`."""
    return np.zeros((_STRIP + taps.size + 1, width + taps.size), np.float32)

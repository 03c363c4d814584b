"""Kernels of light between two drawings: splines, flow around surfaces, and light and rate at an instant.

The law is that of `between`. A drawing has a spline through its light and the flow of what it shows:

    pixels --spline--> coefficients (height + 4, width + 4)      labels, flow --carry_into_sky--> flow everywhere

Fast because pixels are listed, without blocks that stay dark, and computed as vectors (`_move`): 25 ns a pixel on a
core with AVX-512, 65 ns one by one. A margin around the coefficients leaves no test in it.

Source of splines with their filter: Unser, IEEE Signal Processing Magazine 16 (6), 1999.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from emulator.light import Light
from emulator.sensor.numerics.columns import pick, put, take
from emulator.sensor.numerics.compiled import NONE, Real, kernel, lane, vector_kernel
from emulator.sensor.numerics.elementary import use_widest_vectors
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Bytes, Float32s, Int64s, UInt16s

_Part = tuple[int, int, int, int]  # first and last row, first and last column, the last ones not included

entry = entry_of("emulator.scene.moved_light", "emulator.sensor.numerics", _nrt=False)
"""Compile a function for calls from Python; it releases the GIL."""

CHUNK = 1024
"""Pixels that are computed together: their rows fit the first-level cache."""

# Rows of a thread's room: of each drawing light, rate, and whether it is inside.
_Row, _Column = 0, 1
_Before, _After = 2, 5
ROOM = 8 * CHUNK

BLOCK = 8  # pixels a side: a block without light in both drawings, and around, is dark in between
MARGIN = 2  # pixels around the coefficients of a spline, so that no place needs a test
_POLE = np.float32(math.sqrt(3.0) - 2.0)  # of the filter from pixels to coefficients
_SETTLED = 12  # pixels after which what the filter began with is below 1e-6
_FASTEST_PX_S, _FAR_PX = 1e7, np.float32(1e6)
_CUBIC_BELOW_PX, MOVED_ABOVE_PX = 1.0, 2.0  # motion a period: rates count wholly below, not at all above
_DARK = np.float32(1e-9)  # light, relative: no pixel sees it
_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR, _SIX = (np.float32(x) for x in (0, 0.5, 1, 2, 3, 4, 6))


class Drawing(NamedTuple):
    """A light frame with what moves it, for kernels.

    Attributes
    ----------
    light, rate : (height, width), exact.
    coefficients : (height + 4) * (width + 4) of the spline through the light, row by row, with a margin of two pixels.
    flow : (height * width * 2,) px/s, of each pixel to the right and down.
    """

    light: Float32s
    rate: Float32s
    coefficients: Float32s
    flow: Float32s

    @classmethod
    def of(cls, width: int, height: int) -> Drawing:
        """Return room for a drawing."""
        light, rate = np.zeros((2, height, width), np.float32)
        coefficients = np.zeros((height + 2 * MARGIN) * (width + 2 * MARGIN), np.float32)
        return cls(light, rate, coefficients, np.zeros(2 * height * width, np.float32))


class Pair(NamedTuple):
    """Two drawings, a period apart, for kernels.

    Attributes
    ----------
    before, after : the drawings.
    lacking : (2 * height * width,), e0 and e1 of `between`; empty where all pixels move too far.
    blocks : (rows, columns) of blocks, 1 where there may be light in between.
    period_s : time from one to the other.
    """

    before: Drawing
    after: Drawing
    lacking: Float32s
    blocks: Bytes
    period_s: float


@lane
def _settled(coefficient: Real) -> Real:
    """Return a coefficient, 0 where the filter's answer to light far away would go on in slow, denormal numbers."""
    return coefficient if abs(coefficient) > _DARK else _ZERO


@entry
def spline(light: Light, out: Float32s) -> None:
    """Write the coefficients of the cubic B-spline through the pixels, mirrored at the edges, with their margin."""
    height, width = light.shape
    for r in range(height):
        # Along a row: from the left, then back; 6 is the gain of both directions.
        at = r + MARGIN
        total, power = _ZERO, _ONE
        for k in range(min(_SETTLED, width)):
            total += power * light[r, k]
            power *= _POLE
        out[at, MARGIN] = _SIX * total
        for c in range(1, width):
            out[at, MARGIN + c] = _settled(_SIX * light[r, c] + _POLE * out[at, MARGIN + c - 1])
        last = MARGIN + width - 1
        out[at, last] = _POLE / (_POLE * _POLE - _ONE) * (out[at, last] + _POLE * out[at, last - 1])
        for c in range(last - 1, MARGIN - 1, -1):
            out[at, c] = _settled(_POLE * (out[at, c + 1] - out[at, c]))
    # Along columns the same, a row at a time: these loops are vectors.
    first, last = MARGIN, MARGIN + height - 1
    for c in range(out.shape[1]):
        total, power = _ZERO, _ONE
        for k in range(min(_SETTLED, height)):
            total += power * out[first + k, c]
            power *= _POLE
        out[first, c] = _SIX * total
    for r in range(first + 1, last + 1):
        for c in range(out.shape[1]):
            out[r, c] = _settled(_SIX * out[r, c] + _POLE * out[r - 1, c])
    for c in range(out.shape[1]):
        out[last, c] = _POLE / (_POLE * _POLE - _ONE) * (out[last, c] + _POLE * out[last - 1, c])
    for r in range(last - 1, first - 1, -1):
        for c in range(out.shape[1]):
            out[r, c] = _settled(_POLE * (out[r + 1, c] - out[r, c]))
    for r in range(first, last + 1):
        for k in range(1, MARGIN + 1):
            out[r, MARGIN - k] = out[r, MARGIN + k]
            out[r, MARGIN + width - 1 + k] = out[r, MARGIN + width - 1 - k]
    for k in range(1, MARGIN + 1):
        for c in range(out.shape[1]):
            out[first - k, c] = out[first + k, c]
            out[last + k, c] = out[last - k, c]


@lane
def _take_nearer(aways: Float32s, r: int, c: int, dr: int, dc: int, part: _Part, farthest: float) -> None:
    """Let a pixel's way to its nearest surface be that of a neighbour and the step to it, if that is shorter."""
    i, j = r + dr, c + dc
    if part[0] <= i < part[1] and part[2] <= j < part[3]:
        down, right = aways[i, j, 0] + np.float32(dr), aways[i, j, 1] + np.float32(dc)
        length = down * down + right * right
        if length < aways[r, c, 0] ** 2 + aways[r, c, 1] ** 2 and length <= farthest:
            aways[r, c, 0], aways[r, c, 1] = down, right


@entry
def carry_into_sky(labels: UInt16s, flow: Float32s, aways: Float32s, reach_px: float) -> None:
    """Give the sky within `reach_px` of a surface the flow of its nearest pixel.

    The ways to the nearest pixels are found in two sweeps over the frame (Danielsson, Computer Graphics and Image
    Processing 14, 1980).

    Parameters
    ----------
    labels : (height, width), 0 for the sky.
    aways : (height, width, 2), overwritten.
    """
    height, width = labels.shape
    farthest, reach = reach_px * reach_px, int(reach_px) + 1
    # The part of the frame with surfaces, and with the reach around them.
    top, bottom = height, 0
    left, right = width, 0
    for r in range(height):
        for c in range(width):
            if labels[r, c]:
                top, bottom = min(top, r), max(bottom, r + 1)
                left, right = min(left, c), max(right, c + 1)
    top, bottom = max(top - reach, 0), min(bottom + reach, height)
    left, right = max(left - reach, 0), min(right + reach, width)
    for r in range(top, bottom):
        for c in range(left, right):
            aways[r, c, 0] = aways[r, c, 1] = np.float32(0.0 if labels[r, c] else _FAR_PX)
    for sweep in range(2):
        step = 1 - 2 * sweep
        for k in range(bottom - top):
            r = top + k if sweep == 0 else bottom - 1 - k
            for m in range(right - left):
                c = left + m if sweep == 0 else right - 1 - m
                if labels[r, c] == 0:
                    for side in range(-1, 2):
                        _take_nearer(aways, r, c, -step, side, (top, bottom, left, right), farthest)
                    _take_nearer(aways, r, c, 0, -step, (top, bottom, left, right), farthest)
            for m in range(right - left):
                c = right - 1 - m if sweep == 0 else left + m
                if labels[r, c] == 0:
                    _take_nearer(aways, r, c, 0, step, (top, bottom, left, right), farthest)
    for r in range(top, bottom):
        for c in range(left, right):
            if labels[r, c] == 0 and aways[r, c, 0] < _FAR_PX:
                i, j = r + int(aways[r, c, 0]), c + int(aways[r, c, 1])
                flow[r, c, 0], flow[r, c, 1] = flow[i, j, 0], flow[i, j, 1]
    for r in range(height):
        for c in range(width):
            for axis in range(2):  # a point in the camera's own plane has no flow
                if not abs(flow[r, c, axis]) < _FASTEST_PX_S:
                    flow[r, c, axis] = _ZERO


@entry
def speeds(flow: Float32s, light: Light) -> tuple[float, float]:
    """Return the mean and the greatest speed of lit pixels, px/s."""
    total, count = 0.0, 0
    fastest2 = 0.0
    for r in range(light.shape[0]):
        for c in range(light.shape[1]):
            if light[r, c] > _ZERO:
                squared = flow[r, c, 0] ** 2 + flow[r, c, 1] ** 2
                if squared < _FASTEST_PX_S**2:  # see `carry_into_sky`
                    total += math.sqrt(squared)
                    fastest2 = max(fastest2, squared)
                    count += 1
    return total / max(count, 1), math.sqrt(fastest2)


@entry
def lit_blocks(light: Light, blocks: Bytes) -> None:
    """Write 1 for blocks with light, else 0."""
    for i in range(blocks.shape[0]):
        for j in range(blocks.shape[1]):
            blocks[i, j] = 0
            for r in range(i * BLOCK, min((i + 1) * BLOCK, light.shape[0])):
                for c in range(j * BLOCK, min((j + 1) * BLOCK, light.shape[1])):
                    if light[r, c] > _ZERO:
                        blocks[i, j] = 1


@lane
def _weights(t: Real) -> tuple[Real, Real, Real, Real]:
    """Return the weights of the four coefficients around a place, a share t behind the second."""
    left = _ONE - t
    before = (_FOUR - _THREE * t * t * (_TWO - t)) / _SIX
    after = (_FOUR - _THREE * left * left * (_TWO - left)) / _SIX
    return left * left * left / _SIX, before, after, t * t * t / _SIX


@lane
def _slopes(t: Real) -> tuple[Real, Real, Real, Real]:
    """Return the derivatives of `_weights`."""
    left = _ONE - t
    return -_HALF * left * left, _HALF * t * (_THREE * t - _FOUR), _HALF * left * (_FOUR - _THREE * left), _HALF * t * t


@lane
def _line(coefficients: Float32s, first: int, at: int, weights: Any, slopes: Any) -> tuple[Real, Real]:
    """Return the spline along a row of coefficients, and its derivative."""
    a, b = pick(coefficients, first, at), pick(coefficients, first + 1, at)
    c, d = pick(coefficients, first + 2, at), pick(coefficients, first + 3, at)
    value = weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d
    return value, slopes[0] * a + slopes[1] * b + slopes[2] * c + slopes[3] * d


@vector_kernel
def _move(drawing: Drawing, elapsed_s: Real, n: int, room: Float32s, to: int) -> None:
    """Write light, rate by motion, and 1 where the drawing has the place, of n pixels, to rows of `room` from `to`.

    A vector of pixels takes as many gathers as a pixel takes loads.
    """
    use_widest_vectors()
    flow, coefficients = drawing.flow, drawing.coefficients
    height, width = drawing.light.shape
    wide = width + 2 * MARGIN
    right, down = np.float32(width - 1), np.float32(height - 1)
    for k in range(n):
        row, column = take(room, _Row * CHUNK + k), take(room, _Column * CHUNK + k)
        # The place that moves to this pixel: by the flow at the pixel, then by the flow of the pixel at that place.
        at = np.int32(2) * (np.int32(row) * np.int32(width) + np.int32(column))
        x = min(max(column - pick(flow, 0, at) * elapsed_s, _ZERO), right)
        y = min(max(row - pick(flow, 1, at) * elapsed_s, _ZERO), down)
        at = np.int32(2) * (np.int32(y + _HALF) * np.int32(width) + np.int32(x + _HALF))
        vx, vy = pick(flow, 0, at), pick(flow, 1, at)
        x, y = column - vx * elapsed_s, row - vy * elapsed_s
        is_inside = (x >= -_HALF) & (x <= right + _HALF) & (y >= -_HALF) & (y <= down + _HALF)
        x, y = min(max(x, _ZERO), right), min(max(y, _ZERO), down)
        # The spline there and its gradient, from four rows and columns, the first one before the place.
        i, j = np.int32(y), np.int32(x)
        a, b = x - np.float32(j), y - np.float32(i)
        weights, slopes = _weights(a), _slopes(a)
        at = i * np.int32(wide) + j
        first = (MARGIN - 1) * (wide + 1)
        light0, along0 = _line(coefficients, first, at, weights, slopes)
        light1, along1 = _line(coefficients, first + wide, at, weights, slopes)
        light2, along2 = _line(coefficients, first + 2 * wide, at, weights, slopes)
        light3, along3 = _line(coefficients, first + 3 * wide, at, weights, slopes)
        w, s = _weights(b), _slopes(b)
        along = w[0] * along0 + w[1] * along1 + w[2] * along2 + w[3] * along3
        across = s[0] * light0 + s[1] * light1 + s[2] * light2 + s[3] * light3
        put(room, to * CHUNK + k, w[0] * light0 + w[1] * light1 + w[2] * light2 + w[3] * light3)
        put(room, (to + 1) * CHUNK + k, -vx * along - vy * across)
        put(room, (to + 2) * CHUNK + k, _ONE if is_inside else _ZERO)


@vector_kernel
def _weigh(pair: Pair, u: Real, n: int, room: Float32s) -> None:
    """Write light and rate of n pixels, a share u of the period after the first drawing, from both moved ones."""
    use_widest_vectors()
    period, width = np.float32(pair.period_s), pair.before.light.shape[1]
    left = _ONE - u
    has_lacking = pair.lacking.size > 0
    for k in range(n):
        light0, light1 = take(room, _Before * CHUNK + k), take(room, _After * CHUNK + k)
        rate0, rate1 = take(room, (_Before + 1) * CHUNK + k), take(room, (_After + 1) * CHUNK + k)
        is_in_0, is_in_1 = take(room, (_Before + 2) * CHUNK + k), take(room, (_After + 2) * CHUNK + k)
        is_in_both = is_in_0 == is_in_1  # or in none
        share = u if is_in_both else is_in_1
        light, rate = light0 + share * (light1 - light0), rate0 + share * (rate1 - rate0)
        rate += (light1 - light0) / period if is_in_both else _ZERO
        if has_lacking:
            row, column = take(room, _Row * CHUNK + k), take(room, _Column * CHUNK + k)
            at = np.int32(row) * np.int32(width) + np.int32(column)
            e0, e1 = pick(pair.lacking, 0, at), pick(pair.lacking, pair.before.light.size, at)
            light += period * u * left * (e0 * left - e1 * u)
            rate += e0 * left * (_ONE - _THREE * u) + e1 * u * (_THREE * u - _TWO)
        put(room, _Before * CHUNK + k, light if light > _DARK else _ZERO)
        put(room, (_Before + 1) * CHUNK + k, rate if light > _DARK else _ZERO)


@kernel
def _compute(pair: Pair, u: Real, n: int, room: Float32s) -> None:
    """Write light and rate of the n pixels in `room` to its rows _Before and the next."""
    period = np.float32(pair.period_s)
    _move(pair.before, u * period, n, room, _Before)
    _move(pair.after, (u - _ONE) * period, n, room, _After)
    _weigh(pair, u, n, room)


@kernel
def _write_out(n: int, room: Float32s, light: Light, rate: Float32s) -> None:
    """Write light and rate of the n pixels in `room` to their places."""
    for k in range(n):
        r, c = int(room[_Row * CHUNK + k]), int(room[_Column * CHUNK + k])
        light[r, c], rate[r, c] = room[_Before * CHUNK + k], room[(_Before + 1) * CHUNK + k]


@entry
def write_rows(pair: Pair, u: float, part: _Part, room: Float32s, light: Light, rate: Float32s) -> None:
    """Write light and rate, a share u of the period after the first drawing, in rows and columns of a part.

    `room` has ROOM values of one thread.
    """
    n: Any = NONE
    for r in range(part[0], part[1]):
        for c in range(part[2], part[3]):
            if pair.blocks[r // BLOCK, c // BLOCK]:
                room[_Row * CHUNK + n], room[_Column * CHUNK + n] = r, c
                n += 1
            else:
                light[r, c] = rate[r, c] = _ZERO
            if n == CHUNK:
                _compute(pair, np.float32(u), n, room)
                _write_out(n, room, light, rate)
                n = 0
    _compute(pair, np.float32(u), n, room)
    _write_out(n, room, light, rate)


@entry
def write_pixels(pair: Pair, u: float, pixels: Int64s, room: Float32s, light: Float32s, rate: Float32s) -> None:
    """Write light and rate of the pixels row * width + column."""
    width = pair.before.light.shape[1]
    for first in range(0, len(pixels), CHUNK):
        n = min(CHUNK, len(pixels) - first)
        for k in range(n):
            room[_Row * CHUNK + k] = pixels[first + k] // width
            room[_Column * CHUNK + k] = pixels[first + k] % width
        _compute(pair, np.float32(u), n, room)
        for k in range(n):
            r, c = pixels[first + k] // width, pixels[first + k] % width
            is_lit = pair.blocks[r // BLOCK, c // BLOCK]
            light[first + k] = room[_Before * CHUNK + k] if is_lit else _ZERO
            rate[first + k] = room[(_Before + 1) * CHUNK + k] if is_lit else _ZERO


@kernel
def _find_lacking(pair: Pair, n: int, room: Float32s, out: Float32s) -> None:
    """Write e0 and e1 of the n pixels in `room`."""
    height, width = pair.before.light.shape
    period = np.float32(pair.period_s)
    for end in range(2):
        exact = pair.before.rate if end == 0 else pair.after.rate
        _move(pair.before, np.float32(end) * period, n, room, _Before)
        _move(pair.after, np.float32(end - 1) * period, n, room, _After)
        this_row, other_row = (_Before, _After) if end == 0 else (_After, _Before)
        for k in range(n):
            r, c = int(room[_Row * CHUNK + k]), int(room[_Column * CHUNK + k])
            change = (room[_After * CHUNK + k] - room[_Before * CHUNK + k]) / period
            if room[(other_row + 2) * CHUNK + k] > _ZERO:
                lacks = exact[r, c] - room[(this_row + 1) * CHUNK + k] - change
                out[(end * height + r) * width + c] = lacks * _weight_of_rates(pair, r * width + c)


@lane
def _weight_of_rates(pair: Pair, pixel: int) -> Real:
    """Return the share at which the exact rates of a pixel count: by how little it moves in a period."""
    before, after = pair.before.flow, pair.after.flow
    squared = before[2 * pixel] ** 2 + before[2 * pixel + 1] ** 2
    squared = max(squared, after[2 * pixel] ** 2 + after[2 * pixel + 1] ** 2)
    weight = (MOVED_ABOVE_PX - math.sqrt(squared) * pair.period_s) / (MOVED_ABOVE_PX - _CUBIC_BELOW_PX)
    return np.float32(min(max(weight, 0.0), 1.0))


@entry
def write_lacking(pair: Pair, rows: tuple[int, int], room: Float32s, out: Float32s) -> None:
    """Write e0 and e1 of `between` in some rows, weighted; `out`, (2 * height * width,), has zeros."""
    width = pair.before.light.shape[1]
    n: Any = NONE
    for r in range(rows[0], rows[1]):
        for c in range(width):
            if pair.blocks[r // BLOCK, c // BLOCK] and _weight_of_rates(pair, r * width + c) > _ZERO:
                room[_Row * CHUNK + n], room[_Column * CHUNK + n] = r, c
                n += 1
            if n == CHUNK:
                _find_lacking(pair, n, room, out)
                n = 0
    _find_lacking(pair, n, room, out)

"""Kernels of light between two drawings: splines, flow around surfaces, and light and rate at an instant.

The law is that of `between`. A drawing has a spline through its light and the flow of what it shows:

    pixels --spline--> coefficients (height + 4, width + 4)      labels, flow --carry_into_sky--> flow everywhere

Two things make it fast: blocks of pixels that stay dark are left out, and a margin around the coefficients leaves no
test in the loops over rows and columns of a spline. A pixel takes 60 ns on a 3.5 GHz core, a tenth of its drawing.

Source of splines with their filter: Unser, IEEE Signal Processing Magazine 16 (6), 1999.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from emulator.light import Light
from emulator.sensor.numerics.compiled import Real, lane
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Bytes, Float32s, Int64s, UInt16s

_Part = tuple[int, int, int, int]  # first and last row, first and last column, the last ones not included

entry = entry_of("emulator.scene.moved_light", "emulator.sensor.numerics.compiled", _nrt=False)
"""Compile a function for calls from Python; it releases the GIL."""

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
    coefficients : (height + 4, width + 4), of the spline through the light, with a margin of two pixels.
    flow : (height, width, 2), px/s: columns to the right, rows down.
    """

    light: Float32s
    rate: Float32s
    coefficients: Float32s
    flow: Float32s

    @classmethod
    def of(cls, width: int, height: int) -> Drawing:
        """Return room for a drawing."""
        light, rate = np.zeros((2, height, width), np.float32)
        around = np.zeros((height + 2 * MARGIN, width + 2 * MARGIN), np.float32)
        return cls(light, rate, around, np.zeros((height, width, 2), np.float32))


class Pair(NamedTuple):
    """Two drawings, a period apart, for kernels.

    Attributes
    ----------
    before, after : the drawings.
    lacking : (2, height, width), e0 and e1 of the module; empty where all pixels move too far.
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
    top, bottom, left, right = height, 0, width, 0
    for r in range(height):
        for c in range(width):
            if labels[r, c]:
                top, bottom, left, right = min(top, r), max(bottom, r + 1), min(left, c), max(right, c + 1)
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
    total, most, count = 0.0, 0.0, 0
    for r in range(light.shape[0]):
        for c in range(light.shape[1]):
            if light[r, c] > _ZERO:
                squared = flow[r, c, 0] ** 2 + flow[r, c, 1] ** 2
                total += math.sqrt(squared)
                most = max(most, squared)
                count += 1
    return total / max(count, 1), math.sqrt(most)


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
    rest = _ONE - t
    before = (_FOUR - _THREE * t * t * (_TWO - t)) / _SIX
    after = (_FOUR - _THREE * rest * rest * (_TWO - rest)) / _SIX
    return rest * rest * rest / _SIX, before, after, t * t * t / _SIX


@lane
def _slopes(t: Real) -> tuple[Real, Real, Real, Real]:
    """Return the derivatives of `_weights`."""
    rest = _ONE - t
    return -_HALF * rest * rest, _HALF * t * (_THREE * t - _FOUR), _HALF * rest * (_FOUR - _THREE * rest), _HALF * t * t


@lane
def _flow_at(flow: Float32s, axis: int, i: int, j: int, a: Real, b: Real) -> Real:
    """Return the flow between pixels, shares a and b to the right of and below pixel (i, j), linear along both."""
    top = flow[i, j, axis] + a * (flow[i, j + 1, axis] - flow[i, j, axis])
    bottom = flow[i + 1, j, axis] + a * (flow[i + 1, j + 1, axis] - flow[i + 1, j, axis])
    return top + b * (bottom - top)


@lane
def _moved(drawing: Drawing, row: int, column: int, elapsed_s: Real) -> tuple[Real, Real, Any]:
    """Return light and rate at a pixel, of a drawing moved by its flow, and whether the drawing contains the place."""
    flow, coefficients = drawing.flow, drawing.coefficients
    right, down = np.float32(flow.shape[1] - 1), np.float32(flow.shape[0] - 1)
    # The place that moves to this pixel: by the flow at the pixel, then by the flow at that place.
    x = min(max(np.float32(column) - flow[row, column, 0] * elapsed_s, _ZERO), right)
    y = min(max(np.float32(row) - flow[row, column, 1] * elapsed_s, _ZERO), down)
    i, j = min(int(y), flow.shape[0] - 2), min(int(x), flow.shape[1] - 2)
    a, b = x - np.float32(j), y - np.float32(i)
    vx, vy = _flow_at(flow, 0, i, j, a, b), _flow_at(flow, 1, i, j, a, b)
    x, y = np.float32(column) - vx * elapsed_s, np.float32(row) - vy * elapsed_s
    is_inside = (x >= -_HALF) & (x <= right + _HALF) & (y >= -_HALF) & (y <= down + _HALF)
    x, y = min(max(x, _ZERO), right), min(max(y, _ZERO), down)
    # The spline there and its gradient, from four rows and columns, the first one before the place.
    i, j = int(y), int(x)
    a, b = x - np.float32(j), y - np.float32(i)
    wx, sx, wy, sy = _weights(a), _slopes(a), _weights(b), _slopes(b)
    value, along, across = _ZERO, _ZERO, _ZERO
    for k in range(4):
        at = i + k + 1
        p, q, s, t = coefficients[at, j + 1], coefficients[at, j + 2], coefficients[at, j + 3], coefficients[at, j + 4]
        line = wx[0] * p + wx[1] * q + wx[2] * s + wx[3] * t
        value += wy[k] * line
        along += wy[k] * (sx[0] * p + sx[1] * q + sx[2] * s + sx[3] * t)
        across += sy[k] * line
    return value, -vx * along - vy * across, is_inside


@lane
def _between(pair: Pair, row: int, column: int, u: Real) -> tuple[Real, Real]:
    """Return light and rate at a pixel, a share u of the period after the first drawing."""
    period = np.float32(pair.period_s)
    light0, rate0, is_in_0 = _moved(pair.before, row, column, u * period)
    light1, rate1, is_in_1 = _moved(pair.after, row, column, (u - _ONE) * period)
    if is_in_0 != is_in_1:
        return (light0, rate0) if is_in_0 else (light1, rate1)
    light, rate = light0 + u * (light1 - light0), rate0 + u * (rate1 - rate0) + (light1 - light0) / period
    if pair.lacking.shape[1]:
        e0, e1, rest = pair.lacking[0, row, column], pair.lacking[1, row, column], _ONE - u
        light += period * u * rest * (e0 * rest - e1 * u)
        rate += e0 * rest * (_ONE - _THREE * u) + e1 * u * (_THREE * u - _TWO)
    return light, rate


@entry
def write_rows(pair: Pair, u: float, part: _Part, light: Light, rate: Float32s) -> None:
    """Write light and rate, a share u of the period after the first drawing, in rows and columns of a part."""
    share = np.float32(u)
    for r in range(part[0], part[1]):
        for c in range(part[2], part[3]):
            if pair.blocks[r // BLOCK, c // BLOCK]:
                value, change = _between(pair, r, c, share)
                light[r, c], rate[r, c] = (value, change) if value > _DARK else (_ZERO, _ZERO)
            else:
                light[r, c] = rate[r, c] = _ZERO


@entry
def write_pixels(pair: Pair, u: float, pixels: Int64s, light: Float32s, rate: Float32s) -> None:
    """Write light and rate of the pixels row * width + column."""
    share, width = np.float32(u), pair.before.light.shape[1]
    for k in range(len(pixels)):
        r, c = pixels[k] // width, pixels[k] % width
        light[k] = rate[k] = _ZERO
        if pair.blocks[r // BLOCK, c // BLOCK]:
            value, change = _between(pair, r, c, share)
            if value > _DARK:
                light[k], rate[k] = value, change


@entry
def write_lacking(pair: Pair, rows: tuple[int, int], out: Float32s) -> None:
    """Write e0 and e1 of the module, (2, height, width), in some rows, weighted by how little a pixel moves."""
    period = np.float32(pair.period_s)
    for r in range(rows[0], rows[1]):
        for c in range(out.shape[2]):
            out[0, r, c] = out[1, r, c] = _ZERO
            before, after = pair.before.flow, pair.after.flow
            squared = max(before[r, c, 0] ** 2 + before[r, c, 1] ** 2, after[r, c, 0] ** 2 + after[r, c, 1] ** 2)
            moved_px = math.sqrt(squared) * pair.period_s
            if moved_px < MOVED_ABOVE_PX and pair.blocks[r // BLOCK, c // BLOCK]:
                weight = np.float32(min((MOVED_ABOVE_PX - moved_px) / (MOVED_ABOVE_PX - _CUBIC_BELOW_PX), 1.0))
                light0, rate0, _ = _moved(pair.before, r, c, _ZERO)
                light1, _, is_in_1 = _moved(pair.after, r, c, -period)
                if is_in_1:
                    out[0, r, c] = weight * (pair.before.rate[r, c] - rate0 - (light1 - light0) / period)
                light0, _, is_in_0 = _moved(pair.before, r, c, period)
                light1, rate1, _ = _moved(pair.after, r, c, _ZERO)
                if is_in_0:
                    out[1, r, c] = weight * (pair.after.rate[r, c] - rate1 - (light1 - light0) / period)

"""Bursts of noise events that are under way when a sensor starts: as many as there are at any time in still light."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.keyed import Purpose, uniform, words

__all__ = ["under_way"]

_MOST_BURSTS = 16  # of a pixel
_DRAWS = 2 * _MOST_BURSTS + 1

_Float32s = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]


def _nodes(light: _Float32s, lights: _Float32s) -> _Floats:
    """Return the place of each light among the nodes of the table."""
    dark, at_reference, least, most, a_fold, last = lights.astype(np.float64)
    hz = np.clip(at_reference * (np.maximum(light, 0) + dark), least, most)
    return np.asarray(np.clip(np.log(hz / least) * a_fold, 0, last))


def _rates_hz(table: _Float32s, row: _Float32s, node: _Floats) -> _Floats:
    """Return the primaries' rates, by bilinear interpolation."""
    i, j = row.astype(np.int64), node.astype(np.int64)
    y, x = row - i, node - j
    upper = table[i, j] * (1 - x) + table[i, j + 1] * x
    lower = table[i + 1, j] * (1 - x) + table[i + 1, j + 1] * x
    return np.asarray(np.exp(upper * (1 - y) + lower * y))


def _poisson(draw: _Floats, mean: _Floats) -> npt.NDArray[np.int64]:
    """Return the numbers that have these means, at most `_MOST_BURSTS`, from uniform ones."""
    term = np.exp(-mean)
    below, number = term.copy(), np.zeros(mean.size, np.int64)
    for k in range(1, _MOST_BURSTS + 1):
        number += draw > below
        term = term * mean / k
        below += term
    return number


def under_way(
    light: _Float32s, row: _Float32s, tables: tuple[_Float32s, _Float32s], seed: int, slot: tuple[int, int]
) -> npt.NDArray[np.int64]:
    """Return the next events of bursts under way at the start of a slot, (3, n) int64 as `soon` of `draws`.

    Parameters
    ----------
    light : (pixels,), first light; not finite: no burst.
    row : (pixels,), row of the table by threshold; NaN: no burst.
    tables : table and lights, see `draws`.
    slot : its number and its first time, ns.
    """
    pixel = np.flatnonzero(np.isfinite(light) & np.isfinite(row))
    table, lights = tables
    node = _nodes(light[pixel], lights)
    nearest = (node + 0.5).astype(np.int64)
    again, wait_ns = (table[k, nearest].astype(np.float64) for k in (-2, -1))
    expected = _rates_hz(table, row[pixel], node) * wait_ns * 1e-9 * again / (1 - again)
    first = _DRAWS * slot[0]
    bursts = _poisson(uniform(seed, Purpose.NOISE_BURST, pixel, first), expected)
    draw = np.arange(bursts.sum()) - np.repeat(np.cumsum(bursts) - bursts, bursts)
    pixel, wait_ns = np.repeat(pixel, bursts), np.repeat(wait_ns, bursts)
    bits = words(seed, Purpose.NOISE_BURST, pixel, first + 2 * draw + 1)
    wait_ns = -wait_ns * np.log(uniform(seed, Purpose.NOISE_BURST, pixel, first + 2 * draw + 2))
    on = (bits >> np.uint64(20)).astype(np.int64) & 1
    return np.stack([slot[1] + wait_ns.astype(np.int64), pixel << 1 | on, bits.view(np.int64)])

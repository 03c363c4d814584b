"""Rates at which noise takes a pixel over its thresholds from the level that its last event left: first passages.

The noise is a voltage with one pole (see `law`), in units of its deviation. A pixel's thresholds lie `above` and
`below` the mean of its noise, which is the signal. Their sum is given by the thresholds; their difference is twice the
level that the last event left, less the signal. A level near the signal makes passages rare; a signal that stopped near
a threshold, or a start at a random phase of the leak, makes them many times more frequent, until the events have moved
the level.

The mean time T to the first passage and its side follow from the exact law, with the voltage starting at the level.
The two rates, P(ON) / T and P(OFF) / T, over 1 / tau, are tabled over (above, below). Their logarithm is near to
-above^2 / 2, so that linear interpolation between nodes a quarter of a deviation apart is within 1 %.

`python -m emulator.sensor.noise.passages` writes the table.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.law import exits
from emulator.sensor.numerics.compiled import kernel

FIRST, STEP, NODES = -4.0, 0.25, 65
"""Nodes of the table, in deviations: -4 to 12. Farther thresholds count as the last ones."""

TABLE = Path(__file__).with_name("data") / "passages.npy"
"""(2, NODES, NODES) float32: ln of the ON and the OFF rate times tau, over (above, below)."""

_LEAST_HALF = 0.125  # half the distance of the thresholds where the table begins
_LEAST_SHARE = 1e-300

_Floats = npt.NDArray[np.float64]
_Float32s = npt.NDArray[np.float32]


def passage_rates(above: npt.ArrayLike, below: npt.ArrayLike) -> tuple[_Floats, _Floats]:
    """Return the ON and the OFF rate times tau, by the exact law; arguments in deviations, of one shape.

    The voltage starts in the middle between the thresholds, which is the level where these are equal.
    """
    up, down = (np.atleast_1d(np.asarray(distance, np.float64)) for distance in (above, below))
    half, level = np.maximum((up + down) / 2, _LEAST_HALF), (up - down) / 2
    on, off = np.empty(half.shape), np.empty(half.shape)
    for threshold in map(float, np.unique(half)):
        same = half == threshold
        p_on, wait = exits(level[same], threshold, threshold)
        on[same], off[same] = p_on / wait, exits(-level[same], threshold, threshold)[0] / wait
    return on, off


def write_table(path: Path = TABLE) -> None:
    """Compute the table and write it."""
    nodes = FIRST + STEP * np.arange(NODES)
    up, down = (axis.reshape(-1) for axis in np.meshgrid(nodes, nodes, indexing="ij"))
    rates = np.stack(passage_rates(up, down)).reshape(2, NODES, NODES)
    np.save(path, np.log(np.maximum(rates, _LEAST_SHARE)).astype(np.float32))


@functools.cache
def passage_table() -> _Float32s:
    """Return the table."""
    return np.asarray(np.load(TABLE))


_LAST = NODES - 1.001
_ONE = np.uint64(1)


@kernel
def _node(distance: float) -> float:
    """Return the place of a distance among the nodes."""
    return min(max((distance - FIRST) / STEP, 0.0), _LAST)


@kernel
def rates_between(above: float, below: float, table: _Float32s) -> tuple[float, float]:
    """Return the ON and the OFF rate times tau, by interpolation."""
    x, y = _node(above), _node(below)
    i, j = np.uint64(np.int64(x)), np.uint64(np.int64(y))
    s, t = x - np.float64(i), y - np.float64(j)
    on = (table[0, i, j] * (1 - t) + table[0, i, j + _ONE] * t) * (1 - s)
    on += (table[0, i + _ONE, j] * (1 - t) + table[0, i + _ONE, j + _ONE] * t) * s
    off = (table[1, i, j] * (1 - t) + table[1, i, j + _ONE] * t) * (1 - s)
    off += (table[1, i + _ONE, j] * (1 - t) + table[1, i + _ONE, j + _ONE] * t) * s
    return np.exp(on), np.exp(off)


if __name__ == "__main__":
    write_table()

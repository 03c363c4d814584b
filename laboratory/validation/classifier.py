"""A classifier between a recording and the simulated sensor: gradient boosting, and the area under its ROC curve.

A sample is a tile of pixels or a single event, with some quantities. The classifier learns from four bands of the
chip's rows and is judged by the fifth, five times: no tile is in both. An area is the mean of the five: 0.5 where it
cannot separate the two, 1 where it always can. The classifier is scikit-learn's `HistGradientBoostingClassifier`, which
takes quantities that have no value, such as the intervals of a tile with one event, as they are.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from emulator.light import MachineLacks
from firmware_protocol.events import Events, Float32s, Floats, Int64s, Mask
from transports.needs import install_command

QUANTITIES = (
    "events a pixel",
    "ON share",
    "share of pixels with an event",
    "largest count of a pixel",
    "mean interval of a pixel, s",
    "shortest interval of a pixel, s",
    "variation of the intervals of a pixel",
    "share of intervals between opposite polarities",
    "Fano factor",
    "share of events beside one of a neighbour",
    "variation of the intervals of the tile",
)
"""Quantities of a tile; a variation is a standard deviation over its mean."""

ORDER = tuple(k for k, name in enumerate(QUANTITIES) if "interval" in name or "neighbour" in name)
"""Those of them that do not show the rate and the ON share by themselves."""

_WINDOWS = 12  # of the Fano factor
_NEAR_US = 10_000.0
_BANDS = 5

_Ints = Int64s
_Bools = Mask


@dataclass(frozen=True)
class Samples:
    """Samples of one origin.

    Attributes
    ----------
    values : (n, quantities) float32; NaN: a quantity without a value.
    rows, columns : (n,) int64, places on the chip, in tiles or in pixels.
    """

    values: Float32s
    rows: _Ints
    columns: _Ints

    def where(self, chosen: _Bools) -> Samples:
        """Return the samples for which `chosen`, (n,), is true."""
        return Samples(self.values[chosen], self.rows[chosen], self.columns[chosen])

    def of(self, quantities: tuple[int, ...]) -> Samples:
        """Return the samples with some of the quantities."""
        return Samples(self.values[:, quantities], self.rows, self.columns)

    def alternating(self) -> tuple[Samples, Samples]:
        """Return two halves whose places alternate like the fields of a chessboard."""
        even = (self.rows + self.columns) % 2 == 0
        return self.where(even), self.where(~even)

    def sides(self, width: float) -> tuple[Samples, Samples]:
        """Return the left and the right half of a chip of that width, in the unit of `columns`."""
        left = self.columns < width / 2
        return self.where(left), self.where(~left)


def tiles(events: Events, chosen: _Bools, side: int, seconds: float, least_share: float) -> Samples:
    """Return the `QUANTITIES` of the square tiles of which `least_share` of the pixels are chosen.

    Parameters
    ----------
    events : (n,) EVENT, their times from the start of the recording on.
    chosen : (height, width) bool, the pixels that count.
    side : side of a tile, pixels; pixels beside the last whole tile are left out.
    """
    high, wide = (pixels // side for pixels in chosen.shape)
    inside = chosen[: high * side, : wide * side]
    pixels = inside.reshape(high, side, wide, side).sum(axis=(1, 3)).reshape(-1)
    events = events[(events["y"] < high * side) & (events["x"] < wide * side)]
    events = events[inside[events["y"], events["x"]]]
    values = _quantities(events, wide, side, pixels, seconds)
    rows, columns = np.divmod(np.arange(high * wide), wide)
    return Samples(values.astype(np.float32), rows, columns).where(pixels >= least_share * side**2)


def _quantities(events: Events, wide: int, side: int, pixels: _Ints, seconds: float) -> Floats:
    """Return the `QUANTITIES` of all tiles, (tiles, quantities), from the events of chosen pixels."""
    pixel = events["y"].astype(np.int64) * (wide * side) + events["x"]
    order = np.lexsort([events["t"], pixel])
    events, pixel = events[order], pixel[order]
    t_s = events["t"].astype(np.float64) * 1e-6
    tile = events["y"].astype(np.int64) // side * wide + events["x"] // side
    counts = np.bincount(tile, minlength=pixels.size)

    firing, firing_counts = np.unique(pixel, return_counts=True)
    firing_tile = firing // (wide * side) // side * wide + firing % (wide * side) // side
    largest = np.zeros(pixels.size)
    np.maximum.at(largest, firing_tile, firing_counts)

    same = np.diff(pixel) == 0
    waits, waiting_tile = np.diff(t_s)[same], tile[1:][same]
    opposite = (events["on"][1:] != events["on"][:-1])[same]
    shortest = np.full(pixels.size, np.nan)
    np.fmin.at(shortest, waiting_tile, waits)

    window = np.minimum(t_s / seconds * _WINDOWS, _WINDOWS - 1).astype(np.int64)
    in_windows = np.bincount(tile * _WINDOWS + window, minlength=pixels.size * _WINDOWS).reshape(-1, _WINDOWS)
    in_order = np.lexsort([t_s, tile])
    follows = np.diff(tile[in_order]) == 0
    gaps, gap_tile = np.diff(t_s[in_order])[follows], tile[in_order][1:][follows]
    with np.errstate(invalid="ignore", divide="ignore"):
        columns = [
            counts / pixels,
            _mean(tile, events["on"], pixels.size),
            np.bincount(firing_tile, minlength=pixels.size) / pixels,
            largest,
            _mean(waiting_tile, waits, pixels.size),
            shortest,
            _variation(waiting_tile, waits, pixels.size),
            _mean(waiting_tile, opposite, pixels.size),
            in_windows.var(axis=1) / in_windows.mean(axis=1),
            _mean(tile, _beside(events, pixel), pixels.size),
            _variation(gap_tile, gaps, pixels.size),
        ]
    return np.column_stack(columns)


def _mean(tile: _Ints, values: npt.NDArray[Any], size: int) -> Floats:
    """Return the mean of the values of each tile; NaN without any."""
    sums = np.bincount(tile, values.astype(np.float64), size)
    return np.asarray(sums / np.bincount(tile, minlength=size))


def _variation(tile: _Ints, values: Floats, size: int) -> Floats:
    """Return the standard deviation over the mean of the values of each tile."""
    mean = _mean(tile, values, size)
    return np.asarray(np.sqrt(np.maximum(_mean(tile, values**2, size) - mean**2, 0)) / mean)


def _beside(events: Events, pixel: _Ints) -> _Bools:
    """Return for each event whether one of its eight neighbours fires within `_NEAR_US`."""
    places = np.column_stack([events["x"], events["y"], events["t"] / _NEAR_US])
    pairs = cKDTree(places).query_pairs(1.0, p=np.inf, output_type="ndarray")
    found = np.zeros(len(events), np.bool_)
    found[pairs[pixel[pairs[:, 0]] != pixel[pairs[:, 1]]].reshape(-1)] = True
    return found


def area(first: Samples, second: Samples) -> float:
    """Return the area under the ROC curve of a classifier between two origins, in bands that it has not learned from.

    Raises MachineLacks where scikit-learn is not installed.
    """
    return _area(*_joined(first, second))


def _joined(first: Samples, second: Samples) -> tuple[Float32s, _Ints, _Ints]:
    """Return the values of all samples, their origins 0 or 1, and their bands of rows, with as many samples each."""
    rows = np.concatenate([first.rows, second.rows])
    edges = np.quantile(rows, np.arange(1, _BANDS) / _BANDS)
    origins = np.repeat([0, 1], [len(first.rows), len(second.rows)])
    return np.concatenate([first.values, second.values]), origins, np.searchsorted(edges, rows)


def _area(values: Float32s, origins: _Ints, bands: _Ints) -> float:
    """Return the mean area over the bands that have samples of both origins."""
    try:
        ensemble, metrics, threads = (
            importlib.import_module(name) for name in ("sklearn.ensemble", "sklearn.metrics", "threadpoolctl")
        )
    except ImportError as error:
        raise MachineLacks(f"the classifier needs scikit-learn:  {install_command('validate')}") from error
    areas = []
    # Threads that wait for each other in these short loops take many times as long on a busy machine.
    with threads.threadpool_limits(limits=1):
        for band in np.unique(bands):
            judged = bands == band
            if len(np.unique(origins[judged])) < 2:
                continue
            known = np.isfinite(values[~judged]).any(axis=0)  # it cannot learn from a quantity without any value
            boosting = ensemble.HistGradientBoostingClassifier(
                max_iter=100, learning_rate=0.05, max_leaf_nodes=8, random_state=1
            ).fit(values[~judged][:, known], origins[~judged])
            chances = boosting.predict_proba(values[judged][:, known])[:, 1]
            areas.append(metrics.roc_auc_score(origins[judged], chances))
    return float(np.mean(areas)) if areas else float("nan")

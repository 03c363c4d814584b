"""Events as arrays that networks take: counts, voxel grids and time surfaces, and events in the layout of tonic.

`size` is (width, height) of the sensor. All arrays are contiguous, so `torch.from_numpy` takes them without a copy. The
first axis of counts and surfaces is the polarity, OFF and ON.

Sources: voxel grids by Zhu et al., Unsupervised event-based learning of optical flow, depth, and egomotion, CVPR 2019;
time surfaces by Lagorce et al., HOTS, IEEE TPAMI 39 (2017).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.bounds import whole_number
from firmware_protocol.events import Events

TONIC = np.dtype([("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")])
"""The layout of tonic's structured arrays: t in us, p True for ON."""


def to_tonic(events: Events) -> npt.NDArray[np.void]:
    """Return events, (n,) EVENT, as (n,) TONIC; tonic's `sensor_size` is then (width, height, 2)."""
    out = np.empty(len(events), TONIC)
    for name, field in (("x", "x"), ("y", "y"), ("t", "t"), ("p", "on")):
        out[name] = events[field]
    return out


def event_frame(events: Events, size: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return the number of events of each pixel, (2, height, width)."""
    width, height = size
    return np.bincount(_cells(events, size), minlength=2 * width * height).reshape(2, height, width)


def voxel_grid(
    events: Events,
    size: tuple[int, int],
    bins: int,
    *,
    begin_us: int | None = None,
    end_us: int | None = None,
    normalised: bool = False,
) -> npt.NDArray[np.float32]:
    """Return polarities, +1 and -1, summed in bins of time with bilinear weights, (bins, height, width).

    An event at t adds max(0, 1 - |k - s|) of its polarity to bin k, with s = (bins - 1) (t - begin) / (end - begin).

    Parameters
    ----------
    bins : number of bins, at least 2.
    begin_us, end_us : times of the first and of the last bin; by default those of the first and of the last event.
        Events outside are left out.
    normalised : True: the mean of the entries that are not 0 is then 0, and their standard deviation 1.
    """
    if bins < 2:
        raise ValueError(f"bins = {bins}: a voxel grid has at least 2")
    width, height = size
    t_us = events["t"].astype(np.float64)
    begin = t_us[:1].sum() if begin_us is None else float(whole_number("begin_us", begin_us))
    end = t_us[-1:].sum() if end_us is None else float(whole_number("end_us", end_us))
    place = (t_us - begin) * ((bins - 1) / max(end - begin, 1e-9))
    inside = (place >= 0) & (place <= bins - 1)
    place, pixels = place[inside], (_cells(events, size) % (width * height))[inside]
    polarity = np.where(events["on"][inside], 1.0, -1.0)
    lower = np.minimum(place.astype(np.int64), bins - 2)
    share, first = place - lower, lower * (width * height) + pixels
    cells = bins * width * height
    grid = np.bincount(first, polarity * (1 - share), cells)
    grid += np.bincount(first + width * height, polarity * share, cells)
    if normalised and (filled := grid != 0).any():
        values = grid[filled]
        grid[filled] = (values - values.mean()) / (values.std() or 1.0)
    return grid.reshape(bins, height, width).astype(np.float32)


def time_surface(
    events: Events, size: tuple[int, int], tau_us: float, t_us: int | None = None
) -> npt.NDArray[np.float32]:
    """Return e^(-(t - last) / tau) for the last event of each pixel up to `t_us`, (2, height, width); 0 without one.

    By default `t_us` is the time of the last event.
    """
    if isinstance(tau_us, bool) or not tau_us >= 1:
        raise ValueError(f"tau_us = {tau_us}: it must be at least 1, as event times, in microseconds")
    width, height = size
    now_us = int(events["t"][-1:].sum()) if t_us is None else whole_number("t_us", t_us)
    events = events[: int(np.searchsorted(events["t"], np.uint64(max(now_us, 0)), "right"))]
    last_us = np.full(2 * width * height, -np.inf)
    last_us[_cells(events, size)] = events["t"]  # of several events of a cell the last one stays
    return np.exp((last_us - now_us) / tau_us).reshape(2, height, width).astype(np.float32)


def _cells(events: Events, size: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return the index of each event in (2, height, width); raises ValueError for events beyond the sensor."""
    width, height = size
    x, y = events["x"].astype(np.int64), events["y"].astype(np.int64)
    if len(events) and (x.max() >= width or y.max() >= height):
        raise ValueError(f"an event at ({x.max()}, {y.max()}) lies beyond a sensor of {width} x {height} pixels")
    return np.asarray((events["on"] * height + y) * width + x)

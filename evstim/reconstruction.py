"""The picture that events tell: start with a known picture and add a threshold for each event."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.accuracy import metrics
from emulator.accuracy.stream import Stream
from firmware_protocol.events import Events

__all__ = ["reconstruct"]


def reconstruct(
    events: Events,
    log_light: npt.ArrayLike,
    *,
    threshold_on: npt.ArrayLike,
    threshold_off: npt.ArrayLike,
    t_us: float = np.inf,
) -> npt.NDArray[np.float64]:
    """Return the logarithm of light that the events up to `t_us` tell, (height, width).

    Parameters
    ----------
    events : (n,) EVENT.
    log_light : (height, width), natural logarithm of the light before the first event.
    threshold_on, threshold_off : contrast thresholds, natural-log units; one number, or (height, width).
    t_us : time up to which events count, us.

    Raises
    ------
    ValueError
        An event lies outside the picture, or a shape does not fit.
    """
    start = np.asarray(log_light, np.float64)
    if start.ndim != 2:
        raise ValueError(f"log_light has the shape {start.shape}: (height, width) is needed")
    height, width = start.shape
    if len(events) and (events["x"].max() >= width or events["y"].max() >= height):
        raise ValueError(f"there are events outside the {width} x {height} picture")
    on, off = (np.broadcast_to(np.asarray(t, np.float64), start.shape).ravel() for t in (threshold_on, threshold_off))
    stream = Stream.from_events(events, width, height)
    return metrics.reconstruct(stream, on, off, start.ravel(), t_us).reshape(start.shape)

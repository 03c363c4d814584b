"""Light whose logarithm goes up and down on straight lines, and what its events tell of thresholds.

Events of one pixel on one line are threshold / slope + refractory period apart.
"""

import numpy as np

__all__ = ["FRAMES_PER_S", "apart_us", "expected_us", "save_frames"]

FRAMES_PER_S = 2.0
RISE = 4.0
_FEWEST = 500


def save_frames(path, width, height, region):
    """Write the frames of the light in a region (width, height) of the array, the rest dark and still."""
    frames = np.full((3, height, width), 1e-3, np.float32)
    frames[:, : region[1], : region[0]] = np.exp([0.0, RISE, 0.0])[:, None, None]
    np.save(path, frames)


def apart_us(events, *, on):
    """Return the median time between events of one pixel on one line, as often as a polarity repeats."""
    ordered = events[np.lexsort((events["t"], events["x"], events["y"]))]
    same = (ordered["x"][1:] == ordered["x"][:-1]) & (ordered["y"][1:] == ordered["y"][:-1])
    same &= (ordered["on"][1:] == on) & (ordered["on"][:-1] == on)
    between_us = np.diff(ordered["t"].astype(np.int64))[same]
    assert len(between_us) > _FEWEST
    return float(np.median(between_us))


def expected_us(threshold, refractory_us):
    """Return the same in closed form."""
    return 1e6 * threshold / (RISE * FRAMES_PER_S) + refractory_us

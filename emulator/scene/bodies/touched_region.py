"""The part of a picture that bodies can reach: where the boxes around them are seen.

The box has its sides along the body's own axes. While all of its corners are before the camera, what is in the box is
seen between the corners; with corners before and behind, it may be anywhere.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.gl.render_target import Rectangle

__all__ = ["box_corners", "reach"]

_BLACK = Rectangle(0, 0, 1, 1)
_ROUNDING_PX = 1  # what float32 and GL's rounding may add

Floats = npt.NDArray[np.float64]


def box_corners(points: Floats) -> Floats:
    """Return the corners, (8, 3), of the box around points, (n, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    return np.asarray([np.where([k & 1, k & 2, k & 4], high, low) for k in range(8)])


def reach(boxes: Iterable[Floats], pinhole: Pinhole) -> Rectangle:
    """Return a rectangle around all that is seen of `boxes`, each the corners of one, (8, 3), in the camera's axes."""
    whole = Rectangle(0, 0, *pinhole.size)
    before = [corners for corners in boxes if (corners[:, 2] > 0).any()]
    if not before:
        return _BLACK
    corners = np.concatenate(before)
    if (corners[:, 2] <= 0).any():
        return whole
    size = np.array(pinhole.size)
    with np.errstate(over="ignore"):
        seen = pinhole.focal_px * corners[:, :2] / corners[:, 2:] + size / 2
    first = np.clip(np.floor(seen.min(axis=0)) - _ROUNDING_PX, 0, size - 1).astype(int)
    last = np.clip(np.ceil(seen.max(axis=0)) + _ROUNDING_PX, first + 1, size).astype(int)
    return Rectangle(*map(int, first), *map(int, last - first))

"""Compiled loop that brings points of moving bodies into the camera's axes, with their velocities."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.compiled import entry

__all__ = ["move"]

Floats = npt.NDArray[np.float64]


@entry
def move(points: Floats, turns: Floats, shifts: Floats, scale: float, first: int, out: tuple[Floats, Floats]) -> int:
    """Write places and velocities from row `first` on; return the row after the last.

    Parameters
    ----------
    points : (n, 3) m, fixed in a frame, or (n, 6) with velocities in it, m/s.
    turns, shifts : (2, 3, 3) and (2, 3), camera from frame, m, and their rates, a second.
    scale : of what is written.
    out : (rows, 3) m and (rows, 3) m/s.
    """
    places, velocities = out
    drifts = points.shape[1] == 6
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        for j in range(3):
            a, b, c = turns[0, j, 0], turns[0, j, 1], turns[0, j, 2]
            speed = turns[1, j, 0] * x + turns[1, j, 1] * y + turns[1, j, 2] * z + shifts[1, j]
            if drifts:
                speed += a * points[k, 3] + b * points[k, 4] + c * points[k, 5]
            places[first + k, j] = scale * (a * x + b * y + c * z + shifts[0, j])
            velocities[first + k, j] = scale * speed
    return first + len(points)

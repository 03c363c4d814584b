"""The record of what the elements of an IMU feel, before its filter and its converter.

t            u64     stream time, us
index        u64     number of the sample since time zero, at the unit's own rate of about 1 kHz
force        3 f64   specific force along x, y, z of the unit, m/s2: acceleration less gravity, so zero in free fall
rate         3 f64   angular rate about them, rad/s
temperature  f64     degrees Celsius
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["IMU_MOTION", "ImuMotion", "no_motion"]

IMU_MOTION = np.dtype([("t", "<u8"), ("index", "<u8"), ("force", "<f8", 3), ("rate", "<f8", 3), ("temperature", "<f8")])

ImuMotion = npt.NDArray[np.void]
"""An array of IMU_MOTION records, shape (n,), sorted by t."""


def no_motion(n: int = 0) -> ImuMotion:
    """Return an array of `n` zeroed records."""
    return np.zeros(n, IMU_MOTION)

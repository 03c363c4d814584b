"""Frames one after the other as one array, within a bound of memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import SceneError

__all__ = ["MOST_BYTES", "Levels", "stacked"]

MOST_BYTES = 1 << 31
"""Of all frames together."""

Levels = npt.NDArray[Any]


def stacked(frames: Iterator[tuple[str, Levels]]) -> Levels:
    """Return all frames as one array; raises SceneError where they are not alike, too large, or none."""
    kept: list[Levels] = []
    room = MOST_BYTES
    for name, levels in frames:
        if kept and (levels.shape != kept[0].shape or levels.dtype != kept[0].dtype):
            raise SceneError(
                f"{name} is {levels.shape[1]} x {levels.shape[0]} {levels.dtype}, the first frame "
                f"{kept[0].shape[1]} x {kept[0].shape[0]} {kept[0].dtype}: all must be alike"
            )
        room -= levels.nbytes
        if room < 0:
            raise SceneError(f"more than {MOST_BYTES >> 30} GiB of frames; cut it or make it smaller")
        kept.append(levels)
    if not kept:
        raise SceneError("holds no frames")
    return np.stack(kept)

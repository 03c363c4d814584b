"""Frames of a video by PyAV (FFmpeg); for a child process, see `foreign_file`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt

from emulator.light import SceneError
from emulator.scene.video.stacking import Levels, stacked
from emulator.tables.text_file import shortened

__all__ = ["read_video"]


def read_video(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `levels` (n, height, width), and `times_s` (n,) from 0, empty where the file gives none that increase."""
    times: list[float] = []

    def frames() -> Iterator[tuple[str, Levels]]:
        with av.open(str(path)) as container:
            for k, frame in enumerate(container.decode(video=0)):
                times.append(float(frame.time) if frame.time is not None else float("nan"))
                yield f"frame {k}", frame.to_ndarray(format="gray")

    try:
        levels = stacked(frames())
    except (MemoryError, SceneError):
        raise
    except Exception as error:  # FFmpeg's own errors, and what PyAV runs into
        raise SceneError(f"frame {len(times)} cannot be read: {shortened(error)}") from error
    has_times = len(times) > 1 and bool(np.all(np.diff(times) > 0))
    return {"levels": levels, "times_s": np.array(times) - times[0] if has_times else np.zeros(0)}

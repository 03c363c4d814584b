"""Frames of a video or of a sequence of images, read whole, as linear light.

    a folder                 its images in the order of their names, each of any format that pillow reads
    .npy                     an array (frames, height, width): uint8 and uint16 are levels, floats are linear light
    .gif .tif .png .webp     the frames of one file, by pillow
    .mp4 .mkv .avi .mov      by PyAV (`pip install '.[files]'`), with the times that the file gives

Pillow and PyAV read in a child process, see `foreign_file`.
Colours become luminance (Rec. 709). Levels are taken from 0 to 1 and decoded by the sRGB curve unless told to be
linear.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import SceneError
from emulator.scene.foreign_file import Limits, read_in_child
from emulator.scene.video.stacking import MOST_BYTES
from transports.recording.array_file import ArrayFileError, load_array

__all__ = ["VIDEO_SUFFIXES", "Frames", "linear_light", "read_frames"]

_LIMITS = Limits(memory_bytes=3 * MOST_BYTES, cpu_s=600)  # a video of one MiB may well hold a GiB of frames
VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v")

Levels = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames as they were stored.

    Attributes
    ----------
    levels : (n, height, width) uint8, uint16 or float32; floats are linear light.
    times_s : (n,) from the file, first 0; None where it gives none.
    """

    levels: Levels
    times_s: list[float] | None = None

    @property
    def full_scale(self) -> float:
        """The level of white."""
        return 1.0 if self.levels.dtype.kind == "f" else float(np.iinfo(self.levels.dtype).max)


def read_frames(path: Path) -> Frames:
    """Read all frames; raises SceneError with the file and, where it can be told, the frame."""
    if path.suffix == ".npy" and path.is_file():
        return Frames(_array(path))
    is_video = path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES
    reader = f"foreign_{'video:read_video' if is_video else 'images:read_images'}"
    found = read_in_child(f"emulator.scene.video.{reader}", path, _LIMITS)
    return Frames(found["levels"], found["times_s"].tolist() if found["times_s"].size else None)


def linear_light(levels: Levels, full_scale: float, *, is_linear: bool) -> npt.NDArray[np.float32]:
    """Return linear light of levels, white 1."""
    share = np.asarray(levels, np.float32) / np.float32(full_scale)
    if is_linear:
        return share
    low, high = share / np.float32(12.92), ((share + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(share <= 0.04045, low, high)


def _array(path: Path) -> Levels:
    try:
        levels = load_array(path)
    except (OSError, ArrayFileError) as error:
        raise SceneError(f"{path}: cannot be read as an array: {error}") from error
    if levels.ndim != 3 or not levels.size:
        raise SceneError(f"{path}: has the shape {levels.shape}; (frames, height, width) is needed")
    if levels.dtype.kind == "f":
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite then is refused
            levels = levels.astype(np.float32)
        bad = np.flatnonzero(~(np.isfinite(levels) & (levels >= 0)).all(axis=(1, 2)))
        if bad.size:
            raise SceneError(f"{path}: frame {bad[0]} holds light that is negative or not finite")
    elif levels.dtype not in (np.uint8, np.uint16):
        raise SceneError(f"{path}: is {levels.dtype}; uint8, uint16 or floats are needed")
    return np.asarray(levels)

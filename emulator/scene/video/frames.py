"""Frames of a video or of a sequence of images, read whole, as linear light.

    a folder                 its images in the order of their names, each of any format that pillow reads
    .npy                     an array (frames, height, width): uint8 and uint16 are levels, floats are linear light
    .gif .tif .png .webp     the frames of one file, by pillow
    .mp4 .mkv .avi .mov      by PyAV (`pip install '.[files]'`, FFmpeg), with the times that the file gives

Pillow and PyAV read in a child process, see `guarded_reader`. All frames become one array, within a bound of memory.
Colours become luminance (Rec. 709). Levels are scaled to 0 to 1 and decoded by the sRGB curve, except linear ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import SceneError
from emulator.scene.files import read_array, read_in_child
from emulator.tables.toml_text import shortened
from transports.guarded_reader import Limits

MOST_BYTES = 1 << 31
"""Of all frames together."""

Levels = npt.NDArray[Any]


def stacked(frames: Iterator[tuple[str, Levels]]) -> Levels:
    """Return all frames as one array; raises SceneError where they differ in form, are too large, or none."""
    collected: list[Levels] = []
    room = MOST_BYTES
    for name, levels in frames:
        if collected and (levels.shape != collected[0].shape or levels.dtype != collected[0].dtype):
            raise SceneError(
                f"{name} is {levels.shape[1]} x {levels.shape[0]} {levels.dtype}, the first frame "
                f"{collected[0].shape[1]} x {collected[0].shape[0]} {collected[0].dtype}: all must be alike"
            )
        room -= levels.nbytes
        if room < 0:
            raise SceneError(f"more than {MOST_BYTES >> 30} GiB of frames; cut it or make it smaller")
        collected.append(levels)
    if not collected:
        raise SceneError("holds no frames")
    return np.stack(collected)


_LIMITS = Limits(memory_bytes=3 * MOST_BYTES, cpu_s=600)  # a video of one MiB may well hold a GiB of frames
VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v")


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
    """Read all frames; raises SceneError with the file and, where it is known, the frame."""
    if path.suffix == ".npy" and path.is_file():
        return Frames(_array(path))
    is_video = path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES
    reader = "read_video" if is_video else "read_images"
    found = read_in_child(f"emulator.scene.video.frames:{reader}", path, _LIMITS)
    return Frames(found["levels"], found["times_s"].tolist() if found["times_s"].size else None)


def linear_light(levels: Levels, full_scale: float, *, is_linear: bool) -> npt.NDArray[np.float32]:
    """Return linear light of levels, white 1."""
    share = np.asarray(levels, np.float32) / np.float32(full_scale)
    if is_linear:
        return share
    low, high = share / np.float32(12.92), ((share + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(share <= 0.04045, low, high)


def _array(path: Path) -> Levels:
    levels = read_array(path)
    if levels.ndim != 3 or not levels.size:
        raise SceneError(f"{path}: has the shape {levels.shape}; (frames, height, width) is needed")
    if levels.dtype.kind == "f":
        with np.errstate(invalid="ignore", over="ignore"):  # values that are not finite then are refused
            levels = levels.astype(np.float32)
        bad = np.flatnonzero(~(np.isfinite(levels) & (levels >= 0)).all(axis=(1, 2)))
        if bad.size:
            raise SceneError(f"{path}: frame {bad[0]} holds light that is negative or not finite")
    elif levels.dtype not in (np.uint8, np.uint16):
        raise SceneError(f"{path}: is {levels.dtype}; uint8, uint16 or floats are needed")
    return np.asarray(levels)


def read_images(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `levels` (n, height, width) of a file, or of a folder's files in the order of their names, no times."""
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    return {"levels": stacked(_frames(files)), "times_s": np.zeros(0)}


def _frames(paths: list[Path]) -> Iterator[tuple[str, Levels]]:
    """Yield name and levels of every frame of every file."""
    from PIL import Image, ImageSequence

    for path in paths:
        try:
            with Image.open(path) as image:
                for k, frame in enumerate(ImageSequence.Iterator(image)):
                    yield f"{path.name}, frame {k}", _grey(frame)
        except (MemoryError, ImportError, SceneError):
            raise
        except Exception as error:  # pillow raises arbitrary exceptions for a damaged file
            raise SceneError(f"{path.name}: cannot be read as an image: {shortened(error)}") from error


def _grey(frame: Any) -> Levels:
    """Return the luminance of a pillow image, in its own depth."""
    if frame.mode in ("I;16", "I;16L", "I;16B"):
        return np.asarray(frame).astype(np.uint16)
    if frame.mode == "F":
        return np.asarray(frame, np.float32)
    if frame.mode == "L":
        return np.asarray(frame, np.uint8)
    return _luminance(np.asarray(frame.convert("RGB"), np.float32))


def _luminance(rgb: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    return np.rint(rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32)).astype(np.uint8)


def read_video(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `levels` (n, height, width), and `times_s` (n,) from 0, empty where the file gives none that increase."""
    import av

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
    except Exception as error:  # FFmpeg's own errors, and those of PyAV
        raise SceneError(f"frame {len(times)} cannot be read: {shortened(error)}") from error
    has_times = len(times) > 1 and bool(np.all(np.diff(times) > 0))
    return {"levels": levels, "times_s": np.array(times) - times[0] if has_times else np.zeros(0)}

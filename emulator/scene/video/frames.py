"""Frames of a video or of a sequence of images, read whole, as linear light.

    a folder                 its images in the order of their names, each of any format that pillow reads
    .npy                     an array (frames, height, width): uint8 and uint16 are levels, floats are linear light
    .gif .tif .png .webp     the frames of one file, by pillow
    .mp4 .mkv .avi .mov      by PyAV (`pip install 'evstim[files]'`), with the times that the file gives

Colours become luminance (Rec. 709). Levels are taken from 0 to 1 and decoded by the sRGB curve unless told to be
linear.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import MachineLacks, SceneError

__all__ = ["Frames", "linear_light", "read_frames"]

_MOST_BYTES = 1 << 31
_VIDEOS = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v")

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
    if path.is_dir():
        return Frames(_stacked(_images(sorted(p for p in path.iterdir() if p.is_file())), path))
    if not path.is_file():
        raise SceneError(f"{path}: no such file or folder")
    if path.suffix == ".npy":
        return Frames(_array(path))
    if path.suffix.lower() in _VIDEOS:
        return _video(path)
    return Frames(_stacked(_images([path]), path))


def linear_light(levels: Levels, full_scale: float, *, is_linear: bool) -> npt.NDArray[np.float32]:
    """Return linear light of levels, white 1."""
    share = np.asarray(levels, np.float32) / np.float32(full_scale)
    if is_linear:
        return share
    low, high = share / np.float32(12.92), ((share + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(share <= 0.04045, low, high)


def _images(paths: list[Path]) -> Iterator[tuple[str, Levels]]:
    """Yield name and levels of every frame of every file."""
    try:
        from PIL import Image, ImageSequence, UnidentifiedImageError
    except ImportError as error:
        raise MachineLacks("reading images needs pillow: pip install 'evstim[report]'") from error
    for path in paths:
        try:
            with Image.open(path) as image:
                for k, frame in enumerate(ImageSequence.Iterator(image)):
                    yield f"{path.name}, frame {k}", _grey(frame)
        except (OSError, SyntaxError, UnidentifiedImageError, EOFError) as error:
            raise SceneError(f"{path}: cannot be read as an image: {error}") from error


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


def _stacked(frames: Iterator[tuple[str, Levels]], path: Path) -> Levels:
    kept: list[Levels] = []
    room = _MOST_BYTES
    for name, levels in frames:
        if kept and (levels.shape != kept[0].shape or levels.dtype != kept[0].dtype):
            raise SceneError(
                f"{path}: {name} is {levels.shape[1]} x {levels.shape[0]} {levels.dtype}, the first frame "
                f"{kept[0].shape[1]} x {kept[0].shape[0]} {kept[0].dtype}: all must be alike"
            )
        room -= levels.nbytes
        if room < 0:
            raise SceneError(f"{path}: more than {_MOST_BYTES >> 30} GiB of frames; cut it or make it smaller")
        kept.append(levels)
    if not kept:
        raise SceneError(f"{path}: holds no frames")
    return np.stack(kept)


def _array(path: Path) -> Levels:
    try:
        levels = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise SceneError(f"{path}: cannot be read as an array: {error}") from error
    if levels.ndim != 3 or not levels.size:
        raise SceneError(f"{path}: has the shape {levels.shape}; (frames, height, width) is needed")
    if levels.dtype.kind == "f":
        levels = levels.astype(np.float32)
        bad = np.flatnonzero(~(np.isfinite(levels) & (levels >= 0)).all(axis=(1, 2)))
        if bad.size:
            raise SceneError(f"{path}: frame {bad[0]} holds light that is negative or not finite")
    elif levels.dtype not in (np.uint8, np.uint16):
        raise SceneError(f"{path}: is {levels.dtype}; uint8, uint16 or floats are needed")
    return np.asarray(levels)


def _video(path: Path) -> Frames:
    try:
        import av
    except ImportError as error:
        raise MachineLacks(f"{path}: reading videos needs PyAV: pip install 'evstim[files]'") from error
    times: list[float] = []

    def frames() -> Iterator[tuple[str, Levels]]:
        with av.open(str(path)) as container:
            for k, frame in enumerate(container.decode(video=0)):
                times.append(float(frame.time) if frame.time is not None else float("nan"))
                yield f"frame {k}", frame.to_ndarray(format="gray")

    try:
        levels = _stacked(frames(), path)
    except (OSError, ValueError, IndexError) as error:
        raise SceneError(f"{path}: frame {len(times)} cannot be read: {error}") from error
    has_times = bool(np.all(np.diff(times) > 0)) if len(times) > 1 else False
    return Frames(levels, [t - times[0] for t in times] if has_times else None)

"""Frames of images by pillow; for a child process, see `foreign_file`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageSequence

from emulator.light import SceneError
from emulator.scene.video.stacking import Levels, stacked
from emulator.tables.text_file import shortened

__all__ = ["read_images"]


def read_images(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `levels` (n, height, width) of a file, or of a folder's files in the order of their names, no times."""
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    return {"levels": stacked(_frames(files)), "times_s": np.zeros(0)}


def _frames(paths: list[Path]) -> Iterator[tuple[str, Levels]]:
    """Yield name and levels of every frame of every file."""
    for path in paths:
        try:
            with Image.open(path) as image:
                for k, frame in enumerate(ImageSequence.Iterator(image)):
                    yield f"{path.name}, frame {k}", _grey(frame)
        except (MemoryError, ImportError, SceneError):
            raise
        except Exception as error:  # pillow answers a damaged file with whatever it ran into
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

"""Moving pictures for people: GIF by pillow, MP4 (MPEG-4) by PyAV."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import chain
from pathlib import Path

import numpy as np

from emulator.light import MachineLacks, SceneError
from emulator.report.preview import Rgb
from transports.needs import install_command

__all__ = ["MOVIES", "save_movie"]


def save_movie(path: Path, pictures: Iterable[Rgb], fps: int) -> None:
    """Write pictures of one size as .gif or .mp4; raises SceneError, or MachineLacks for a package that is missing."""
    try:
        MOVIES[path.suffix.lower()](path, pictures, fps)
    except OSError as error:
        raise SceneError(f"the pictures {path} cannot be written: {error.strerror or error}") from error


def _gif(path: Path, pictures: Iterable[Rgb], fps: int) -> None:
    try:
        from PIL import Image
    except ImportError as error:
        raise MachineLacks(f"writing .gif needs pillow: {install_command('report')}") from error
    first, *rest = (Image.fromarray(picture) for picture in pictures)
    first.save(path, "GIF", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0)


def _mp4(path: Path, pictures: Iterable[Rgb], fps: int) -> None:
    try:
        import av
    except ImportError as error:
        raise MachineLacks(f"writing .mp4 needs av: {install_command('files')}") from error
    pictures = iter(pictures)
    first = next(pictures)
    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream("mpeg4", rate=fps, bit_rate=4_000_000)
        stream.height, stream.width, stream.pix_fmt = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2, "yuv420p"
        for picture in chain([first], pictures):
            even = np.ascontiguousarray(picture[: stream.height, : stream.width])
            file.mux(stream.encode(av.VideoFrame.from_ndarray(even, "rgb24")))
        file.mux(stream.encode())


MOVIES: Mapping[str, Callable[[Path, Iterable[Rgb], int], None]] = {".gif": _gif, ".mp4": _mp4}
"""What writes a movie, by the end of the file's name."""

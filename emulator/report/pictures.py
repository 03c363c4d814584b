"""Pictures and movies of light and events.

Pictures for people have the light dimmed, ON events orange, OFF events blue, as 8-bit sRGB. The two colours are of the
palette of Okabe and Ito (2008): people with any kind of colour blindness can distinguish them, and both are brighter
than the dimmed light. Movies are GIF by pillow, MP4 (MPEG-4) by PyAV. Pictures for programs are linear grey levels in a
PNG file.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from emulator.light import Light, MachineLacks, SceneError
from firmware_protocol.events import Events
from transports.needs import install_command

Rgb = npt.NDArray[np.uint8]
"""(height, width, 3), row 0 on top."""

ON_RGB, OFF_RGB = (230, 159, 0), (86, 180, 233)
_BRIGHT_SHARE = 0.99  # of the lit pixels are darker than white
_SMALL_PX = 640  # a picture that is less wide is drawn twice as large
_CAPTION_PX = 18


def white_of(light: Light) -> float:
    """Return the light level drawn as white: that of the brightest hundredth of the lit pixels, not of glints."""
    lit = light[light > 0]
    return float(np.quantile(lit, _BRIGHT_SHARE)) if lit.size else 0.0


def event_picture(light: Light, events: Events, *, white: float | None = None, dimming: float = 0.25) -> Rgb:
    """Draw events over the light in which they arose.

    Parameters
    ----------
    light : (height, width) float32, linear.
    events : (n,) EVENT, sorted by time; where a pixel has several the last is seen.
    white
        The light drawn as full white; `white_of` the picture unless given.
    dimming
        Level of white, as a share of the screen's range; 1 is best for light without events.

    Raises
    ------
    ValueError
        Events outside the picture.
    """
    height, width = light.shape
    if len(events) and (events["x"].max() >= width or events["y"].max() >= height):
        raise ValueError(f"there are events outside the {width} x {height} picture: it belongs to another sensor")
    top = white_of(light) if white is None else white
    grey = _srgb(np.clip(light / top, 0.0, 1.0) if top > 0 else np.zeros_like(light))
    picture = np.repeat(np.rint(255 * dimming * grey).astype(np.uint8)[:, :, None], 3, axis=2)
    picture[events["y"], events["x"]] = np.where(events["on"][:, None], ON_RGB, OFF_RGB)
    return picture


def scaled(rgb: Rgb) -> Rgb:
    """Return the picture of a small sensor twice as large, each pixel as a square; others as they are."""
    return rgb if rgb.shape[1] >= _SMALL_PX else rgb.repeat(2, axis=0).repeat(2, axis=1)


def captioned(rgb: Rgb, text: str) -> Rgb:
    """Return the picture with a line of text and the key of the colours below it; needs pillow."""
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise MachineLacks(f"drawing pictures needs pillow: {install_command('report')}") from error
    height, width = rgb.shape[:2]
    picture = Image.new("RGB", (width, height + _CAPTION_PX))
    picture.paste(Image.fromarray(rgb))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(12)
    x, y = 4.0, height + 2
    for words, colour in ((f"{text}  ", (255, 255, 255)), ("ON ", ON_RGB), ("OFF", OFF_RGB)):
        draw.text((x, y), words, colour, font)
        x += draw.textlength(words, font)
    return np.asarray(picture)


def save_png(path: Path, rgb: Rgb) -> None:
    """Write a picture as PNG; needs pillow."""
    try:
        from PIL import Image
    except ImportError as error:
        raise MachineLacks(f"writing pictures needs pillow: {install_command('report')}") from error
    try:
        Image.fromarray(rgb).save(path, "PNG")
    except OSError as error:
        raise SceneError(f"the picture {path} cannot be written: {error.strerror or error}") from error


def _srgb(linear: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Encode linear light 0 to 1 for a screen (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** np.float32(1 / 2.4) - 0.055)


_FASTEST = 1  # of zlib's levels: three times as fast as the default, files a tenth longer


def check_png() -> None:
    """Raise MachineLacks where pillow is not installed."""
    try:
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise MachineLacks(f"writing pictures needs pillow: {install_command('report')}") from error


def grey_png(light: Light, white: float) -> bytes:
    """Return the light, (height, width), as an 8-bit grey PNG, linear from 0 to `white`; brighter light is white."""
    from PIL import Image

    grey = np.rint(np.clip(light * (255.0 / white), 0.0, 255.0)).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(grey).save(file, "PNG", compress_level=_FASTEST)
    return file.getvalue()


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
"""Writers of movies, by the suffix of the file."""

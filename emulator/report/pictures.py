"""Pictures and movies of light and events.

Pictures for people have the light dimmed, ON events orange, OFF events blue, as 8-bit sRGB. The two colours are of the
palette of Okabe and Ito (2008): people with any kind of colour blindness can distinguish them, and both are brighter
than the dimmed light. Movies are GIF by pillow, MP4 (MPEG-4) by PyAV. Pictures for programs are linear grey levels in a
PNG file.

Maps of the pixels of a sensor, and small pictures, are PNG files of a few colours inside a page. A PNG with a palette
needs no library and a fraction of the octets of one in full colour (PNG, third edition, colour type 3). Maps have
sixteen levels of the colour map cividis, which people with any kind of colour vision read alike (Nunez, Anderton and
Renslow 2018), on a logarithmic scale.
"""

from __future__ import annotations

import base64
import io
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import Light, MachineLacks, SceneError
from emulator.report.charts import escaped
from firmware_protocol.events import Bytes, Events, Int64s, UInt16s
from transports.needs import install_command

Rgb = Bytes
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
    """Draw events over the light in which they arose; raises ValueError for events outside the picture.

    Parameters
    ----------
    light : (height, width) float32, linear.
    events : (n,) EVENT, sorted by time; where a pixel has several the last is seen.
    white : the light drawn as full white; `white_of` the picture unless given.
    dimming : level of white, as a share of the screen's range; 1 is best for light without events.
    """
    height, width = light.shape
    if len(events) and (events["x"].max() >= width or events["y"].max() >= height):
        raise ValueError(f"there are events outside the {width} x {height} picture: it belongs to another sensor")
    top = white_of(light) if white is None else white
    linear = np.clip(light / top, 0.0, 1.0) if top > 0 else np.zeros_like(light)
    # Encoded for a screen (IEC 61966-2-1).
    grey = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** np.float32(1 / 2.4) - 0.055)
    picture = np.repeat(np.rint(255 * dimming * grey).astype(np.uint8)[:, :, None], 3, axis=2)
    picture[events["y"], events["x"]] = np.where(events["on"][:, None], ON_RGB, OFF_RGB)
    return picture


def scaled(rgb: Rgb) -> Rgb:
    """Return the picture of a small sensor twice as large, each pixel as a square; others as they are."""
    return rgb if rgb.shape[1] >= _SMALL_PX else rgb.repeat(2, axis=0).repeat(2, axis=1)


def captioned(rgb: Rgb, text: str) -> Rgb:
    """Return the picture with a line of text and the key of the colours below it; needs pillow."""
    check_pillow("drawing pictures")
    from PIL import Image, ImageDraw, ImageFont

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
    check_pillow("writing pictures")
    from PIL import Image

    try:
        Image.fromarray(rgb).save(path, "PNG")
    except OSError as error:
        raise SceneError(f"the picture {path} cannot be written: {error.strerror or error}") from error


_FASTEST = 1  # of zlib's levels: three times as fast as the default, files a tenth longer


def check_pillow(use: str = "writing pictures") -> None:
    """Raise MachineLacks where pillow is not installed, which this use needs."""
    try:
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise MachineLacks(f"{use} needs pillow: {install_command('report')}") from error


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
    check_pillow("writing .gif")
    from PIL import Image

    first, *later = (Image.fromarray(picture) for picture in pictures)
    first.save(path, "GIF", save_all=True, append_images=later, duration=round(1000 / fps), loop=0)


def _mp4(path: Path, pictures: Iterable[Rgb], fps: int) -> None:
    try:
        import av
    except ImportError as error:
        raise MachineLacks(f"writing .mp4 needs av: {install_command('files')}") from error
    pictures = iter(pictures)
    first = next(pictures)
    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream("mpeg4", rate=fps, bit_rate=4_000_000)
        stream.height = first.shape[0] // 2 * 2
        stream.width = first.shape[1] // 2 * 2
        stream.pix_fmt = "yuv420p"
        for picture in chain([first], pictures):
            even = np.ascontiguousarray(picture[: stream.height, : stream.width])
            file.mux(stream.encode(av.VideoFrame.from_ndarray(even, "rgb24")))
        file.mux(stream.encode())


MOVIES: Mapping[str, Callable[[Path, Iterable[Rgb], int], None]] = {".gif": _gif, ".mp4": _mp4}
"""Writers of movies, by the suffix of the file."""

Counts = Int64s

_LEVELS = 16
_CIVIDIS = ("00224e", "123570", "3b496c", "575d6d", "707173", "8a8678", "a59c74", "c3b369", "e1cc55", "fee838")
_MOST_PX = 480  # width of a map; a larger sensor is shown reduced
_GREYS, _DIMMING = 30, 0.45
_ON, _OFF = _GREYS, _GREYS + 1


def palette_png(pixels: Bytes, palette: Bytes) -> bytes:
    """Return a PNG of pixels (height, width), numbers of colours in `palette` (n, 3), n at most 256."""
    return _png(pixels, pixels.shape[1], 8, 3, {b"PLTE": palette.tobytes()})


def deep_png(pixels: UInt16s) -> bytes:
    """Return a PNG of pixels (height, width, 3), red, green and blue of 16 bits."""
    return _png(pixels.astype(">u2").reshape(len(pixels), -1).view(np.uint8), pixels.shape[1], 16, 2, {})


def _png(rows: Bytes, width: int, depth: int, colours: int, palette: Mapping[bytes, bytes]) -> bytes:
    """Return a PNG of rows (height, bytes of a row), each with filter 0 before it; `colours` is the colour type."""
    header, data = struct.pack(">IIBB3x", width, len(rows), depth, colours), np.insert(rows, 0, 0, axis=1).tobytes()
    chunks = {b"IHDR": header, **palette, b"IDAT": zlib.compress(data, 9), b"IEND": b""}
    parts = [[struct.pack(">I", len(c)), n, c, struct.pack(">I", zlib.crc32(n + c))] for n, c in chunks.items()]
    return b"".join([b"\x89PNG\r\n\x1a\n", *chain.from_iterable(parts)])


def image_element(png: bytes, description: str, width: int) -> str:
    """Return an <img> element that holds its own data; `width` is that of the shown pixels."""
    text = base64.b64encode(png).decode()
    return f'<img width="{width}" alt="{escaped(description)}" src="data:image/png;base64,{text}">'


def reduced(counts: Counts, block: int) -> Counts:
    """Return the largest count of each block of `block` x `block` pixels, so that a single hot pixel stays visible."""
    height, width = counts.shape
    padded: Counts = np.zeros((-(-height // block) * block, -(-width // block) * block), np.int64)
    padded[:height, :width] = counts
    blocks = padded.reshape(padded.shape[0] // block, block, padded.shape[1] // block, block)
    largest: Counts = blocks.max(axis=(1, 3))
    return largest


@dataclass(frozen=True)
class ColourScale:
    """Logarithmic scale from 0 to `largest` events a pixel, in sixteen levels; only 0 has the lowest."""

    largest: int

    def levels(self, counts: Counts) -> Bytes:
        """Return the level of each count."""
        top = math.log1p(max(self.largest, 1))
        above = np.ceil(np.log1p(counts) / top * (_LEVELS - 1))
        levels: Bytes = np.clip(above, 0, _LEVELS - 1).astype(np.uint8)
        return levels

    @property
    def legend(self) -> str:
        """The colours with the counts at both ends and in the middle, as an element."""
        colours = ",".join("#" + bytes(colour).hex() for colour in _colours())
        middle = round(math.expm1(math.log1p(self.largest) / 2))
        texts = "".join(f"<span>{value}</span>" for value in (0, middle, self.largest))
        return f'<div class="scale"><i style="background:linear-gradient(90deg,{colours})"></i>{texts}</div>'


def _colours() -> Bytes:
    anchors = np.array([list(bytes.fromhex(colour)) for colour in _CIVIDIS], float)
    at = np.linspace(0, len(anchors) - 1, _LEVELS)
    columns = [np.interp(at, np.arange(len(anchors)), anchors[:, k]) for k in range(3)]
    colours: Bytes = np.rint(np.stack(columns, axis=1)).astype(np.uint8)
    return colours


def count_map(counts: Counts, scale: ColourScale, name: str) -> str:
    """Return a map of events a pixel (height, width), as a figure with its caption."""
    height, width = counts.shape
    block = max(1, math.ceil(width / _MOST_PX))
    small = reduced(counts, block)
    description = f"{name}, {width} x {height} pixels, row 0 on top; at most {int(counts.max(initial=0))} in a pixel"
    shown = image_element(palette_png(scale.levels(small), _colours()), description, small.shape[1])
    beside = f"; the largest of {block} x {block} pixels is shown" if block > 1 else ""
    return f'<figure class="map">{shown}<figcaption>{escaped(name + beside)}</figcaption></figure>'


def scene_picture(light: Light, polarity: npt.NDArray[np.int8], caption: str) -> str:
    """Return light (height, width) with events over it as a figure; `polarity` is 1 for ON, -1 for OFF, 0 for none."""
    white = white_of(light)
    share: npt.NDArray[Any] = np.clip(light / white, 0.0, 1.0) if white > 0 else np.zeros(light.shape, np.float32)
    pixels = np.rint(share ** (1 / 2.2) * (_GREYS - 1)).astype(np.uint8)
    pixels[polarity > 0] = _ON
    pixels[polarity < 0] = _OFF
    greys = np.rint(np.linspace(0, 255 * _DIMMING, _GREYS))[:, None].repeat(3, axis=1)
    palette = np.concatenate([greys, [ON_RGB, OFF_RGB]]).astype(np.uint8)
    on, off = int((polarity > 0).sum()), int((polarity < 0).sum())
    description = f"light frame at {caption}, {on} pixels with ON events and {off} with OFF events"
    element = image_element(palette_png(pixels, palette), description, light.shape[1])
    return f"<figure>{element}<figcaption>{escaped(caption)}</figcaption></figure>"

"""Maps of the pixels of a sensor, and small pictures, as PNG files of a few colours inside a page.

A PNG with a palette needs no library and a fraction of the octets of one in full colour (PNG, third edition, colour
type 3). Maps have sixteen levels of the colour map cividis, which people with any kind of colour vision read alike
(Nunez, Anderton and Renslow 2018), on a logarithmic scale.
"""

from __future__ import annotations

import base64
import math
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import Light
from emulator.report.charts import escaped
from emulator.report.pictures import OFF_RGB, ON_RGB, white_of

Bytes = npt.NDArray[np.uint8]
Counts = npt.NDArray[np.int64]

_LEVELS = 16
_CIVIDIS = ("00224e", "123570", "3b496c", "575d6d", "707173", "8a8678", "a59c74", "c3b369", "e1cc55", "fee838")
_MOST_PX = 480  # width of a map; a larger sensor is shown reduced
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREYS, _DIMMING = 30, 0.45
_ON, _OFF = _GREYS, _GREYS + 1


def palette_png(pixels: Bytes, palette: Bytes) -> bytes:
    """Return a PNG of pixels (height, width), numbers of colours in `palette` (n, 3), n at most 256."""
    height, width = pixels.shape
    rows = np.zeros((height, width + 1), np.uint8)  # each with filter 0 before it
    rows[:, 1:] = pixels
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    data = zlib.compress(rows.tobytes(), 9)
    return b"".join(
        [_SIGNATURE, _chunk(b"IHDR", header), _chunk(b"PLTE", palette.tobytes()), _chunk(b"IDAT", data)]
        + [_chunk(b"IEND", b"")]
    )


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


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
    most: Counts = blocks.max(axis=(1, 3))
    return most


@dataclass(frozen=True)
class ColourScale:
    """Logarithmic scale from 0 to `most` events a pixel, in sixteen levels; only 0 has the lowest."""

    most: int

    def levels(self, counts: Counts) -> Bytes:
        """Return the level of each count."""
        top = math.log1p(max(self.most, 1))
        above = np.ceil(np.log1p(counts) / top * (_LEVELS - 1))
        levels: Bytes = np.clip(above, 0, _LEVELS - 1).astype(np.uint8)
        return levels

    @property
    def legend(self) -> str:
        """The colours with the counts at both ends and in the middle, as an element."""
        colours = ",".join("#" + bytes(colour).hex() for colour in _colours())
        middle = round(math.expm1(math.log1p(self.most) / 2))
        texts = "".join(f"<span>{value}</span>" for value in (0, middle, self.most))
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
    """Return a picture of light (height, width) with events over it as a figure.

    `polarity` is 1 for a pixel with an ON event, -1 for OFF, 0 for none.
    """
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

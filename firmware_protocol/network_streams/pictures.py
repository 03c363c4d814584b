"""Streams of pictures: event images as numpy arrays, and a coloured display as PPM pictures.

    event image   .npy arrays one after another, each (1,) of {t_us: i64, image: (channels, height, width) f32}
    display       P6 pictures one after another, as ffmpeg's image2pipe reads them: colours of ON and OFF events, and
                  between them (or below) a background or the light that the events tell of

Sources: numpy, "A simple file format for NumPy arrays"; netpbm, ppm(5); the display's settings: "Real-time event-based
sensor simulation for space applications"; E. Reinhard et al., "Photographic tone reproduction", 2002 (its curve).
"""

from __future__ import annotations

import io
from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import Edges
from firmware_protocol.events import Events
from firmware_protocol.network_streams.coder import ConnectionCoder, StreamFacts
from firmware_protocol.network_streams.frames import CHANNELS, EventFrames, Image
from firmware_protocol.network_streams.picture_settings import PictureSettings

__all__ = ["DisplayCoder", "EventImageCoder", "chosen", "coloured", "frames_for"]

_ON, _OFF, _FILTERED = (CHANNELS.index(name) for name in ("on", "off", "filtered"))
_WHITE = 255


class _PictureCoder(ConnectionCoder):
    """Codes a picture for each stretch of stream time."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        self._frames = frames_for(facts.size, facts.frame_us, facts.pictures)

    @property
    def greeting(self) -> bytes:
        """Nothing: each picture stands alone."""
        return b""

    def encode(self, events: Events, edges: Edges) -> bytes:
        """Return the pictures that these events complete."""
        return self._joined(self._frames.add(events))

    def advance(self, t_us: int) -> bytes:
        """Return the pictures that are complete by `t_us`."""
        return self._joined(self._frames.reach(t_us))

    def restart(self) -> bytes:
        """Return the picture that the camera's clock has cut short."""
        last = self.finish()
        self._frames.restart()
        return last

    def finish(self) -> bytes:
        """Return the picture that is not complete."""
        return self._joined(iter([self._frames.cut()] if self._frames.begun else []))

    def _joined(self, frames: Iterator[tuple[int, Image]]) -> bytes:
        return b"".join(self._picture(t_us, image) for t_us, image in frames)

    @abstractmethod
    def _picture(self, t_us: int, image: Image) -> bytes:
        """Return one picture."""


class EventImageCoder(_PictureCoder):
    """Codes event images with the channels that `facts.pictures` names."""

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        width, height = facts.size
        shape = (len(facts.pictures.channels), height, width)
        self._head = _npy_head(np.dtype([("t_us", "<i8"), ("image", "<f4", shape)]))

    def _picture(self, t_us: int, image: Image) -> bytes:
        pixels = chosen(image, self.facts.pictures).astype("<f4", copy=False)
        return self._head + t_us.to_bytes(8, "little", signed=True) + pixels.tobytes()


class DisplayCoder(_PictureCoder):
    """Codes what a person looks at."""

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        width, height = facts.size
        self._head = f"P6\n{width} {height}\n255\n".encode("ascii")

    def _picture(self, t_us: int, image: Image) -> bytes:
        return self._head + coloured(image, self.facts.pictures).tobytes()


def frames_for(size: tuple[int, int], period_us: int, settings: PictureSettings) -> EventFrames:
    """Return frames with all that pictures of these settings need."""
    filtered = "filtered" in settings.channels or settings.shows_light
    return EventFrames(size, period_us, settings.filter_us if filtered else 0.0)


def chosen(image: Image, settings: PictureSettings) -> Image:
    """Return the channels of an image that are asked for, (channels, height, width)."""
    return image[[CHANNELS.index(name) for name in settings.channels]]


def coloured(image: Image, settings: PictureSettings) -> npt.NDArray[np.uint8]:
    """Return (height, width, 3) of an image: colours of ON and OFF events, and between them background or light."""
    on, off = image[_ON], image[_OFF]
    rgb = np.full((*on.shape, 3), settings.background, np.uint8)
    if settings.shows_light:
        rgb[:] = _grey(image[_FILTERED], settings)[..., None]
    below = rgb.copy() if settings.shows_light and settings.light_below_events else np.zeros_like(rgb)
    cases = ((on > off, settings.on_colour), (off > on, settings.off_colour),
             ((off == on) & (on > 0), settings.both_colour))  # fmt: skip
    for where, colour in cases:
        rgb[where] = np.minimum(below[where] + np.array(colour, np.int64), _WHITE)
    return rgb


def _grey(level: Image, settings: PictureSettings) -> npt.NDArray[np.uint8]:
    """Return the grey of light exp(contrast * level) on Reinhard's curve light / (1 + light), without overflow."""
    curve = 0.5 + 0.5 * np.tanh(0.5 * settings.contrast * level)
    grey: npt.NDArray[np.uint8] = np.rint(settings.light_share * _WHITE * curve).astype(np.uint8)
    return grey


def _npy_head(record: np.dtype[np.void]) -> bytes:
    """Return the head of a .npy file with one record."""
    head = io.BytesIO()
    fields = {"descr": np.lib.format.dtype_to_descr(record), "fortran_order": False, "shape": (1,)}
    np.lib.format.write_array_header_1_0(head, fields)
    return head.getvalue()

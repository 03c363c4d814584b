"""Streams of images of events: numpy arrays, or a coloured display in PPM format.

    event image   .npy arrays one after another, each (1,) of {t_us: i64, image: (channels, height, width) f32}
    display       P6 images one after another, as ffmpeg's image2pipe reads them: colours of ON and OFF events, and
                  between them (or below) a background or the light computed from the events

Sources: numpy, "A simple file format for NumPy arrays"; netpbm, ppm(5); the display's settings: "Real-time event-based
sensor simulation for space applications"; E. Reinhard et al., "Photographic tone reproduction", 2002 (its curve).

An image holds the events of one of equal intervals of stream time.
"""

from __future__ import annotations

import io
from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from firmware_protocol.events import Bytes, Edges, Events, Float32s
from firmware_protocol.network_streams.coders import ConnectionCoder, PictureSettings, StreamFacts

CHANNELS = ("on", "off", "first_us", "last_us", "level", "count", "filtered")
"""Channels of an image: ON and OFF events of the frame, times of the pixel's first and last one after the frame's
start, us (NaN if it had none), ON less OFF events since the first frame, ON less OFF events of the frame, and the level
after a first-order low pass at the frame's end (0 without a filter)."""

_MOST_EMPTY = 8  # frames in a row without an event; of a longer silence only the last frame is made
_ON, _OFF, _FIRST, _LAST, _LEVEL, _COUNT, _FILTERED = range(len(CHANNELS))

Image = Float32s


class EventFrames:
    """Gathers events into frames of `period_us`; frame k holds k * period_us <= t < (k + 1) * period_us.

    The low pass of a level that events change in steps is the level less the part of each step that has not passed yet:
    filtered(T) = level(T) - sum of +-exp(-(T - t) / filter_us) over the events. Only this sum is stored, no samples.

    Parameters
    ----------
    size : (width, height), pixels.
    filter_us : time constant of the channel "filtered"; 0 if it is not needed.
    """

    def __init__(self, size: tuple[int, int], period_us: int, filter_us: float = 0.0) -> None:
        self._period_us = period_us
        self._filter_us = filter_us
        self._width, self._height = size
        self._image = np.zeros((len(CHANNELS), self._height * self._width), np.float32)
        self._decayed = np.zeros(self._height * self._width if filter_us else 0)  # the sum, at the frame's end
        self._frame: int | None = None

    @property
    def begun(self) -> bool:
        """True if there is an incomplete frame."""
        return self._frame is not None

    def restart(self) -> None:
        """Restart, because the camera's clock did."""
        self._frame = None

    def add(self, events: Events) -> Iterator[tuple[int, Image]]:
        """Add events (n,) EVENT, sorted; yield (t_us, image) of each frame that they complete.

        `t_us` is the end of the frame. The image is (channels, height, width), see `CHANNELS`, and changes with the
        next step of the iterator.
        """
        frames = (events["t"] // np.uint64(self._period_us)).astype(np.int64)
        starts = np.flatnonzero(np.diff(frames, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(events)], strict=True):
            yield from self.reach(int(frames[start]) * self._period_us)
            self._count(events[start:end])

    def reach(self, t_us: int) -> Iterator[tuple[int, Image]]:
        """Advance to `t_us`, before which there are no more events; yield the frames that this completes."""
        frame = t_us // self._period_us
        if self._frame is None:
            self._begin(frame)
        assert self._frame is not None
        while self._frame < frame:
            yield self.cut()
            self._begin(self._frame + 1 if frame - self._frame < _MOST_EMPTY else frame)

    def cut(self) -> tuple[int, Image]:
        """Return the frame in its present state."""
        frame = self._frame or 0
        shape = (len(CHANNELS), self._height, self._width)
        np.subtract(self._image[_ON], self._image[_OFF], out=self._image[_COUNT])
        if self._filter_us:
            np.subtract(self._image[_LEVEL], self._decayed, out=self._image[_FILTERED], casting="same_kind")
        return (frame + 1) * self._period_us, self._image.reshape(shape)

    def _begin(self, frame: int) -> None:
        self._image[:_FIRST] = 0
        self._image[_FIRST:_LEVEL] = np.nan
        if self._filter_us and self._frame is not None:
            self._decayed *= np.exp(-(frame - self._frame) * self._period_us / self._filter_us)
        self._frame = frame

    def _count(self, events: Events) -> None:
        assert self._frame is not None
        pixel = events["y"].astype(np.int64) * self._width + events["x"]
        counts = np.bincount(2 * pixel + events["on"], minlength=2 * self._image.shape[1]).reshape(-1, 2)
        self._image[_OFF] += counts[:, 0]
        self._image[_ON] += counts[:, 1]
        self._image[_LEVEL] += counts[:, 1].astype(np.float32) - counts[:, 0]
        t = (events["t"].astype(np.int64) - self._frame * self._period_us).astype(np.float32)
        fresh = np.isnan(self._image[_FIRST, pixel])
        self._image[_FIRST, pixel[fresh][::-1]] = t[fresh][::-1]  # of equal indices the last value stays: the earliest
        self._image[_LAST, pixel] = t
        if self._filter_us:
            left = np.exp((t.astype(np.float64) - self._period_us) / self._filter_us)
            steps = np.where(events["on"], left, -left)
            self._decayed += np.bincount(pixel, steps, minlength=len(self._decayed))


_WHITE = 255


class _PictureCoder(ConnectionCoder):
    """Coder of an image for each interval of stream time."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        self._frames = frames_for(facts.size, facts.frame_us, facts.pictures)

    def encode(self, events: Events, edges: Edges) -> bytes:
        """Return the images that these events complete."""
        return self._joined(self._frames.add(events))

    def advance(self, t_us: int) -> bytes:
        """Return the images that are complete by `t_us`."""
        return self._joined(self._frames.reach(t_us))

    def restart(self) -> bytes:
        """Return the incomplete image at a restart of the camera's clock."""
        last = self.finish()
        self._frames.restart()
        return last

    def finish(self) -> bytes:
        """Return the incomplete image."""
        return self._joined(iter([self._frames.cut()] if self._frames.begun else []))

    def _joined(self, frames: Iterator[tuple[int, Image]]) -> bytes:
        return b"".join(self._picture(t_us, image) for t_us, image in frames)

    @abstractmethod
    def _picture(self, t_us: int, image: Image) -> bytes:
        """Return one image."""


class EventImageCoder(_PictureCoder):
    """Coder of event images with the channels of `facts.pictures`."""

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        width, height = facts.size
        shape = (len(facts.pictures.channels), height, width)
        self._head = _npy_head(np.dtype([("t_us", "<i8"), ("image", "<f4", shape)]))

    def _picture(self, t_us: int, image: Image) -> bytes:
        pixels = chosen(image, self.facts.pictures).astype("<f4", copy=False)
        return self._head + t_us.to_bytes(8, "little", signed=True) + pixels.tobytes()


class DisplayCoder(_PictureCoder):
    """Coder of coloured images for people."""

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        width, height = facts.size
        self._head = f"P6\n{width} {height}\n255\n".encode("ascii")

    def _picture(self, t_us: int, image: Image) -> bytes:
        return self._head + coloured(image, self.facts.pictures).tobytes()


def frames_for(size: tuple[int, int], period_us: int, settings: PictureSettings) -> EventFrames:
    """Return frames with the data that images of these settings need."""
    filtered = "filtered" in settings.channels or settings.shows_light
    return EventFrames(size, period_us, settings.filter_us if filtered else 0.0)


def chosen(image: Image, settings: PictureSettings) -> Image:
    """Return the selected channels of an image, (channels, height, width)."""
    return image[[CHANNELS.index(name) for name in settings.channels]]


def coloured(image: Image, settings: PictureSettings) -> Bytes:
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


def _grey(level: Image, settings: PictureSettings) -> Bytes:
    """Return the grey of light exp(contrast * level) on Reinhard's curve light / (1 + light), without overflow."""
    curve = 0.5 + 0.5 * np.tanh(0.5 * settings.contrast * level)
    grey: Bytes = np.rint(settings.light_share * _WHITE * curve).astype(np.uint8)
    return grey


def _npy_head(record: np.dtype[np.void]) -> bytes:
    """Return the head of a .npy file with one record."""
    head = io.BytesIO()
    fields = {"descr": np.lib.format.dtype_to_descr(record), "fortran_order": False, "shape": (1,)}
    np.lib.format.write_array_header_1_0(head, fields)
    return head.getvalue()

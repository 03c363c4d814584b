"""Pictures of the events of equal stretches of stream time, for streams of pictures instead of events."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events

__all__ = ["CHANNELS", "EventFrames", "Image"]

CHANNELS = ("on", "off", "first_us", "last_us", "level", "count", "filtered")
"""Of an image: ON and OFF events of the frame, times of the pixel's first and last one after the frame's start, us (NaN
where it had none), ON less OFF events since the first frame, ON less OFF events of the frame, and the level behind a
low pass of the first order at the frame's end (0 without a filter)."""

_MOST_EMPTY = 8  # frames in a row without an event; of a longer silence only the last one is made
_ON, _OFF, _FIRST, _LAST, _LEVEL, _COUNT, _FILTERED = range(len(CHANNELS))

Image = npt.NDArray[np.float32]


class EventFrames:
    """Gathers events into frames of `period_us`; frame k holds k * period_us <= t < (k + 1) * period_us.

    The low pass of a level that events move in steps is the level less what each step has not passed on yet:
    filtered(T) = level(T) - sum of +-exp(-(T - t) / filter_us) over the events. The sum is kept, so no sample is.

    Parameters
    ----------
    size
        (width, height), pixels.
    filter_us
        Time constant of the channel "filtered"; 0 where it is not needed.
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
        """Whether there is a frame that is not complete."""
        return self._frame is not None

    def restart(self) -> None:
        """Begin anew: the camera's clock did."""
        self._frame = None

    def add(self, events: Events) -> Iterator[tuple[int, Image]]:
        """Take events (n,) EVENT, sorted; yield (t_us, image) of each frame that these show to be complete.

        `t_us` is the end of the frame. The image is (channels, height, width), see `CHANNELS`, and changes with the
        next step of the iterator.
        """
        frames = (events["t"] // np.uint64(self._period_us)).astype(np.int64)
        starts = np.flatnonzero(np.diff(frames, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(events)], strict=True):
            yield from self.reach(int(frames[start]) * self._period_us)
            self._count(events[start:end])

    def reach(self, t_us: int) -> Iterator[tuple[int, Image]]:
        """Say that there are no more events before `t_us`; yield the frames that this completes."""
        frame = t_us // self._period_us
        if self._frame is None:
            self._begin(frame)
        assert self._frame is not None
        while self._frame < frame:
            yield self.cut()
            self._begin(self._frame + 1 if frame - self._frame < _MOST_EMPTY else frame)

    def cut(self) -> tuple[int, Image]:
        """Return the frame as it is now."""
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
        self._image[_FIRST, pixel[fresh][::-1]] = t[fresh][::-1]  # of equal places the last one stays: the earliest
        self._image[_LAST, pixel] = t
        if self._filter_us:
            left = np.exp((t.astype(np.float64) - self._period_us) / self._filter_us)
            steps = np.where(events["on"], left, -left)
            self._decayed += np.bincount(pixel, steps, minlength=len(self._decayed))

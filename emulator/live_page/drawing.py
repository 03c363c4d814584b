"""Pictures of events and light for the page: small planes of bytes, from which the browser makes its colours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.live_page.messages import Picture
from firmware_protocol.events import Events

__all__ = ["Canvas", "reduction"]

_MOST_SIZE = (640, 480)
_MOST_DRAWN = 60_000  # events of a picture; of more, each second, third ... is drawn
_NEWEST = 127
_MOST_COUNT = 15
_BRIGHT_SHARE = 0.99  # of the lit pixels are darker than what is drawn white
_WHITE_EVERY = 25  # pictures between two looks at what white is


def reduction(size: tuple[int, int]) -> int:
    """Return how many pixels of a sensor, along x and y, share a pixel of the page."""
    return max(-(-side // most) for side, most in zip(size, _MOST_SIZE, strict=True))


class Canvas:
    """Draws the pictures of a sensor of `size` (width, height), one after another."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._by = reduction(size)
        self._width, self._height = (-(-side // self._by) for side in size)
        self._number = 0
        self._until_us = 0
        self._white = 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the page's picture, pixels."""
        return self._height, self._width

    def begin(self, at_us: int) -> None:
        """Let the next picture's interval begin at `at_us`: nobody looked before."""
        self._until_us = at_us

    def draw(self, events: Events, light: npt.NDArray[np.float32], until_us: int) -> Picture:
        """Return the picture of the time since the last one.

        Parameters
        ----------
        events : (n,) EVENT, sorted by t.
        light : `shape`, float32, linear.
        until_us : the end of the interval, us.
        """
        from_us, self._until_us = self._until_us, max(until_us, self._until_us)
        every = 1 + len(events) // _MOST_DRAWN
        drawn = events[::every]
        place = (drawn["y"] // self._by).astype(np.intp) * self._width + drawn["x"] // self._by
        self._number += 1
        return Picture(
            self._number, from_us, self._until_us, len(events), every, self._screen(light),
            self._last(drawn, place, from_us), self._counts(drawn, place),
        )  # fmt: skip

    def _last(self, events: Events, place: npt.NDArray[np.intp], from_us: int) -> npt.NDArray[np.int8]:
        """Return when in the interval each pixel had its last event, and which."""
        plane = np.zeros(self._height * self._width, np.int8)
        length_us = max(self._until_us - from_us, 1)
        since_us = np.clip(events["t"].astype(np.int64) - from_us, 0, length_us)
        level = 1 + since_us * (_NEWEST - 1) // length_us
        plane[place] = np.where(events["on"], level, -level)  # of several at one place the last stays
        return plane.reshape(self.shape)

    def _counts(self, events: Events, place: npt.NDArray[np.intp]) -> npt.NDArray[np.uint8]:
        on = events["on"]
        up, down = (
            np.minimum(np.bincount(place[which], minlength=self._height * self._width), _MOST_COUNT)
            for which in (on, ~on)
        )
        return np.asarray((up | down << 4).reshape(self.shape), np.uint8)

    def _screen(self, light: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
        """Return light as levels of a screen, roughly as sRGB has them (a square root); not finite is dark."""
        if self._number % _WHITE_EVERY == 1:
            self._white = _white_of(light)
        if not self._white > 0:
            return np.zeros(self.shape, np.uint8)
        with np.errstate(invalid="ignore", over="ignore"):
            level = np.sqrt(np.clip(light * np.float32(1 / self._white), 0, 1)) * np.float32(255)
        return np.asarray(np.nan_to_num(level, copy=False, nan=0.0), np.uint8)


def _white_of(light: npt.NDArray[np.float32]) -> float:
    sample = light[::4, ::4]
    lit = sample[np.isfinite(sample) & (sample > 0)]
    return float(np.quantile(lit, _BRIGHT_SHARE)) if lit.size else 0.0

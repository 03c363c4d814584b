"""An event stream for comparison: times of any resolution, sorted by pixel and then by time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events

__all__ = ["Stream"]


@dataclass(frozen=True, slots=True)
class Stream:
    """Events of `pixels` pixels, those of pixel k from `first[k]` to `first[k + 1]`, in the order of their times.

    Attributes
    ----------
    t_us : (n,) float64
        Times.
    on : (n,) bool
        True where the light increased.
    first : (pixels + 1,) int64
        Index of each pixel's first event.
    """

    t_us: npt.NDArray[np.float64]
    on: npt.NDArray[np.bool_]
    first: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return self.t_us.size

    @property
    def pixels(self) -> int:
        """How many pixels there are, silent ones included."""
        return self.first.size - 1

    @property
    def counts(self) -> npt.NDArray[np.int64]:
        """Events of each pixel, (pixels,)."""
        return np.diff(self.first)

    @property
    def pixel(self) -> npt.NDArray[np.int64]:
        """Pixel of each event, (n,)."""
        return np.repeat(np.arange(self.pixels), self.counts)

    @classmethod
    def of(cls, t_us: npt.ArrayLike, pixel: npt.ArrayLike, on: npt.ArrayLike, pixels: int) -> Stream:
        """Sort events, (n,) each, by pixel and time; those of one pixel and time keep their order.

        Raises
        ------
        ValueError
            The lengths differ, a time is not finite, or a pixel is not in [0, pixels).
        """
        t, where, up = np.asarray(t_us, np.float64), np.asarray(pixel, np.int64), np.asarray(on, np.bool_)
        if not t.shape == where.shape == up.shape or t.ndim != 1:
            raise ValueError(f"t_us {t.shape}, pixel {where.shape}, on {up.shape}: must be of one length")
        if not np.isfinite(t).all():
            raise ValueError("t_us: times must be finite")
        if where.size and (where.min() < 0 or where.max() >= pixels):
            raise ValueError(f"pixel from {where.min()} to {where.max()}: must lie in [0, {pixels})")
        order = np.lexsort((t, where))
        first = np.concatenate([[0], np.cumsum(np.bincount(where, minlength=pixels))])
        return cls(t[order], up[order], first.astype(np.int64))

    @classmethod
    def from_events(cls, events: Events, width: int, height: int) -> Stream:
        """Return the stream of an EVENT array, (n,), of a sensor of that size."""
        pixel = events["y"].astype(np.int64) * width + events["x"]
        return cls.of(events["t"].astype(np.float64), pixel, events["on"], width * height)

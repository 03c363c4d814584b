"""Statistics of a stream of events, of a recording or of a simulated sensor, and distances between two of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats
from scipy.ndimage import uniform_filter

from firmware_protocol.events import Events

__all__ = ["Activity", "activity", "distances", "still_pixels"]

_MOST_INTERVALS = 200_000
_NEIGHBOURHOOD = 5

_Floats = npt.NDArray[np.float64]
_Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Activity:
    """Statistics of the events of some pixels.

    Attributes
    ----------
    seconds, pixels, events : extent of the stream, and how many pixels and events are counted.
    on_share : share of ON events; NaN without events, as the other shares.
    silent_share : share of the pixels without any event.
    opposite_share : share of a pixel's successive events that differ in polarity.
    fano : variance of the pixels' counts over their mean.
    above_50 : pixels with more than 50 events.
    counts : (pixels,) events of each pixel.
    intervals_s : (n,) times between successive events of a pixel, s.
    opposite : (n,) whether each interval is between events of different polarity.
    per_ms, per_10_ms : events in each such stretch of time.
    """

    seconds: float
    pixels: int
    events: int
    on_share: float
    silent_share: float
    opposite_share: float
    fano: float
    above_50: int
    counts: npt.NDArray[np.int64]
    intervals_s: _Floats
    opposite: _Bools
    per_ms: npt.NDArray[np.int64]
    per_10_ms: npt.NDArray[np.int64]

    @property
    def rate_hz(self) -> float:
        """Mean rate of a pixel, Hz."""
        return self.events / (self.pixels * self.seconds)

    def figures(self) -> dict[str, float]:
        """Return the single figures, by name."""
        return {
            "rate, Hz a pixel": self.rate_hz,
            "ON share": self.on_share,
            "silent share": self.silent_share,
            "successive events of opposite polarity": self.opposite_share,
            "Fano factor of the pixels' counts": self.fano,
            "pixels above 50 events": float(self.above_50),
            "median interval of a pixel, ms": 1e3 * float(np.median(self.intervals_s))
            if self.intervals_s.size
            else np.nan,
        }


def activity(events: Events, size: tuple[int, int], seconds: float, chosen: _Bools | None = None) -> Activity:
    """Return the statistics of (n,) EVENT in `seconds`, of a sensor of `size` = (width, height).

    `chosen`, (height, width), are the pixels that count; None: all.
    """
    kept = np.ones(size[::-1], bool) if chosen is None else chosen
    events = events[kept[events["y"], events["x"]]]
    pixel = events["y"].astype(np.int64) * size[0] + events["x"]
    counts = np.bincount(pixel, minlength=kept.size)[kept.reshape(-1)]
    order = np.lexsort([events["t"], pixel])
    same = np.diff(pixel[order]) == 0
    intervals = np.diff(events["t"][order].astype(np.float64))[same] * 1e-6
    opposite = np.diff(events["on"][order].astype(np.int8))[same] != 0
    since_us = events["t"] - events["t"][0] if len(events) else events["t"]
    per_ms, per_10_ms = (_per(since_us, ms, seconds) for ms in (1, 10))
    return Activity(
        seconds, int(counts.size), len(events),
        on_share=_mean(events["on"]), silent_share=_mean(counts == 0), opposite_share=_mean(opposite),
        fano=float(counts.var() / counts.mean()) if counts.sum() else np.nan, above_50=int((counts > 50).sum()),
        counts=counts, intervals_s=intervals, opposite=opposite, per_ms=per_ms, per_10_ms=per_10_ms,
    )  # fmt: skip


def _mean(values: npt.NDArray[np.bool_]) -> float:
    return float(values.mean()) if values.size else np.nan


def _per(since_us: npt.NDArray[np.uint64], ms: int, seconds: float) -> npt.NDArray[np.int64]:
    stretches = max(1, int(seconds * 1000 / ms))
    return np.bincount(np.minimum(since_us // (1000 * ms), stretches - 1).astype(np.int64), minlength=stretches)


def still_pixels(events: Events, size: tuple[int, int], seconds: float, most_hz: float) -> _Bools:
    """Return the pixels, (height, width), whose neighbours fire at `most_hz` a pixel at most, their own rate left out.

    So a hot pixel in a still part of the picture counts as still, and a pixel under a moving edge does not.
    """
    counts = np.bincount(events["y"].astype(np.int64) * size[0] + events["x"], minlength=size[0] * size[1])
    picture = np.minimum(counts.reshape(size[::-1]).astype(np.float64), 4 * most_hz * seconds + 2)
    inside = uniform_filter(np.ones_like(picture), _NEIGHBOURHOOD, mode="constant") * _NEIGHBOURHOOD**2 - 1
    around = uniform_filter(picture, _NEIGHBOURHOOD, mode="constant") * _NEIGHBOURHOOD**2 - picture
    return np.asarray(around / inside <= most_hz * seconds + 1e-9)


def distances(recorded: Activity, simulated: Activity) -> dict[str, float]:
    """Return how far two streams are apart: ratio of rates, differences of shares, Kolmogorov-Smirnov distances."""
    return {
        "rate, simulated over recorded": simulated.rate_hz / recorded.rate_hz if recorded.events else np.nan,
        "ON share, difference": simulated.on_share - recorded.on_share,
        "silent share, difference": simulated.silent_share - recorded.silent_share,
        "opposite share, difference": simulated.opposite_share - recorded.opposite_share,
        "Fano factor, ratio": simulated.fano / recorded.fano,
        "intervals of a pixel, KS": _ks(recorded.intervals_s, simulated.intervals_s),
        "counts of the pixels, KS": _ks(recorded.counts, simulated.counts),
        "events in 1 ms, KS": _ks(recorded.per_ms, simulated.per_ms),
        "events in 10 ms, KS": _ks(recorded.per_10_ms, simulated.per_10_ms),
    }


def _ks(a: npt.NDArray[np.generic], b: npt.NDArray[np.generic]) -> float:
    if not (a.size and b.size):
        return np.nan
    few = (one[:: -(-one.size // _MOST_INTERVALS)] for one in (a, b))
    return float(stats.ks_2samp(*few, method="asymp").statistic)

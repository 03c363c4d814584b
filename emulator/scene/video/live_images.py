"""Images that come while the run goes on: those known by now, joined in the logarithm of light.

For a picture of time t, with the images' times shifted by a delay

    between two known images    each pixel goes along a straight line in log light, as in a video
    after the newest one        the newest one stays, and the picture is counted as late
    before the first one        the first one; even grey where there is none

The time of an image is that of its arrival, or goes on from the last one's by the difference of their stamps: so stamps
may be Unix time or the time of another simulation. A stamp that goes back, or that leads away from the arrival by more
than a second, begins anew at the arrival, and is counted.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Around", "ImageCounters", "LiveImages"]

_Float32s = npt.NDArray[np.float32]

_KNOWN = 16
_LEAST_APART_NS = 1000
_MOST_ASTRAY_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Around:
    """Log light (height, width) of the images around a time, how far between them it lies, and the seconds between."""

    before: _Float32s
    after: _Float32s
    share: np.float32
    apart_s: float


@dataclass
class ImageCounters:
    """Counts of images.

    Attributes
    ----------
    taken : images used.
    repeated : images at the time of the one before them, refused.
    clock_jumps : stamps that did not go on from those before.
    late_pictures : pictures drawn with an image that stood still for want of a newer one.
    """

    taken: int = 0
    repeated: int = 0
    clock_jumps: int = 0
    late_pictures: int = 0


class LiveImages:
    """The images known by now.

    Parameters
    ----------
    grey : log light until the first one, (height, width).
    delay_ns : how much later than its time an image is shown.
    by_stamp : whether times go by the stamps; else by arrival.
    """

    def __init__(self, grey: _Float32s, delay_ns: int, *, by_stamp: bool) -> None:
        self._grey, self._delay_ns, self._by_stamp = grey, delay_ns, by_stamp
        self._known: deque[tuple[int, _Float32s]] = deque(maxlen=_KNOWN)
        self._ahead_ns: int | None = None  # of the stamps, beyond the scene's time
        self.counters = ImageCounters()

    def add(self, log_light: _Float32s, stamp_ns: int, arrival_ns: int) -> None:
        """Take an image, (height, width) log light, that arrived at the scene's time `arrival_ns`."""
        t_ns = self._time_ns(stamp_ns, arrival_ns)
        if self._known and t_ns < self._known[-1][0] + _LEAST_APART_NS:
            self.counters.repeated += 1
            return
        self._known.append((t_ns, log_light))
        self.counters.taken += 1

    def restart(self, t_ns: int) -> None:
        """Go back to time `t_ns`: the newest image stays from there."""
        self._ahead_ns = None
        if self._known:
            newest = self._known[-1][1]
            self._known.clear()
            self._known.append((t_ns - self._delay_ns, newest))

    def around(self, t_ns: int) -> Around:
        """Return the images around `t_ns`."""
        shown_ns, known = t_ns - self._delay_ns, self._known
        if not known or shown_ns <= known[0][0]:
            return _still(known[0][1] if known else self._grey)
        if shown_ns >= known[-1][0]:
            self.counters.late_pictures += shown_ns > known[-1][0]
            return _still(known[-1][1])
        after = next(k for k, (time_ns, _) in enumerate(known) if time_ns > shown_ns)
        (start_ns, before), (end_ns, end) = known[after - 1], known[after]
        share = np.float32((shown_ns - start_ns) / (end_ns - start_ns))
        return Around(before, end, share, (end_ns - start_ns) * 1e-9)

    def _time_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        if not self._by_stamp:
            return arrival_ns
        if self._ahead_ns is not None:
            t_ns = stamp_ns - self._ahead_ns
            if abs(t_ns - arrival_ns) <= _MOST_ASTRAY_NS and not (self._known and t_ns < self._known[-1][0]):
                return t_ns
            self.counters.clock_jumps += 1
        self._ahead_ns = stamp_ns - arrival_ns
        return arrival_ns


def _still(log_light: _Float32s) -> Around:
    return Around(log_light, log_light, np.float32(0), 0.0)

"""Estimate of a camera's clock error from pairs of timestamps, a reference for clients.

    y_i = host receive stamp - device stamp = offset + drift * (t_i - t_0) + delay_i,     delay_i >= the least delay

The delay of a message is never less than some least value and often much more: interrupts, other frames on the bus, a
busy host. A straight line through all points (least squares) attributes the mean delay to the offset, and the tail of
the delays pulls it. The least delay is constant, so the line sought is *below* all points: a line of the lower convex
hull of (device stamp, y), namely the one that minimises the sum of distances, which is the hull's edge above the mean
of the stamps. (S. Moon, P. Skelly and D. Towsley, INFOCOM 1999, take that line for the skew of two clocks; L. Zhang,
Z. Liu and C. Xia, INFOCOM 2002, find it on the convex hull.)

Points are added one by one, in the order of the stamps (Andrew's monotone chain, amortised constant time). Only the
hull is stored: `window_s` of it, so memory is bounded (a hull of n random points has some log n corners; a fixed limit
covers the rest). All in integers of ns.

The least delay itself remains in the offset, because no one-sided measurement can determine it: measure it once, by a
loopback, and subtract it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

_MOST_CORNERS = 512


@dataclass(frozen=True)
class ClockEstimate:
    """Estimated state of a clock.

    Attributes
    ----------
    offset_ns : host stamp less device stamp at `at_ns` of device time, the least delay included.
    drift_ppm : rate of the host's clock less that of the device's.
    """

    at_ns: int
    offset_ns: float
    drift_ppm: float

    def host_ns(self, device_ns: int) -> float:
        """Return the host's time when the device showed `device_ns`."""
        return device_ns + self.offset_ns + (device_ns - self.at_ns) * self.drift_ppm * 1e-6


class ClockEstimator:
    """A line below all points, updated with each point.

    Parameters
    ----------
    period_ns : nominal time between two SYNCs.
    window_ns : age at which points are removed: a quartz's frequency is constant for a minute or two.
    alarm_periods : periods without a SYNC after which there is an alarm.
    least_delay_ns : least delay, measured once by a loopback.
    """

    def __init__(
        self,
        period_ns: int = 100_000_000,
        window_ns: int = 120_000_000_000,
        alarm_periods: float = 3.0,
        least_delay_ns: int = 0,
    ) -> None:
        if period_ns < 1 or window_ns < period_ns or alarm_periods <= 1:
            raise ValueError("a period must be above 0, a window at least one, and an alarm later than the next SYNC")
        self._window_ns = window_ns
        self._alarm_ns = round(alarm_periods * period_ns)
        self._least_delay_ns = least_delay_ns
        self._hull: deque[tuple[int, int]] = deque()
        self._last_host_ns: int | None = None
        self.restarts = 0

    @property
    def corners(self) -> int:
        """Number of points stored."""
        return len(self._hull)

    def add(self, device_ns: int, host_ns: int) -> None:
        """Add a pair of stamps of one SYNC. If the device stamp does not increase, the clock has restarted."""
        if self._hull and device_ns <= self._hull[-1][0]:
            self._hull.clear()
            self.restarts += 1
        self._last_host_ns = host_ns
        point = (device_ns, host_ns - device_ns)
        while len(self._hull) > 1 and _turns_down(self._hull[-2], self._hull[-1], point):
            self._hull.pop()
        self._hull.append(point)
        while self._hull[0][0] < device_ns - self._window_ns or len(self._hull) > _MOST_CORNERS:
            self._hull.popleft()

    def lost(self, host_ns: int) -> bool:
        """Return True if no SYNC has arrived for too long, at host time `host_ns`; also before the first one."""
        return self._last_host_ns is None or host_ns - self._last_host_ns > self._alarm_ns

    @property
    def estimate(self) -> ClockEstimate | None:
        """The line now; None before two SYNCs."""
        if len(self._hull) < 2:
            return None
        last_ns = self._hull[-1][0]
        middle_ns = (self._hull[0][0] + last_ns) / 2
        (x0, y0), (x1, y1) = next(edge for edge in pairwise(self._hull) if edge[1][0] >= middle_ns)
        slope = (y1 - y0) / (x1 - x0)
        return ClockEstimate(last_ns, y1 + (last_ns - x1) * slope - self._least_delay_ns, slope * 1e6)


def _turns_down(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    """Return True if `b` is on or above the line from `a` to `c`."""
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])

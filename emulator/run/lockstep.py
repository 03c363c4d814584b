"""Time driven by a bus: each SYNC lets the run go on by one period, for targets too slow for real time."""

from __future__ import annotations

from collections.abc import Callable

from transports.link.edges import EdgeRing
from transports.link.pacing import Clock

__all__ = ["Lockstep"]

_POLL_NS = 200_000
_FOREVER_US = 1 << 62


class Lockstep:
    """How far the SYNCs heard let the run go.

    Parameters
    ----------
    syncs
        Where they are heard.
    period_ns
        What each of them is worth.
    """

    def __init__(self, syncs: EdgeRing, period_ns: int, clock: Clock) -> None:
        self._syncs = syncs
        self._period_ns = period_ns
        self._clock = clock
        self.heard = 0

    @property
    def limit_ns(self) -> int:
        """Stream time that the run may reach."""
        self.heard += len(self._syncs.take(_FOREVER_US))
        return self.heard * self._period_ns

    def wait(self, t_ns: int, goes_on: Callable[[], bool]) -> int:
        """Return the stream time that the run may reach as soon as it is beyond `t_ns`, or when `goes_on` says no."""
        while (limit_ns := self.limit_ns) <= t_ns and goes_on():
            self._clock.sleep_until(self._clock.now_ns() + _POLL_NS)
        return limit_ns

"""A clock in software, and the servo that sets its time and rate by measured offsets from a master.

    time = time_ns + (local - local_ns) * (1 + rate_ppb / 10^9)        in integers, rounded down

`local` is a free-running clock of the machine, which is never set.

The servo has three phases:

    first offset         the time is set by all of it
    estimate             at least 8 offsets and 1 s: the rate is set by the line through the medians of both halves
    locked               rate -= proportional * offset + integral, limited; phase error decays with damping 0.7

An offset beyond 1 ms, three times in a row, begins anew: the master has set its time. In the locked phase a single
offset counts for at most 100 us, so that one late message does not move the clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

_PPB = 1_000_000_000
_NS_PER_S = 1_000_000_000
_MOST_PPB = 500_000
_STEP_NS = 1_000_000
_STEPS_IN_A_ROW = 3
_MOST_COUNTED_NS = 100_000
_LEAST_ESTIMATES = 8
_ESTIMATE_NS = 1_000_000_000
_PROPORTIONAL, _INTEGRAL = 0.2, 0.02  # of an offset, in one interval
_INTERVALS_S = (1 / 128, 64.0)


@dataclass(frozen=True)
class Timebase:
    """Relation of a clock to the local one.

    Attributes
    ----------
    local_ns, time_ns
        Readings of the local clock and of this one at the same instant.
    rate_ppb
        Parts in 10^9 by which this clock goes faster than the local one.
    """

    local_ns: int = 0
    time_ns: int = 0
    rate_ppb: int = 0

    def at(self, local_ns: int) -> int:
        """Return the clock's reading at a reading of the local clock, ns."""
        elapsed_ns = local_ns - self.local_ns
        return self.time_ns + elapsed_ns + elapsed_ns * self.rate_ppb // _PPB

    def slewed(self, local_ns: int, rate_ppb: int) -> Timebase:
        """Return the clock with another rate from `local_ns` on."""
        return Timebase(local_ns, self.at(local_ns), rate_ppb)

    def stepped(self, by_ns: int) -> Timebase:
        """Return the clock with its time set ahead by `by_ns`."""
        return replace(self, time_ns=self.time_ns + by_ns)


class Servo:
    """The servo of one clock.

    Attributes
    ----------
    clock
        The clock that it sets.
    locked
        True if time and rate follow the master.
    steps
        Number of times that the time was set.
    """

    def __init__(self) -> None:
        self.clock = Timebase()
        self.steps = 0
        self.locked = False
        self._samples: list[tuple[int, int]] = []
        self._far = 0
        self._integral_ppb = 0.0
        self._before_s = 0.0
        self._last_ns: int | None = None

    def restart(self) -> None:
        """Begin anew with the next offset; until then the clock goes on with its rate."""
        self.locked = False
        self._samples.clear()
        self._far = 0
        self._before_s = 0.0
        self._last_ns = None

    def sample(self, local_ns: int, offset_ns: int) -> None:
        """Take an offset of the clock from its master, measured at `local_ns`."""
        if self._last_ns is not None and local_ns <= self._last_ns:
            return
        if self._last_ns is None:
            self._set(-offset_ns)
        elif self.locked and self._is_far(offset_ns):
            self.restart()
            self._set(-offset_ns)
        elif self.locked:
            self._follow(local_ns, offset_ns)
        else:
            self._estimate(local_ns, offset_ns)
        self._last_ns = local_ns

    def _set(self, by_ns: int) -> None:
        self.clock = self.clock.stepped(by_ns)
        self.steps += 1

    def _is_far(self, offset_ns: int) -> bool:
        self._far = self._far + 1 if abs(offset_ns) > _STEP_NS else 0
        return self._far == _STEPS_IN_A_ROW

    def _estimate(self, local_ns: int, offset_ns: int) -> None:
        """Collect offsets; then set rate and time by them."""
        self._samples.append((local_ns, offset_ns))
        if len(self._samples) < _LEAST_ESTIMATES or local_ns - self._samples[0][0] < _ESTIMATE_NS:
            return
        slope_ppb, last_ns = _line(self._samples)
        self._integral_ppb = _limited(self.clock.rate_ppb - slope_ppb)
        self.clock = self.clock.slewed(local_ns, round(self._integral_ppb))
        self._set(-round(last_ns))
        self.locked = True
        self._samples.clear()

    def _follow(self, local_ns: int, offset_ns: int) -> None:
        assert self._last_ns is not None
        least_s, most_s = _INTERVALS_S
        elapsed_s = min(most_s, max(least_s, (local_ns - self._last_ns) / _NS_PER_S))
        interval_s = max(elapsed_s, self._before_s)  # a Sync that came late is followed by the next one soon
        self._before_s = elapsed_s
        counted_ns = min(_MOST_COUNTED_NS, max(-_MOST_COUNTED_NS, offset_ns))
        self._integral_ppb = _limited(self._integral_ppb - _INTEGRAL * counted_ns / interval_s)
        rate_ppb = _limited(self._integral_ppb - _PROPORTIONAL * counted_ns / interval_s)
        self.clock = self.clock.slewed(local_ns, round(rate_ppb))


def _line(samples: list[tuple[int, int]]) -> tuple[float, float]:
    """Return slope, ns/s, and last value, ns, of the line through the medians of both halves.

    A single outlier has no effect.
    """
    times_s = [(local_ns - samples[0][0]) / _NS_PER_S for local_ns, _ in samples]
    offsets_ns = [offset_ns for _, offset_ns in samples]
    half = len(samples) // 2
    first_s, second_s = middle(times_s[:half]), middle(times_s[half:])
    first_ns, second_ns = middle(offsets_ns[:half]), middle(offsets_ns[half:])
    slope = (second_ns - first_ns) / (second_s - first_s)
    return slope, second_ns + slope * (times_s[-1] - second_s)


def middle(values: Sequence[float]) -> float:
    """Return the median; `statistics` takes longer to import than a small process should need."""
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


def _limited(rate_ppb: float) -> float:
    return min(_MOST_PPB, max(-_MOST_PPB, rate_ppb))

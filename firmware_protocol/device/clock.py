"""A device's own clock: its reading as a function of stream time, in integers; and keyed random draws.

    shown(t) = t + offset + phase(t) + the steps so far             all in ns; phase is stored in ps

    rate of second k, in parts per 10^12:   rate_k = drift + ramp_k + walk_k
    phase at its start, in ps:              phase_k = rate_0 + ... + rate_(k-1)         (1 s x 10^-12 = 1 ps)
    within it:                              phase_k + rate_k * (t - k s) / 1 s

`ramp_k` is the part of a temperature ramp that has passed in the middle of that second; `walk_k` a random walk of the
frequency, one keyed normal step a second. The frequency is constant within a second: a quartz changes slowly, by its
temperature.

A hardware counter never runs backward: at a step back it stands still until time has caught up. A restart sets it to
zero; `shown` ignores restarts, because the device executes them (its host gets a timestamp reset), and `restarts_us`
lists them.

The result does not depend on the sequence of calls. Rates and phases of the last hour are stored, no more.

Keyed draws are random numbers that depend on (seed, purpose, index) only, not on the step, batch or restart.

SplitMix64 (Steele, Lea and Flood, OOPSLA 2014; finaliser "variant 13" of D. Stafford):

    base  = mix(mix(seed) + purpose * golden)
    value = mix(base + (index + 1) * golden)          golden = 2^64 / golden ratio, made odd

A uniform number is (top 53 bits + 1/2) / 2^53, so it is never 0 nor 1. A normal number is Box-Muller on the two halves
of one value, hence within 6.8 standard deviations.

All functions take and return arrays of 64-bit words. They are the only source of draws: the sensor's keyed numbers,
with one stream for each pixel, are built on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from firmware_protocol.bounds import Bounded, check_bounds

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""Distance between two streams, and between two numbers of a stream."""

_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_WORD = (1 << 64) - 1

Words = npt.NDArray[np.uint64]


class Draw(IntEnum):
    """Purpose of a draw. The values define the meaning of a seed: never reuse or renumber them."""

    EDGE_JITTER = 64
    CLOCK_WALK = 65


def mix(z: Words) -> Words:
    """Scramble 64-bit words, one to one; also compiled by numba for single words."""
    z = (z ^ (z >> np.uint64(30))) * _MULTIPLIERS[0]
    z = (z ^ (z >> np.uint64(27))) * _MULTIPLIERS[1]
    return z ^ (z >> np.uint64(31))


def as_words(numbers: npt.ArrayLike) -> Words:
    """Return whole numbers as 64-bit words, at least one-dimensional."""
    return np.atleast_1d(np.asarray(numbers)).astype(np.uint64)


def root_of(seed: int, purpose: int) -> Words:
    """Return the start of the streams of a seed and a purpose, (1,)."""
    with np.errstate(over="ignore"):
        return mix(mix(as_words(seed & _WORD)) + as_words(purpose) * GOLDEN)


def words_of(base: Words, index: npt.ArrayLike) -> Words:
    """Return numbers `index` >= 0 of the streams that start at `base` (broadcast)."""
    with np.errstate(over="ignore"):
        return mix(base + (as_words(index) + np.uint64(1)) * GOLDEN)


def normal_of(words: Words) -> npt.NDArray[np.float64]:
    """Return a normal number of mean 0 and deviation 1 for each word."""
    radius = np.sqrt(-2 * np.log(((words >> np.uint64(32)).astype(np.float64) + 0.5) / 2.0**32))
    return np.asarray(radius * np.cos(2 * np.pi * (words & np.uint64(0xFFFFFFFF)).astype(np.float64) / 2.0**32))


def normal(seed: int, purpose: Draw, index: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return normal numbers of mean 0 and deviation 1, one for each of `index`, whole numbers >= 0, shape (n,)."""
    return normal_of(words_of(root_of(seed, purpose), index))


Times = npt.NDArray[np.int64]

_SECOND_NS = 1_000_000_000
_KEPT_SECONDS = 3600
_YEAR_S = 3.2e7
_StreamSeconds = Annotated[float, Meta(ge=0, le=_YEAR_S)]
_Ppm = Annotated[float, Meta(ge=-1000, le=1000)]
_AHEAD_SECONDS = 64
_PPT_PER_PPM = 1_000_000
_PPT_PER_PPB = 1000


@dataclass(frozen=True)
class ClockStep(Bounded):
    """A jump of the clock: by `by_us`, forward or back, at `at_s` of stream time.

    Attributes
    ----------
    at_s : stream time of the jump, seconds.
    by_us : its size, microseconds; above 0 the clock jumps forward.
    """

    at_s: _StreamSeconds
    by_us: Annotated[float, Meta(ge=-1e12, le=1e12)]


@dataclass(frozen=True)
class ClockSettings:
    """Errors of a camera's clock.

    Attributes
    ----------
    offset_us : its reading at the start.
    drift_ppm : frequency error, positive if too fast; a quartz has 10 to 50.
    walk_ppb : random walk of its frequency, standard deviation after one second; after n seconds sqrt(n) times that.
    ramp_ppm, ramp_from_s, ramp_seconds
        A temperature ramp: the frequency changes by `ramp_ppm`, evenly, within `ramp_seconds` from `ramp_from_s` on.
    steps : jumps. The clock of a camera never runs backward: at a jump back it stands still until time has caught up.
    restarts_s : stream times at which it restarts at zero, as by a pulse on a DAVIS346's synchronisation input.
    """

    offset_us: Annotated[float, Meta(ge=0, le=1e15)] = 0.0
    drift_ppm: _Ppm = 0.0
    walk_ppb: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    ramp_ppm: _Ppm = 0.0
    ramp_from_s: _StreamSeconds = 0.0
    ramp_seconds: Annotated[float, Meta(gt=0, le=_YEAR_S)] = 60.0
    steps: tuple[ClockStep, ...] = ()
    restarts_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_bounds(self)
        if not all(0 < at_s <= _YEAR_S for at_s in self.restarts_s):
            raise ValueError(f"restarts_s must be above 0 and at most 3.2e7, got {self.restarts_s}")


class DeviceClock:
    """A clock with `settings`, its walk drawn from `seed`. Calls may go back by an hour at most."""

    def __init__(self, settings: ClockSettings, seed: int) -> None:
        self._settings = settings
        self._seed = seed
        self._offset_ns = round(settings.offset_us * 1000)
        steps = sorted(settings.steps, key=lambda step: step.at_s)
        self._step_at_ns = np.array([round(step.at_s * 1e9) for step in steps], np.int64)
        self._step_by_ns = np.array([round(step.by_us * 1000) for step in steps], np.int64)
        self._stepped_ns = np.concatenate([np.zeros(1, np.int64), np.cumsum(self._step_by_ns)])
        self._least_ns = [0]  # shown at least, after 0, 1, ... of the steps
        self._first = 0
        self._rates = np.zeros(0, np.int64)
        self._phases = np.zeros(1, np.int64)
        self._walked = 0

    def shown_ns(self, stream_ns: npt.ArrayLike) -> Times:
        """Return the clock's reading at `stream_ns` >= 0, (n,) ns, without restarts."""
        t = np.atleast_1d(np.asarray(stream_ns, np.int64))
        if not len(t):
            return t.copy()
        last_ns = int(t.max())
        while len(self._least_ns) <= len(self._step_at_ns) and self._step_at_ns[len(self._least_ns) - 1] <= last_ns:
            self._pass_step(len(self._least_ns) - 1)
        done = np.searchsorted(self._step_at_ns, t, side="right")
        shown: Times = np.maximum(self._running_ns(t, done), np.array(self._least_ns, np.int64)[done])
        return shown

    def shown_us(self, stream_us: npt.ArrayLike) -> Times:
        """Return the same in whole microseconds, as a counter of microseconds shows it."""
        return self.shown_ns(np.atleast_1d(np.asarray(stream_us)).astype(np.int64) * 1000) // 1000

    def stream_us(self, shown_us: Times, near_us: int) -> npt.NDArray[np.float64]:
        """Return the time at which the clock showed `shown_us`, (n,) us, to about a microsecond.

        `near_us` is a stream time nearby. While the clock stands still, any time of that interval may be returned. For
        the measurement of latencies, not for timestamps.
        """
        ahead = int(self.shown_us(near_us)[0]) - near_us
        t = np.maximum(shown_us.astype(np.int64) - ahead, 0)
        for _ in range(3):
            t = np.maximum(t + shown_us.astype(np.int64) - self.shown_us(t), 0)
        return t.astype(np.float64)

    def ppm(self, stream_us: int) -> float:
        """Return the clock's frequency error at `stream_us`, ppm, positive if too fast."""
        second = stream_us // 1_000_000
        self._reach(second, second)
        return float(self._rates[second - self._first]) / _PPT_PER_PPM

    def _phase_ns(self, t: Times) -> Times:
        second = t // _SECOND_NS
        earliest = int(second.min())
        self._reach(int(second.max()), earliest)
        at = second - self._first
        if earliest < self._first:
            raise ValueError(f"the clock's readings before {self._first} s are no longer stored")
        within_ps = self._rates[at] * (t - second * _SECOND_NS) // _SECOND_NS
        phase_ns: Times = (self._phases[at] + within_ps) // 1000
        return phase_ns

    def _running_ns(self, t: Times, done: npt.NDArray[np.intp]) -> Times:
        """Return the reading of a clock that may run backward, `done` (n,) steps done."""
        shown: Times = t + self._offset_ns + self._phase_ns(t) + self._stepped_ns[done]
        return shown

    def _pass_step(self, i: int) -> None:
        """Store the reading just before a step back: later readings are not less."""
        least = self._least_ns[i]
        if self._step_by_ns[i] < 0:
            before = np.maximum(self._step_at_ns[i : i + 1] - 1, 0)
            least = max(least, int(self._running_ns(before, np.array([i]))[0]))
        self._least_ns.append(least)

    def _reach(self, second: int, earliest: int) -> None:
        """Compute the rates from `earliest` up to `second`, with some more in advance."""
        computed = self._first + len(self._rates)
        if second < computed:
            return
        seconds = np.arange(computed, second + 1 + _AHEAD_SECONDS, dtype=np.int64)
        rates = self._rates_of(seconds)
        phases = self._phases[-1] + np.cumsum(rates)
        self._rates = np.concatenate([self._rates, rates])
        self._phases = np.concatenate([self._phases, phases])
        old = max(0, min(second - _KEPT_SECONDS, earliest) - self._first)
        self._first, self._rates, self._phases = self._first + old, self._rates[old:], self._phases[old:]

    def _rates_of(self, seconds: Times) -> Times:
        s = self._settings
        rates = np.full(len(seconds), round(s.drift_ppm * _PPT_PER_PPM), np.int64)
        if s.ramp_ppm:
            gone = np.clip((seconds + 0.5 - s.ramp_from_s) / s.ramp_seconds, 0, 1)
            rates += np.rint(gone * s.ramp_ppm * _PPT_PER_PPM).astype(np.int64)
        if s.walk_ppb:
            moves = np.rint(normal(self._seed, Draw.CLOCK_WALK, seconds) * s.walk_ppb * _PPT_PER_PPB).astype(np.int64)
            walk = self._walked + np.cumsum(moves)
            self._walked = int(walk[-1])
            rates += walk
        return rates

"""Jitter of events: a keyed delay for each event of each pixel, which preserves the order of a pixel's events.

Event number k of a pixel (counted since the reset) is delayed by a log-normal time of the given mean and deviation,
keyed by pixel and k; it leaves at least 1 ns after event k - 1. Events that leave after the step stay pending. So the
result depends on the crossings alone, not on their division into steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.slots import LONGEST_NS, Pending, Window, new_pending, release, reserve
from emulator.sensor.effects import JitterParameters
from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.numerics.keyed import Purpose, root_of
from emulator.sensor.numerics.keyed_kernels import normal_of, stream, word
from emulator.sensor.pixels.array import Crossings
from emulator.sensor.pixels.merging import joined, unpacked

__all__ = ["Jitter"]


class _Delays(NamedTuple):
    """Logarithm of the delay in ns, mean and deviation; of each pixel, number of events and when the last one left."""

    root: np.uint64
    mean: float
    deviation: float
    events: npt.NDArray[np.int64]
    last_ns: npt.NDArray[np.int64]


_Arrays = tuple[npt.NDArray[np.int64], npt.NDArray[np.uint32], npt.NDArray[np.bool_]]


@cached_entry
def _delay(
    crossings: _Arrays,
    window: Window,
    d: _Delays,
    pending: Pending,
    n: int,
) -> tuple[Pending, int, npt.NDArray[np.uint64]]:
    """Add crossings to the pending events; return those that stay pending, and the packed events of the window."""
    t_ns, pixels, on = crossings
    pending = reserve(pending, n, t_ns.size)
    for k in range(t_ns.size):
        pixel = pixels[k]
        bits = word(stream(d.root, pixel), d.events[pixel])
        late_ns = int(math.exp(d.mean + d.deviation * normal_of(bits)))
        leaves_ns = max(t_ns[k] + late_ns, d.last_ns[pixel] + 1)
        d.events[pixel] += 1
        d.last_ns[pixel] = leaves_ns
        pending.t_ns[n], pending.key[n] = leaves_ns, np.uint64(pixel) << np.uint64(1) | np.uint64(on[k])
        n += 1
    keys = np.empty(n + 1, np.uint64)
    found, remaining = release(window, pending, n, keys)
    return pending, remaining, keys[:found]


class Jitter:
    """The delays of an array's events.

    Parameters
    ----------
    parameters : JitterParameters
        With `latency_us` > 0.
    seed : int
        Keys the delays.
    pixels : int
        Number of pixels.

    Attributes
    ----------
    waiting : int
        Events that have not left.
    """

    def __init__(self, parameters: JitterParameters, seed: int, pixels: int) -> None:
        deviation = math.sqrt(math.log1p((parameters.deviation_us / parameters.latency_us) ** 2))
        mean = math.log(parameters.latency_us * 1000) - deviation**2 / 2
        nothing = np.zeros(pixels, np.int64)
        self._delays = _Delays(root_of(seed, Purpose.LATENCY), mean, deviation, nothing, nothing.copy())
        self._pixel_bits = max(1, (pixels - 1).bit_length())
        self.reset(0)

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns` with nothing waiting and events counted from 0."""
        self._delays.events[:], self._delays.last_ns[:] = 0, t_ns
        self._pending, self.waiting = new_pending(), 0
        self._t_ns = t_ns

    def step(self, crossings: Crossings, t_ns: int) -> Crossings:
        """Add the crossings of a step, and return the events that leave before its end, `t_ns`."""
        parts, k = [], 0
        while t_ns - self._t_ns > LONGEST_NS:
            end_ns = self._t_ns + LONGEST_NS
            n = int(np.searchsorted(crossings.t_ns, end_ns))
            parts.append(self._advance(crossings, (k, n), end_ns))
            k = n
        parts.append(self._advance(crossings, (k, len(crossings)), t_ns))
        return joined(parts)

    def _advance(self, crossings: Crossings, span: tuple[int, int], t_ns: int) -> Crossings:
        """Delay some of the crossings; return the events that leave until `t_ns`, at most LONGEST_NS from now."""
        window, some = Window(0, self._t_ns, t_ns, self._pixel_bits), slice(*span)
        arrays = crossings.t_ns[some], crossings.pixel[some], crossings.on[some]
        pending, self.waiting, keys = _delay(arrays, window, self._delays, self._pending, self.waiting)
        self._pending, self._t_ns = Pending(*pending), t_ns
        return unpacked(keys, window.t0_ns, self._pixel_bits)

    def last_ns(self) -> int:
        """Return when the last waiting event leaves; the present time if none waits."""
        return int(self._pending.t_ns[: self.waiting].max(initial=self._t_ns))

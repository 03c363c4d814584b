"""Which events of a pixel its leak raised: a definition, because leak and light move one comparator together.

An ON event is the leak's if, since the pixel's reference was last read, the leak has moved the comparator further than
the light has: by more than half of the ON threshold, and before a pixel's first event by more than half of what was
left of it at the random start. Else it is the signal's. OFF events are always the signal's, because the leak works
against them. What the leak has moved is its rate times the time since the reference was read (at an event, and the
refractory period behind it), the parasitic leak by the mean of the light before and after each step.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.pixels.array import Crossings

__all__ = ["LeakShare"]

Floats = npt.NDArray[np.float64]


class LeakShare:
    """How much of each pixel's ON threshold its leak has moved since the reference was read.

    Parameters
    ----------
    start : (pixels,), the share of the ON threshold by which the first reference lies below the first light.
    refractory_ns : time from an event until the reference is read.
    parasitic_hz : rate that light 1 adds.
    """

    def __init__(self, start: Floats, refractory_ns: int, parasitic_hz: float) -> None:
        self._start, self._refractory_ns, self._parasitic_hz = start, refractory_ns, parasitic_hz
        self._share, self._half, self._rate_hz = (np.zeros_like(start) for _ in range(3))
        self._light = np.zeros(start.size, np.float32)
        self._t_ns = 0

    def reset(self, light: npt.NDArray[np.float32], t_ns: int) -> None:
        """Start at `t_ns` on `light`, (height, width)."""
        self._share[:], self._half[:], self._t_ns = 0, (1 - self._start) / 2, t_ns
        self._light[:] = light.reshape(-1)

    def step(
        self, crossings: Crossings, leak_hz: Floats, light: npt.NDArray[np.float32], t_ns: int
    ) -> npt.NDArray[np.bool_]:
        """Move to `t_ns`; return which of the crossings on the way are the leak's.

        Parameters
        ----------
        leak_hz : (pixels,), without the parasitic leak.
        light : (height, width) at `t_ns`.
        """
        np.copyto(self._rate_hz, leak_hz)
        if self._parasitic_hz:
            flat = light.reshape(-1)
            self._rate_hz += self._parasitic_hz / 2 * np.nan_to_num(np.maximum(self._light, 0) + np.maximum(flat, 0))
            self._light[:] = flat
        leaks = np.empty(len(crossings), np.bool_)
        arrays = crossings.t_ns, crossings.pixel, crossings.on
        _step(arrays, (self._t_ns, t_ns, self._refractory_ns), self._rate_hz, (self._share, self._half), leaks)
        self._t_ns = t_ns
        return leaks


@cached_entry
def _step(
    crossings: tuple[npt.NDArray[np.int64], npt.NDArray[np.uint32], npt.NDArray[np.bool_]],
    times_ns: tuple[int, int, int],
    rate_hz: Floats,
    levels: tuple[Floats, Floats],
    leaks: npt.NDArray[np.bool_],
) -> None:
    share, half = levels
    (t_ns, pixel, on), (t0_ns, t1_ns, refractory_ns) = crossings, times_ns
    for k in range(t_ns.size):
        p = pixel[k]
        leaks[k] = on[k] and share[p] + rate_hz[p] * (t_ns[k] - t0_ns) * 1e-9 > half[p]
        half[p] = 0.5
        share[p] = -rate_hz[p] * (t_ns[k] + refractory_ns - t0_ns) * 1e-9
    moved_s = (t1_ns - t0_ns) * 1e-9
    for p in range(share.size):
        share[p] += rate_hz[p] * moved_s

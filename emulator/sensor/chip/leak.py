"""Leak that changes while the array runs: pixels that a dose turns hot, and jitter between stretches of time.

The leak of a pixel is constant over each stretch of 2^33 ns (8.6 s, the epochs of `array`): the pixel's usual leak
times 1 + share times a keyed normal number, never below 0. It changes at fixed stream times, which `Sensor` makes the
ends of steps, so the result does not depend on the steps.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.defects import Defects
from emulator.sensor.numerics.keyed import Purpose, root_of
from emulator.sensor.numerics.keyed_kernels import normals, streams
from emulator.sensor.pixels.faults import PixelFaults

__all__ = ["NEVER_NS", "Leaks"]

NEVER_NS = (1 << 63) - 1
_STRETCH_BITS = 33

_Floats = npt.NDArray[np.float64]


class Leaks:
    """The changing leak of an array.

    Parameters
    ----------
    pixels : PixelFaults
        The array's pixels; their present leak is the usual one.
    seed : int
        Keys the jitter.
    share : float
        Relative standard deviation of a pixel's leak between stretches.
    defects : Defects
        Pixels that are or turn hot.

    Attributes
    ----------
    next_ns : int
        Time of the next change; NEVER_NS if there is none.
    """

    def __init__(self, pixels: PixelFaults, seed: int, share: float, defects: Defects) -> None:
        self._pixels, self._share, self._defects = pixels, share, defects
        self._usual_hz = pixels.leak_hz()
        self._streams = streams(root_of(seed, Purpose.LEAK_JITTER), self._usual_hz.size) if share else None
        self.next_ns = NEVER_NS

    def follow(self, t_ns: int) -> None:
        """Set the leak that holds from `t_ns`, the array's time, until `next_ns`."""
        d, hz = self._defects, self._usual_hz.copy()
        turned = int(np.searchsorted(d.hot_from_ns, t_ns, side="right"))
        hz[d.hot[:turned]] = d.hot_hz[:turned]
        next_ns = int(d.hot_from_ns[turned]) if turned < d.hot.size else NEVER_NS
        if self._streams is not None:
            stretch = t_ns >> _STRETCH_BITS
            hz *= np.maximum(1 + self._share * normals(self._streams, stretch), 0)
            next_ns = min(next_ns, (stretch + 1) << _STRETCH_BITS)
        self._pixels.set_leak(hz)
        self.next_ns = next_ns

"""The light on each pixel while it is exposed: the integral over pictures, on a straight line between two."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.light import Light

__all__ = ["Exposure"]

Times = npt.NDArray[np.int64]


class Exposure:
    """Integrates light over the exposure of each line of a frame.

    Parameters
    ----------
    open_ns, shut_ns
        (lines,) of each line.
    samples
        Of a line.

    Attributes
    ----------
    light_ms
        (lines, samples) float32, light times milliseconds so far.
    """

    def __init__(self, open_ns: Times, shut_ns: Times, samples: int) -> None:
        self._open, self._shut = open_ns, shut_ns
        self.light_ms = np.zeros((len(open_ns), samples), np.float32)

    def add(self, before: Light, t0_ns: int, after: Light, t1_ns: int) -> None:
        """Add the time from `t0_ns` to `t1_ns`, with the light at both, (lines, samples) float32."""
        if t1_ns <= t0_ns:
            return
        begin, end = np.maximum(self._open, t0_ns), np.minimum(self._shut, t1_ns)
        lit = np.flatnonzero(begin < end)
        if not len(lit):
            return
        part = slice(int(lit[0]), int(lit[-1]) + 1)  # lines open and shut in order, so there is no gap
        length_ms = (end[part] - begin[part]) * 1e-6
        middle = ((begin[part] + end[part]) / 2 - t0_ns) / (t1_ns - t0_ns)
        first, second = (1 - middle) * length_ms, middle * length_ms
        self.light_ms[part] += _weighed(first, before[part]) + _weighed(second, after[part])


def _weighed(weights: npt.NDArray[np.float64], light: Light) -> Light:
    """Return (lines, samples) of light, negative as 0, times (lines,) of weights."""
    product: Light = np.maximum(light, 0) * weights.astype(np.float32)[:, None]
    return product

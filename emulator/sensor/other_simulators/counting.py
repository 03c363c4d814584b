"""v2e's rule, which counts thresholds and spreads events evenly, and the same rule with an exact filter.

v2e (Hu, Liu and Delbruck, CVPRW 2021; read at commit cac6384): the filter mixes the last filtered value with the log of
the new frame, v += min(1, lambda h) (u1 - v); the change since the reference over the threshold, rounded down, is the
number of events; they are spread evenly, the last at the step's end. Within a refractory period events are not lost but
deferred, as the reference moves only for those that are emitted. Here each pixel spreads its own events; v2e takes the
array's largest count for all.

`V2eExactFilter` decays exactly towards the new light, as if that held during the whole step (the front end of IEBCS),
and counts and spreads as v2e does.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.other_simulators.rule import Fired, Frame, Rule, each

__all__ = ["V2e", "V2eExactFilter"]

_Float64s = npt.NDArray[np.float64]
_NEVER_NS = -(1 << 62)


class V2e(Rule):
    """Clamped mixing factor, counts, even slots, deferred events."""

    def reset(self, light: npt.NDArray[np.float32], t_ns: int, rate: npt.NDArray[np.float32] | None = None) -> None:
        """See `Rule`."""
        super().reset(light, t_ns, rate)
        self._refractory_until_ns[:] = _NEVER_NS

    def _mixing(self, rate: _Float64s, h_s: float) -> _Float64s:
        """Return the share of the new light in the filtered value."""
        return np.minimum(1.0, rate * h_s)

    def _fire(self, frame: Frame) -> Fired:
        u1 = np.where(frame.readable, frame.u1, self._v)
        self._v = self._v + self._mixing(self._rate(u1), frame.h_s) * (u1 - self._v)
        self._r = self._r - self._drawn.leak * frame.h_s
        apart = np.where(frame.readable, self._v - self._r, 0.0)
        on, theta = apart > 0, np.where(apart > 0, self._drawn.on, self._drawn.off)
        counts = np.floor(np.abs(apart) / theta).astype(np.int64)
        pixel, k = each(counts)
        share = (k + 1) / counts[pixel]
        emitted = self._pass(pixel, k, frame.t0_ns + (share * frame.h_ns).astype(np.int64))
        moved = np.bincount(pixel[emitted], minlength=counts.size)
        self._r = self._r + moved * np.where(on, theta, -theta)
        return Fired(pixel[emitted], share[emitted], on[pixel[emitted]])

    def _pass(
        self, pixel: npt.NDArray[np.int64], k: npt.NDArray[np.int64], t_ns: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.bool_]:
        """Return which events lie outside the refractory period of the last one emitted, slot by slot."""
        if self._refractory_ns() == 0:
            return np.ones(pixel.size, np.bool_)
        emitted = np.zeros(pixel.size, np.bool_)
        for slot in range(int(k.max(initial=-1)) + 1):
            here = np.flatnonzero(k == slot)
            here = here[t_ns[here] >= self._refractory_until_ns[pixel[here]]]
            emitted[here] = True
            self._refractory_until_ns[pixel[here]] = t_ns[here] + self._refractory_ns()
        return emitted


class V2eExactFilter(V2e):
    """v2e's rule behind a filter that decays exactly towards the new light."""

    def _mixing(self, rate: _Float64s, h_s: float) -> _Float64s:
        return np.asarray(-np.expm1(-rate * h_s))

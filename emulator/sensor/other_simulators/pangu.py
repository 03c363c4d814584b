"""PANGU's rule, after "Real-time event-based sensor simulation for space applications".

    filter       v += clip(lambda h, least, 1) (u1 - v); lambda proportional to light, least from the lowest corner
    reference    reduced by leakage, that of the junction and that by light: r -= (leak + by_light i) h
    difference   d = v - r
    no reset     N = floor(d / theta), r += N theta
    reset        in reset for the whole step: r = v. Else d is scaled by the share of the step that is left after the
                 reset that was going on, and is taken to grow evenly over it, at s: a first event if d >= theta, at
                 theta / s; then as many more as periods of reset and event, t_ref + theta / s, fit. The last reset is
                 not counted
    event times  the step in N equal slots, each event a keyed uniform share of its slot after its start

The paper does not tell where the reference is after a reset within the step; here it is on the even growth at the end
of the last reset, or v if that lies beyond the step. The *raw event image* is what PANGU's shader leaves of a pixel.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.keyed import Purpose, uniform
from emulator.sensor.other_simulators.rule import MOST_EVENTS, Fired, Frame, Rule, each
from emulator.sensor.pixels.packed_crossings import MOST_LOST
from emulator.sensor.presets import SensorParameters

__all__ = ["RAW_CHANNELS", "Pangu"]

_Float64s = npt.NDArray[np.float64]
_Int64s = npt.NDArray[np.int64]

RAW_CHANNELS = ("count", "first_us", "reference", "filtered", "reset_end_us")
"""The raw event image's channels: signed count of events, time of the first one in us after the step's start (NaN: none
fired), reference and filtered log light, end of the last reset in us after the step's start (NaN: not in reset)."""


class Pangu(Rule):
    """Clamped mixing factor, closed-form counts, uniform slots with jitter."""

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        super().__init__(parameters, seed)
        self._by_light = parameters.parasitic_hz_at_reference * self._drawn.on
        self._fired = np.zeros(self._drawn.on.size, np.int64)
        self._raw = np.zeros((parameters.height, parameters.width, len(RAW_CHANNELS)), np.float32)

    def reset(self, light: npt.NDArray[np.float32], t_ns: int, rate: npt.NDArray[np.float32] | None = None) -> None:
        """See `Rule`."""
        super().reset(light, t_ns, rate)
        self._fired[:] = 0
        nothing = np.full(self._fired.size, np.nan)
        self._keep_raw(np.zeros(self._fired.size), nothing, nothing)

    def raw_event_image(self) -> npt.NDArray[np.float32]:
        """Return the last step's raw event image, (height, width, 5) float32; see `RAW_CHANNELS`."""
        return self._raw.copy()

    def _fire(self, frame: Frame) -> Fired:
        u1 = np.where(frame.readable, frame.u1, self._v)
        self._v = self._v + np.minimum(1.0, self._rate(u1) * frame.h_s) * (u1 - self._v)
        self._r = self._r - (self._drawn.leak + self._by_light * np.exp(u1)) * frame.h_s
        apart = np.where(frame.readable, self._v - self._r, 0.0)
        on, theta = apart > 0, np.where(apart > 0, self._drawn.on, self._drawn.off)
        refractory_ns = self._refractory_ns()
        if refractory_ns:
            counts, first = self._with_reset(frame, apart, theta, refractory_ns)
        else:
            passed = np.floor(np.abs(apart) / theta)
            counts = np.minimum(passed, MOST_LOST).astype(np.int64)
            first = np.where(counts > 0, theta / np.where(counts > 0, np.abs(apart), 1), np.nan)
            self._r = self._r + passed * np.where(on, theta, -theta)
        end_ns = np.where(self._refractory_until_ns > frame.t0_ns, self._refractory_until_ns - frame.t0_ns, np.nan)
        self._keep_raw(np.where(on, counts, -counts), first * frame.h_ns, end_ns)
        listed = np.minimum(counts, MOST_EVENTS)
        pixel, k = each(listed)
        jitter = uniform(self.seed, Purpose.SLOT, pixel, self._fired[pixel] + k)
        self._fired = self._fired + counts
        return Fired(pixel, (k + jitter) / counts[pixel], on[pixel], int((counts - listed).sum()))

    def _with_reset(
        self, frame: Frame, apart: _Float64s, theta: _Float64s, refractory_ns: int
    ) -> tuple[_Int64s, _Float64s]:
        """Return counts and the share of the step at which the first event is due (NaN: none); move the references."""
        waits = np.clip((self._refractory_until_ns - frame.t0_ns) / frame.h_ns, 0, 1)
        reset = refractory_ns / frame.h_ns
        free = 1 - waits
        apart = apart * free
        fires = (np.abs(apart) >= theta) & (free > 0)
        per_event = theta * free / np.where(fires, np.abs(apart), 1)
        more = np.floor(np.where(fires, (free - per_event) / (reset + per_event), 0))
        counts = np.where(fires, 1 + more, 0).astype(np.int64)
        last_end = waits + per_event + more * (reset + per_event) + reset
        grown = apart * (last_end - waits) / np.where(free > 0, free, 1)
        inside = fires & (last_end < 1)
        reference = np.where(inside, self._v - apart + grown, self._v)
        reference = np.where(fires | (waits >= 1), reference, self._v - apart)
        self._r = np.where(frame.readable, reference, self._r)
        ends_ns = frame.t0_ns + (last_end * frame.h_ns).astype(np.int64)
        self._refractory_until_ns = np.where(fires, ends_ns, self._refractory_until_ns)
        return counts, np.where(fires, waits + per_event, np.nan)

    def _keep_raw(self, counts: _Float64s, first_ns: _Float64s, end_ns: _Float64s) -> None:
        channels = (counts, first_ns * 1e-3, self._r, self._v, end_ns * 1e-3)
        for k, channel in enumerate(channels):
            self._raw[..., k] = channel.reshape(self._raw.shape[:2])

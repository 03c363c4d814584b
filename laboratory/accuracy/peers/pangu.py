"""The rule of PANGU's event sensor, after "Real-time event-based sensor simulation for space applications".

PANGU is not public, so its rule is written here; simulators that can be run are in `adapters`. The physics is this
sensor's, in this sensor's units: photocurrent i = max(E, 0) + i_dark, u = ln i, thresholds and leak drawn as
`PixelArray` draws them. Of each step, of length h:

    filter       v += clip(lambda h, least, 1) (u1 - v); lambda proportional to light, least from the lowest corner
    reference    reduced by leakage, that of the junction and that by light: r -= (leak + by_light i) h
    difference   d = v - r
    no reset     N = floor(d / theta), r += N theta
    reset        in reset for the whole step: r = v. Else d is scaled by the share of the step that is left after the
                 present reset, and is assumed to grow evenly over it, at s: a first event if d >= theta, at
                 theta / s; then as many more as periods of reset and event, t_ref + theta / s, fit. The last reset is
                 not counted
    event times  the step in N equal slots, each event a keyed uniform share of its slot after its start

The paper gives no reference after a reset within the step; here it is on the even growth at the end of the last reset,
or v if that lies beyond the step. Unreadable light (NaN, infinite) silences a pixel for that step and is counted; its
filter starts again from the next readable light. At most 64 crossings of a pixel in a step are listed, the others are
counted. Arithmetic is float64 in numpy: a published method is reproduced, and need not be fast.
"""

from __future__ import annotations

import math

import numpy as np

from emulator.light import LightFrame
from emulator.sensor.numerics.keyed import Purpose, uniform
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings
from emulator.sensor.pixels.event_time import MOST_LOST
from emulator.sensor.pixels.method import PixelMethod, time_of
from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Float32s, Floats, Int64s, Mask

MOST_EVENTS = 64
"""Crossings of one pixel in one step that are listed."""


class Pangu(PixelMethod):
    """Clamped mixing factor, closed-form counts, uniform slots with jitter.

    Parameters
    ----------
    parameters : the sensor.
    seed : keys the pixels, which are those of a `PixelArray` with that seed.

    Attributes
    ----------
    lost_in_pixel : crossings since `reset` beyond 64 of a pixel and step.
    quiet_nan : pixel-steps since `reset` whose light was unreadable.
    """

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        super().__init__(parameters, seed)
        self._drawn = draw(parameters, seed)
        self._by_light = parameters.parasitic_hz_at_reference * self._drawn.on
        self._refractory_ns = round(parameters.refractory_us * 1000)
        pixels = self._drawn.on.size
        self._u, self._v, self._r = (np.zeros(pixels) for _ in range(3))
        self._fired, self._refractory_until_ns = np.zeros((2, pixels), np.int64)
        self._t_ns = 0

    def reset(self, frame: LightFrame) -> None:
        """Start at rest on the light of `frame`, at its time, and with counters at zero."""
        self._t_ns = int(frame.t_ns)
        self._u = self._log(self._flat(frame.light))
        self._v = self._u.copy()
        self._r = self._u - self._drawn.on * self._drawn.phase
        self._refractory_until_ns[:] = self._t_ns
        self._fired[:] = 0
        self.lost_in_pixel = self.quiet_nan = 0

    def step(self, frame: LightFrame) -> Crossings:
        """Move from the last frame to this one; a frame at the time of the last one has no effect.

        Raises ValueError where time goes back, or the frame does not have the sensor's size.
        """
        flat, t0_ns, t_ns = self._flat(frame.light), self._t_ns, time_of(frame, self._t_ns)
        if t_ns == t0_ns:
            return NO_CROSSINGS
        u1 = self._log(flat)
        unreadable, restarts = np.isnan(u1), np.isnan(self._u)
        self.quiet_nan += int(unreadable.sum())
        restarted = restarts & ~unreadable
        self._v[restarted] = u1[restarted]
        self._r[restarted & np.isnan(self._r)] = u1[restarted & np.isnan(self._r)]
        readable = ~(unreadable | restarts)
        self._u, self._t_ns = u1, t_ns
        return self._fire(t0_ns, t_ns - t0_ns, np.where(readable, u1, self._v), readable)

    @property
    def settled_ns(self) -> int:
        """Stream time up to which all crossings have been returned."""
        return self._t_ns

    def _fire(self, t0_ns: int, h_ns: int, u1: Floats, readable: Mask) -> Crossings:
        """Return the crossings of a step that ends in log light u1, and move the state."""
        h_s = h_ns * 1e-9
        self._v = self._v + np.minimum(1.0, self._rate(u1) * h_s) * (u1 - self._v)
        self._r = self._r - (self._drawn.leak + self._by_light * np.exp(u1)) * h_s
        apart = np.where(readable, self._v - self._r, 0.0)
        on, theta = apart > 0, np.where(apart > 0, self._drawn.on, self._drawn.off)
        if self._refractory_ns:
            counts = self._counts_with_reset(t0_ns, h_ns, apart, theta, readable)
        else:
            passed = np.floor(np.abs(apart) / theta)
            counts = np.minimum(passed, MOST_LOST).astype(np.int64)
            self._r = self._r + passed * np.where(on, theta, -theta)
        listed = np.minimum(counts, MOST_EVENTS)
        pixel = np.repeat(np.arange(counts.size), listed)
        k = np.arange(pixel.size) - np.repeat(np.cumsum(listed) - listed, listed)
        jitter = uniform(self.seed, Purpose.SLOT, pixel, self._fired[pixel] + k)
        self._fired = self._fired + counts
        dt_ns = np.minimum(((k + jitter) / counts[pixel] * h_ns).astype(np.int64), h_ns)
        lost = int((counts - listed).sum())
        self.lost_in_pixel += lost
        order = np.lexsort((pixel, dt_ns))
        return Crossings(t0_ns + dt_ns[order], pixel[order].astype(np.uint32), on[pixel[order]], lost)

    def _counts_with_reset(self, t0_ns: int, h_ns: int, apart: Floats, theta: Floats, readable: Mask) -> Int64s:
        """Return the numbers of events of pixels with resets; move the references."""
        waits = np.clip((self._refractory_until_ns - t0_ns) / h_ns, 0, 1)
        reset = self._refractory_ns / h_ns
        free = 1 - waits
        apart = apart * free
        fires = (np.abs(apart) >= theta) & (free > 0)
        per_event = theta * free / np.where(fires, np.abs(apart), 1)
        more = np.floor(np.where(fires, (free - per_event) / (reset + per_event), 0))
        last_end = waits + per_event + more * (reset + per_event) + reset
        grown = apart * (last_end - waits) / np.where(free > 0, free, 1)
        inside = fires & (last_end < 1)
        reference = np.where(inside, self._v - apart + grown, self._v)
        reference = np.where(fires | (waits >= 1), reference, self._v - apart)
        self._r = np.where(readable, reference, self._r)
        ends_ns = t0_ns + (last_end * h_ns).astype(np.int64)
        self._refractory_until_ns = np.where(fires, ends_ns, self._refractory_until_ns)
        return np.where(fires, 1 + more, 0).astype(np.int64)

    def _rate(self, u1: Floats) -> Floats:
        """Return the filter's rate under log light u1, rad/s."""
        p = self.parameters
        hz = np.clip(p.corner_hz_at_reference * np.exp(u1), p.corner_min_hz, p.corner_max_hz)
        return 2 * math.pi * (np.full_like(u1, math.inf) if math.isinf(p.corner_hz_at_reference) else hz)

    def _log(self, flat: Float32s) -> Floats:
        current = np.maximum(flat.astype(np.float64), 0) + self.parameters.dark_current_relative
        current[~np.isfinite(current)] = np.nan
        return np.asarray(np.log(current))

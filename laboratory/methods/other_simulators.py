"""Rules of other simulators: v2e, AirSim, Ziegler et al., PANGU, Sikorski and ESIM.

A rule treats each frame as its simulator does, with this sensor's physics in this sensor's units: photocurrent
i = max(E, 0) + i_dark, u = ln i, thresholds and leak drawn as `PixelArray` draws them. Unreadable light (NaN, infinite)
silences a pixel for that step and is counted; its filter starts again from the next readable light. At most 64
crossings of a pixel in a step are listed, the others are counted. Arithmetic is float64 in numpy: these rules reproduce
published methods, and need not be fast.

v2e (Hu, Liu and Delbruck, CVPRW 2021; read at commit cac6384): the filter mixes the last filtered value with the log of
the new frame, v += min(1, lambda h) (u1 - v); the change since the reference over the threshold, rounded down, is the
number of events; they are spread evenly, the last at the step's end. Within a refractory period events are not lost but
deferred, as the reference moves only for those that are emitted. Here each pixel spreads its own events; v2e takes the
array's largest count for all. `V2eExactFilter` decays exactly towards the new light, as if that lasted during the whole
step (the front end of IEBCS), and counts and spreads as v2e does.

AirSim, and the basic rule of Ziegler et al. (arXiv 2209.04634): the number of events is the change of log light between
two frames over the threshold, rounded down. There is no filter, no leak and no reference: the rest of the change is
lost. Events are spread evenly, the last at the end of the step.

PANGU, after "Real-time event-based sensor simulation for space applications":

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
or v if that lies beyond the step. The *raw event image* is the output of PANGU's shader for a pixel.

Sikorski and ESIM interpolate the log of each pixel's light linearly between frames, without filter and leak, and fire
where the line meets the next level. The differences:

                         Sikorski                        ESIM
    a level met exactly  fires                           must lie above (ON) or below (OFF) where the line starts: a
    at the line's start                                  signal that turned at a level never meets it again
    small changes        are used                        below 1e-6 are ignored
    thresholds           each pixel's own                ESIM draws them again for each pixel and frame; here only with
                                                         `redraw`, because pixels then die

In both, crossings within the refractory period of the last event ("latency") are lost, and the reference moves on.

Sources: Sikorski, Izzo and Meoni, CVPRW 2021, as in the PANGU paper ("linear interpolation ... taking latency into
account"); Rebecq, Gehrig and Scaramuzza, CoRL 2018, event_simulator.cpp of rpg_esim at commit 4cf0b89.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from emulator.light import LightFrame
from emulator.sensor.numerics.keyed import Purpose, normal, uniform
from emulator.sensor.pixels.crossings import Crossings
from emulator.sensor.pixels.event_time import MOST_LOST
from emulator.sensor.pixels.method import PixelMethod, time_of
from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Float32s, Floats, Int64s, Mask

MOST_EVENTS = 64
"""Crossings of one pixel in one step that are listed."""

_Bools = Mask


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a rule.

    Attributes
    ----------
    t0_ns, h_ns : start and length of the step.
    u0, u1 : (pixels,) float64, log light before and after; NaN where unreadable.
    readable : (pixels,) bool, True where both are readable.
    """

    t0_ns: int
    h_ns: int
    u0: Floats
    u1: Floats
    readable: _Bools

    @property
    def h_s(self) -> float:
        """Length, s."""
        return self.h_ns * 1e-9


@dataclass(frozen=True, slots=True)
class Fired:
    """Crossings, (n,) each: pixel, time as a share of the step in [0, 1], and polarity; and the number of lost ones."""

    pixel: Int64s
    share: Floats
    on: _Bools
    lost: int = 0


def each(counts: Int64s) -> tuple[Int64s, Int64s]:
    """Return (pixel, k) of each event, (n,): counts[p] times p, k going from 0 to counts[p] - 1."""
    active = np.flatnonzero(counts)
    many = counts[active]
    k = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
    return np.repeat(active, many), k


class Rule(PixelMethod):
    """An array of pixels under the rule of another simulator.

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
        pixels = self._drawn.on.size
        self._u, self._v, self._r = (np.zeros(pixels) for _ in range(3))
        self._refractory_until_ns = np.zeros(pixels, np.int64)
        self._t_ns = 0

    def reset(self, frame: LightFrame) -> None:
        """Start at rest on the light of `frame`, at its time, and with counters at zero."""
        self._t_ns = int(frame.t_ns)
        self._u = self._log(self._flat(frame.light))
        self._v = self._u.copy()
        self._r = self._u - self._drawn.on * self._drawn.phase
        self._refractory_until_ns[:] = self._t_ns
        self.lost_in_pixel = self.quiet_nan = 0

    def step(self, frame: LightFrame) -> Crossings:
        """Move from the last frame to this one; a frame at the time of the last one has no effect.

        Raises ValueError where time goes back, or the frame does not have the sensor's size.
        """
        flat, t0_ns, t_ns = self._flat(frame.light), self._t_ns, time_of(frame, self._t_ns)
        if t_ns == t0_ns:
            return self._crossings(Fired(np.empty(0, np.int64), np.empty(0), np.empty(0, np.bool_)), t0_ns, 0)
        u1 = self._log(flat)
        unreadable, restarts = np.isnan(u1), np.isnan(self._u)
        self.quiet_nan += int(unreadable.sum())
        restarted = restarts & ~unreadable
        self._v[restarted] = u1[restarted]
        self._r[restarted & np.isnan(self._r)] = u1[restarted & np.isnan(self._r)]
        fired = self._fire(Step(t0_ns, t_ns - t0_ns, self._u, u1, ~(unreadable | restarts)))
        self._u, self._t_ns = u1, t_ns
        return self._crossings(fired, t0_ns, t_ns - t0_ns)

    @property
    def settled_ns(self) -> int:
        """Stream time up to which all crossings have been returned."""
        return self._t_ns

    @abstractmethod
    def _fire(self, step: Step) -> Fired:
        """Return the crossings of a step, in any order, and move the state; unreadable pixels stay silent."""

    def _crossings(self, fired: Fired, t0_ns: int, h_ns: int) -> Crossings:
        """Sort by time and pixel, and drop the crossings of a pixel beyond the cap."""
        dt_ns = np.minimum((fired.share * h_ns).astype(np.int64), h_ns)
        order = np.lexsort((dt_ns, fired.pixel))
        pixel = fired.pixel[order]
        starts = np.searchsorted(pixel, pixel)
        listed = order[np.arange(order.size) - starts < MOST_EVENTS]
        listed = listed[np.lexsort((fired.pixel[listed], dt_ns[listed]))]
        lost = order.size - listed.size + fired.lost
        self.lost_in_pixel += lost
        return Crossings(t0_ns + dt_ns[listed], fired.pixel[listed].astype(np.uint32), fired.on[listed], lost)

    def _rate(self, u1: Floats) -> Floats:
        """Return the filter's rate under log light u1, rad/s."""
        p = self.parameters
        hz = np.clip(p.corner_hz_at_reference * np.exp(u1), p.corner_min_hz, p.corner_max_hz)
        return 2 * math.pi * (np.full_like(u1, math.inf) if math.isinf(p.corner_hz_at_reference) else hz)

    def _refractory_ns(self) -> int:
        return round(self.parameters.refractory_us * 1000)

    def _log(self, flat: Float32s) -> Floats:
        current = np.maximum(flat.astype(np.float64), 0) + self.parameters.dark_current_relative
        current[~np.isfinite(current)] = np.nan
        return np.asarray(np.log(current))


_NEVER_NS = -(1 << 62)


class V2e(Rule):
    """Clamped mixing factor, counts, even slots, deferred events."""

    def reset(self, frame: LightFrame) -> None:
        """See `Rule`."""
        super().reset(frame)
        self._refractory_until_ns[:] = _NEVER_NS

    def _mixing(self, rate: Floats, h_s: float) -> Floats:
        """Return the share of the new light in the filtered value."""
        return np.minimum(1.0, rate * h_s)

    def _fire(self, step: Step) -> Fired:
        u1 = np.where(step.readable, step.u1, self._v)
        self._v = self._v + self._mixing(self._rate(u1), step.h_s) * (u1 - self._v)
        self._r = self._r - self._drawn.leak * step.h_s
        apart = np.where(step.readable, self._v - self._r, 0.0)
        on, theta = apart > 0, np.where(apart > 0, self._drawn.on, self._drawn.off)
        counts = np.floor(np.abs(apart) / theta).astype(np.int64)
        pixel, k = each(counts)
        share = (k + 1) / counts[pixel]
        emitted = self._pass(pixel, k, step.t0_ns + (share * step.h_ns).astype(np.int64))
        moved = np.bincount(pixel[emitted], minlength=counts.size)
        self._r = self._r + moved * np.where(on, theta, -theta)
        return Fired(pixel[emitted], share[emitted], on[pixel[emitted]])

    def _pass(self, pixel: Int64s, k: Int64s, t_ns: Int64s) -> Mask:
        """Return the mask of events outside the refractory period of the last one emitted, slot by slot."""
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

    def _mixing(self, rate: Floats, h_s: float) -> Floats:
        return np.asarray(-np.expm1(-rate * h_s))


class FrameDifference(Rule):
    """Events by the change of log light since the last frame, in thresholds."""

    def _fire(self, step: Step) -> Fired:
        change = np.where(step.readable, step.u1, 0) - np.where(step.readable, step.u0, 0)
        on = change > 0
        counts = np.floor(np.abs(change) / np.where(on, self._drawn.on, self._drawn.off)).astype(np.int64)
        pixel, k = each(counts)
        return Fired(pixel, (k + 1) / counts[pixel], on[pixel])


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

    def reset(self, frame: LightFrame) -> None:
        """See `Rule`."""
        super().reset(frame)
        self._fired[:] = 0
        nothing = np.full(self._fired.size, np.nan)
        self._keep_raw(np.zeros(self._fired.size), nothing, nothing)

    def raw_event_image(self) -> Float32s:
        """Return the last step's raw event image, (height, width, 5) float32; see `RAW_CHANNELS`."""
        return self._raw.copy()

    def _fire(self, step: Step) -> Fired:
        u1 = np.where(step.readable, step.u1, self._v)
        self._v = self._v + np.minimum(1.0, self._rate(u1) * step.h_s) * (u1 - self._v)
        self._r = self._r - (self._drawn.leak + self._by_light * np.exp(u1)) * step.h_s
        apart = np.where(step.readable, self._v - self._r, 0.0)
        on, theta = apart > 0, np.where(apart > 0, self._drawn.on, self._drawn.off)
        refractory_ns = self._refractory_ns()
        if refractory_ns:
            counts, first = self._with_reset(step, apart, theta, refractory_ns)
        else:
            passed = np.floor(np.abs(apart) / theta)
            counts = np.minimum(passed, MOST_LOST).astype(np.int64)
            first = np.where(counts > 0, theta / np.where(counts > 0, np.abs(apart), 1), np.nan)
            self._r = self._r + passed * np.where(on, theta, -theta)
        end_ns = np.where(self._refractory_until_ns > step.t0_ns, self._refractory_until_ns - step.t0_ns, np.nan)
        self._keep_raw(np.where(on, counts, -counts), first * step.h_ns, end_ns)
        listed = np.minimum(counts, MOST_EVENTS)
        pixel, k = each(listed)
        jitter = uniform(self.seed, Purpose.SLOT, pixel, self._fired[pixel] + k)
        self._fired = self._fired + counts
        return Fired(pixel, (k + jitter) / counts[pixel], on[pixel], int((counts - listed).sum()))

    def _with_reset(self, step: Step, apart: Floats, theta: Floats, refractory_ns: int) -> tuple[Int64s, Floats]:
        """Return counts and the share of the step at which the first event is due (NaN: none); move the references."""
        waits = np.clip((self._refractory_until_ns - step.t0_ns) / step.h_ns, 0, 1)
        reset = refractory_ns / step.h_ns
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
        self._r = np.where(step.readable, reference, self._r)
        ends_ns = step.t0_ns + (last_end * step.h_ns).astype(np.int64)
        self._refractory_until_ns = np.where(fires, ends_ns, self._refractory_until_ns)
        return counts, np.where(fires, waits + per_event, np.nan)

    def _keep_raw(self, counts: Floats, first_ns: Floats, end_ns: Floats) -> None:
        channels = (counts, first_ns * 1e-3, self._r, self._v, end_ns * 1e-3)
        for k, channel in enumerate(channels):
            self._raw[..., k] = channel.reshape(self._raw.shape[:2])


_TOLERANCE = 1e-6  # ESIM's, ln units
_LEAST_THRESHOLD = 0.01  # ESIM's, ln units


class Sikorski(Rule):
    """Sikorski's rule: a straight line in log light; every level that it meets fires."""

    def reset(self, frame: LightFrame) -> None:
        """See `Rule`."""
        super().reset(frame)
        self._refractory_until_ns[:] = _NEVER_NS

    def _thresholds(self, on: _Bools) -> Floats:
        return np.where(on, self._drawn.on, self._drawn.off)

    def _moves(self, u0: Floats, u1: Floats) -> _Bools:
        return np.asarray(u0 != u1)

    def _meets(self, level: Floats, u0: Floats, u1: Floats) -> _Bools:
        """Return whether each line meets its level; a level behind its start, as after unreadable light, counts."""
        return np.where(u1 > u0, level <= u1, level >= u1)

    def _fire(self, step: Step) -> Fired:
        """Proceed level by level, with the lines that met the last one."""
        up = step.u1 > step.u0
        theta = np.where(up, 1, -1) * self._thresholds(up)
        pixel = np.flatnonzero(step.readable & self._moves(step.u0, step.u1))
        met, shares = [pixel[:0]], [np.empty(0)]
        while pixel.size:
            level, u0, u1 = self._r[pixel] + theta[pixel], step.u0[pixel], step.u1[pixel]
            meets = self._meets(level, u0, u1)
            pixel, level, u0, u1 = pixel[meets], level[meets], u0[meets], u1[meets]
            self._r[pixel] = level
            share = np.clip((level - u0) / (u1 - u0), 0, 1)
            passes = self._pass(pixel, step.t0_ns + (share * step.h_ns).astype(np.int64))
            met.append(pixel[passes])
            shares.append(share[passes])
        fired = np.concatenate(met)
        return Fired(fired, np.concatenate(shares), up[fired])

    def _pass(self, pixel: Int64s, t_ns: Int64s) -> _Bools:
        """Return the mask of crossings outside the refractory period, and begin new periods."""
        passes = t_ns >= self._refractory_until_ns[pixel]
        self._refractory_until_ns[pixel[passes]] = t_ns[passes] + self._refractory_ns()
        return passes


class Esim(Sikorski):
    """ESIM's rule: a straight line in log light, with ESIM's comparisons.

    Parameters
    ----------
    parameters, seed : see `Rule`.
    redraw : True: every pixel's thresholds are drawn again in each step, with the sensor's mismatch.
    """

    def __init__(self, parameters: SensorParameters, seed: int, redraw: bool = False) -> None:
        super().__init__(parameters, seed)
        self._redraw = redraw
        self._steps = 0

    def _thresholds(self, on: _Bools) -> Floats:
        if not self._redraw:
            return super()._thresholds(on)
        self._steps += 1
        p = self.parameters
        spread = p.mismatch * normal(self.seed, Purpose.THRESHOLD_REDRAWN, np.arange(on.size), self._steps)
        return np.maximum(np.where(on, p.threshold_on, p.threshold_off) * (1 + spread), _LEAST_THRESHOLD)

    def _moves(self, u0: Floats, u1: Floats) -> _Bools:
        return np.abs(u1 - u0) > _TOLERANCE

    def _meets(self, level: Floats, u0: Floats, u1: Floats) -> _Bools:
        return np.where(u1 > u0, (level > u0) & (level <= u1), (level < u0) & (level >= u1))


OTHER_SIMULATORS: Mapping[str, type[Rule]] = MappingProxyType(
    {
        "pangu": Pangu,
        "v2e": V2e,
        "v2e_exact_filter": V2eExactFilter,
        "sikorski": Sikorski,
        "esim": Esim,
        "frame_difference": FrameDifference,
    }
)
"""Pixel methods by their name in a rig, `run.method`."""

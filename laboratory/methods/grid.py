"""Pixels whose noise voltage is simulated on a fixed grid of times: the reference for `points`.

Its cost allows some thousand pixels. Arithmetic is float64. The grid's step is a tenth of the shortest time constant of
the noise, rounded down to a power of two of 1 us, and its times are multiples of it since stream time zero. From one
grid time to the next, with log light on a straight line between frames,

    filter    v in warped time, as in `curve`; behind a second pole w, for a v on a straight line
    noise     n1 = n0 A + sigma sqrt(1 - A^2) N,  A = e^(-delta / tau_n), N keyed by (seed, pixel, grid time)
    x - r     the comparator's input: moves by the change of w + n and by the leaks, that of light by its mean

Within a grid step x is a Brownian bridge of variance V = 2 sigma^2 delta / tau_n: a level c above both ends a, b is met
nevertheless with probability exp(-2 (c - a)(c - b) / V), at a time drawn uniformly; the comparator's value at the end
of a refractory period is drawn from the bridge.

All draws are keyed by grid time, and events are known up to the last grid time only (`settled_ns`). So in still light
the result does not depend on the steps, and in moving light it does so only through the light between frames.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame
from emulator.sensor.chip.sources import Pending, new_pending, reserve
from emulator.sensor.noise.law import bandwidth_hz, fixed_corner_hz, noise_scale
from emulator.sensor.numerics.compiled import SOURCES, kernel, kernel_that_allocates
from emulator.sensor.numerics.keyed import Purpose, high, low, normal, normal_from, root_of, stream, unit, word
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, unpacked
from emulator.sensor.pixels.event_time import levels_passed
from emulator.sensor.pixels.method import Capabilities, DrawnPixels, time_of
from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import SensorParameters
from firmware_protocol.compiled import entry_of

_MOST_EVENTS = 16  # of a pixel in a grid step
_DRAWS = 4 * _MOST_EVENTS + 4  # numbers set apart for a grid step
_HOPELESS = 40.0
_FASTEST_HZ = 1e9
_NO_POLE_HZ = 1e300

_Floats = npt.NDArray[np.float64]


class _Model(NamedTuple):
    """Constants; thresholds, leak and parasitic leak at light 1 (ln units per second) are (pixels,) float64."""

    on: _Floats
    off: _Floats
    leak: _Floats
    parasitic: _Floats
    voltage_root: np.uint64
    bridge_root: np.uint64
    delta_ns: int
    refractory_ns: int
    hz_at_reference: float
    hz_min: float
    hz_max: float
    second: float  # rate of the second pole times the grid step; 0: none
    noise_rms: float
    noise_corner_hz: float
    noise_scale: _Floats
    large: bool  # whether the photoreceptor has the large-signal law


class _State(NamedTuple):
    """State at the last grid time, (pixels,) each: log light, filter, second pole, noise, x - r (NaN: refractory)."""

    u: _Floats
    v: _Floats
    w: _Floats
    n: _Floats
    seen: _Floats
    refractory_until_ns: npt.NDArray[np.int64]


class _Span(NamedTuple):
    """The grid times after `first` up to `last`, and the times of the frames before and after them."""

    first: int
    last: int
    t0_ns: int
    t1_ns: int


class _Move(NamedTuple):
    """Motion of x - r of a pixel in a grid step: start, change, the bridge's variance; stream and next number."""

    pixel: int
    start_ns: int
    change: float
    variance: float
    base: np.uint64
    draw: int


def grid_ns(p: SensorParameters) -> int:
    """Return the grid's step, ns."""
    fastest = np.inf if math.isinf(p.corner_hz_at_reference) else min(p.corner_max_hz, _FASTEST_HZ)
    tau_us = 1e6 / (2 * math.pi * float(bandwidth_hz(p, fastest)))
    return int(1000 * 2 ** max(0, math.floor(math.log2(0.1 * tau_us))))


@kernel
def _corner_hz(u: float, m: _Model) -> float:
    hz = m.hz_at_reference * math.exp(u)
    return min(max(hz, m.hz_min), m.hz_max)


@kernel
def _filtered(u0: float, u1: float, v0: float, m: _Model) -> float:
    """Return the photoreceptor's output a grid step later."""
    rate0, rate1 = 2 * math.pi * _corner_hz(u0, m), 2 * math.pi * _corner_hz(u1, m)
    d = u1 - u0
    warped = m.delta_ns * 1e-9 * max((rate0 + rate1) / 2 + d * (rate0 - rate1) / 12, min(rate0, rate1))
    q = -math.expm1(-warped)
    if m.large:  # the same filter of e^-u (see `pixels.receptor`), relative to its value at the start
        excess, rise = math.expm1(v0 - u0), math.exp(v0 - u0) * math.expm1(-d)
        return float(v0 - math.log1p(q * excess + rise * (1 - q / warped)))
    return float(v0 + q * (u0 - v0) + d * (1 - q / warped))


@kernel
def _behind_second_pole(v0: float, v1: float, w0: float, m: _Model) -> float:
    """Return the second pole's output a grid step later."""
    if m.second == 0:
        return v1
    q = -math.expm1(-m.second)
    return float(w0 + q * (v0 - w0) + (v1 - v0) * (1 - q / m.second))


@kernel
def _leaked(u0: float, u1: float, pixel: int, m: _Model) -> float:
    """Return the increase of x - r by leaks in a grid step."""
    by_light = m.parasitic[pixel] * (math.exp(u0) + math.exp(u1)) / 2 if m.parasitic[pixel] > 0 else 0.0
    return float((m.leak[pixel] + by_light) * m.delta_ns * 1e-9)


@kernel
def _noise_figures(u: float, m: _Model) -> tuple[float, float]:
    """Return sigma and delta / tau_n at a light (see `law`)."""
    hz = _corner_hz(u, m)
    passed = m.noise_corner_hz / (m.noise_corner_hz + hz)
    return m.noise_rms * math.sqrt(passed), 2 * math.pi * hz * passed * m.delta_ns * 1e-9


@kernel
def _next_event(at: float, seen: float, end: float, move: _Move, thresholds: tuple[float, float]) -> tuple[float, int]:
    """Return the first place after `at` in the grid step where a threshold is met, and 1 for ON; 2 if there is none."""
    on, off = thresholds
    left = 1 - at
    if end >= on or end <= -off:
        level = on if end >= on else -off
        share = (level - seen) / (end - seen) if end != seen else 0.0
        return at + left * min(max(share, 0.0), 1.0), 1 if end >= on else 0
    bits = word(move.base, move.draw)
    where = at + left * unit(high(word(move.base, move.draw + 1)))
    variance = move.variance * left
    rising, falling = 2 * (on - seen) * (on - end), 2 * (seen + off) * (end + off)
    if rising < _HOPELESS * variance and unit(high(bits)) < math.exp(-rising / variance):
        return where, 1
    if falling < _HOPELESS * variance and unit(low(bits)) < math.exp(-falling / variance):
        return where, 0
    return 2.0, 0


@kernel
def _bridge(at: float, to: float, seen: float, end: float, move: _Move) -> float:
    """Return x - r at `to`, on the way from `seen` at `at` to `end` at 1."""
    share = (to - at) / (1 - at)
    deviation = math.sqrt(max(move.variance * (1 - at) * share * (1 - share), 0.0))
    return float(seen + share * (end - seen) + deviation * normal_from(word(move.base, move.draw + 2)))


@kernel
def _later(move: _Move) -> _Move:
    """Return the same move with fresh numbers."""
    return _Move(move.pixel, move.start_ns, move.change, move.variance, move.base, move.draw + 4)


@kernel_that_allocates
def _fire(move: _Move, m: _Model, s: _State, pending: Pending, n: int) -> tuple[Pending, int, int]:
    """Move a pixel's comparator over one grid step; add its events to `pending`, and return the number of lost ones."""
    pixel, events, refractory = move.pixel, 0, m.refractory_ns / m.delta_ns
    at, seen, end = 0.0, s.seen[pixel], s.seen[pixel] + move.change
    if seen != seen:
        at = max((s.refractory_until_ns[pixel] - move.start_ns) / m.delta_ns, 0.0)
        if at >= 1:
            return pending, n, 0
        seen, end = 0.0, move.change - _bridge(0.0, at, 0.0, move.change, move)
    while True:
        move = _later(move)
        if events >= _MOST_EVENTS and refractory == 0 and (end >= m.on[pixel] or end <= -m.off[pixel]):
            passed, end = levels_passed(0.0, end, m.on[pixel] if end > 0 else m.off[pixel])
            events += passed
        at_event, on = _next_event(at, seen, end, move, (m.on[pixel], m.off[pixel]))
        if at_event > 1:
            s.seen[pixel] = end
            break
        events += 1
        if events <= _MOST_EVENTS:
            pending = reserve(pending, n, 1)
            pending.t_ns[n] = move.start_ns + int(at_event * m.delta_ns)
            pending.key[n] = np.uint64(pixel) << np.uint64(1) | np.uint64(on)
            n += 1
        level = m.on[pixel] if on else -m.off[pixel]
        at = at_event + refractory
        if refractory > 0 and at >= 1:
            s.seen[pixel], s.refractory_until_ns[pixel] = np.nan, move.start_ns + int(at * m.delta_ns)
            break
        seen, end = 0.0, end - (_bridge(at_event, at, level, end, move) if refractory > 0 else level)
    return pending, n, max(events - _MOST_EVENTS, 0)


@entry_of(*SOURCES, __name__)
def _advance(
    light: tuple[_Floats, _Floats],
    span: _Span,
    m: _Model,
    s: _State,
    pending: Pending,
) -> tuple[Pending, int, int]:
    """Move all pixels over the grid times of a span; `light` is the log light of its two frames, (pixels,) each."""
    n = lost = 0
    for pixel in range(m.on.size):
        voltage, bridge = stream(m.voltage_root, pixel), stream(m.bridge_root, pixel)
        for grid in range(span.first + 1, span.last + 1):
            share = (grid * m.delta_ns - span.t0_ns) / (span.t1_ns - span.t0_ns)
            u = light[0][pixel] + share * (light[1][pixel] - light[0][pixel])
            v = _filtered(s.u[pixel], u, s.v[pixel], m)
            w = _behind_second_pole(s.v[pixel], v, s.w[pixel], m)
            sigma, delta = _noise_figures(s.u[pixel], m)
            sigma *= m.noise_scale[pixel]
            decay = math.exp(-delta)
            noise = s.n[pixel] * decay + sigma * math.sqrt(-math.expm1(-2 * delta)) * normal_from(word(voltage, grid))
            change = w - s.w[pixel] + noise - s.n[pixel] + _leaked(s.u[pixel], u, pixel, m)
            start_ns, variance = (grid - 1) * m.delta_ns, 2 * sigma * sigma * delta
            move = _Move(pixel, start_ns, change, variance, bridge, grid * _DRAWS)
            pending, n, more = _fire(move, m, s, pending, n)
            lost += more
            s.u[pixel], s.v[pixel], s.w[pixel], s.n[pixel] = u, v, w, noise
    return pending, n, lost


class NoisyPixels(DrawnPixels):
    """An array of pixels whose noise is simulated in time.

    Parameters
    ----------
    parameters : SensorParameters
        The sensor, with `noise.rms` > 0.
    seed : int
        Keys the noise, and the pixels, which are those of a `PixelArray` with that seed.

    Attributes
    ----------
    lost_in_pixel : int
        Crossings beyond 16 of a pixel in a grid step.
    quiet_nan : int
        Pixel-steps whose light was not finite; the last finite light of the pixel is used.
    """

    capabilities: ClassVar = Capabilities(has_faults=True, has_grid_noise=True, has_large_signal=True)
    _model: _Model

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        super().__init__(parameters, seed)
        p, drawn = parameters, draw(parameters, seed)
        noise_corner_hz = min(fixed_corner_hz(p), _NO_POLE_HZ)
        self._settled_ns = 0
        self._phase = drawn.phase
        no_low_pass = math.isinf(p.corner_hz_at_reference)
        self._model = _Model(
            drawn.on, drawn.off, drawn.leak, p.parasitic_hz_at_reference * drawn.on,
            voltage_root=root_of(seed, Purpose.NOISE_VOLTAGE),
            bridge_root=root_of(seed, Purpose.NOISE_BRIDGE),
            delta_ns=grid_ns(p),
            refractory_ns=round(p.refractory_us * 1000),
            hz_at_reference=_FASTEST_HZ if no_low_pass else p.corner_hz_at_reference,
            hz_min=_FASTEST_HZ if no_low_pass else p.corner_min_hz,
            hz_max=_FASTEST_HZ if no_low_pass else min(p.corner_max_hz, _FASTEST_HZ),
            second=2 * math.pi * p.source_follower_hz * grid_ns(p) * 1e-9,
            noise_rms=p.noise.rms * (math.sqrt(1 + _FASTEST_HZ / noise_corner_hz) if no_low_pass else 1.0),
            noise_corner_hz=noise_corner_hz,
            noise_scale=noise_scale(p, seed),
            large=p.photoreceptor == "large_signal",
        )  # fmt: skip
        self._u = np.zeros(drawn.on.size)
        self._t_ns = 0

    @property
    def settled_ns(self) -> int:
        """Stream time of the last grid time, up to which all crossings have been returned."""
        return self._settled_ns

    def reset(self, frame: LightFrame) -> None:
        """Start at rest on the light of `frame`, at its time, with stationary noise."""
        m, pixels = self._model, self._u.size
        self._u[:] = np.log(self.parameters.dark_current_relative)
        self._u, self._t_ns = self._log(frame.light), int(frame.t_ns)
        self.lost_in_pixel = self.quiet_nan = 0
        first = -(-self._t_ns // m.delta_ns)
        self._settled_ns = first * m.delta_ns
        hz = np.clip(m.hz_at_reference * np.exp(self._u), m.hz_min, m.hz_max)
        sigma = m.noise_rms * m.noise_scale * np.sqrt(m.noise_corner_hz / (m.noise_corner_hz + hz))
        noise = sigma * normal(self.seed, Purpose.NOISE_VOLTAGE, np.arange(pixels), first)
        seen = m.on * self._phase + noise
        self._state = _State(self._u.copy(), self._u.copy(), self._u.copy(), noise, seen, np.zeros(pixels, np.int64))

    def step(self, frame: LightFrame) -> Crossings:
        """Move from the last frame to this one; a frame at the time of the last one takes its place.

        Returns
        -------
        The crossings between the last `settled_ns` and the new one, the last grid time before the frame.

        Raises
        ------
        ValueError
            Time goes back, or the frame does not have the sensor's size.
        """
        light, t_ns, m = frame.light, time_of(frame, self._t_ns), self._model
        if t_ns == self._t_ns:
            self._u = self._log(light)
            return NO_CROSSINGS
        u, settled = self._log(light), self.settled_ns
        span = _Span(settled // m.delta_ns, t_ns // m.delta_ns, self._t_ns, t_ns)
        pending, n, lost = _advance((self._u, u), span, m, self._state, new_pending())
        self._u, self._t_ns, self._settled_ns = u, t_ns, max(span.last * m.delta_ns, settled)
        self.lost_in_pixel += lost
        bits = max(1, (u.size - 1).bit_length())
        keys = (pending[0][:n] - settled).astype(np.uint64) << np.uint64(bits + 1) | pending[1][:n]
        found = unpacked(keys, settled, bits)
        return Crossings(found.t_ns, found.pixel, found.on, lost)

    def _log(self, light: npt.NDArray[np.float32]) -> _Floats:
        """Return the log of the photocurrent, (pixels,); the last finite one where the light is not finite."""
        flat = self._flat(light).astype(np.float64)
        readable = np.isfinite(flat)
        self.quiet_nan += int((~readable).sum())
        current = np.maximum(np.where(readable, flat, 0), 0) + self.parameters.dark_current_relative
        return np.where(readable, np.log(current), self._u)

"""The truth: the continuous-time pixel in float64, against which every method is measured.

    i  = max(E, 0) + i_dark                 photocurrent, relative to the reference light
    v' = lambda(i) (ln i - v)               lambda = 2 pi clip(f_ref i, f_min, f_max)
    x' = lambda(i) (1 / i - x), v = -ln x   the same for the large-signal photoreceptor, v' = lambda (1 - e^v / i)
    w' = lambda_2 (v - w)                   the second pole, fixed; w = v without it
    q' = i                                  for the leak that light causes
    g  = w + leak t + R_par theta_on q      the comparator's input, with the reference at rest

An event where g - r first reaches theta_on or -theta_off (touching fires). Then, without a refractory period, r moves
by exactly that threshold; with one the pixel is silent until it ends, and r is g there. The start is at rest, r = w
minus a share of theta_on, the same as that of `PixelArray`.

The integration is Runge-Kutta of fourth order in steps of a few us; between, g is the cubic through its values and
slopes, divided at its extrema, and crossings are found by bisection to the last bit. Around a known jump the light is
taken as constant on both sides for one such step. `ideal_events` are those of a pixel without filter, leak and
refractory period, with r = ln i at the start: there g is ln i itself, in closed form. Nothing here is shared with the
fast kernels but the numbers that are drawn. Crossings agree with those of an adaptive solver of eighth order to 1e-6 us
at steps of 10 us (see the tests).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import SensorParameters
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Floats, Int64s, Mask
from laboratory.accuracy.scenes import ClosedLight
from laboratory.accuracy.scores import Stream
from laboratory.methods.circuit import cubic, first_crossing

_CHUNK = 512
_LONGEST_STEP = 1.5  # in time constants; Runge-Kutta is unstable from 2.8

# Without reference counts, which cost more than the arithmetic: no kernel here makes an array (see sensor.compiled).
compiled: Callable[[Callable[..., Any]], Callable[..., Any]] = entry_of(
    __name__, "laboratory.methods.circuit", "emulator.sensor.numerics.compiled", _nrt=False
)


class _Constants(NamedTuple):
    h: float  # s
    dark: float
    at_reference: float  # rad/s
    least: float
    most: float
    second: float  # rad/s; infinite: no second pole
    refractory: float  # s
    large: bool  # the large-signal photoreceptor


class _Pixels(NamedTuple):
    """Thresholds, leak (ln units a second), leak by light (the same at light 1) and jumps of each pixel."""

    on: Floats
    off: Floats
    leak: Floats
    by_light: Floats
    jumps: Floats  # (pixels, k) s


class _State(NamedTuple):
    """The state, (pixels,) each; r is the reference, and is valid after `refractory_until` (s).

    With the large-signal photoreceptor v holds x = e^-v, whose equation is linear.
    """

    v: Floats
    w: Floats
    q: Floats
    r: Floats
    refractory_until: Floats


class _Span(NamedTuple):
    """An interval of time, s, and the light at its start, middle and end."""

    t: float
    h: float
    lights: tuple[float, float, float]
    refractory: float


class _Events(NamedTuple):
    """Buffers of the events found; `n` (1,) counts further events when they are full."""

    t_s: Floats
    pixel: Int64s
    on: Mask
    n: Int64s


@compiled
def _slopes(light: float, v: float, w: float, c: _Constants) -> tuple[float, float, float]:
    """Return v', w' and q' under that light."""
    current = max(light, 0.0) + c.dark
    rate = min(max(c.at_reference * current, c.least), c.most)
    if c.large:
        x_slope = rate * (1 / current - v)
        return x_slope, c.second * (-math.log(v) - w) if c.second < math.inf else -x_slope / v, current
    v_slope = rate * (math.log(current) - v)
    return v_slope, c.second * (v - w) if c.second < math.inf else v_slope, current


@compiled
def _fine_step(
    lights: tuple[float, float, float], h: float, y: tuple[float, float, float], c: _Constants
) -> tuple[float, float, float]:
    """Return (v, w, q) a step of h later; light at its start, middle and end."""
    v, w, q = y
    a = _slopes(lights[0], v, w, c)
    b = _slopes(lights[1], v + h / 2 * a[0], w + h / 2 * a[1], c)
    d = _slopes(lights[1], v + h / 2 * b[0], w + h / 2 * b[1], c)
    e = _slopes(lights[2], v + h * d[0], w + h * d[1], c)
    v_after = v + h / 6 * (a[0] + 2 * b[0] + 2 * d[0] + e[0])
    w_after = w + h / 6 * (a[1] + 2 * b[1] + 2 * d[1] + e[1])
    return (
        v_after,
        -math.log(v_after) if c.large and c.second == math.inf else w_after,
        q + h / 6 * (a[2] + 2 * b[2] + 2 * d[2] + e[2]),
    )


@compiled
def _fire(j: int, span: _Span, g: tuple[float, float, float, float], p: _Pixels, s: _State, out: _Events) -> None:
    """Write the events of pixel j in a span in which the comparator's input is the cubic g."""
    t, h, refractory = span.t, span.h, span.refractory
    z = 0.0
    while s.refractory_until[j] <= t + h:
        if s.refractory_until[j] > -math.inf:
            z = min(max((s.refractory_until[j] - t) / h, z), 1.0)
            s.r[j] = cubic(g, z)
            s.refractory_until[j] = -math.inf
        z = first_crossing(g, z, s.r[j] - p.off[j], s.r[j] + p.on[j])
        if z > 1:
            break
        up = cubic(g, z) > s.r[j]
        n = out.n[0]
        if n < out.t_s.size:
            out.t_s[n], out.pixel[n], out.on[n] = t + z * h, j, up
        out.n[0] = n + 1
        if refractory > 0:
            s.refractory_until[j] = t + z * h + refractory
        else:
            s.r[j] += p.on[j] if up else -p.off[j]


@compiled
def _integrate(j: int, span: _Span, p: _Pixels, s: _State, c: _Constants, out: _Events) -> None:
    """Integrate pixel j over a span and write its events."""
    lights, t, h = span.lights, span.t, span.h
    y0 = (s.v[j], s.w[j], s.q[j])
    y1 = _fine_step(lights, h, y0, c)
    before, after = _slopes(lights[0], y0[0], y0[1], c), _slopes(lights[2], y1[0], y1[1], c)
    leak, by_light = p.leak[j], p.by_light[j]
    g = (
        y0[1] + leak * t + by_light * y0[2],
        y1[1] + leak * (t + h) + by_light * y1[2],
        h * (before[1] + leak + by_light * before[2]),
        h * (after[1] + leak + by_light * after[2]),
    )
    _fire(j, span, g, p, s, out)
    s.v[j], s.w[j], s.q[j] = y1


@compiled
def _advance(light: Floats, t0: float, p: _Pixels, s: _State, c: _Constants, out: _Events) -> None:
    """Integrate over light (2 steps + 1, pixels), sampled each half step from t0 on."""
    for k in range(light.shape[0] // 2):
        end = t0 + (k + 1) * c.h
        for j in range(light.shape[1]):
            start, first, middle, last = t0 + k * c.h, light[2 * k, j], light[2 * k + 1, j], light[2 * k + 2, j]
            for i in range(p.jumps.shape[1]):
                jump = p.jumps[j, i]
                if start < jump <= end:
                    _integrate(j, _Span(start, jump - start, (first, first, first), c.refractory), p, s, c, out)
                    start, first, middle = jump, last, last
            if start < end:
                _integrate(j, _Span(start, end - start, (first, middle, last), c.refractory), p, s, c, out)


def true_events(
    scene: ClosedLight, parameters: SensorParameters, seed: int, duration_s: float, fine_s: float = 1e-5
) -> Stream:
    """Return the true events of a sensor under a scene from time 0 to `duration_s`.

    Parameters
    ----------
    scene : the light, with as many pixels as the sensor.
    parameters : the sensor.
    seed : keys its mismatch, leak rates and phases.
    duration_s : rounded to a whole number of fine steps.
    fine_s : the Runge-Kutta step, s.

    Raises
    ------
    ValueError
        The scene and the sensor have different numbers of pixels; the sensor has no low-pass (the truth is the solution
        of its equation) or the circuit as its photoreceptor; the step is too long for the corner frequency.
    """
    pixels = parameters.width * parameters.height
    if scene.pixels != pixels:
        raise ValueError(f"the scene has {scene.pixels} pixels: must be the sensor's {pixels}")
    if math.isinf(parameters.corner_hz_at_reference):
        raise ValueError("corner_hz_at_reference = inf: the truth needs a low-pass; take a corner of 100 kHz")
    if parameters.photoreceptor == "circuit" or parameters.highpass_hz:
        raise ValueError('the truth has no photoreceptor = "circuit", no highpass_hz: take "one_pole", highpass_hz = 0')
    drawn, c = draw(parameters, seed), _constants(parameters, fine_s)
    by_light = parameters.parasitic_hz_at_reference * drawn.on
    static = _Pixels(drawn.on, drawn.off, drawn.leak, by_light, scene.jumps_s())
    start = np.log(np.maximum(scene.value(0.0)[0], 0) + c.dark)
    reference = start - drawn.on * drawn.phase
    first = np.exp(-start) if c.large else start.copy()
    state = _State(first, start.copy(), np.zeros(pixels), reference, np.full(pixels, -np.inf))
    steps = round(duration_s / fine_s)
    parts = [_chunk(scene, k, min(k + _CHUNK, steps), static, state, c) for k in range(0, steps, _CHUNK)]
    t_s, pixel, on = (np.concatenate([part[field] for part in parts]) for field in range(3))
    return Stream.of(t_s * 1e6, pixel, on, pixels)


def _constants(p: SensorParameters, fine_s: float) -> _Constants:
    at_reference, least, most = (
        2 * math.pi * hz for hz in (p.corner_hz_at_reference, p.corner_min_hz, p.corner_max_hz)
    )
    second = 2 * math.pi * p.source_follower_hz if p.source_follower_hz > 0 else math.inf
    large = p.photoreceptor == "large_signal"
    return _Constants(fine_s, p.dark_current_relative, at_reference, least, most, second, p.refractory_us * 1e-6, large)


def _chunk(scene: ClosedLight, first: int, last: int, p: _Pixels, s: _State, c: _Constants) -> tuple[Any, Any, Any]:
    """Integrate fine steps first to last; return times (s), pixels and polarities."""
    light = scene.value(np.arange(2 * first, 2 * last + 1) * (c.h / 2))
    fastest = min(max(c.at_reference * (float(light.max(initial=0.0)) + c.dark), c.least), c.most)
    if max(fastest, c.second if c.second < math.inf else 0) * c.h > _LONGEST_STEP:
        raise ValueError(f"fine_s = {c.h:g}: too long for a corner of {fastest / 2 / math.pi:.3g} Hz")
    return _collected(s, lambda trial, out: _advance(light, first * c.h, p, trial, c, out))


def _collected(s: _State, advance: Callable[[_State, _Events], None]) -> tuple[Any, Any, Any]:
    """Move the state on, with room for all events; return times (s), pixels and polarities."""
    room = 4096
    while True:
        out = _Events(np.empty(room), np.empty(room, np.int64), np.empty(room, np.bool_), np.zeros(1, np.int64))
        trial = _State(*(part.copy() for part in s))
        advance(trial, out)
        n = int(out.n[0])
        if n <= room:
            break
        room = n
    for part, new in zip(s, trial, strict=True):
        part[:] = new
    return out.t_s[:n], out.pixel[:n], out.on[:n]


@compiled
def _advance_ideal(u: Floats, slope: Floats, times: tuple[float, float], p: _Pixels, s: _State, out: _Events) -> None:
    """Write the events of log light u, (steps + 1, pixels), and its derivative; `times` are the start and a step, s."""
    t0, h = times
    for k in range(u.shape[0] - 1):
        span = _Span(t0 + k * h, h, (0.0, 0.0, 0.0), 0.0)
        for j in range(u.shape[1]):
            _fire(j, span, (u[k, j], u[k + 1, j], h * slope[k, j], h * slope[k + 1, j]), p, s, out)


def ideal_events(
    scene: ClosedLight, threshold_on: float, threshold_off: float, duration_s: float, fine_s: float = 1e-5
) -> Stream:
    """Return the events of ideal pixels under a scene from time 0 to `duration_s`.

    Such a pixel fires where the log of its light first reaches `threshold_on` above or `threshold_off` below its
    reference, which then moves by that threshold; it starts with the log of its light at time 0.

    Parameters
    ----------
    scene : the light, above 0 and without jumps.
    threshold_on, threshold_off : ln units, > 0.
    duration_s : rounded to a whole number of fine steps.
    fine_s : distance of the values of ln i between which it is the cubic through its values and slopes, s.

    Raises ValueError where a threshold is not positive, the light jumps, or it is not above 0.
    """
    if min(threshold_on, threshold_off) <= 0:
        raise ValueError(f"thresholds {threshold_on:g} and {threshold_off:g}: must be above 0")
    if scene.jumps_s().size:
        raise ValueError(f"{type(scene).__name__}: its light jumps, and events at a jump have no one time")
    every, none = np.ones(scene.pixels), np.zeros(scene.pixels)
    static = _Pixels(threshold_on * every, threshold_off * every, none, none, scene.jumps_s())
    start = _log_and_slope(scene, np.zeros(1))[0][0]
    state = _State(start.copy(), start.copy(), none.copy(), start.copy(), np.full(scene.pixels, -np.inf))
    steps, parts = round(duration_s / fine_s), []
    for first in range(0, steps, _CHUNK):
        u, slope = _log_and_slope(scene, np.arange(first, min(first + _CHUNK, steps) + 1, dtype=np.float64) * fine_s)
        advance = partial(_advance_ideal, u, slope, (first * fine_s, fine_s), static)
        parts.append(_collected(state, advance))
    t_s, pixel, on = (np.concatenate([part[field] for part in parts]) for field in range(3))
    return Stream.of(t_s * 1e6, pixel, on, scene.pixels)


def _log_and_slope(scene: ClosedLight, t_s: Floats) -> tuple[Floats, Floats]:
    """Return ln of the light at times (m,) s, and its time derivative, (m, pixels) each."""
    light = scene.value(t_s)
    if not light.min() > 0:
        raise ValueError(f"{type(scene).__name__}: its light must be above 0 for pixels without dark current")
    return np.log(light), scene.rate(t_s) / light

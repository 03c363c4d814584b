"""Pixels whose noise voltage is simulated on a fine grid of times: the independent reference of noise.

It shares no code with the noise of `emulator.sensor`; its cost allows some thousand pixels. Arithmetic is float64. The
shot noise of the photoreceptor is white; the receptor's pole a1, which follows the light, and a fixed one filter it:

    dn1 = -a1 n1 dt + rms sqrt(2 a1) dW        a1 = 2 pi f(light): the rms of n1 is the same in any light
    dn2 = a2 (n1 - n2) dt                      a2 = 2 pi noise.corner_hz, or the signal's source follower

From one grid time to the next (n1, n2) moves by its exact Gaussian transition at the rates of the light in the middle,
with numbers keyed by (seed, pixel, grid time). A step is a twentieth of 1 / sqrt(a1 a2) at the highest corner
frequency, a quarter of 1 / a2 at most, and a power of two; steps of half that length give the same statistics (see the
tests). Filters are solved with their input, and their rate, on a straight line between grid times.

    two poles     n2 is the cubic through its values and its derivatives a2 (n1 - n2) at both grid times, here as two
                  straight lines that join at its middle: the noise has a derivative, and no excursion between them
    one pole      where there is no fixed pole, or no receptor's, n1 at the comparator is a Brownian bridge of variance
                  V = 2 rms^2 a1 delta: a level c above both ends x, y is met with probability exp(-2(c - x)(c - y) / V)

The time t at which a bridge of length 1 first meets c is exact too: t / (1 - t) is an inverse Gaussian number of mean
|c - x| / |c - y| and shape (c - x)^2 / V (Borodin and Salminen, Handbook of Brownian Motion, 2002).

Events are known up to the last grid time (`settled_ns`): in still light they do not depend on the steps at all, and in
moving light only through the light between frames.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np

from emulator.sensor.chip.sources import Pending, new_pending, reserve
from emulator.sensor.numerics.compiled import SOURCES, kernel, kernel_that_allocates
from emulator.sensor.numerics.keyed import Purpose, high, low, normal, normal_from, root_of, stream, unit, word
from emulator.sensor.pixels.method import Capabilities
from emulator.sensor.presets import SensorParameters
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Floats, Int64s
from laboratory.methods.circuit import LogLightPixels, log_light, log_light_between

_MOST_EVENTS = 16  # of a pixel in a straight piece of its noise
_DRAWS = 4 * _MOST_EVENTS + 8  # numbers set apart for a grid step
_MOST_COUNTED = 2.0**40  # of a piece
_HOPELESS = 40.0
_FASTEST_HZ = 1e9
_PER_E_FOLD = 1024  # different lights of the noise's transition


class _Pole(NamedTuple):
    """A rate that is proportional to the photocurrent, rad/s: at light 1, and its bounds."""

    at_reference: float
    least: float
    most: float


class _Model(NamedTuple):
    """Constants; thresholds, leak and parasitic leak at light 1 (ln units per second), noise: (pixels,) float64."""

    on: Floats
    off: Floats
    leak: Floats
    parasitic: Floats
    rms: Floats
    voltage_root: np.uint64
    bridge_root: np.uint64
    delta_ns: int
    refractory_ns: int
    receptor: _Pole
    follower: float  # rad/s; 0: none
    noise: _Pole
    fixed: float  # pole of the noise behind it, rad/s; 0: none
    large: bool  # whether the photoreceptor has the large-signal law


class _State(NamedTuple):
    """State at the last grid time, (pixels,) each: log light, signal and noise behind each pole, comparator."""

    u: Floats
    v: Floats  # with the large-signal photoreceptor e^-v, whose equation is linear
    w: Floats
    n1: Floats  # over its rms
    n2: Floats
    seen: Floats  # the input over the reference; NaN: refractory
    refractory_until_ns: Int64s


class _Piece(NamedTuple):
    """A piece of a pixel's comparator input, and the pixel's stream of numbers with the next one's index."""

    pixel: int
    start_ns: int
    length_ns: int
    change: float
    variance: float
    base: np.uint64
    draw: int


class _Transition(NamedTuple):
    """n1 -> first n1 + a N, n2 -> second n2 + mixed n1 + b N + c M, with independent normal numbers N and M."""

    first: float
    second: float
    mixed: float
    a: float
    b: float
    c: float


def _poles_hz(p: SensorParameters) -> tuple[float, float]:
    """Return the fastest receptor's pole of the noise, and the pole behind it, Hz; 0: none."""
    fixed = p.noise.corner_hz or p.source_follower_hz
    if math.isinf(p.corner_hz_at_reference):
        return fixed, 0.0
    return min(p.corner_max_hz, _FASTEST_HZ), fixed


def grid_ns(p: SensorParameters) -> int:
    """Return the grid's step, ns."""
    first, second = (2e-6 * math.pi * hz for hz in _poles_hz(p))
    step_us = min(0.05 / math.sqrt(first * second), 0.25 / second) if second else 0.05 / first
    return int(1000 * 2.0 ** max(-3, math.floor(math.log2(step_us))))


@kernel
def _rate(current: float, pole: _Pole) -> float:
    return min(max(pole.at_reference * current, pole.least), pole.most)


@kernel
def _low_passed(before: float, after: float, output: float, length: float) -> float:
    """Return a low-pass's output after so many time constants, its input on a straight line."""
    q = -math.expm1(-length)
    return float(output + q * (before - output) + (after - before) * (1 - q / length))


@kernel
def _transition(a1: float, a2: float, h: float) -> _Transition:
    """Return the transition of the noise over h seconds, for an rms of 1 behind the first pole."""
    e1 = math.exp(-a1 * h)
    q11 = -math.expm1(-2 * a1 * h)
    if a2 == 0:
        return _Transition(e1, e1, 0.0, math.sqrt(q11), math.sqrt(q11), 0.0)
    if abs(a2 - a1) < 1e-4 * a1:
        a2 = a1 * (1 + 1e-4)
    both, k = -math.expm1(-(a1 + a2) * h) / (a1 + a2), a2 / (a2 - a1)
    q12 = k * (q11 - 2 * a1 * both)
    q22 = k * k * (q11 - 4 * a1 * both - a1 / a2 * math.expm1(-2 * a2 * h))
    e2, b = math.exp(-a2 * h), q12 / math.sqrt(q11)
    return _Transition(e1, e2, k * (e1 - e2), math.sqrt(q11), b, math.sqrt(max(q22 - b * b, 0.0)))


@kernel
def _next_noise(n1: float, n2: float, step: _Transition, bits: np.uint64) -> tuple[float, float]:
    """Return the noise behind both poles a transition later, by two normal numbers that are made of `bits`."""
    radius, angle = math.sqrt(-2 * math.log(unit(high(bits)))), 2 * math.pi * unit(low(bits))
    a, b = radius * math.cos(angle), radius * math.sin(angle)
    return step.first * n1 + step.a * a, step.second * n2 + step.mixed * n1 + step.b * a + step.c * b


@kernel
def _next_event(
    at: float, seen: float, end: float, piece: _Piece, thresholds: tuple[float, float]
) -> tuple[float, int]:
    """Return the first place after `at` in the piece where a threshold is met, and 1 for ON; 2 if there is none."""
    on, off = thresholds
    left = 1 - at
    if seen >= on or seen <= -off:
        return at, 1 if seen >= on else 0
    if piece.variance == 0:
        if -off < end < on:
            return 2.0, 0
        return at + left * ((on if end >= on else -off) - seen) / (end - seen), 1 if end >= on else 0
    variance, bits = piece.variance * left, word(piece.base, piece.draw)
    rising, falling = 2 * (on - seen) * (on - end), 2 * (seen + off) * (end + off)
    if end >= on or (rising < _HOPELESS * variance and unit(high(bits)) < math.exp(-rising / variance)):
        level, up = on, 1
    elif end <= -off or (falling < _HOPELESS * variance and unit(low(bits)) < math.exp(-falling / variance)):
        level, up = -off, 0
    else:
        return 2.0, 0
    way, rest = abs(level - seen), max(abs(level - end), 1e-12)
    # An inverse Gaussian number of mean way / rest and shape way^2 / V (Michael, Schucany and Haas 1976).
    x = normal_from(word(piece.base, piece.draw + 1)) ** 2 * variance / (way * rest)
    root = 1 + (x + math.sqrt(x * (4 + x))) / 2
    y = way / rest * (1 / root if unit(high(word(piece.base, piece.draw + 2))) < root / (1 + root) else root)
    return at + left * y / (1 + y), up


@kernel
def _within(at: float, to: float, seen: float, end: float, piece: _Piece) -> float:
    """Return the comparator's input at `to`, on the way from `seen` at `at` to `end` at 1."""
    share = (to - at) / (1 - at)
    deviation = math.sqrt(max(piece.variance * (1 - at) * share * (1 - share), 0.0))
    return float(seen + share * (end - seen) + deviation * normal_from(word(piece.base, piece.draw + 3)))


@kernel_that_allocates
def _fire(piece: _Piece, m: _Model, s: _State, pending: Pending, n: int) -> tuple[Pending, int, int]:
    """Move a pixel's comparator over a piece; add its events to `pending`; return it, their number, the lost ones."""
    pixel, events, refractory = piece.pixel, 0, m.refractory_ns / piece.length_ns
    at, seen, end = 0.0, s.seen[pixel], s.seen[pixel] + piece.change
    if seen != seen:
        at = max((s.refractory_until_ns[pixel] - piece.start_ns) / piece.length_ns, 0.0)
        if at >= 1:
            return pending, n, 0
        seen, end = 0.0, piece.change - _within(0.0, at, 0.0, piece.change, piece)
    while True:
        piece = _Piece(*piece[:6], piece.draw + 4)
        if events >= _MOST_EVENTS and refractory == 0 and (end >= m.on[pixel] or end <= -m.off[pixel]):
            level = m.on[pixel] if end > 0 else -m.off[pixel]
            events, seen, end = events + int(min(end / level, _MOST_COUNTED)), 0.0, end % level
        at_event, on = _next_event(at, seen, end, piece, (m.on[pixel], m.off[pixel]))
        if at_event > 1:
            s.seen[pixel] = end
            return pending, n, max(events - _MOST_EVENTS, 0)
        events += 1
        if events <= _MOST_EVENTS:
            pending = reserve(pending, n, 1)
            pending.t_ns[n] = piece.start_ns + int(at_event * piece.length_ns)
            pending.key[n] = np.uint64(pixel) << np.uint64(1) | np.uint64(on)
            n += 1
        level = m.on[pixel] if on else -m.off[pixel]
        at = at_event + refractory
        if refractory > 0 and at >= 1:
            s.seen[pixel], s.refractory_until_ns[pixel] = np.nan, piece.start_ns + int(at * piece.length_ns)
            return pending, n, max(events - _MOST_EVENTS, 0)
        seen, end = 0.0, end - (_within(at_event, at, level, end, piece) if refractory > 0 else level)


@kernel
def _signal(
    u: tuple[float, float], current: tuple[float, float], v0: float, w0: float, m: _Model
) -> tuple[float, float]:
    """Return receptor and source follower a grid step later; log light and photocurrent are those of both its ends."""
    h = m.delta_ns * 1e-9
    length = h * (_rate(current[0], m.receptor) + _rate(current[1], m.receptor)) / 2
    if m.large:
        v1 = _low_passed(1 / current[0], 1 / current[1], v0, length)
        x0, x1 = -math.log(v0), -math.log(v1)
    else:
        v1 = _low_passed(u[0], u[1], v0, length)
        x0, x1 = v0, v1
    return v1, _low_passed(x0, x1, w0, m.follower * h) if m.follower > 0 else x1


@kernel
def _is_far(seen: float, middle: float, end: float, variance: float, thresholds: tuple[float, float]) -> bool:
    """Return whether a grid step, of two straight pieces or a bridge, meets no threshold."""
    if seen != seen:
        return False
    high, low = thresholds[0] - max(seen, middle, end), thresholds[1] + min(seen, middle, end)
    if variance == 0:
        return high > 0 and low > 0
    return min(high, low) > 0 and 2 * min(high, low) ** 2 > _HOPELESS * variance


@entry_of(*SOURCES, __name__, "laboratory.methods.circuit")
def _advance(
    light_of: tuple[tuple[Floats, Floats], tuple[Floats, Floats]],
    grid_times: tuple[int, int],
    frame_ns: tuple[int, int],
    m: _Model,
    s: _State,
    pending: Pending,
) -> tuple[tuple[Any, ...], int, int]:
    """Move all pixels over the grid times after the first of `grid_times` up to the last.

    `light_of` are log light of two frames and its derivatives, 1/s; NaN: unknown.
    """
    n, lost, h, half_ns = 0, 0, m.delta_ns * 1e-9, m.delta_ns // 2
    for pixel in range(m.on.size):
        values, slopes = [(both[0][pixel], both[1][pixel]) for both in light_of]
        light = log_light_between(values, slopes, (frame_ns[1] - frame_ns[0]) * 1e-9)
        voltage, bridge = stream(m.voltage_root, pixel), stream(m.bridge_root, pixel)
        thresholds, rms = (m.on[pixel], m.off[pixel]), m.rms[pixel]
        u0, v0, w0, n1, n2 = s.u[pixel], s.v[pixel], s.w[pixel], s.n1[pixel], s.n2[pixel]
        current0, bend, variance, known, noise = math.exp(u0), 0.0, 0.0, math.nan, _transition(1.0, 0.0, 1.0)
        rests, is_still = False, light.u0 == light.u1 and light.a0 == 0 and light.a1 == 0
        for grid in range(grid_times[0] + 1, grid_times[1] + 1):
            start_ns, change = (grid - 1) * m.delta_ns, 0.0
            if not rests:
                u1 = log_light(light, (grid * m.delta_ns - frame_ns[0]) * 1e-9)[0]
                current1 = math.exp(u1)
                v1, w1 = _signal((u0, u1), (current0, current1), v0, w0, m)
                middle = math.floor((u0 + u1) * (_PER_E_FOLD / 2) + 0.5)
                if middle != known:
                    a1 = _rate(math.exp(middle / _PER_E_FOLD), m.noise)
                    known, noise = middle, _transition(a1, m.fixed, h)
                    variance = 2 * rms * rms * a1 * h if m.fixed == 0 else 0.0
                leaked = (m.leak[pixel] + m.parasitic[pixel] * (current0 + current1) / 2) * h
                rests = is_still and u0 == u1 and v0 == v1 and w0 == w1
                change, u0, v0, w0, current0 = w1 - w0, u1, v1, w1, current1
            slope, before = n1 - n2, n2
            n1, n2 = _next_noise(n1, n2, noise, word(voltage, grid))
            change += rms * (n2 - before) + leaked
            bend, seen = rms * m.fixed * h * (slope - n1 + n2) / 8, s.seen[pixel]
            first, length_ns = (change / 2 + bend, half_ns) if m.fixed > 0 else (change, m.delta_ns)
            if _is_far(seen, seen + first, seen + change, variance, thresholds):
                s.seen[pixel] = seen + change
                continue
            piece = _Piece(pixel, start_ns, length_ns, first, variance, bridge, grid * _DRAWS)
            pending, n, more = _fire(piece, m, s, pending, n)
            lost += more
            if m.fixed > 0:
                piece = _Piece(pixel, start_ns + half_ns, half_ns, change - first, 0.0, bridge, grid * _DRAWS)
                pending, n, more = _fire(piece, m, s, pending, n)
                lost += more
        s.u[pixel], s.v[pixel], s.w[pixel], s.n1[pixel], s.n2[pixel] = u0, v0, w0, n1, n2
    return pending[0:], n, lost


class NoisyPixels(LogLightPixels):
    """An array of pixels whose noise is simulated in time.

    Parameters
    ----------
    parameters : the sensor, with `noise.rms` > 0.
    seed : keys the noise, and the pixels, which are those of a `PixelArray` with that seed.
    delta_ns : step of the grid; 0: `grid_ns`.

    Attributes
    ----------
    lost_in_pixel : crossings beyond 16 of a pixel in half a grid step.
    """

    capabilities: ClassVar = Capabilities(uses_rate=True, has_faults=True, has_grid_noise=True, has_large_signal=True)

    def __init__(self, parameters: SensorParameters, seed: int, delta_ns: int = 0) -> None:
        super().__init__(parameters, seed)
        p, drawn = parameters, self.drawn
        low_pass, (noise_hz, fixed_hz) = math.isfinite(p.corner_hz_at_reference), _poles_hz(p)
        hz = p.corner_hz_at_reference, p.corner_min_hz, min(p.corner_max_hz, _FASTEST_HZ)
        self._model: _Model = _Model(
            drawn.on, drawn.off, drawn.leak, p.parasitic_hz_at_reference * drawn.on,
            p.noise.rms * np.exp(p.noise.spread * normal(seed, Purpose.NOISE_SPREAD, np.arange(drawn.on.size))),
            voltage_root=root_of(seed, Purpose.NOISE_VOLTAGE),
            bridge_root=root_of(seed, Purpose.NOISE_BRIDGE),
            delta_ns=delta_ns or grid_ns(p),
            refractory_ns=round(p.refractory_us * 1000),
            receptor=_Pole(*(2 * math.pi * one for one in (hz if low_pass else (_FASTEST_HZ,) * 3))),
            follower=2 * math.pi * p.source_follower_hz,
            noise=_Pole(*(2 * math.pi * one for one in (hz if low_pass else (noise_hz,) * 3))),
            fixed=2 * math.pi * fixed_hz,
            large=p.photoreceptor == "large_signal",
        )  # fmt: skip

    def _start(self) -> None:
        """Start with stationary noise, and references that were stored without it."""
        m, u, pixel = self._model, self._u, np.arange(self._u.size)
        first = -(-self._t_ns // m.delta_ns)
        self._settled_ns = first * m.delta_ns
        n1, other = (normal(self.seed, one, pixel, first) for one in (Purpose.NOISE_VOLTAGE, Purpose.NOISE_BRIDGE))
        passed = 1.0
        if m.fixed:
            passed = m.fixed / (m.fixed + np.clip(m.noise.at_reference * np.exp(u), m.noise.least, m.noise.most))
        n2 = passed * n1 + np.sqrt(passed - passed**2) * other
        v = np.exp(-u) if m.large else u.copy()
        seen = m.on * self._phase + m.rms * n2
        self._state = _State(u.copy(), v, u.copy(), n1, n2, seen, np.zeros(pixel.size, np.int64))

    def _move(self, u: Floats, slope: Floats, t_ns: int) -> tuple[Pending, int, int]:
        delta_ns, settled_ns = self._model.delta_ns, self._settled_ns
        light_of, times = ((self._u, u), (self._slope, slope)), (settled_ns // delta_ns, t_ns // delta_ns)
        pending, n, lost = _advance(light_of, times, (self._t_ns, t_ns), self._model, self._state, new_pending())
        pending[0][:n] -= settled_ns
        self._settled_ns = max(times[1] * delta_ns, settled_ns)
        return Pending(*pending), n, lost

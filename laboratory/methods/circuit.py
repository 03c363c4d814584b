"""Pixels whose photoreceptor is a circuit with two poles and a limited slew: off unless a rig selects it.

`pixels.receptor` has the large-signal law of the photodiode's node alone, at the cost of the one-pole model. This is
the reference for it, and for amplifiers whose bias is so low that b, below, matters.

In units of the thermal voltage, p is the photodiode's node above its rest, y the output, u = ln i the photocurrent. The
feedback transistor carries e^(y - p); the amplifier has a bias current that limits the rise of its output, and a
capacitance couples its output to the photodiode. The source follower w comes behind it:

    dp/dt = a (e^(y - p) - i) + dy/dt        a    = 2 pi corner_hz_at_reference
    dy/dt = b (1 - e^p)                      b    = 2 pi corner_max_hz
    dw/dt = c (y - w)                        c    = 2 pi source_follower_hz

For small signals that is y'' + (a i + b) y' + a i b (y - u) = 0: two poles, at a i and at b, of which the slower one is
that of the one-pole model. For large ones the output rises by at most b a second, and falls as slowly as the remaining
light allows. The circuit and its large-signal form: Graca and Delbruck, arXiv 2505.07386; here with ideal transistors,
and with the coupling at which the circuit does not ring, not with their fitted parameters.

Arithmetic is float64. Between two frames log light is a cubic, or a straight line without derivatives. The circuit is
solved pixel by pixel with steps of its own, each as long as an error of `_TOLERANCE` allows; between their ends the
comparator's signal is the cubic through values and derivatives. A pixel at rest in light that does not change takes
one step. One step is Shampine's Rosenbrock method of order 4 with an error estimate of order 3 (Hairer and Wanner,
Solving ODEs II, IV.7), with the exact Jacobian: it stays stable however stiff the circuit is.
"""

from __future__ import annotations

import dataclasses
import math
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from emulator.light import LightFrame
from emulator.sensor.chip.sources import Pending, new_pending, reserve
from emulator.sensor.numerics.compiled import SOURCES, kernel, kernel_that_allocates
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, unpacked
from emulator.sensor.pixels.event_time import levels_passed
from emulator.sensor.pixels.method import Capabilities, PixelMethod, time_of
from emulator.sensor.pixels.state import DEAD_THRESHOLD, draw
from emulator.sensor.presets import SensorParameters
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Float32s, Floats, Int64s

_State = tuple[float, float, float]

_LARGEST = 60.0  # of an exponent


class Circuit(NamedTuple):
    """The rates a, b and c of the equations, rad/s; c = 0: no source follower."""

    a: float
    b: float
    c: float


class State(NamedTuple):
    """Photodiode, output and source follower."""

    p: float
    y: float
    w: float


class Light(NamedTuple):
    """Log light in a step of h seconds: a cubic in the share of the step, by value and slope per step at both ends."""

    u0: float
    u1: float
    a0: float
    a1: float
    h: float


@kernel
def log_light_between(u: tuple[float, float], slopes: tuple[float, float], h: float) -> Light:
    """Return log light in a step of h seconds, by value and slope (1/s) at both ends; monotone where they are.

    It is a straight line where a slope is NaN. Slopes too steep for a monotone cubic are scaled down (Fritsch and
    Carlson).
    """
    d, a0, a1 = u[1] - u[0], slopes[0] * h, slopes[1] * h
    if a0 != a0 or a1 != a1:
        a0 = a1 = d
    size = a0 * a0 + a1 * a1
    if a0 * d >= 0 and a1 * d >= 0 and a0 * a1 >= 0 and size > 9 * d * d:
        less = 3 * abs(d) / math.sqrt(size)
        a0, a1 = a0 * less, a1 * less
    return Light(u[0], u[1], a0, a1, h)


@kernel
def log_light(light: Light, t: float) -> tuple[float, float]:
    """Return log light and its time derivative, 1/s, at a time since the step's start."""
    z, d = t / light.h, light.u1 - light.u0
    second, third = 3 * d - 2 * light.a0 - light.a1, light.a0 + light.a1 - 2 * d
    value = light.u0 + z * (light.a0 + z * (second + z * third))
    return value, (light.a0 + z * (2 * second + z * 3 * third)) / light.h


@kernel
def _exp(x: float) -> float:
    return math.exp(min(x, _LARGEST))


@kernel
def rates(s: State, u: float, c: Circuit) -> State:
    """Return the time derivatives of the state in log light u."""
    dy = c.b * (1 - _exp(s.p))
    return State(c.a * (_exp(s.y - s.p) - math.exp(u)) + dy, dy, c.c * (s.y - s.w))


@kernel
def _plus(s: State, k1: State, f1: float, k2: State, f2: float) -> State:
    return State(s.p + f1 * k1.p + f2 * k2.p, s.y + f1 * k1.y + f2 * k2.y, s.w + f1 * k1.w + f2 * k2.w)


@kernel
def rosenbrock(s: State, t: float, h: float, light: Light, c: Circuit) -> tuple[State, State]:
    """Return the state after h from the time t of the step, and the error's estimate."""
    u, du = log_light(light, t)
    feedback, slew, i = c.a * _exp(s.y - s.p), c.b * _exp(s.p), math.exp(u)
    # Jacobian: [[-feedback - slew, feedback], [-slew, 0]], and c (y - w) for the third; time enters the first alone.
    by_time = -c.a * i * du * h
    d = 2 / h
    m11, m12, m21 = d + feedback + slew, -feedback, slew
    determinant = m11 * d - m12 * m21
    k = (State(0.0, 0.0, 0.0), State(0.0, 0.0, 0.0), State(0.0, 0.0, 0.0))
    k1, k2, k3 = k
    f = rates(s, u, c)
    g = f.p + 0.5 * by_time, f.y, f.w
    for stage in range(4):
        p, y = (d * g[0] - m12 * g[1]) / determinant, (m11 * g[1] - m21 * g[0]) / determinant
        now = State(p, y, (g[2] + c.c * y) / (d + c.c))
        if stage == 0:
            k1 = now
            f = rates(_plus(s, k1, 2.0, k1, 0.0), log_light(light, t + h)[0], c)
            g = f.p - 8 * k1.p / h - 1.5 * by_time, f.y - 8 * k1.y / h, f.w - 8 * k1.w / h
        elif stage == 1:
            k2 = now
            f = rates(_plus(s, k1, 48 / 25, k2, 6 / 25), log_light(light, t + 0.6 * h)[0], c)
            back = _plus(State(0.0, 0.0, 0.0), k1, 372 / 25 / h, k2, 12 / 5 / h)
            g = f.p + back.p + 121 / 50 * by_time, f.y + back.y, f.w + back.w
        elif stage == 2:
            k3 = now
            back = _plus(_plus(State(0.0, 0.0, 0.0), k1, -112 / 125 / h, k2, -54 / 125 / h), k3, -2 / 5 / h, k3, 0.0)
            g = f.p + back.p + 29 / 250 * by_time, f.y + back.y, f.w + back.w
    after = _plus(_plus(s, k1, 19 / 9, k2, 0.5), k3, 25 / 108, now, 125 / 108)
    error = _plus(_plus(State(0.0, 0.0, 0.0), k1, 17 / 54, k2, 7 / 36), now, 125 / 108, now, 0.0)
    return after, error


_BISECTIONS = 60
_TOLERANCE = 2e-6  # ln units a substep
_AT_REST = 1e-6  # ln units: less than the tolerance
_MOST_EVENTS = 64
_BRIGHTEST = 1e20  # light: more counts as this, for which the circuit's equations can be solved
_LONGEST_NS = 1 << 33  # of a step, whose events are sorted together
_SAFETY, _LEAST, _MOST = 0.9, 0.2, 4.0


class _Model(NamedTuple):
    """Constants; thresholds, leak and parasitic leak at light 1 (ln units per second) are (pixels,)."""

    on: Floats
    off: Floats
    leak: Floats
    parasitic: Floats
    circuit: Circuit
    refractory_s: float


class _Array(NamedTuple):
    """State of the pixels, (pixels,) each: circuit, reference (leak added), end of the refractory period, a substep."""

    p: Floats
    y: Floats
    w: Floats
    reference: Floats
    refractory_s: Floats  # since the start of the step; 0 and below: over
    substep_s: Floats


class _Piece(NamedTuple):
    """The comparator's signal, leak included, in a substep, as a cubic (see `cubic`); its start and length, s."""

    g: tuple[float, float, float, float]
    t: float
    h: float


@kernel
def cubic(g: tuple[float, float, float, float], z: float) -> float:
    """Return the cubic of values g[0], g[1] and slopes g[2], g[3] (a step) at z in [0, 1]."""
    g0, g1, m0, m1 = g
    d = g1 - g0
    return g0 + z * (m0 + z * (3 * d - 2 * m0 - m1 + z * (m0 + m1 - 2 * d)))


@kernel
def turns(g: tuple[float, float, float, float]) -> tuple[float, float]:
    """Return the extrema of the cubic inside (0, 1), in rising order; 1 stands for none."""
    g0, g1, m0, m1 = g
    d = g1 - g0
    a, b = 3 * (m0 + m1 - 2 * d), 2 * (3 * d - 2 * m0 - m1)
    under = b * b - 4 * a * m0
    if under <= 0:
        return 1.0, 1.0
    half = -0.5 * (b + math.copysign(math.sqrt(under), b))
    z1 = half / a if a != 0 else 1.0
    z2 = m0 / half if half != 0 else 1.0
    z1, z2 = (z1 if 0 < z1 < 1 else 1.0), (z2 if 0 < z2 < 1 else 1.0)
    return min(z1, z2), max(z1, z2)


@kernel
def first_crossing(g: tuple[float, float, float, float], start: float, low: float, high: float) -> float:
    """Return the first point from `start` on at which the cubic reaches `high` or `low`; 2 if none in the step."""
    turn_1, turn_2 = turns(g)
    a = start
    for end in (turn_1, turn_2, 1.0):
        if end <= a:
            continue
        value = cubic(g, end)
        if value >= high or value <= low:
            up = value >= high
            level = high if up else low
            b = end
            for _ in range(_BISECTIONS):
                middle = 0.5 * (a + b)
                if (cubic(g, middle) >= level) if up else (cubic(g, middle) <= level):
                    b = middle
                else:
                    a = middle
            return b
        a = end
    return 2.0


@kernel
def _pass_over(piece: _Piece, z: float, reference: float, thresholds: tuple[float, float]) -> tuple[float, int]:
    """Return the reference after all crossings of a substep from share z on, and their number."""
    turn_1, turn_2 = turns(piece.g)
    lost = 0
    for high in (turn_1, turn_2, 1.0):
        end = cubic(piece.g, high)
        threshold = thresholds[0] if end > reference else thresholds[1]
        if high > z and abs(end - reference) >= threshold:
            passed, rest = levels_passed(reference, end, threshold)
            reference, lost = end - rest, lost + passed
    return reference, lost


@kernel_that_allocates
def _fire(
    pixel: int, piece: _Piece, m: _Model, s: _Array, pending: Pending, at: tuple[int, int]
) -> tuple[Pending, int, int]:
    """Add the events of a substep to `pending`; return it, the number of its events, and the number of lost ones.

    `at` are the numbers of events in it before this step of the pixel, and now.
    """
    (begun, n), lost, z = at, 0, 0.0
    while True:
        if s.refractory_s[pixel] > piece.t + z * piece.h:
            z = (s.refractory_s[pixel] - piece.t) / piece.h
            if z > 1:
                return pending, n, lost
            s.reference[pixel] = cubic(piece.g, z)
        reference = s.reference[pixel]
        z = first_crossing(piece.g, z, reference - m.off[pixel], reference + m.on[pixel])
        if z > 1:
            return pending, n, lost
        on = cubic(piece.g, z) > reference
        if n - begun < _MOST_EVENTS:
            pending = reserve(pending, n, 1)
            pending.t_ns[n] = np.int64((piece.t + z * piece.h) * 1e9)
            pending.key[n] = np.uint64(pixel) << np.uint64(1) | np.uint64(on)
            n += 1
        elif m.refractory_s == 0:
            s.reference[pixel], more = _pass_over(piece, z, reference, (m.on[pixel], m.off[pixel]))
            return pending, n, lost + more
        else:
            lost += 1
        s.reference[pixel] += m.on[pixel] if on else -m.off[pixel]
        s.refractory_s[pixel] = piece.t + z * piece.h + m.refractory_s


@kernel
def _leak(m: _Model, pixel: int, u: float) -> float:
    return float(m.leak[pixel] + (m.parasitic[pixel] * math.exp(u) if m.parasitic[pixel] > 0 else 0.0))


@kernel
def _substep(s: State, t: float, wanted: float, light: Light, c: Circuit) -> tuple[State, float, float]:
    """Return the state after a substep within the tolerance, its length, and that wanted for the next one."""
    h = min(wanted, light.h - t)
    while True:
        after, error = rosenbrock(s, t, h, light, c)
        off = max(abs(error.y), abs(error.w), 0.1 * abs(error.p)) / _TOLERANCE
        factor = min(max(_SAFETY * max(off, 1e-8) ** -0.25, _LEAST), _MOST)
        if off <= 1 or h < 1e-10:
            return after, h, max(h, min(wanted, h)) * factor if h < wanted else h * factor
        h *= factor


@kernel_that_allocates
def _advance_pixel(
    pixel: int, light: Light, m: _Model, s: _Array, pending: Pending, n: int
) -> tuple[Pending, int, int]:
    """Move one pixel over a step."""
    c, lost, begun, t, leaked = m.circuit, 0, n, 0.0, 0.0
    state = State(s.p[pixel], s.y[pixel], s.w[pixel])
    still = light.u0 == light.u1 and light.a0 == 0 and light.a1 == 0
    rests = still and max(abs(state.p), abs(state.y - light.u0), abs(state.w - light.u0)) < _AT_REST
    while t < light.h * (1 - 1e-12):
        if rests:
            after, h = state, light.h
        else:
            after, h, s.substep_s[pixel] = _substep(state, t, s.substep_s[pixel], light, c)
        u0, u1 = log_light(light, t)[0], log_light(light, min(t + h, light.h))[0]
        l0, l1 = _leak(m, pixel, u0), _leak(m, pixel, u1)
        d0, d1 = rates(state, u0, c), rates(after, u1, c)
        slope0, slope1 = (d0.w, d1.w) if c.c > 0 else (d0.y, d1.y)
        v0, v1 = (state.w, after.w) if c.c > 0 else (state.y, after.y)
        more = leaked + h * (l0 + l1) / 2
        piece = _Piece((v0 + leaked, v1 + more, h * (slope0 + l0), h * (slope1 + l1)), t, h)
        pending, n, gone = _fire(pixel, piece, m, s, pending, (begun, n))
        state, t, leaked, lost = after, t + h, more, lost + gone
    s.p[pixel], s.y[pixel], s.w[pixel] = state
    if not c.c > 0:
        s.w[pixel] = state.y
    s.reference[pixel] -= leaked
    s.refractory_s[pixel] -= light.h
    return pending, n, lost


@entry_of(*SOURCES, __name__)
def _advance(
    u: tuple[Floats, Floats], slopes: tuple[Floats, Floats], h_s: float, m: _Model, s: _Array, pending: Pending
) -> tuple[tuple[Any, ...], int, int]:
    """Move all pixels over a step; `u` is log light of both frames, `slopes` its derivatives, 1/s; NaN: unknown."""
    n = lost = 0
    for pixel in range(m.on.size):
        light = log_light_between((u[0][pixel], u[1][pixel]), (slopes[0][pixel], slopes[1][pixel]), h_s)
        pending, n, gone = _advance_pixel(pixel, light, m, s, pending, n)
        lost += gone
    return pending[0:], n, lost


class LogLightPixels(PixelMethod):
    """A method in float64 for which log light between two frames is a cubic, or a straight line without derivatives.

    Faults are changes of the arrays of its `_model`, (pixels,) float64 each: thresholds and leaks.

    Attributes
    ----------
    quiet_nan : pixel-steps whose light was not finite; the last finite light of the pixel is used.
    """

    _model: Any

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        super().__init__(parameters, seed)
        self.drawn = draw(parameters, seed)
        self._phase, pixels, dark = self.drawn.phase, self.drawn.on.size, parameters.dark_current_relative
        self._settled_ns = self._t_ns = 0
        self._current, self._lit = np.full(pixels, dark), np.zeros(pixels, np.bool_)
        self._u, self._slope = np.log(self._current), np.full(pixels, np.nan)

    @property
    def settled_ns(self) -> int:
        """Stream time up to which all crossings have been returned."""
        return self._settled_ns

    def reset(self, frame: LightFrame) -> None:
        """Start at rest on the light of `frame`, at its time, and with counters at zero."""
        self._u, self._t_ns = self._log(frame.light), int(frame.t_ns)
        self._slope = self._slopes(frame.rate)
        self.lost_in_pixel = self.quiet_nan = 0
        self._start()

    def step(self, frame: LightFrame) -> Crossings:
        """Move to the time of `frame` and return the crossings up to `settled_ns`; see `PixelArray.step`.

        Raises
        ------
        ValueError
            Time goes back, the step is longer than 8.6 s, or the frame does not have the sensor's size.
        """
        t_ns, settled_ns = time_of(frame, self._t_ns), self._settled_ns
        if t_ns - self._t_ns > _LONGEST_NS:
            raise ValueError(f"a step of {(t_ns - self._t_ns) * 1e-9:.3g} s: this method takes 8.6 s at most")
        u, slope, found = self._log(frame.light), self._slopes(frame.rate), NO_CROSSINGS
        if t_ns > self._t_ns:
            pending, n, lost = self._move(u, slope, t_ns)
            self.lost_in_pixel += lost
            bits = max(1, (u.size - 1).bit_length())
            keys = pending[0][:n].astype(np.uint64) << np.uint64(bits + 1) | pending[1][:n]
            found = dataclasses.replace(unpacked(keys, settled_ns, bits), lost_in_pixel=lost)
        self._u, self._slope, self._t_ns = u, slope, t_ns
        return found

    def kill(self, pixel: Int64s) -> None:
        """Set thresholds that no light reaches, and no leak, for pixels, (n,)."""
        m = self._model
        m.on[pixel] = m.off[pixel] = DEAD_THRESHOLD
        m.leak[pixel] = m.parasitic[pixel] = self._phase[pixel] = 0

    def leak_hz(self) -> Floats:
        """Return the leak rate of all pixels, (pixels,), without the parasitic leak."""
        return np.asarray(self._model.leak / self._model.on)

    def set_leak(self, leak_hz: Floats) -> None:
        """Set the leak rate of all pixels, (pixels,)."""
        self._model.leak[:] = leak_hz * self._model.on

    @abstractmethod
    def _start(self) -> None:
        """Start at rest on the present light, at the present time."""

    @abstractmethod
    def _move(self, u: Floats, slope: Floats, t_ns: int) -> tuple[Pending, int, int]:
        """Move to a time with that log light and slope; return the events, counted from `settled_ns`, and lost ones."""

    def _slopes(self, rate: Float32s | None) -> Floats:
        """Return the time derivative of the present log light, 1/s; NaN where unknown."""
        if rate is None:
            return np.full(self._u.size, np.nan)
        slope = np.where(self._lit, self._flat(rate), 0) / self._current
        return np.where(np.isfinite(slope), slope, np.nan)

    def _log(self, light: Float32s) -> Floats:
        """Return the log of the photocurrent, (pixels,); the last finite one where the light is not finite."""
        flat = self._flat(light)
        readable = np.isfinite(flat)
        self.quiet_nan += int((~readable).sum())
        current = np.clip(flat, 0, _BRIGHTEST).astype(np.float64) + self.parameters.dark_current_relative
        self._current = np.where(readable, current, self._current)
        self._lit = np.where(readable, flat > 0, self._lit)
        return np.asarray(np.log(self._current))


class CircuitPixels(LogLightPixels):
    """An array of event pixels with the photoreceptor's circuit.

    Parameters
    ----------
    parameters : the sensor, with `photoreceptor = "circuit"`.
    seed : keys the pixels, which are those of a `PixelArray` with that seed.

    Attributes
    ----------
    lost_in_pixel : crossings beyond 64 of a pixel in a step.
    """

    capabilities: ClassVar = Capabilities(uses_rate=True, has_faults=True, has_circuit=True)

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        super().__init__(parameters, seed)
        p, drawn = parameters, self.drawn
        hz = p.corner_hz_at_reference, p.corner_max_hz, p.source_follower_hz
        self._model: _Model = _Model(
            drawn.on, drawn.off, drawn.leak, p.parasitic_hz_at_reference * drawn.on,
            Circuit(*(2 * math.pi * one for one in hz)), p.refractory_us * 1e-6,
        )  # fmt: skip

    def _start(self) -> None:
        u, m, self._settled_ns = self._u, self._model, self._t_ns
        shortest = np.full(u.size, 1e-4)
        self._state = _Array(np.zeros(u.size), u.copy(), u.copy(), u - m.on * self._phase, np.zeros(u.size), shortest)

    def _move(self, u: Floats, slope: Floats, t_ns: int) -> tuple[Pending, int, int]:
        h_ns, self._settled_ns = t_ns - self._t_ns, t_ns
        light_of = (self._u, u), (self._slope, slope)
        pending, n, lost = _advance(*light_of, h_ns * 1e-9, self._model, self._state, new_pending())
        np.minimum(pending[0], h_ns - 1, out=pending[0])
        return Pending(*pending), n, lost

"""One pixel over one step, without shortcuts, in float64: big changes, turns, blind stretches, slow exponentials.

The log light is a straight line over the step. It is cut into equal pieces of at most 0.5 each, because within a piece
the filter's time constant is held at its mean. On a piece, with x in [0, 1],

    g(x) = (u_a - D/S + l T_a) + (D + l h) x + B e^(-S x)       or, where the exponential matters little,
    g(x) = the cubic through the values and slopes at both ends (it knows the time constant at each end)

Both are c0 + c1 x + c2 x^2 + c3 x^3 + b e^(-s x) with at most two turning points in closed form; between them g is
monotone, so the values at the ends decide whether a level is met, and nothing can be missed.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.compiled import kernel

__all__ = ["MOST_EVENTS", "Pixel", "Real", "Step", "Trace", "solve_exactly"]

Real = Any
"""A float of any width: inside numba, whichever the caller has."""

MOST_EVENTS = 64
"""Events of a pixel in a step; crossings beyond are counted as lost in the pixel."""

_LARGEST_CHANGE = 0.5
_SHARE = 0.01
_FAST, _FAINT = 100.0, 1e-5
_MOST_TURNS = 60
_SETTLED = 1e-6  # last Newton correction, as a share of the piece; the error is of the order of its square


class Trace(NamedTuple):
    """Where one pixel's events are written: z, the share of the step, and 1 for ON."""

    z: npt.NDArray[np.float64]
    on: npt.NDArray[np.uint8]


class _Curve(NamedTuple):
    """c0 + c1 x + c2 x^2 + c3 x^3 + b e^(-s x)."""

    c0: float
    c1: float
    c2: float
    c3: float
    b: float
    s: float


class Step(NamedTuple):
    """What is the same for all pixels of a step; rates in rad/s, times in s, the refractory period in steps."""

    h: float
    since_epoch: float
    refractory: float
    rate_at_reference: float
    rate_min: float
    rate_max: float


class Pixel(NamedTuple):
    """A pixel at the start of a step, and its light at the end; `start` is where it stops being blind, in steps."""

    log_light: float
    filtered: float
    rate: float
    log_light_after: float
    rate_after: float
    reference: float  # NaN: blind until `start`
    on: float
    off: float
    leak: float
    start: float


@kernel
def _value_and_slope(f: _Curve, x: float) -> tuple[float, float]:
    y, slope = ((f.c3 * x + f.c2) * x + f.c1) * x + f.c0, (3 * f.c3 * x + 2 * f.c2) * x + f.c1
    if f.b != 0:
        exponential = f.b * math.exp(-f.s * x)
        y, slope = y + exponential, slope - f.s * exponential
    return y, slope


@kernel
def _turns(f: _Curve) -> tuple[float, float]:
    """Return the turning points in (0, 1) in ascending order; 1 stands for none."""
    if f.b != 0:
        ratio = f.b * f.s / f.c1 if f.c1 != 0 else 0.0
        x = math.log(ratio) / f.s if ratio > 0 else 1.0
        return (x if 0 < x < 1 else 1.0), 1.0
    # The slope as a parabola in Bernstein form: of one sign if its three coefficients are.
    first, middle, last = f.c1, f.c1 + f.c2, f.c1 + 2 * f.c2 + 3 * f.c3
    if min(first, middle, last) >= 0 or max(first, middle, last) <= 0:
        return 1.0, 1.0
    a, half_b, c = 3 * f.c3, f.c2, f.c1
    root = half_b * half_b - a * c
    if root <= 0:
        return 1.0, 1.0
    w = -(half_b + math.copysign(math.sqrt(root), half_b))
    one = w / a if a != 0 else 1.0
    other = c / w if w != 0 else 1.0
    one = one if 0 < one < 1 else 1.0
    other = other if 0 < other < 1 else 1.0
    return min(one, other), max(one, other)


@kernel
def _crossing(f: _Curve, level: float, low: float, f_low: float, high: float, f_high: float) -> float:
    """Return where f meets `level` in [low, high], on which it is monotone; f_low and f_high are f - level there."""
    rising = f_high > f_low
    x: float = low - f_low * (high - low) / (f_high - f_low)
    for _ in range(_MOST_TURNS):
        value, slope = _value_and_slope(f, x)
        y = value - level
        if (y > 0) == rising:
            high = x
        else:
            low = x
        newton = x - y / slope
        following = newton if low < newton < high else 0.5 * (low + high)
        if abs(following - x) < _SETTLED:
            return following
        x = following
    return x


@kernel
def _clamped_rate(log_light: float, c: Step) -> float:
    return float(min(max(c.rate_at_reference * math.exp(log_light), c.rate_min), c.rate_max))


@kernel
def _warped_time(h: float, d: float, l0: float, l1: float) -> float:
    """Return the integral of the rate over h while the log light changes by d (trapezium with end correction)."""
    return h * max((l0 + l1) / 2 + d * (l0 - l1) / 12, min(l0, l1))


class _Piece(NamedTuple):
    """One piece of the step: state at its start, change of log light, rates at both ends, lengths."""

    u0: float
    v0: float
    d: float
    rate0: float
    rate1: float
    s: float  # length in warped time
    h: float  # length, s
    t: float  # time since the epoch at its start, s


@kernel
def _filtered_after(q: _Piece) -> float:
    decayed = -math.expm1(-q.s)
    return q.v0 + decayed * (q.u0 - q.v0) + q.d * (1 - decayed / q.s)


@kernel
def _curve(q: _Piece, v1: float, p: Pixel) -> _Curve:
    """Return the filtered value, leak added, over the piece: a line, a cubic, or a line and an exponential."""
    b = q.v0 - q.u0 + q.d / q.s
    d0, d1 = q.v0 + p.leak * q.t, v1 + p.leak * (q.t + q.h)
    if q.s > _FAST and abs(b) < _FAINT:
        return _Curve(d0, d1 - d0, 0.0, 0.0, 0.0, 1.0)
    if abs(b) * min(q.s**4 / 384, 0.16 * q.s + 0.2) > _SHARE * min(p.on, p.off):
        return _Curve(q.u0 - q.d / q.s + p.leak * q.t, q.d + p.leak * q.h, 0.0, 0.0, b, q.s)
    m0 = q.h * (q.rate0 * (q.u0 - q.v0) + p.leak)
    m1 = q.h * (q.rate1 * (q.u0 + q.d - v1) + p.leak)
    rise = d1 - d0
    return _Curve(d0, m0, 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise, 0.0, 1.0)


class _Span(NamedTuple):
    """A monotone part of a piece, in the piece's x, and where the piece lies in the step."""

    low: float
    value_low: float
    high: float
    value_high: float
    origin: float
    width: float


class _Walk(NamedTuple):
    """Where the pixel has got to: its reference, or until when (in steps) it is blind, and its events so far."""

    reference: float
    blind: bool
    until: float
    events: int


@kernel
def _next(f: _Curve, x: float, here: float, span: _Span, reference: float, p: Pixel) -> tuple[float, int]:
    """Return where from x on, with value `here`, the pixel fires next, and 1 for ON; beyond the span if it does not."""
    if here - reference >= p.on:
        return x, 1
    if here - reference <= -p.off:
        return x, 0
    on = span.value_high - reference >= p.on
    if not on and span.value_high - reference > -p.off:
        return span.high + 1, 0
    level = reference + p.on if on else reference - p.off
    return _crossing(f, level, x, here - level, span.high, span.value_high - level), int(on)


@kernel
def _walk_part(f: _Curve, span: _Span, walk: _Walk, p: Pixel, c: Step, trace: Trace) -> _Walk:
    """Go along a monotone part, from event to event."""
    reference, blind, until, count = walk
    x, here = span.low, span.value_low
    while True:
        if blind:
            sees_again = (until - span.origin) / span.width
            if sees_again > span.high:
                break
            if sees_again > x:
                x, here = sees_again, _value_and_slope(f, sees_again)[0]
            reference, blind = here, False
        x, on = _next(f, x, here, span, reference, p)
        if x > span.high:
            break
        z = span.origin + x * span.width
        if count < MOST_EVENTS:
            trace.z[count], trace.on[count] = z, on
        count += 1
        if c.refractory > 0:
            blind, until = True, z + c.refractory
            here = _value_and_slope(f, x)[0]
        else:
            reference += p.on if on else -p.off
            here = reference
    return _Walk(reference, blind, until, count)


@kernel
def _walk_piece(f: _Curve, place: tuple[float, float], walk: _Walk, p: Pixel, c: Step, trace: Trace) -> _Walk:
    """Go along a piece, from one monotone part to the next; `place` is its origin and width, in steps."""
    low, value_low = 0.0, _value_and_slope(f, 0.0)[0]
    first, second = _turns(f)
    for turn in (first, second, 1.0):
        if turn > low:
            value = _value_and_slope(f, turn)[0]
            walk = _walk_part(f, _Span(low, value_low, turn, value, place[0], place[1]), walk, p, c, trace)
            low, value_low = turn, value
    return walk


@kernel
def solve_exactly(p: Pixel, c: Step, trace: Trace) -> tuple[int, float, float, float]:
    """Walk one pixel through one step.

    Returns
    -------
    number of crossings (the first MOST_EVENTS of them in `trace`), filtered value at the end, reference at the end
    (NaN: blind) and, if blind, until when in steps.
    """
    d = p.log_light_after - p.log_light
    pieces = max(1, math.ceil(abs(d) / _LARGEST_CHANGE))
    width, h = 1 / pieces, c.h / pieces
    walk = _Walk(p.reference, p.reference != p.reference, p.start, 0)
    v, rate = p.filtered, p.rate
    for k in range(pieces):
        u = p.log_light + k * width * d
        rate1 = p.rate_after if k == pieces - 1 else _clamped_rate(u + width * d, c)
        s = _warped_time(h, width * d, rate, rate1)
        q = _Piece(u, v, width * d, rate, rate1, s, h, c.since_epoch + k * h)
        v, rate = _filtered_after(q), rate1
        walk = _walk_piece(_curve(q, v, p), (k * width, width), walk, p, c, trace)
    reference = math.nan if walk.blind else walk.reference
    return walk.events, v, reference, walk.until

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

__all__ = ["MOST_EVENTS", "Pixel", "Step", "Trace", "cubic", "solve_exactly"]

Real = Any
"""A float of any width: inside numba, whichever the caller has."""

MOST_EVENTS = 64
"""Events of a pixel in a step; crossings beyond are counted as lost in the pixel."""

_LARGEST_CHANGE = 0.5
_SHARE = 0.01
_FAST, _FAINT = 100.0, 1e-5


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
def cubic(d0: Real, d1: Real, m0: Real, m1: Real, z: Real) -> Real:
    """Return the cubic with values d0, d1 and slopes m0, m1 at z = 0, 1."""
    rise = d1 - d0
    return (((m0 + m1 - rise - rise) * z + (rise + rise + rise - m0 - m0 - m1)) * z + m0) * z + d0


@kernel
def _value(f: _Curve, x: float) -> float:
    y = ((f.c3 * x + f.c2) * x + f.c1) * x + f.c0
    return y + f.b * math.exp(-f.s * x) if f.b != 0 else y


@kernel
def _slope(f: _Curve, x: float) -> float:
    y = (3 * f.c3 * x + 2 * f.c2) * x + f.c1
    return y - f.b * f.s * math.exp(-f.s * x) if f.b != 0 else y


@kernel
def _turns(f: _Curve) -> tuple[float, float]:
    """Return the turning points in (0, 1) in ascending order; 1 stands for none."""
    if f.b != 0:
        ratio = f.b * f.s / f.c1 if f.c1 != 0 else 0.0
        x = math.log(ratio) / f.s if ratio > 0 else 1.0
        return (x if 0 < x < 1 else 1.0), 1.0
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
def _crossing(f: _Curve, level: float, low: float, high: float) -> float:
    """Return where f meets `level` in [low, high], on which it is monotone and at whose ends it lies on both sides."""
    f_low, f_high = _value(f, low) - level, _value(f, high) - level
    rising = f_high > f_low
    x: float = low - f_low * (high - low) / (f_high - f_low)
    for _ in range(60):
        y = _value(f, x) - level
        if (y > 0) == rising:
            high = x
        else:
            low = x
        slope = _slope(f, x)
        newton = x - y / slope if slope != 0 else low
        following = newton if low < newton < high else 0.5 * (low + high)
        if abs(following - x) < 1e-10:
            break
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
    high: float
    origin: float
    width: float


class _Walk(NamedTuple):
    """Where the pixel has got to: its reference, or until when (in steps) it is blind, and its events so far."""

    reference: float
    blind: bool
    until: float
    events: int


@kernel
def _next(f: _Curve, x: float, high: float, reference: float, p: Pixel) -> tuple[float, int]:
    """Return where from x on the pixel fires next, and 1 for ON; beyond `high` if it does not."""
    here, there = _value(f, x) - reference, _value(f, high) - reference
    if here >= p.on:
        return x, 1
    if here <= -p.off:
        return x, 0
    if there >= p.on:
        return _crossing(f, reference + p.on, x, high), 1
    if there <= -p.off:
        return _crossing(f, reference - p.off, x, high), 0
    return high + 1, 0


@kernel
def _walk_part(f: _Curve, span: _Span, walk: _Walk, p: Pixel, c: Step, trace: Trace) -> _Walk:
    """Go along a monotone part, from event to event."""
    reference, blind, until, count = walk
    x = span.low
    while True:
        if blind:
            sees_again = (until - span.origin) / span.width
            if sees_again > span.high:
                break
            x = max(x, sees_again)
            reference, blind = _value(f, x), False
        x, on = _next(f, x, span.high, reference, p)
        if x > span.high:
            break
        z = span.origin + x * span.width
        if count < MOST_EVENTS:
            trace.z[count], trace.on[count] = z, on
        count += 1
        if c.refractory > 0:
            blind, until = True, z + c.refractory
        else:
            reference += p.on if on else -p.off
    return _Walk(reference, blind, until, count)


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
        f = _curve(q, v, p)
        first, second = _turns(f)
        walk = _walk_part(f, _Span(0.0, first, k * width, width), walk, p, c, trace)
        if first < 1:
            walk = _walk_part(f, _Span(first, second, k * width, width), walk, p, c, trace)
        if second < 1:
            walk = _walk_part(f, _Span(second, 1.0, k * width, width), walk, p, c, trace)
    reference = math.nan if walk.blind else walk.reference
    return walk.events, v, reference, walk.until

"""The photoreceptor's circuit in large-signal form, and one step of its solution.

In units of the thermal voltage, p is the photodiode's node above its rest, y the output, u = ln i the photocurrent. The
feedback transistor carries e^(y - p); the amplifier has a bias current that limits how fast its output can rise, and a
capacitance couples its output to the photodiode. Behind it lies the source follower w:

    dp/dt = a (e^(y - p) - i) + dy/dt        a    = 2 pi corner_hz_at_reference
    dy/dt = b (1 - e^p)                      b    = 2 pi corner_max_hz
    dw/dt = c (y - w)                        c    = 2 pi source_follower_hz

For small signals that is y'' + (a i + b) y' + a i b (y - u) = 0: two poles, at a i and at b, of which the slower one is
that of the one-pole model. For large ones the output rises by at most b a second, and falls as slowly as the little
light that is left allows. The circuit and its large-signal form: Graca and Delbruck, arXiv 2505.07386; here with ideal
transistors, and with the coupling at which the circuit does not ring, not with their fitted figures.

One step is Shampine's Rosenbrock method of order 4 with an error estimate of order 3 (Hairer and Wanner, Solving ODEs
II, IV.7), with the exact Jacobian: it stays stable however stiff the circuit is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from emulator.sensor.numerics.compiled import kernel

__all__ = ["Circuit", "Light", "State", "log_light", "rates", "rosenbrock"]

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

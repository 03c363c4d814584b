"""Resets: the random numbers of an event, and how its column goes on behind its dead time.

The noise leaves through a threshold with a slope that is drawn (`exit_speed`); value and slope are carried over the
dead time exactly, with two normal numbers. The new reference is signal plus noise at its end.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.integral import ONE_POLE, exit_speed
from emulator.sensor.noise.moments import Start, moments_over
from emulator.sensor.numerics.columns import put, take
from emulator.sensor.numerics.compiled import vector_kernel
from emulator.sensor.numerics.elementary import decay, natural_log, use_widest_vectors
from emulator.sensor.numerics.keyed import mix_word
from emulator.sensor.pixels.passages.bursts import after_bound, bound_of, store_bound
from emulator.sensor.pixels.passages.rows import DONE, PLACED, Column, chosen, curve_of, noise_at, replace, value_at

_Float32s = npt.NDArray[np.float32]
_Words = npt.NDArray[np.uint64]

_ZERO, _HALF, _ONE, _TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
_NAN = np.float32(np.nan)
_DEEP = np.float32(-4)  # deviations behind a threshold at which the noise may be any
_STEEPEST = np.float32(1e6)
_LEAST_DEVIATION = np.float32(1e-10)
_S16, _S32, _S40, _MASK, _LAST = (np.uint64(n) for n in (16, 32, 40, 0xFFFFFF, 0xFFFF))
_SECOND = np.uint64(0x9E3779B97F4A7C15)
_UNIT_16, _UNIT_24, _UNIT_32 = (np.float32(2.0**-n) for n in (16, 24, 32))
_FEW = np.float32(1e-3)
# cos 2 pi h and sin 2 pi h / h in powers of h^2, fitted to |h| <= 1/2.
_Z = np.linspace(0, 0.25, 2001)
_COSINE, _SINE = (
    np.polynomial.polynomial.polyfit(_Z, values, 6).astype(np.float32)
    for values in (np.cos(2 * np.pi * np.sqrt(_Z)), 2 * np.pi * np.sinc(2 * np.sqrt(_Z)))
)
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = (np.float32(c) for c in _COSINE)
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = (np.float32(c) for c in _SINE)


@vector_kernel
def draw(rows: _Float32s, keys: _Words, n: int) -> None:
    """Draw the numbers of an event of each column by its key: two normal ones, a share, and an exponential one."""
    use_widest_vectors()
    for i in range(n):
        # Box-Muller on 24 bits for the radius and 24 for the angle, in turns from 1/2; the sign of both is random.
        bits = mix_word(keys[i])
        radius = np.sqrt(-_TWO * natural_log((np.float32(bits >> _S40) + _HALF) * _UNIT_24))
        h = np.float32((bits >> _S16) & _MASK) * _UNIT_24 - _HALF
        z = h * h
        cosine = (((((_C6 * z + _C5) * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _C0
        sine = ((((((_S6 * z + _S5) * z + _S4) * z + _S3) * z + _S2) * z + _S1) * z + _S0) * h
        share = (np.float32(bits & _LAST) + _HALF) * _UNIT_16
        put(rows, Column.NORMAL + i, radius * cosine)
        put(rows, Column.NORMAL2 + i, radius * sine)
        put(rows, Column.SHARE + i, share)
        u = (np.float32(mix_word(keys[i] + _SECOND) >> _S32) + _HALF) * _UNIT_32
        # -ln(1 - u), with the digits of a small u.
        put(rows, Column.DRAWN + i, -natural_log(_ONE - u) if u > _FEW else u + _HALF * u * u)


@vector_kernel
def leave(rows: _Float32s, tables: _Float32s, n: int) -> None:
    """Find value and slope of the noise at the event of each column in state PLACED; N and V hold them from then on.

    Whether the event is the noise's is decided too: the signal has gone less than half of the way since the reset.
    """
    use_widest_vectors()
    for i in range(n):
        selected = take(rows, Column.STATE + i) == PLACED
        x, sign = take(rows, Column.EVENT + i), take(rows, Column.SIGN + i)
        c = take(rows, Column.C + i)
        nu, z = take(rows, Column.NU + i), take(rows, Column.EVENT_Z + i)
        curve = curve_of(rows, i)
        w, reference = value_at(curve, x), take(rows, Column.REFERENCE + i)
        threshold = chosen(rows, Column.ON + i, Column.OFF + i, _ONE if sign > _ZERO else _ZERO)
        deviation = noise_at(rows, i, x).sigma * take(rows, Column.DEVIATION + i)
        # The noise is what the signal lacks; of a signal that has jumped beyond the level, any.
        deep = c < _DEEP
        value = reference + sign * threshold - w
        value += sign * deviation * (take(rows, Column.NORMAL2 + i) - c) if deep else _ZERO
        outward = exit_speed(tables, nu, c, take(rows, Column.SHARE + i), z) - nu
        outward = deviation * (outward * take(rows, Column.SLOPE + i) + c * take(rows, Column.PULL + i))
        slope = take(rows, Column.MEAN_SLOPE + i) + (_ZERO if deep else sign * outward)
        gone = sign * (w - (reference - take(rows, Column.N + i)))
        replace(rows, Column.OF_NOISE + i, _ONE if gone < _HALF * threshold else _ZERO, selected)
        replace(rows, Column.N + i, value, selected)
        # One pole's noise has no slope: any signal is slow beside it.
        steep = _STEEPEST * take(rows, Column.SPAN + i)
        replace(rows, Column.V + i, sign * steep if z > ONE_POLE else slope, selected)


@vector_kernel
def reset(rows: _Float32s, n: int) -> None:
    """Carry each column in state PLACED over its dead time, set its reference, and bound its burst."""
    use_widest_vectors()
    for i in range(n):
        state = take(rows, Column.STATE + i)
        selected, event = state == PLACED, take(rows, Column.EVENT + i)
        dead = take(rows, Column.DEAD + i) + take(rows, Column.LATE + i)
        noise, value = noise_at(rows, i, event), take(rows, Column.N + i)
        slope = take(rows, Column.V + i)
        single, m = noise.z > ONE_POLE, moments_over(dead, noise)
        g1, g2 = take(rows, Column.NORMAL + i), take(rows, Column.NORMAL2 + i)
        product, total = noise.a1 * noise.a2, noise.a1 + noise.a2
        deviation = np.sqrt(max(m.v, _ZERO))
        shared = total * m.p12 * m.b12 / max(deviation, _LEAST_DEVIATION)
        alone = np.sqrt(max(m.w - shared * shared, _ZERO))
        of_one = value * m.e + noise.sigma * np.sqrt(decay(_TWO * noise.rate * dead)) * g1
        n_after = of_one if single else m.p11 * value + m.p12 * slope + noise.sigma * deviation * g1
        v_after = m.p22 * slope - product * m.p12 * value + noise.sigma * noise.rate * (shared * g1 + alone * g2)
        start = Start(n_after, _ZERO if single else v_after)
        armed, offset = event + dead, take(rows, Column.OFFSET + i)
        reference = value_at(curve_of(rows, i), armed) + n_after + offset
        late, number = armed >= _ONE, take(rows, Column.DRAWN + i)
        # The burst that follows.
        b = bound_of(rows, i, armed, armed, reference, number, start)
        after = after_bound(b, armed, armed, take(rows, Column.BURST + i))
        put(rows, Column.STATE + i, (DONE if late else after.state) if selected else state)
        replace(rows, Column.AT + i, max(armed, _ONE) if late else after.x, selected)
        replace(rows, Column.RESET + i, armed, selected)
        replace(rows, Column.REFERENCE + i, _NAN if late else reference, selected)
        replace(rows, Column.LEFT + i, number, selected)
        replace(rows, Column.N + i, start.n, selected)
        replace(rows, Column.V + i, start.v, selected)
        replace(rows, Column.LIMIT + i, _TWO, selected)
        store_bound(rows, i, b, after, selected)

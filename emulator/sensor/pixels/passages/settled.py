"""Parts of a column in which the noise has forgotten its last reset: their integral, and events in them.

A part does not turn. Its integral depends on the distances at both ends, and on the speed near the closer one: the
hazard is gained over the last d = 1.27 / c deviations before it, so the speed that counts is

    nu = (nu_near + sqrt(nu_near^2 + 2 a d)) / 2         a: the acceleration, seen from the near end outwards

which is exact for a curve that turns at the near end, where it gives the Gaussian integral. A part in which the
distance hardly changes (a cell) has no speed to divide by: there the hazard of its middle is multiplied by its length.

The event in an approach is at the c where K has the value that is left; its time is a root of the cubic.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.hazard import (
    CERTAIN,
    FARTHEST,
    density_or_integral,
    farther,
    integral_beyond,
    pair_factors,
    place_of,
    rho_of,
    slice_of,
    steeper_beyond,
)
from emulator.sensor.noise.moments import Noise
from emulator.sensor.numerics.columns import Packed, put, take
from emulator.sensor.numerics.compiled import Real, lane, vector_kernel
from emulator.sensor.numerics.elementary import exponential_less_one, log_of_one_more, use_widest_vectors
from emulator.sensor.pixels.passages.rows import (
    BURST,
    DONE,
    FIRED,
    PART,
    PLACED,
    Column,
    Curve,
    bend_at,
    chosen,
    curve_of,
    noise_at,
    replace,
    speed_at,
    value_at,
)

_Float32s = npt.NDArray[np.float32]

_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR, _SIX = (np.float32(x) for x in (0, 0.5, 1, 2, 3, 4, 6))
_GAINED = np.float32(1.27)  # 4 / pi: deviations times c over which a hazard is gained
_CELL = np.float32(0.6)  # change of c times c below which a part is a cell
_TINY, _LEAST_SPEED = np.float32(1e-9), np.float32(1e-6)
_LEAST_INTEGRAL = np.float32(1e-30)
_BEYOND = np.float32(-4)  # deviations behind a threshold at which a passage is certain
_BENDS = np.float32(1 / 24)
_UNRESOLVED = np.float32(16)  # difference of two squares of c beyond which the far end adds nothing
_BOTH, _BOTH_TOGETHER = np.float32(0.02), np.float32(0.1)  # integrals of both thresholds with which a part is shortened
_MUCH, _QUARTER = np.float32(4), np.float32(0.25)
_LITTLE = np.float32(0.02)
_ON, _OFF = np.float32(1), np.float32(2)  # bits of CELL


class Ends(NamedTuple):
    """Distances, speeds and accelerations of a threshold at both ends of a part, in deviations and time constants."""

    c0: Real
    c1: Real
    nu0: Real
    nu1: Real
    bend0: Real
    bend1: Real


class Integral(NamedTuple):
    """The integral of a threshold's hazard over a part, its signed speed, whether it is a cell, and the least c."""

    value: Real
    nu: Real
    cell: Real
    closeness: Real


@lane
def near_speed(nu: Real, bend: Real, c: Real, gone: Real) -> Real:
    """Return the speed that counts of an approach that is `nu` fast at its near end."""
    d = min(_GAINED / max(c, _HALF), gone)
    return _HALF * (nu + np.sqrt(max(nu * nu + _TWO * bend * d, _ZERO)))


@lane
def integral_of(tables: Packed, k: Real, apart: Real, ends: Ends, q: Real, needed: Real) -> Integral:
    """Return a threshold's integral over a part of q time constants, in slice k; 0 if not `needed`."""
    travel = ends.c0 - ends.c1
    size, toward = abs(travel), travel > _ZERO
    closeness, distant = min(ends.c0, ends.c1), max(ends.c0, ends.c1)
    cell = size * max(closeness, _ONE) < _CELL
    counts = near_speed(ends.nu1 if toward else -ends.nu0, ends.bend1 if toward else ends.bend0, closeness, size)
    nu = travel / q if cell else (counts if toward else -counts)
    steep, middle = _ONE + abs(nu), _HALF * (ends.c0 + ends.c1)
    rho = nu / steep
    # One look-up serves both forms: the hazard of a cell's middle, or the integral beyond the near end.
    at = middle if cell else closeness
    at += farther(at, nu, apart)
    counted = needed & (closeness < FARTHEST)
    value = density_or_integral(tables, ~cell, k, rho, at, counted)
    resolved = counted & ~cell & ((distant - closeness) * (distant + closeness) < _UNRESOLVED)
    beyond = integral_beyond(tables, k, rho, distant + farther(distant, nu, apart), resolved)
    bent = _ONE + travel * travel * (middle * middle - _ONE) * _BENDS  # mean of the Gaussian over the cell
    in_cell = q * steep * value * steeper_beyond(at) * bent
    along = max((value - beyond) / max(abs(rho), _TINY), _ZERO)
    total = in_cell if cell else (CERTAIN if closeness < _BEYOND else along)
    return Integral(total if counted else _ZERO, nu, cell, closeness)


class Both(NamedTuple):
    """The integrals of both thresholds, as if each were alone, and as they are."""

    on: Integral
    off: Integral
    on_value: Real
    off_value: Real


@lane
def both_count(pair: Both) -> Real:
    """Return whether both thresholds take so much that their order in time counts: the part is to be shortened."""
    on, off = pair.on, pair.off
    return (min(on.value, off.value) > _BOTH) & (on.value + off.value > _BOTH_TOGETHER) & ~(on.cell & off.cell)


class Span(NamedTuple):
    """A part of a piece: its ends, and the distances to both thresholds at its start's value, ln units."""

    x0: Real
    x1: Real
    on: Real
    off: Real


class Widening(NamedTuple):
    """Sigma at the start of a piece, and its change."""

    sigma: Real
    change: Real


@lane
def integrals(tables: Packed, curve: Curve, span: Span, widening: Widening, noise: Noise, needed: Real) -> Both:
    """Return both integrals over a part, with the poles of `noise`, and the factors of two thresholds in its middle.

    A passage through one threshold is none through the other one.
    """
    w0, w1 = value_at(curve, span.x0), value_at(curve, span.x1)
    i0 = _ONE / (widening.sigma + widening.change * span.x0)
    i1 = _ONE / (widening.sigma + widening.change * span.x1)
    per = _ONE / noise.rate
    u0, u1 = i0 * per, i1 * per
    on0, on1 = (span.on - w0) * i0, (span.on - w1) * i1
    off0, off1 = (span.off + w0) * i0, (span.off + w1) * i1
    v0, v1 = speed_at(curve, span.x0) * u0, speed_at(curve, span.x1) * u1
    b0, b1 = bend_at(curve, span.x0) * u0 * per, bend_at(curve, span.x1) * u1 * per
    n0, n1 = widening.change * u0, widening.change * u1  # a sigma that grows brings both thresholds nearer
    k, q = slice_of(noise.z), (span.x1 - span.x0) * noise.rate
    on = integral_of(tables, k, noise.apart, Ends(on0, on1, v0 + on0 * n0, v1 + on1 * n1, -b0, -b1), q, needed)
    off = integral_of(tables, k, noise.apart, Ends(off0, off1, -v0 + off0 * n0, -v1 + off1 * n1, b0, b1), q, needed)
    middle = value_at(curve, _HALF * (span.x0 + span.x1))
    per_sigma, rise = _ONE / noise.sigma, _HALF * (on.nu - off.nu)
    c_on, c_off = (span.on - middle) * per_sigma, (span.off + middle) * per_sigma
    share = _ONE / (_ONE + rise * rise)
    on_factor, off_factor = pair_factors(tables, c_on, c_off, noise.z, share, needed)
    return Both(on, off, on.value * on_factor, off.value * off_factor)


@vector_kernel
def part(rows: _Float32s, tables: Packed, n: int) -> None:
    """Integrate the next part of each column in state PART."""
    use_widest_vectors()
    for i in range(n):
        state = take(rows, Column.STATE + i)
        selected = state == PART
        # The part: to the next turn, or as short as it was made.
        x, turn = take(rows, Column.AT + i), take(rows, Column.TURN + i)
        turn2 = take(rows, Column.TURN2 + i)
        limit = take(rows, Column.LIMIT + i)
        end = min(turn if x < turn else (turn2 if x < turn2 else _ONE), limit)
        reference, left = take(rows, Column.REFERENCE + i), take(rows, Column.LEFT + i)
        on_level, off_level = take(rows, Column.ON + i) + reference, take(rows, Column.OFF + i) - reference
        noise, curve = noise_at(rows, i, _HALF * (x + end)), curve_of(rows, i)
        widening = Widening(take(rows, Column.SIGMA + i), take(rows, Column.D_SIGMA + i))
        pair = integrals(tables, curve, Span(x, end, on_level, off_level), widening, noise, selected)
        on, off = pair.on, pair.off
        on_integral, off_integral = pair.on_value, pair.off_value
        short = both_count(pair)
        shorter = x + (_HALF if on.value + off.value < _MUCH * left else _QUARTER) * (end - x)
        total = on_integral + off_integral
        fired = ~(total < left)
        burst_end = take(rows, Column.RESET + i) + take(rows, Column.BURST + i)
        passed = DONE if end >= _ONE else (BURST if end < burst_end else PART)
        go = selected & ~short & ~fired
        put(rows, Column.STATE + i, (PART if short else (FIRED if fired else passed)) if selected else state)
        put(rows, Column.LIMIT + i, (shorter if short else _TWO) if selected else limit)
        put(rows, Column.AT + i, end if go else x)
        put(rows, Column.LEFT + i, left - total if go else left)
        replace(rows, Column.END + i, end, selected)
        replace(rows, Column.ON_INTEGRAL + i, on_integral, selected)
        replace(rows, Column.OFF_INTEGRAL + i, off_integral, selected)
        replace(rows, Column.ON_SPEED + i, on.nu, selected)
        replace(rows, Column.OFF_SPEED + i, off.nu, selected)
        replace(rows, Column.CELL + i, (_ON if on.cell else _ZERO) + (_OFF if off.cell else _ZERO), selected)


class Bracket(NamedTuple):
    """A root, and bounds of it."""

    x: Real
    low: Real
    high: Real


@lane
def nearer_root(at: Bracket, rising: Real, base: Real, curve: Curve) -> Bracket:
    """Return a step of Halley's method for base + curve = 0, kept within its bounds."""
    value, slope = base + value_at(curve, at.x), speed_at(curve, at.x)
    bend = bend_at(curve, at.x)
    before = (value < _ZERO) == rising
    low, high = at.x if before else at.low, at.high if before else at.x
    x = at.x - value * slope / (slope * slope - _HALF * value * bend)
    return Bracket(x if (low <= x) & (x <= high) else _HALF * (low + high), low, high)


@lane
def root_of(at: Bracket, base: Real, curve: Curve) -> Bracket:
    """Return the root of a monotone base + curve within bounds after four steps; a loop would be no vector."""
    rising = base + value_at(curve, at.low) < _ZERO
    at = nearer_root(at, rising, base, curve)
    at = nearer_root(at, rising, base, curve)
    at = nearer_root(at, rising, base, curve)
    root: Bracket = nearer_root(at, rising, base, curve)
    return root


@vector_kernel
def locate(rows: _Float32s, tables: Packed, n: int) -> None:  # noqa: PLR0915
    """Find time, polarity and noise of the event of each column in state FIRED."""
    use_widest_vectors()
    for i in range(n):
        state = take(rows, Column.STATE + i)
        selected = state == FIRED
        x, end = take(rows, Column.AT + i), take(rows, Column.END + i)
        reference, left = take(rows, Column.REFERENCE + i), take(rows, Column.LEFT + i)
        on_level, off_level = take(rows, Column.ON + i) + reference, take(rows, Column.OFF + i) - reference
        sigma, change = take(rows, Column.SIGMA + i), take(rows, Column.D_SIGMA + i)
        noise, curve = noise_at(rows, i, _HALF * (x + end)), curve_of(rows, i)
        k, per = slice_of(noise.z), _ONE / noise.rate
        w0, w1, i0, i1 = (
            value_at(curve, x),
            value_at(curve, end),
            _ONE / (sigma + change * x),
            _ONE / (sigma + change * end),
        )
        on0, on1 = (on_level - w0) * i0, (on_level - w1) * i1
        off0, off1 = (off_level + w0) * i0, (off_level + w1) * i1
        # The polarity: by chance in two cells, else the threshold that recedes comes first.
        on_integral, off_integral = take(rows, Column.ON_INTEGRAL + i), take(rows, Column.OFF_INTEGRAL + i)
        cells, total = take(rows, Column.CELL + i), on_integral + off_integral
        in_cells, on_first = cells == _ON + _OFF, on1 > on0
        of_first = chosen(rows, Column.ON_INTEGRAL + i, Column.OFF_INTEGRAL + i, _ONE if on_first else _ZERO)
        by_first = left < of_first
        is_on = (take(rows, Column.POLARITY + i) * total < on_integral) if in_cells else (on_first == by_first)
        integral = chosen(rows, Column.ON_INTEGRAL + i, Column.OFF_INTEGRAL + i, _ONE if is_on else _ZERO)
        remaining = left * integral / total if in_cells else (left if by_first else left - of_first)
        c0, c1 = on0 if is_on else off0, on1 if is_on else off1
        sign = _ONE if is_on else -_ONE
        # In a cell: the hazard is exponential in time.
        growth = _HALF * (c0 + c1) * (c0 - c1)
        grows = abs(growth) > _LITTLE
        share, growth = remaining / max(integral, _LEAST_INTEGRAL), growth if grows else _ONE
        share = log_of_one_more(share * exponential_less_one(growth)) / growth if grows else share
        in_cell = x + min(max(share, _ZERO), _ONE) * (end - x)
        # Along an approach, or receding: the place by the inverse integral, at the speed at 3 deviations first.
        approach, per_deviation = c1 < c0, (end - x) / (c0 - c1)
        guess = x + max(c0 - _THREE, _ZERO) * per_deviation if c1 < _TWO else end
        fast = max((sign * speed_at(curve, guess) + _THREE * change) / (sigma + change * guess) * per, _LEAST_SPEED)
        nu = chosen(rows, Column.ON_SPEED + i, Column.OFF_SPEED + i, _ONE if is_on else _ZERO)
        nu = fast if approach & (c1 < _TWO) else nu
        rho = rho_of(nu)
        least, largest = min(c0, c1), max(c0, c1)
        before, used = (
            integral_beyond(tables, k, rho, c0 + farther(c0, nu, noise.apart), selected),
            remaining * abs(rho),
        )
        c = place_of(tables, k, rho, used + before if approach else before - used, selected)
        c = min(max(c - farther(c, nu, noise.apart), least), largest)
        # A place c deviations before the level, which is `distance` away: the curve there is a cubic still.
        distance = on_level if is_on else -off_level
        at_c = Curve(curve.c1 + sign * c * change, curve.c2, curve.c3)
        guess = min(max(x + (c0 - c) * per_deviation, x), end)
        at = root_of(Bracket(guess, x, end), sign * c * sigma - distance, at_c)
        # And again with the speed that counts there.
        inverse = _ONE / (sigma + change * at.x)
        v = (sign * speed_at(curve, at.x) + c * change) * inverse * per
        nu = max(near_speed(v, -sign * bend_at(curve, at.x) * inverse * per * per, c, c0 - c), _LEAST_SPEED)
        rho = rho_of(nu)
        before = integral_beyond(tables, k, rho, c0 + farther(c0, nu, noise.apart), selected & approach)
        better = place_of(tables, k, rho, remaining * rho + before, selected & approach)
        better = min(max(better - farther(better, nu, noise.apart), least), largest)
        c = better if approach else c
        base, at_c = sign * c * sigma - distance, Curve(curve.c1 + sign * c * change, curve.c2, curve.c3)
        rising = base + value_at(at_c, x) < _ZERO
        at = nearer_root(Bracket(at.x, x, end), rising, base, at_c)
        at = nearer_root(at, rising, base, at_c)
        is_cell = in_cells | (cells == (_ON if is_on else _OFF))
        event = in_cell if is_cell else at.x
        sigma_there = sigma + change * event
        c = sign * (distance - value_at(curve, event)) / sigma_there
        replace(rows, Column.EVENT + i, event, selected)
        replace(rows, Column.SIGN + i, sign, selected)
        replace(rows, Column.C + i, c, selected)
        replace(rows, Column.NU + i, (sign * speed_at(curve, event) + c * change) / sigma_there * per, selected)
        replace(rows, Column.SLOPE + i, noise.rate, selected)
        replace(rows, Column.DEVIATION + i, _ONE, selected)
        replace(rows, Column.PULL + i, _ZERO, selected)
        replace(rows, Column.MEAN_SLOPE + i, _ZERO, selected)
        replace(rows, Column.EVENT_Z + i, noise.z, selected)
        put(rows, Column.STATE + i, PLACED if selected else state)

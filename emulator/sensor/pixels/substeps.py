"""Pixels whose step is not simple, walked through it piece by piece, all together: one column of a table a pixel.

Here come big changes, turns, jumps, unknown or limited slopes, blind stretches and exponentials. On a piece

    light     changes by at most 0.5 in its logarithm, as do its slopes a piece
    filter    is solved by `lowpass`; what is compared, g, is the cubic in time through values and slopes at the ends
    length    is cut until what that cubic misses of the exponential, |B| E(S), is below 0.4 % of a threshold. What is
              left of B has died by e^-S in the next piece, so that a few pieces do for any light and any rate

and the turning points of a cubic are known in closed form: between them g is monotone, so its values at the ends decide
whether a level is met, and nothing can be missed. A round moves every column one piece on, and within it from event to
event: Newton's turns for all columns together, halving for the few that do not settle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import Real, kernel, kernel_that_allocates, lane, vector_kernel
from emulator.sensor.numerics.elementary import decay, exponential
from emulator.sensor.pixels.interpolation import LARGEST_CHANGE, completed, is_jump, is_suspect, limit
from emulator.sensor.pixels.lowpass import Course, rise_of_filter, transient, warped_time
from emulator.sensor.pixels.packed_crossings import MOST_EVENTS, Keys, pack, room_for
from emulator.sensor.pixels.state import BLOCK, Field, Pixels, StepConstants, slot, whole_vectors

__all__ = ["WALK_CAPACITY", "Start", "Walk", "enter", "new_walk", "walk_through"]

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]

_V, _REF, _W, _P = (int(f) * BLOCK for f in (Field.FILTERED, Field.REFERENCE, Field.SECOND, Field.LEAKED))

WALK_CAPACITY = 2 * BLOCK + 16
# Rows of a column for the whole step, ...
_KEPT_ROWS = 17
(
    _C_U, _C_D, _C_A0, _C_A1, _C_JUMP, _C_WIDTH, _C_V, _C_W, _C_P, _C_Z, _C_BASE, _C_LEVEL, _C_SEES,
    _C_ON, _C_OFF, _C_LEAK, _C_COUNT,
) = (k * WALK_CAPACITY for k in range(_KEPT_ROWS))  # fmt: skip
# ... and for a piece: g = d0 + c1 x + c2 x^2 + c3 x^3 with x in [0, 1], its turns, its end, and where the walk is.
(
    _C_D0, _C_C1, _C_C2, _C_C3, _C_TURN, _C_TURN2, _C_SPAN, _C_V1, _C_W1, _C_P1, _C_Z1,
    _C_X, _C_FIRES, _C_HIT, _C_LOW, _C_HIGH, _C_TO, _C_MISS, _C_SUSPECT, _C_U0, _C_U1, _C_SLOPE0, _C_SLOPE1,
    _C_D1, _C_M1,
) = (k * WALK_CAPACITY for k in range(_KEPT_ROWS, _KEPT_ROWS + 25))  # fmt: skip
_ROWS = _KEPT_ROWS + 25

_NAN = np.float32(np.nan)
_TWELFTH = np.float32(1 / 12)
_ZERO, _ONE, _TWO, _THREE, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 0.5))
_SHARE = np.float32(0.004)  # of a threshold: what a cubic may miss
_LEAST_MISS = np.float32(2e-5)  # ln units: float32 has nothing to offer below
_LEAST_WEIGHT = np.float32(1e-20)
_E4, _E1, _E0 = np.float32(384), np.float32(1 / 0.16), np.float32(0.2)
_NEARLY = np.float32(1.001)
_NEWTON_TURNS = 4
_HALVINGS = 25
_SETTLED = np.float32(3e-5)  # last Newton correction; the error is of the order of its square


class Walk(NamedTuple):
    """The table: float32 rows, pixels of the columns, columns that did not settle."""

    rows: _Float32s
    pixels: _Int64s
    unsettled: _Int64s


class Start(NamedTuple):
    """A pixel at the start of a step: its log light at both ends, slopes per step, and state."""

    u0: Real
    u1: Real
    a0: Real
    a1: Real
    v: Real
    w: Real
    leaked: Real
    reference: Real  # NaN: blind until `sees`
    sees: Real  # as a share of the step
    on: Real
    off: Real
    leak: Real


def new_walk() -> Walk:
    """Return an empty table."""
    rows = np.zeros(_ROWS * WALK_CAPACITY, np.float32)
    return Walk(rows, np.empty(WALK_CAPACITY, np.int64), np.empty(WALK_CAPACITY, np.int64))


@kernel
def enter(walk: Walk, j: int, pixel: int, p: Start) -> None:
    """Put a pixel into column j."""
    rows = walk.rows
    walk.pixels[j] = pixel
    rows[_C_U + j], rows[_C_D + j], rows[_C_A0 + j], rows[_C_A1 + j] = p.u0, p.u1 - p.u0, p.a0, p.a1
    rows[_C_V + j], rows[_C_W + j], rows[_C_P + j], rows[_C_SEES + j] = p.v, p.w, p.leaked, p.sees
    rows[_C_BASE + j], rows[_C_ON + j], rows[_C_OFF + j], rows[_C_LEAK + j] = p.reference, p.on, p.off, p.leak


@vector_kernel
def _set_out(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Decide how each column's light is taken, and put it at the step's start.

    Levels are held relative to `base`, which is the stored reference or, for a blind pixel, its value at the start.
    """
    for j in range(n):
        d, on, off = rows[_C_D + j], rows[_C_ON + j], rows[_C_OFF + j]
        a0, a1 = completed(d, rows[_C_A0 + j], rows[_C_A1 + j])
        suspect = is_suspect(d, a0, a1, c.trust * min(on, off))
        jump = suspect & is_jump(d, a0, a1)
        factor = _ZERO if jump else limit(d, a0, a1)
        a0, a1 = factor * a0, factor * a1
        steepness = max(abs(d), _HALF * max(abs(a0), abs(a1)))
        rows[_C_SUSPECT + j] = _ONE if suspect else _ZERO
        rows[_C_JUMP + j] = _ONE if jump else _ZERO
        rows[_C_A0 + j], rows[_C_A1 + j] = a0, a1
        rows[_C_WIDTH + j] = _HALF if jump else _ONE / max(np.ceil(steepness / LARGEST_CHANGE), _ONE)
        reference, w = rows[_C_BASE + j], rows[_C_W + j]
        blind = reference != reference
        rows[_C_BASE + j] = w + (rows[_C_LEAK + j] * c.since_epoch_0 + rows[_C_P + j]) if blind else reference
        rows[_C_LEVEL + j] = _NAN if blind else _ZERO
        rows[_C_Z + j] = rows[_C_COUNT + j] = _ZERO


class _Light(NamedTuple):
    """The log light of a step: a cubic, or a jump of d at mid-step."""

    u: Real
    d: Real
    a0: Real
    a1: Real
    jump: Real


class _Piece(NamedTuple):
    """Light and rates over a piece."""

    u0: Real
    u1: Real
    r0: Real  # rates, per step
    r1: Real
    a0: Real  # slopes per piece
    a1: Real
    course: Course


@lane
def _light_at(light: _Light, z: Real, jumped: Real) -> tuple[Real, Real]:
    """Return the log light and its slope per step at z."""
    c3 = light.a0 + light.a1 - _TWO * light.d
    c2 = _THREE * light.d - _TWO * light.a0 - light.a1
    smooth = ((c3 * z + c2) * z + light.a0) * z
    stepped = light.d if jumped else _ZERO
    slope = (_THREE * c3 * z + _TWO * c2) * z + light.a0
    jump = light.jump != _ZERO
    return light.u + (stepped if jump else smooth), (_ZERO if jump else slope)


@lane
def _piece(light: _Light, z: Real, width: Real, c: StepConstants) -> _Piece:
    """Return the piece of the step from z to z + width."""
    jumped = z >= _HALF
    u0, slope0 = _light_at(light, z, jumped)
    u1, slope1 = _light_at(light, z + width, jumped)
    l0 = min(max(c.rate_at_reference * exponential(u0), c.rate_min), c.rate_max)
    l1 = min(max(c.rate_at_reference * exponential(u1), c.rate_min), c.rate_max)
    a0, a1 = width * slope0, width * slope1
    s = warped_time(c.h * width, (l0, l1), a0, a1, c)
    course = Course(s, u1 - u0, s * slope0 / (c.h * l0), s * slope1 / (c.h * l1))
    return _Piece(u0, u1, c.h * l0, c.h * l1, a0, a1, course)


@lane
def _share_to_take(b: Real, s: Real, most: Real) -> Real:
    """Return how much of a stretch of length s may be taken at once, so that a cubic misses less of b e^-s than `most`.

    The bound E is min(s^4 / 384, 0.16 s + 0.2); its inverse is the larger of the two inverses.
    """
    allowed = most / max(abs(b), _LEAST_WEIGHT)
    longest = max(np.sqrt(np.sqrt(_E4 * allowed)), (allowed - _E0) * _E1)
    return min(longest / s, _ONE)


@lane
def _most(rows: _Float32s, j: int) -> Real:
    """Return by how much a cubic may miss column j's curve."""
    return max(_SHARE * min(rows[_C_ON + j], rows[_C_OFF + j]), _LEAST_MISS)


@lane
def _light_of(rows: _Float32s, j: int) -> _Light:
    return _Light(rows[_C_U + j], rows[_C_D + j], rows[_C_A0 + j], rows[_C_A1 + j], rows[_C_JUMP + j])


@vector_kernel
def _cut(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Choose each column's next piece: as far as the light allows, and then as far as the exponential does."""
    for j in range(n):
        z, wide = rows[_C_Z + j], rows[_C_WIDTH + j]
        stop = _HALF if (rows[_C_JUMP + j] != _ZERO) & (z < _HALF) else _ONE
        last = stop - z < _NEARLY * wide
        whole = stop - z if last else wide
        q = _piece(_light_of(rows, j), z, whole, c)
        share = _share_to_take(_transient(q, rows[_C_V + j]), q.course.s, _most(rows, j))
        rows[_C_SPAN + j], rows[_C_X + j] = share * whole, _ZERO
        rows[_C_Z1 + j] = stop if last & (share == _ONE) else z + share * whole


@vector_kernel
def _shorten_for_second_pole(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Shorten each column's piece to what the exponential behind the second pole allows."""
    for j in range(n):
        span = rows[_C_SPAN + j]
        behind = rows[_C_V + j] - rows[_C_W + j]
        s = c.second * span
        t = transient(behind, Course(s, rows[_C_D1 + j] - rows[_C_D0 + j], rows[_C_C1 + j], rows[_C_M1 + j]))
        share = _share_to_take(_ZERO if t.faint else t.b, s, _most(rows, j))
        rows[_C_SPAN + j] = share * span
        rows[_C_Z1 + j] = rows[_C_Z1 + j] if share == _ONE else rows[_C_Z + j] + share * span


@lane
def _transient(q: _Piece, v0: Real) -> Real:
    """Return the weight of the exponential in the filter's answer over a piece, 0 if it is rounding noise."""
    t = transient(q.u0 - v0, q.course)
    return _ZERO if t.faint else t.b


@vector_kernel
def _follow_light(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Solve the filter over each column's piece, and write values and slopes at both ends."""
    for j in range(n):
        v0, width = rows[_C_V + j], rows[_C_SPAN + j]
        q = _piece(_light_of(rows, j), rows[_C_Z + j], width, c)
        behind = q.u0 - v0
        v1 = v0 + rise_of_filter(decay(q.course.s), behind, q.course)
        t = transient(behind, q.course)
        rows[_C_U0 + j], rows[_C_U1 + j], rows[_C_SLOPE0 + j], rows[_C_SLOPE1 + j] = q.u0, q.u1, q.a0, q.a1
        rows[_C_D0 + j], rows[_C_D1 + j], rows[_C_V1 + j], rows[_C_W1 + j] = v0, v1, v1, v1
        rows[_C_C1 + j] = width * q.r0 * (t.lag0 if t.faint else behind)
        rows[_C_M1 + j] = width * q.r1 * (t.lag1 if t.faint else q.u1 - v1)


@vector_kernel
def _follow_filter(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Solve the second pole over each column's piece, and write values and slopes in the place of the filter's."""
    for j in range(n):
        w0, s = rows[_C_W + j], c.second * rows[_C_SPAN + j]
        v0, v1 = rows[_C_D0 + j], rows[_C_D1 + j]
        course = Course(s, v1 - v0, rows[_C_C1 + j], rows[_C_M1 + j])
        w1 = w0 + rise_of_filter(decay(s), v0 - w0, course)
        t = transient(v0 - w0, course)
        rows[_C_D0 + j], rows[_C_D1 + j], rows[_C_W1 + j] = w0, w1, w1
        rows[_C_C1 + j] = s * (t.lag0 if t.faint else v0 - w0)
        rows[_C_M1 + j] = s * (t.lag1 if t.faint else v1 - w1)


@vector_kernel
def _draw(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Turn each column's values and slopes into the cubic relative to `base`, the leak of the dark added."""
    for j in range(n):
        d0, d1, leaked = rows[_C_D0 + j], rows[_C_D1 + j], rows[_C_LEAK + j] * (c.h * rows[_C_SPAN + j])
        rise, m0, m1 = d1 - d0 + leaked, rows[_C_C1 + j] + leaked, rows[_C_M1 + j] + leaked
        since = c.since_epoch_0 + c.h * rows[_C_Z + j]
        rows[_C_D0 + j], rows[_C_C1 + j] = (d0 - rows[_C_BASE + j]) + rows[_C_LEAK + j] * since, m0
        rows[_C_C2 + j], rows[_C_C3 + j] = _THREE * rise - _TWO * m0 - m1, m0 + m1 - _TWO * rise


@vector_kernel
def _add_parasitic(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Add the leak that light makes, the integral of i, to each column's piece: the cubic of that integral."""
    for j in range(n):
        width, on = rows[_C_SPAN + j], rows[_C_ON + j]
        i0, i1 = exponential(rows[_C_U0 + j]), exponential(rows[_C_U1 + j])
        leaks = c.parasitic * on * c.h * width
        m0, m1 = leaks * i0, leaks * i1
        rise = _HALF * (m0 + m1) + _TWELFTH * (m0 * rows[_C_SLOPE0 + j] - m1 * rows[_C_SLOPE1 + j])
        rows[_C_P1 + j] = rows[_C_P + j] + rise
        rows[_C_D0 + j] += rows[_C_P + j]
        rows[_C_C1 + j] += m0
        rows[_C_C2 + j] += _THREE * rise - _TWO * m0 - m1
        rows[_C_C3 + j] += m0 + m1 - _TWO * rise


@vector_kernel
def _find_turns(rows: _Float32s, n: int) -> None:
    """Write where each column's cubic turns, within (0, 1) and in ascending order; 1 where it does not."""
    for j in range(n):
        a, half, first = _THREE * rows[_C_C3 + j], rows[_C_C2 + j], rows[_C_C1 + j]
        square = half * half - a * first
        root = np.sqrt(max(square, _ZERO))
        far = -(half + (root if half > _ZERO else -root))
        one, other = far / a, first / far
        one = one if (one > _ZERO) & (one < _ONE) & (square > _ZERO) else _ONE
        other = other if (other > _ZERO) & (other < _ONE) & (square > _ZERO) else _ONE
        rows[_C_TURN + j], rows[_C_TURN2 + j] = min(one, other), max(one, other)


@lane
def _value(rows: _Float32s, j: int, x: Real) -> Real:
    return ((rows[_C_C3 + j] * x + rows[_C_C2 + j]) * x + rows[_C_C1 + j]) * x + rows[_C_D0 + j]


@vector_kernel
def _look(rows: _Float32s, n: int) -> None:
    """Find for each column the next monotone part of its piece on which it fires, after reading a level anew if due."""
    for j in range(n):
        on, off, level, x = rows[_C_ON + j], rows[_C_OFF + j], rows[_C_LEVEL + j], rows[_C_X + j]
        wait = rows[_C_SEES + j] - rows[_C_Z + j]
        opens = wait / rows[_C_SPAN + j] if wait > _ZERO else _ZERO
        blind = level != level
        x = max(x, opens) if blind else x
        sees = x <= _ONE
        level = _value(rows, j, x) if blind & sees else level
        turn, turn2 = max(rows[_C_TURN + j], x), max(rows[_C_TURN2 + j], x)
        g, g1 = _value(rows, j, x) - level, _value(rows, j, turn) - level
        g2, g3 = _value(rows, j, turn2) - level, _value(rows, j, _ONE) - level
        at_once, by1 = (g >= on) | (g <= -off), (g1 >= on) | (g1 <= -off)
        by2, by3 = (g2 >= on) | (g2 <= -off), (g3 >= on) | (g3 <= -off)
        end = x if at_once else (turn if by1 else (turn2 if by2 else _ONE))
        there = g if at_once else (g1 if by1 else (g2 if by2 else g3))
        rows[_C_LEVEL + j] = level
        rows[_C_X + j] = x if sees else rows[_C_X + j]
        rows[_C_FIRES + j] = _ONE if sees & (at_once | by1 | by2 | by3) else _ZERO
        rows[_C_LOW + j] = x if at_once | by1 else (turn if by2 else turn2)
        rows[_C_HIGH + j] = end
        rows[_C_TO + j] = level + (on if there > _ZERO else -off)


@vector_kernel
def _cross(rows: _Float32s, n: int) -> None:
    """Find where each column meets its level in its monotone part, and write the last Newton correction."""
    for j in range(n):
        low, high, to = rows[_C_LOW + j], rows[_C_HIGH + j], rows[_C_TO + j]
        sign = _ONE if to > rows[_C_LEVEL + j] else -_ONE
        at_low, at_high = _value(rows, j, low), _value(rows, j, high)
        c1, c2, c3 = rows[_C_C1 + j], rows[_C_C2 + j], rows[_C_C3 + j]
        secant = low + (high - low) * (to - at_low) / (at_high - at_low)
        x = secant if (secant >= low) & (secant <= high) else high
        step = _ZERO
        for _ in range(_NEWTON_TURNS):
            beyond = sign * (_value(rows, j, x) - to)
            slope = sign * ((_THREE * c3 * x + _TWO * c2) * x + c1)
            low = low if beyond > _ZERO else x
            high = x if beyond > _ZERO else high
            newton = x - beyond / slope
            better = newton if (newton >= low) & (newton <= high) else _HALF * (low + high)
            step = better - x
            x = better
        rows[_C_HIT + j], rows[_C_MISS + j] = x, abs(step)


@kernel
def _halve(rows: _Float32s, j: int) -> None:
    """Find the crossing of column j by halving."""
    low, high, to = rows[_C_LOW + j], rows[_C_HIGH + j], rows[_C_TO + j]
    rising = to > rows[_C_LEVEL + j]
    for _ in range(_HALVINGS):
        x = _HALF * (low + high)
        if (_value(rows, j, x) > to) == rising:
            high = x
        else:
            low = x
    rows[_C_HIT + j] = high


@kernel
def _mend(walk: Walk, n: int) -> None:
    """Find by halving the crossings that Newton did not settle on; listed first, so that the rest costs nothing."""
    unsettled = 0
    for j in range(n):
        walk.unsettled[unsettled] = j
        unsettled += (walk.rows[_C_FIRES + j] != _ZERO) & (walk.rows[_C_MISS + j] > _SETTLED)
    for k in range(unsettled):
        _halve(walk.rows, walk.unsettled[k])


@kernel
def _fire(pixels: Pixels, walk: Walk, n: int, keys: Keys, n_keys: int, c: StepConstants) -> tuple[int, int, int]:
    """Write the events of the columns that fire; return how many events there are now, were written and were lost."""
    rows = walk.rows
    fired = lost = 0
    for j in range(n):
        if rows[_C_FIRES + j] == _ZERO:
            continue
        fired += 1
        pixel, to = walk.pixels[j], rows[_C_TO + j]
        z = rows[_C_Z + j] + rows[_C_HIT + j] * rows[_C_SPAN + j]
        dt_ns = min(int(z * c.h_ns), c.h_ns)
        if rows[_C_COUNT + j] < MOST_EVENTS:
            keys[n_keys] = pack(dt_ns, pixel, to > rows[_C_LEVEL + j], c.pixel_bits)
            n_keys += 1
        else:
            lost += 1
        rows[_C_COUNT + j] += _ONE
        rows[_C_X + j], rows[_C_LEVEL + j] = rows[_C_HIT + j], to
        if c.refractory > _ZERO:
            rows[_C_LEVEL + j], rows[_C_SEES + j] = _NAN, z + c.refractory
            pixels.blind_until_ns[pixel] = c.t0_ns + dt_ns + c.refractory_ns
    return n_keys, fired, lost


@kernel
def _store(pixels: Pixels, walk: Walk, j: int, c: StepConstants) -> None:
    """Put a column that has reached the step's end back into the state."""
    rows, here = walk.rows, slot(walk.pixels[j])
    level, leaked = rows[_C_LEVEL + j], _ZERO
    pixels.fields[here + _V] = rows[_C_V1 + j]
    if c.second > _ZERO:
        pixels.fields[here + _W] = rows[_C_W1 + j]
    if c.parasitic > _ZERO:
        leaked = rows[_C_P1 + j]
        pixels.fields[here + _P] = leaked if level == _ZERO else _ZERO
    moved = level - leaked if level != _ZERO else _ZERO
    pixels.fields[here + _REF] = rows[_C_BASE + j] + moved


@kernel
def _go_on(pixels: Pixels, walk: Walk, n: int, c: StepConstants) -> int:
    """Store the columns that have reached the end, move the others together and on; return how many."""
    rows, kept = walk.rows, 0
    for j in range(n):
        if rows[_C_Z1 + j] >= _ONE:
            _store(pixels, walk, j, c)
            continue
        rows[_C_V + j], rows[_C_W + j], rows[_C_P + j] = rows[_C_V1 + j], rows[_C_W1 + j], rows[_C_P1 + j]
        rows[_C_Z + j] = rows[_C_Z1 + j]
        if kept < j:
            walk.pixels[kept] = walk.pixels[j]
            for row in range(_KEPT_ROWS):
                rows[row * WALK_CAPACITY + kept] = rows[row * WALK_CAPACITY + j]
        kept += 1
    return kept


@kernel
def _take_piece(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Give each column its next piece."""
    _cut(rows, n, c)
    _follow_light(rows, n, c)
    if c.second > _ZERO:
        _shorten_for_second_pole(rows, n, c)
        _follow_light(rows, n, c)
        _follow_filter(rows, n, c)
    _draw(rows, n, c)
    if c.parasitic > _ZERO:
        _add_parasitic(rows, n, c)
    _find_turns(rows, n)


@kernel_that_allocates
def walk_through(
    pixels: Pixels, walk: Walk, n: int, keys: Keys, n_keys: int, c: StepConstants
) -> tuple[Keys, int, int, int]:
    """Walk the n columns through the step.

    Returns
    -------
    keys (replaced by a longer copy if there was no room), the number of events in it, the number of crossings beyond
    MOST_EVENTS of a pixel, and the number of suspect pixels.
    """
    _set_out(walk.rows, whole_vectors(n), c)
    suspects, lost = int(walk.rows[_C_SUSPECT : _C_SUSPECT + n].sum()), 0
    while n > 0:
        _take_piece(walk.rows, whole_vectors(n), c)
        fired = n
        while fired > 0:
            keys = room_for(keys, n_keys + n)
            _look(walk.rows, whole_vectors(n))
            _cross(walk.rows, whole_vectors(n))
            _mend(walk, n)
            n_keys, fired, more = _fire(pixels, walk, n, keys, n_keys, c)
            lost += more
        n = _go_on(pixels, walk, n, c)
    return keys, n_keys, lost, suspects

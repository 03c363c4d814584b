"""Substeps: a pixel's light, filter and comparator curve over a part of a step, for a whole table of pixels at once.

Pixels come here whose step is not one smooth cubic: large changes, turns, jumps, unknown or limited slopes, refractory
periods that end inside the step, and exponentials. Over a substep

    light     changes by at most 0.5 in its logarithm, and so do its slopes times the substep
    filter    is solved as in `curve`; the comparator's input is g, the cubic in time through values and slopes at both
    ends length    is limited so that the part of the exponential that this cubic misses, |B| E(S), is below 0.4 % of a
              threshold. The rest of B decays by e^-S in the next substep, so a few substeps do for any light and rate

`march.solve_substeps` finds the events on these curves.

The table has one column a pixel, one row a quantity. A row is named by its first index in the flat array, so
`rows[Z + j]` is quantity Z of column j. The first `STEP_ROWS` rows hold for the whole step and move with a column; the
others are rewritten for each substep. Fast because every loop runs over all columns without a branch, and its rows lie
at distances known when compiled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import Real, kernel, lane, vector_kernel
from emulator.sensor.numerics.elementary import aligned_zeros, decay, exponential
from emulator.sensor.pixels import curve, receptor
from emulator.sensor.pixels.state import BLOCK, Field, Pixels, StepConstants, slot

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]

CAPACITY = 5 * BLOCK + 16
"""Columns; a little more than a power of two, so that a column's entries do not all fall into one set of the cache."""

STEP_ROWS = 24
# Light: value at the start, change, both slopes, its form and where that changes, width of a substep. State: filter,
# second pole, high-pass, parasitic leak. Position z; base and level of the comparator, when it is re-armed; thresholds,
# leak, number of events, offset of the reference after the last reset. Distances from the level at which the column
# fires; share of the step after which it fires in still light, 2: never, and with which polarity.
(
    U, D, A0, A1, FORM, KNOT, WIDTH, V, W, Y, P, Z, BASE, LEVEL, RE_ARMED, ON, OFF, LEAK, COUNT, RESET,
    FIRES_ON, FIRES_OFF, DUE, SIGN,
) = (k * CAPACITY for k in range(STEP_ROWS))  # fmt: skip
# The curve of a substep g = d0 + c1 x + c2 x^2 + c3 x^3 with x in [0, 1], its turns, its width and end; the position x,
# whether it fires and where, bounds and level of that crossing, the last Newton correction; light at both ends. Whether
# it crosses a level, and upward.
(
    D0, C1, C2, C3, TURN, TURN2, SPAN, V1, W1, Y1, P1, Z1,
    X, FIRES, HIT, LOW, HIGH, TO, MISS, UNDERSAMPLED, U0, U1, SLOPE0, SLOPE1, D1, M1,
    CROSSES, UP,
) = (k * CAPACITY for k in range(STEP_ROWS, STEP_ROWS + 28))  # fmt: skip
_ROWS = STEP_ROWS + 28


class SubstepTable(NamedTuple):
    """The table: float32 rows, pixels of the columns, and a list of columns whose root has not settled."""

    rows: _Float32s
    pixels: _Int64s
    unsettled: _Int64s


def new_substep_table() -> SubstepTable:
    """Return an empty table."""
    rows = aligned_zeros(_ROWS * CAPACITY)
    return SubstepTable(rows, np.empty(CAPACITY, np.int64), np.empty(CAPACITY, np.int64))


_V, _W, _Y = (int(f) * BLOCK for f in (Field.FILTERED, Field.SECOND, Field.HIGH_PASSED))
_NAN = np.float32(np.nan)
_THIRD, _TWELFTH = np.float32(1 / 3), np.float32(1 / 12)
_ZERO, _ONE, _TWO, _THREE, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 0.5))
_SHARE = np.float32(0.004)  # of a threshold: what a cubic may miss
_LEAST_MISS = np.float32(2e-5)  # ln units: float32 has nothing to offer below
_LEAST_WEIGHT = np.float32(1e-20)
_FLAT = np.float32(0.3)  # slope, over the change of the light, below which an undersampled step is a jump
_E4, _E1, _E0 = np.float32(384), np.float32(1 / 0.16), np.float32(0.2)
_NEARLY = np.float32(1.001)
_CUBIC, _JUMP, _LATE, _EARLY = (np.float32(form) for form in range(4))


@vector_kernel
def begin(rows: _Float32s, first: int, n: int, c: StepConstants) -> None:
    """Choose the interpolation of the light of columns `first` to n - 1, and set them to the start of the step.

    Levels are relative to `base`: the stored reference or, in a refractory period, the comparator's value at the start.
    """
    for j in range(first, n):
        d = rows[D + j]
        threshold = min(rows[ON + j], rows[OFF + j])
        a0, a1 = curve.completed(d, rows[A0 + j], rows[A1 + j])
        # One of three forms: a jump at mid-step, a line with a bend, or the cubic, its slopes limited where need be.
        undersampled = curve.is_undersampled(d, a0, a1, c.unseen_share * threshold)
        jump = undersampled & (max(abs(a0), abs(a1)) < _FLAT * abs(d))
        cap = curve.capped(a0, a1)
        width = curve.bend_width(d, cap * a0, cap * a1, threshold)
        bent = width < _ONE
        factor = _ZERO if jump else (cap if bent else curve.limit(d, a0, a1))
        a0, a1 = factor * a0, factor * a1
        late = abs(d - a0) < abs(d - a1)
        # Substeps in which the light changes by LARGEST_CHANGE at most; no longer in time constants of the high-pass.
        steepest = max(abs(a0), abs(a1))
        steepness = _ZERO if jump else max(abs(d), steepest if bent else _HALF * steepest)
        rows[UNDERSAMPLED + j] = _ONE if undersampled else _ZERO
        rows[FORM + j] = _JUMP if jump else ((_LATE if late else _EARLY) if bent else _CUBIC)
        rows[KNOT + j] = _HALF if jump else (_ONE - width if bent & late else width)
        rows[A0 + j], rows[A1 + j] = a0, a1
        rows[WIDTH + j] = _ONE / max(np.ceil(max(steepness, c.high) / curve.LARGEST_CHANGE), _TWO if jump else _ONE)
        # The state at the start of the step.
        reference, w = rows[BASE + j], rows[(Y if c.high > _ZERO else W) + j]
        refractory = reference != reference
        rows[BASE + j] = w + (rows[LEAK + j] * c.since_epoch_0 + rows[P + j]) if refractory else reference
        rows[LEVEL + j] = _NAN if refractory else _ZERO
        rows[Z + j] = rows[COUNT + j] = _ZERO


class _Light(NamedTuple):
    """The log light of a step: a cubic, a jump of d at the knot, or a bend behind or before the knot."""

    u: Real
    d: Real
    a0: Real
    a1: Real
    form: Real
    knot: Real  # 1 where there is none


class _Substep(NamedTuple):
    """Light and rates over a substep."""

    u0: Real
    u1: Real
    r0: Real  # rates, per step
    r1: Real
    a0: Real  # slopes per substep
    a1: Real
    course: curve.Course


@lane
def _bent(light: _Light, z: Real) -> tuple[Real, Real]:
    """Return the change of log light up to z, and its slope per step, on a line with a bend at its end or start."""
    late, steeper = light.form == _LATE, light.a1 - light.a0
    width = _ONE - light.knot if late else light.knot
    t = max(z - light.knot if late else light.knot - z, _ZERO) / width
    line, straight = (light.a0 * z if late else light.d - light.a1 * (_ONE - z)), (light.a0 if late else light.a1)
    turned = steeper * t * t
    return line + _THIRD * width * t * turned, straight + (turned if late else -turned)


@lane
def _light_at(light: _Light, z: Real, jumped: Real) -> tuple[Real, Real]:
    """Return the log light and its slope per step at z."""
    c3 = light.a0 + light.a1 - _TWO * light.d
    c2 = _THREE * light.d - _TWO * light.a0 - light.a1
    smooth = ((c3 * z + c2) * z + light.a0) * z
    slope = (_THREE * c3 * z + _TWO * c2) * z + light.a0
    bent, bent_slope = _bent(light, z)
    curved, jump = light.form >= _LATE, light.form == _JUMP
    rise = bent if curved else ((light.d if jumped else _ZERO) if jump else smooth)
    return light.u + rise, (bent_slope if curved else (_ZERO if jump else slope))


@lane
def _substep(light: _Light, z: Real, width: Real, c: StepConstants) -> _Substep:
    """Return the substep from z to z + width."""
    jumped = z >= light.knot
    u0, slope0 = _light_at(light, z, jumped)
    u1, slope1 = _light_at(light, z + width, jumped)
    l0 = min(max(c.rate_at_reference * exponential(u0), c.rate_min), c.rate_max)
    l1 = min(max(c.rate_at_reference * exponential(u1), c.rate_min), c.rate_max)
    a0, a1 = width * slope0, width * slope1
    s = curve.warped_time(c.h * width, l0, l1, a0, a1, c)
    course = curve.Course(s, u1 - u0, s * slope0 / (c.h * l0), s * slope1 / (c.h * l1))
    return _Substep(u0, u1, c.h * l0, c.h * l1, a0, a1, course)


@lane
def _share_within(b: Real, s: Real, allowed: Real) -> Real:
    """Return the share of an interval of length s on which a cubic misses less than `allowed` of b e^-s.

    The bound E is min(s^4 / 384, 0.16 s + 0.2); its inverse is the larger of the two inverses.
    """
    relative = allowed / max(abs(b), _LEAST_WEIGHT)
    longest = max(np.sqrt(np.sqrt(_E4 * relative)), (relative - _E0) * _E1)
    return min(longest / s, _ONE)


@lane
def _allowed(rows: _Float32s, j: int) -> Real:
    """Return the error that a cubic may have on column j's curve."""
    return max(_SHARE * min(rows[ON + j], rows[OFF + j]), _LEAST_MISS)


@lane
def _light_of(rows: _Float32s, j: int) -> _Light:
    form, knot = rows[FORM + j], rows[KNOT + j]
    return _Light(rows[U + j], rows[D + j], rows[A0 + j], rows[A1 + j], form, knot)


@lane
def _widest(rows: _Float32s, j: int) -> tuple[Real, Real, Real]:
    """Return the widest next substep that the light of column j allows, where it may end, and 1 if it ends there.

    A substep ends at the knot of the light, where its form changes, and at the end of the step.
    """
    z, wide, knot = rows[Z + j], rows[WIDTH + j], rows[KNOT + j]
    stop = knot if z < knot else _ONE
    last = stop - z < _NEARLY * wide
    return (stop - z if last else wide), stop, (_ONE if last else _ZERO)


@lane
def _set_width(rows: _Float32s, j: int, width: Real, share: Real, stop: Real, last: Real) -> None:
    """Write the next substep of column j: `share` of `width`. It ends at `stop` itself, not a rounding error off."""
    rows[SPAN + j] = share * width
    rows[X + j] = _ZERO
    rows[Z1 + j] = stop if (last == _ONE) & (share == _ONE) else rows[Z + j] + share * width


@vector_kernel
def _choose_width(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Choose the width of each column's next substep: limited by the light, then by the exponential."""
    for j in range(n):
        width, stop, last = _widest(rows, j)
        q = _substep(_light_of(rows, j), rows[Z + j], width, c)
        t = curve.transient(q.u0 - rows[V + j], q.course, _allowed(rows, j))
        share = _share_within(_ZERO if t.faint else t.b, q.course.s, _allowed(rows, j))
        _set_width(rows, j, width, share, stop, last)


@vector_kernel
def _choose_width_of_receptor(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Choose the widths of `_choose_width` for the large-signal law."""
    for j in range(n):
        width, stop, last = _widest(rows, j)
        q = _substep(_light_of(rows, j), rows[Z + j], width, c)
        bending = receptor.fourth_derivative(receptor.excess_of(q.u0 - rows[V + j]), q.course, _allowed(rows, j))
        share = _share_within(bending, q.course.s, _allowed(rows, j))
        _set_width(rows, j, width, share, stop, last)


@vector_kernel
def _shorten_for_second_pole(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Shorten each column's substep to what the exponential behind the second pole allows."""
    for j in range(n):
        span = rows[SPAN + j]
        behind = rows[V + j] - rows[W + j]
        s = c.second * span
        t = curve.transient(
            behind, curve.Course(s, rows[D1 + j] - rows[D0 + j], rows[C1 + j], rows[M1 + j]), _allowed(rows, j)
        )
        share = _share_within(_ZERO if t.faint else t.b, s, _allowed(rows, j))
        rows[SPAN + j] = share * span
        rows[Z1 + j] = rows[Z1 + j] if share == _ONE else rows[Z + j] + share * span


@lane
def _set_light(rows: _Float32s, j: int, q: _Substep) -> None:
    """Write the light at both ends of column j's substep, and its slopes."""
    rows[U0 + j] = q.u0
    rows[U1 + j] = q.u1
    rows[SLOPE0 + j] = q.a0
    rows[SLOPE1 + j] = q.a1


@lane
def _set_ends(rows: _Float32s, j: int, v0: Real, v1: Real, m0: Real, m1: Real) -> None:
    """Write the filter's output at both ends of column j's substep, and its slopes: what a cubic goes through."""
    rows[D0 + j] = v0
    rows[D1 + j] = v1
    rows[C1 + j] = m0
    rows[M1 + j] = m1


@vector_kernel
def _follow_light(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Solve the filter over each column's substep, and write values and slopes at both ends."""
    for j in range(n):
        v0, width = rows[V + j], rows[SPAN + j]
        q = _substep(_light_of(rows, j), rows[Z + j], width, c)
        behind = q.u0 - v0
        v1 = v0 + curve.rise_of_filter(decay(q.course.s), behind, q.course)
        # The slope is the rate times the lag; without a faint exponential, which is rounding noise.
        t = curve.transient(behind, q.course, _allowed(rows, j))
        m0 = width * q.r0 * (t.lag0 if t.faint else behind)
        m1 = width * q.r1 * (t.lag1 if t.faint else q.u1 - v1)
        _set_light(rows, j, q)
        _set_ends(rows, j, v0, v1, m0, m1)
        rows[V1 + j] = rows[W1 + j] = v1


@vector_kernel
def _follow_light_of_receptor(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Solve the large-signal law over each column's substep, and write values and slopes at both ends."""
    for j in range(n):
        v0, width = rows[V + j], rows[SPAN + j]
        q = _substep(_light_of(rows, j), rows[Z + j], width, c)
        v1 = v0 + receptor.rise_of_receptor(decay(q.course.s), receptor.excess_of(q.u0 - v0), q.course)
        r = receptor.response(
            curve.Filtered(q.u0 - v0, q.u1 - v1, v1 - v0, width * q.r0, width * q.r1), q.course, _allowed(rows, j)
        )
        _set_light(rows, j, q)
        _set_ends(rows, j, v0, v1, r.m0, r.m1)
        rows[V1 + j] = rows[W1 + j] = v1


@vector_kernel
def _follow_filter(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Solve the second pole over each column's substep; its values and slopes replace those of the filter."""
    for j in range(n):
        w0, s = rows[W + j], c.second * rows[SPAN + j]
        v0, v1 = rows[D0 + j], rows[D1 + j]
        course = curve.Course(s, v1 - v0, rows[C1 + j], rows[M1 + j])
        w1 = w0 + curve.rise_of_filter(decay(s), v0 - w0, course)
        t = curve.transient(v0 - w0, course, _allowed(rows, j))
        m0 = s * (t.lag0 if t.faint else v0 - w0)
        m1 = s * (t.lag1 if t.faint else v1 - w1)
        _set_ends(rows, j, w0, w1, m0, m1)
        rows[W1 + j] = w1


@vector_kernel
def _follow_high_pass(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Solve the high-pass over each column's substep; its values and slopes replace those of its input."""
    for j in range(n):
        y0, s = rows[Y + j], c.high * rows[SPAN + j]
        w = curve.Course(s, rows[D1 + j] - rows[D0 + j], rows[C1 + j], rows[M1 + j])
        y1 = curve.behind_high_pass(decay(s), y0, w)
        _set_ends(rows, j, y0, y1, w.w0 - s * y0, w.w1 - s * y1)
        rows[Y1 + j] = y1


@vector_kernel
def _make_cubic(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Turn each column's values and slopes into the cubic relative to `base`, and add the junction's leak."""
    for j in range(n):
        d0, d1 = rows[D0 + j], rows[D1 + j]
        leaked = rows[LEAK + j] * (c.h * rows[SPAN + j])
        rise = d1 - d0 + leaked
        m0 = rows[C1 + j] + leaked
        m1 = rows[M1 + j] + leaked
        since = c.since_epoch_0 + c.h * rows[Z + j]
        rows[D0 + j] = (d0 - rows[BASE + j]) + rows[LEAK + j] * since
        rows[C1 + j] = m0
        rows[C2 + j] = _THREE * rise - _TWO * m0 - m1
        rows[C3 + j] = m0 + m1 - _TWO * rise


@vector_kernel
def _add_parasitic(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Add the parasitic leak, the integral of i as a cubic, to each column's curve."""
    for j in range(n):
        width, on = rows[SPAN + j], rows[ON + j]
        i0, i1 = exponential(rows[U0 + j]), exponential(rows[U1 + j])
        leaks = c.parasitic * on * c.h * width
        m0, m1 = leaks * i0, leaks * i1
        rise = _HALF * (m0 + m1) + _TWELFTH * (m0 * rows[SLOPE0 + j] - m1 * rows[SLOPE1 + j])
        rows[P1 + j] = rows[P + j] + rise
        rows[D0 + j] += rows[P + j]
        rows[C1 + j] += m0
        rows[C2 + j] += _THREE * rise - _TWO * m0 - m1
        rows[C3 + j] += m0 + m1 - _TWO * rise


@vector_kernel
def _find_turns(rows: _Float32s, n: int) -> None:
    """Write the turning points of each column's cubic within (0, 1), in ascending order; 1 where there is none."""
    for j in range(n):
        # Zeros of the slope 3 c3 x^2 + 2 c2 x + c1: the larger first, without cancellation, the other by their product.
        a = _THREE * rows[C3 + j]
        half = rows[C2 + j]
        first = rows[C1 + j]
        square = half * half - a * first
        root = np.sqrt(max(square, _ZERO))
        sum_of_both = -(half + (root if half > _ZERO else -root))
        larger, smaller = sum_of_both / a, first / sum_of_both
        larger = larger if (larger > _ZERO) & (larger < _ONE) & (square > _ZERO) else _ONE
        smaller = smaller if (smaller > _ZERO) & (smaller < _ONE) & (square > _ZERO) else _ONE
        rows[TURN + j], rows[TURN2 + j] = min(larger, smaller), max(larger, smaller)


@kernel
def _follow(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Solve the photoreceptor over each column's substep."""
    if c.large:
        _follow_light_of_receptor(rows, n, c)
    else:
        _follow_light(rows, n, c)


@kernel
def begin_substep(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Compute each column's curve over its next substep."""
    if c.large:
        _choose_width_of_receptor(rows, n, c)
    else:
        _choose_width(rows, n, c)
    _follow(rows, n, c)
    if c.second > _ZERO:
        _shorten_for_second_pole(rows, n, c)
        _follow(rows, n, c)
        _follow_filter(rows, n, c)
    if c.high > _ZERO:
        _follow_high_pass(rows, n, c)
    _make_cubic(rows, n, c)
    if c.parasitic > _ZERO:
        _add_parasitic(rows, n, c)
    _find_turns(rows, n)


@kernel
def store_filters(pixels: Pixels, pixel: int, rows: _Float32s, j: int, c: StepConstants) -> None:
    """Write the filters of column j, which has reached the end of the step, to the state of its pixel."""
    at = slot(pixel)
    pixels.fields[at + _V] = rows[V1 + j]
    if c.second > _ZERO:
        pixels.fields[at + _W] = rows[W1 + j]
    if c.high > _ZERO:
        pixels.fields[at + _Y] = rows[Y1 + j]


@kernel
def go_on(table: SubstepTable, j: int, place: int) -> None:
    """Begin the next substep of column j where the last one ended, in column `place`, which is not behind it."""
    rows = table.rows
    rows[V + j] = rows[V1 + j]
    rows[W + j] = rows[W1 + j]
    rows[Y + j] = rows[Y1 + j]
    rows[P + j] = rows[P1 + j]
    rows[Z + j] = rows[Z1 + j]
    if place < j:
        table.pixels[place] = table.pixels[j]
        for k in range(STEP_ROWS):
            rows[k * CAPACITY + place] = rows[k * CAPACITY + j]

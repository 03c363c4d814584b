"""The candidates of a step, the pixels that may fire: collected in a table, one column a pixel, and solved together.

The comparator's input of a candidate, the filtered value plus leak minus the reference, is the cubic in time through
its values and derivatives at both ends of the step (the derivative is the rate times the filter's lag). The part of the
exponential in the filter's response that this cubic misses is at most |B| E(S), E = min(S^4 / 384, 0.16 S + 0.2).

Steps on smooth light are solved here where this error is below 1 % of a threshold and the cubic is monotone: its end
values decide whether the pixel fires, and `newton` finds the crossing for all candidates of the table at once. Pixels
that fire again in the same step stay in the table. All others are solved in substeps (`march`).

Fast because every stage is one loop over the columns of the table, without a branch, in 16 lanes at once; stages that
few sensors have, and what few pixels need, are loops of their own. `solve` lists the stages in order.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import emulator.sensor.pixels.candidate_table as row
import emulator.sensor.pixels.substeps as substep
from emulator.sensor.numerics.compiled import NONE, cached_entry, kernel, lane, vector_kernel
from emulator.sensor.numerics.elementary import decay, exponential, use_widest_vectors
from emulator.sensor.pixels import curve, event_time, state
from emulator.sensor.pixels.candidate_table import Table
from emulator.sensor.pixels.crossings import Keys, pack, reserve
from emulator.sensor.pixels.march import solve_substeps
from emulator.sensor.pixels.offsets import draw_next, gather_draws, go_on, keep_clocks, place_levels, take_due
from emulator.sensor.pixels.receptor import MOST_BEHIND, response
from emulator.sensor.pixels.state import BLOCK, Field, Pixels, StepConstants

_Float32s = npt.NDArray[np.float32]

_REF, _LEAK, _P, _Y = (int(f) * BLOCK for f in (Field.REFERENCE, Field.LEAK, Field.LEAKED, Field.HIGH_PASSED))

_LAST, _NEXT = (np.int64(n) for n in range(2))
_NAN = np.float32(np.nan)
_ZERO, _ONE, _TWO, _THREE, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 0.5))
_MISSED = np.float32(1e-3)  # ln units: up to there the second pole's output is that behind a cubic (see `receptor`)
_SHARE = np.float32(0.01)  # of a threshold: what the cubic may miss of the exponential


@kernel
def _complete_parasitic(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Add to each candidate's sums what its light at both ends of the step leaks since the epoch."""
    use_widest_vectors()
    for j in range(n):
        leaks = c.parasitic * rows[row.ON + j]
        since0, since1 = leaks * curve.photocurrent(rows[row.U0 + j]), leaks * curve.photocurrent(rows[row.U1 + j])
        rows[row.P0 + j] += since0 * c.since_epoch_0
        rows[row.P1 + j] += since1 * c.since_epoch_1
        rows[row.LIT + j] = since1


@kernel
def _find_starts(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Write when each candidate is re-armed, as a share of the step; 0 outside a refractory period."""
    for j in range(n):
        reference = table.rows[row.REF + j]
        start = _ZERO
        if reference != reference:
            wait_ns = pixels.refractory_until_ns[table.pixels[j]] - c.t0_ns
            start = np.float32(max(wait_ns, 0) / c.h_ns)
        table.rows[row.START + j] = start


@kernel
def _find_offsets(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Write the offsets of each candidate's reference after its last reset and after its next one; see `state`."""
    rows = table.rows
    for j in range(n):
        pixel, on, off = table.pixels[j], rows[row.ON + j], rows[row.OFF + j]
        rows[row.RESET + j] = state.reset_offset(pixels, pixel, _LAST, on, off, c.reset)
        rows[row.NEXT_RESET + j] = state.reset_offset(pixels, pixel, _NEXT, on, off, c.reset)


@vector_kernel
def _make_curves(table: _Float32s, n: int, c: StepConstants) -> None:
    """Write each candidate's cubic, without leak, and whether the pixel needs substeps instead."""
    use_widest_vectors()
    for j in range(n):
        u0, u1 = table[row.U0 + j], table[row.U1 + j]
        v0, v1 = table[row.V0 + j], table[row.V1 + j]
        a0, a1 = table[row.A0 + j], table[row.A1 + j]
        s = table[row.S + j]
        threshold = min(table[row.ON + j], table[row.OFF + j])
        r0 = c.h * table[row.L0 + j]  # rates of the filter, per step
        r1 = c.h * table[row.L1 + j]
        smooth = curve.is_smooth(u1 - u0, a0, a1, threshold, c.unseen_share)
        # The slopes of the filter's output are its rate times its lag. Where the exponential is rounding noise, the lag
        # without it is more accurate than the difference of two large numbers.
        allowed = _SHARE * threshold
        t = curve.transient(u0 - v0, curve.Course(s, u1 - u0, s * a0 / r0, s * a1 / r1), allowed)
        m0 = r0 * (t.lag0 if t.faint else u0 - v0)
        m1 = r1 * (t.lag1 if t.faint else u1 - v1)
        # A cubic is good where it misses little of the exponential.
        fits = (_ZERO if t.faint else curve.missed_by_cubic(t.b, s)) <= allowed
        table[row.D0 + j] = v0
        table[row.D1 + j] = v1
        table[row.C1 + j] = m0
        table[row.C2 + j] = m1
        table[row.KIND + j] = row.NOTHING if smooth & fits else row.NEEDS_SUBSTEPS


@vector_kernel
def _make_curves_of_receptor(table: _Float32s, n: int, c: StepConstants) -> None:
    """Write the cubics of `_make_curves` for the large-signal law."""
    use_widest_vectors()
    for j in range(n):
        u0, u1 = table[row.U0 + j], table[row.U1 + j]
        v0, v1 = table[row.V0 + j], table[row.V1 + j]
        a0, a1 = table[row.A0 + j], table[row.A1 + j]
        s = table[row.S + j]
        threshold = min(table[row.ON + j], table[row.OFF + j])
        r0 = c.h * table[row.L0 + j]
        r1 = c.h * table[row.L1 + j]
        allowed = _SHARE * threshold if c.second == _ZERO else min(_SHARE * threshold, _MISSED)
        course = curve.Course(s, u1 - u0, s * a0 / r0, s * a1 / r1)
        r = response(curve.Filtered(u0 - v0, u1 - v1, v1 - v0, r0, r1), course, allowed)
        smooth = curve.is_smooth(u1 - u0, a0, a1, threshold, c.unseen_share) & (u0 - v0 < MOST_BEHIND)
        table[row.D0 + j] = v0
        table[row.D1 + j] = v1
        table[row.C1 + j] = r.m0
        table[row.C2 + j] = r.m1
        table[row.KIND + j] = row.NOTHING if smooth & (r.missed <= allowed) else row.NEEDS_SUBSTEPS


@vector_kernel
def _make_curves_of_second_pole(table: _Float32s, n: int, c: StepConstants) -> None:
    """Replace each candidate's cubic by that of the second pole's output: it follows the cubic as the filter light."""
    use_widest_vectors()
    for j in range(n):
        v0, v1 = table[row.V0 + j], table[row.V1 + j]
        w0, w1 = table[row.W0 + j], table[row.W1 + j]
        allowed = _SHARE * min(table[row.ON + j], table[row.OFF + j])
        t = curve.transient(v0 - w0, curve.Course(c.second, v1 - v0, table[row.C1 + j], table[row.C2 + j]), allowed)
        fits = (_ZERO if t.faint else curve.missed_by_cubic(t.b, c.second)) <= allowed
        table[row.D0 + j] = w0
        table[row.D1 + j] = w1
        table[row.C1 + j] = c.second * (t.lag0 if t.faint else v0 - w0)
        table[row.C2 + j] = c.second * (t.lag1 if t.faint else v1 - w1)
        table[row.KIND + j] = table[row.KIND + j] if fits else row.NEEDS_SUBSTEPS


@vector_kernel
def _make_curves_of_high_pass(table: _Float32s, n: int, c: StepConstants) -> None:
    """Replace each candidate's cubic by that of the high-pass's output; long steps are left to substeps."""
    use_widest_vectors()
    q = decay(c.high)
    for j in range(n):
        w = curve.Course(c.high, table[row.D1 + j] - table[row.D0 + j], table[row.C1 + j], table[row.C2 + j])
        y0 = table[row.Y0 + j]
        y1 = curve.behind_high_pass(q, y0, w)
        table[row.D0 + j] = y0
        table[row.D1 + j] = table[row.Y1 + j] = y1
        table[row.C1 + j] = w.w0 - c.high * y0
        table[row.C2 + j] = w.w1 - c.high * y1
        table[row.KIND + j] = table[row.KIND + j] if c.high <= curve.LARGEST_CHANGE else row.NEEDS_SUBSTEPS


@vector_kernel
def _add_parasitic(table: _Float32s, n: int, c: StepConstants) -> None:
    """Add the parasitic leak to each candidate's curve."""
    use_widest_vectors()
    for j in range(n):
        leaks = c.h * c.parasitic * table[row.ON + j]
        table[row.D0 + j] += table[row.P0 + j]
        table[row.D1 + j] += table[row.P1 + j]
        table[row.C1 + j] += leaks * exponential(table[row.U0 + j])
        table[row.C2 + j] += leaks * exponential(table[row.U1 + j])


@kernel
def make_curves(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Write values and slopes of the n candidates' curves at both ends of the step, without the junction's leak.

    Marks those that need substeps. The rows of the coefficients hold the slopes at the ends, C1 and C2.
    """
    rows = table.rows
    if c.parasitic > _ZERO:
        _complete_parasitic(rows, state.whole_vectors(n), c)
    if c.large:
        _make_curves_of_receptor(rows, state.whole_vectors(n), c)
    else:
        _make_curves(rows, state.whole_vectors(n), c)
    if c.second > _ZERO:
        _make_curves_of_second_pole(rows, state.whole_vectors(n), c)
    if c.high > _ZERO:
        _make_curves_of_high_pass(rows, state.whole_vectors(n), c)
        for j in range(n):
            pixels.fields[state.slot(table.pixels[j]) + _Y] = rows[row.Y1 + j]
    if c.parasitic > _ZERO:
        _add_parasitic(rows, state.whole_vectors(n), c)


@vector_kernel
def _sort_by_kind(table: _Float32s, n: int, c: StepConstants) -> None:
    """Finish each candidate's curve, relative to `base` and with leak, and write its kind."""
    use_widest_vectors()
    for j in range(n):
        leak = table[row.LEAK + j]
        on = table[row.ON + j]
        off = table[row.OFF + j]
        start = table[row.START + j]
        reference = table[row.REF + j]
        w0 = table[row.D0 + j]
        # Relative to the reference, or to the start of the step where there is none: small numbers are exact.
        refractory = reference != reference
        base = w0 + leak * c.since_epoch_0 if refractory else reference
        d0 = (w0 - base) + leak * c.since_epoch_0
        d1 = (table[row.D1 + j] - base) + leak * c.since_epoch_1
        # The cubic through both values and slopes. It is monotone if the Bernstein coefficients of its slope, m0, m1
        # and the middle one, have one sign.
        rise = d1 - d0
        m0 = table[row.C1 + j] + c.h * leak
        m1 = table[row.C2 + j] + c.h * leak
        c2 = _THREE * rise - _TWO * m0 - m1
        c3 = m0 + m1 - _TWO * rise
        middle = m0 + c2
        monotone = (min(min(m0, m1), middle) >= _ZERO) | (max(max(m0, m1), middle) <= _ZERO)
        # The pixel compares from `start` on with the level a: then a monotone curve fires if its end does.
        at_start = ((c3 * start + c2) * start + m0) * start + d0
        a = at_start + table[row.RESET + j] if refractory else _ZERO
        inside = (at_start - a < on) & (at_start - a > -off)
        fires = (d1 - a >= on) | (d1 - a <= -off) | (table[row.DUE + j] <= _ONE)
        table[row.BASE + j] = base
        table[row.A + j] = a
        table[row.D0 + j] = d0
        table[row.D1 + j] = d1
        table[row.C1 + j] = m0
        table[row.C2 + j] = c2
        table[row.C3 + j] = c3
        idle = row.RE_ARMS if refractory else row.NOTHING
        kind = row.FIRES if fires else idle
        solved = monotone & inside & (table[row.KIND + j] != row.NEEDS_SUBSTEPS)
        table[row.KIND + j] = kind if solved else row.NEEDS_SUBSTEPS


@lane
def _cubic(rows: _Float32s, j: int) -> event_time.Cubic:
    """Return the curve of candidate j over the step."""
    return event_time.Cubic(rows[row.D0 + j], rows[row.C1 + j], rows[row.C2 + j], rows[row.C3 + j])


@lane
def _bracket(rows: _Float32s, j: int) -> event_time.Bracket:
    """Return the bracket in which the curve of candidate j meets its next level."""
    a = rows[row.A + j]
    rising = rows[row.D1 + j] > a
    level = a + (rows[row.ON + j] if rising else -rows[row.OFF + j])
    return event_time.Bracket(rows[row.START + j], _ONE, level, rising)


@vector_kernel
def _cross(table: _Float32s, n: int) -> None:
    """Find where each candidate's monotone cubic meets its next level, and write z and the last Newton correction."""
    use_widest_vectors()
    for j in range(n):
        g, at = _cubic(table, j), _bracket(table, j)
        at_start = event_time.value(g, at.low)
        guess = at.low + (_ONE - at.low) * (at.level - at_start) / (table[row.D1 + j] - at_start)
        table[row.Z + j], table[row.MISS + j] = event_time.newton(g, at, guess)
        table[row.UP + j] = _ONE if at.rising else _ZERO


@kernel
def _bisect_unsettled(table: Table, n: int) -> None:
    """Bisect the crossings whose Newton iterations have not settled.

    These are listed first: in one loop the compiler would bisect for all candidates and then choose.
    """
    rows, unsettled = table.rows, 0
    for j in range(n):
        table.listed[unsettled] = j
        unsettled += (rows[row.KIND + j] == row.FIRES) & (rows[row.MISS + j] > event_time.SETTLED)
    for k in range(unsettled):
        j = table.listed[k]
        rows[row.Z + j] = event_time.bisect(_cubic(rows, j), _bracket(rows, j))


@kernel
def _find_delays(table: Table, n: int, c: StepConstants) -> None:
    """Write the delay of the comparator of each candidate that fires, as a share of the step."""
    rows = table.rows
    for j in range(n):
        if rows[row.KIND + j] == row.FIRES:
            z = rows[row.Z + j]
            slope = (_THREE * rows[row.C3 + j] * z + _TWO * rows[row.C2 + j]) * z + rows[row.C1 + j]
            late_s = event_time.delay_s(np.float64(abs(slope) / c.h), rows[row.UP + j] > _ZERO, c)
            rows[row.LATE + j] = np.float32(late_s / c.h)


@vector_kernel
def _follow(table: _Float32s, n: int, c: StepConstants) -> None:
    """Write for each candidate that fires at z its next reference, when it is re-armed, and whether it fires again."""
    use_widest_vectors()
    at_level = (c.refractory == _ZERO) & (not c.offsets)
    of_next_on, of_next_off = (row.NEXT_ON, row.NEXT_OFF) if c.offsets else (row.ON, row.OFF)
    for j in range(n):
        a, d1 = table[row.A + j], table[row.D1 + j]
        on, off = table[row.ON + j], table[row.OFF + j]
        next_on, next_off = table[of_next_on + j], table[of_next_off + j]
        re_armed = table[row.Z + j] + (table[row.LATE + j] + c.refractory)
        # Without a refractory period the level that was crossed is the next reference; else the curve at its end is.
        crossed = a + (on if d1 > a else -off)
        at_end = event_time.value(_cubic(table, j), re_armed)
        following = (crossed if at_level else at_end) + table[row.NEXT_RESET + j]
        meets = (d1 - following >= next_on) | (d1 - following <= -next_off) | (table[row.NEXT_DUE + j] <= _ONE)
        fires = meets & (re_armed <= _ONE)
        table[row.NEXT_A + j] = following
        table[row.NEXT_START + j] = re_armed
        table[row.NEXT_REF + j] = table[row.BASE + j] + following if re_armed <= _ONE else _NAN
        table[row.AGAIN + j] = _ONE if fires & (table[row.KIND + j] == row.FIRES) else _ZERO


@kernel
def _move_column(table: Table, j: int, k: int, c: StepConstants) -> None:
    """Move the entries for the next crossing from column j to column k."""
    rows = table.rows
    table.pixels[k] = table.pixels[j]
    rows[row.A + k] = rows[row.NEXT_A + j]
    rows[row.START + k] = rows[row.NEXT_START + j]
    rows[row.KIND + k] = row.FIRES
    for kept in (row.ON, row.OFF, row.BASE, row.D0, row.D1, row.C1, row.C2, row.C3, row.NEXT_RESET):
        rows[kept + k] = rows[kept + j]
    if c.offsets:
        go_on(rows, j, k)


@kernel
def _fire(pixels: Pixels, table: Table, n: int, keys: Keys, n_keys: int, c: StepConstants) -> tuple[int, int]:
    """Write the events of the candidates that fire, and their references; return n_keys and the count of repeats."""
    rows, again = table.rows, NONE
    for j in range(n):
        if rows[row.KIND + j] != row.FIRES:
            continue
        # The event: its time in the step is the crossing's, and the delay of the comparator.
        pixel = table.pixels[j]
        dt_ns = min(int(rows[row.Z + j] * c.h_ns), c.h_ns) + int(rows[row.LATE + j] * c.h_ns)
        number = 2 * pixel + int(rows[row.OF_NOISE + j]) if c.offsets else pixel
        keys[n_keys] = pack(dt_ns, number, rows[row.UP + j] > _ZERO, c.pixel_bits)
        n_keys += 1
        # The reset. The reference is NaN in the refractory period, if that lasts longer than the step.
        reference = rows[row.NEXT_REF + j]
        pixels.fields[state.slot(pixel) + _REF] = reference
        if reference != reference:
            pixels.refractory_until_ns[pixel] = c.t0_ns + dt_ns + c.refractory_ns
        state.count_reset(pixels, pixel, c.reset.noise)
        if rows[row.AGAIN + j] != _ZERO:
            _move_column(table, j, again, c)  # to the front: `again` is never behind j
            if c.reset.noise > _ZERO:
                on, off = rows[row.ON + j], rows[row.OFF + j]
                rows[row.NEXT_RESET + again] = state.reset_offset(pixels, pixel, _NEXT, on, off, c.reset)
            again += 1
    return n_keys, again


@kernel
def _pass_over(pixels: Pixels, table: Table, n: int, c: StepConstants) -> int:
    """Move the references of candidates that fire too often to their last crossings; return the count of lost ones."""
    rows, lost = table.rows, NONE
    for j in range(n):
        pixel = table.pixels[j]
        at = state.slot(pixel)
        compared = pixels.fields[at + c.compared] + pixels.fields[at + _LEAK] * c.since_epoch_1
        on, off = rows[row.ON + j], rows[row.OFF + j]
        rising = rows[row.D1 + j] > rows[row.A + j]
        if c.refractory_ns == 0:
            crossings, climbed = event_time.levels_passed(rows[row.A + j], rows[row.D1 + j], on if rising else off)
            pixels.fields[at + _REF] = compared - np.float32(climbed)
            lost += crossings
            continue
        offset = state.reset_offset(pixels, pixel, _LAST, on, off, c.reset)
        threshold = np.float64(on + offset if rising else off - offset)
        passed = event_time.pass_over(_cubic(rows, j), np.float64(rows[row.START + j]), 1.0, threshold, rising, 1.0, c)
        if passed.waiting > 0:
            pixels.fields[at + _REF] = _NAN
            pixels.refractory_until_ns[pixel] = c.t0_ns + int((1.0 + passed.waiting) * c.h_ns)
        else:
            climbed = passed.climbed if rising else -passed.climbed
            pixels.fields[at + _REF] = compared - np.float32(climbed) + offset
        lost += passed.crossings
    return int(lost)


@kernel
def enter(table: Table, j: int, k: int, c: StepConstants) -> None:
    """Write candidate j into column k of the table of substeps, at the start of the step."""
    rows, to = table.rows, table.substep_table.rows
    table.substep_table.pixels[k] = table.pixels[j]
    # light: value, change and slopes per step
    to[substep.U + k] = rows[row.U0 + j]
    to[substep.D + k] = rows[row.U1 + j] - rows[row.U0 + j]
    to[substep.A0 + k] = rows[row.A0 + j]
    to[substep.A1 + k] = rows[row.A1 + j]
    # filters and leak
    to[substep.V + k] = rows[row.V0 + j]
    to[substep.W + k] = rows[row.W0 + j] if c.second > _ZERO else rows[row.V0 + j]
    to[substep.Y + k] = rows[row.Y0 + j] if c.high > _ZERO else _ZERO
    to[substep.P + k] = rows[row.P0 + j] if c.parasitic > _ZERO else _ZERO
    to[substep.LEAK + k] = rows[row.LEAK + j]
    # comparator: the reference is NaN in the refractory period, until `re_armed`
    to[substep.BASE + k] = rows[row.REF + j]
    to[substep.RE_ARMED + k] = rows[row.START + j]
    to[substep.FIRES_ON + k], to[substep.FIRES_OFF + k] = rows[row.ON + j], rows[row.OFF + j]
    to[substep.ON + k] = rows[(row.TRUE_ON if c.offsets else row.ON) + j]
    to[substep.OFF + k] = rows[(row.TRUE_OFF if c.offsets else row.OFF) + j]
    to[substep.DUE + k], to[substep.SIGN + k] = rows[row.DUE + j], rows[row.SIGN + j]
    to[substep.RESET + k] = rows[row.RESET + j]


@kernel
def _dispatch(pixels: Pixels, table: Table, n: int, c: StepConstants) -> int:
    """Store the references of re-armed candidates that do not fire; enter and count those that need substeps.

    This loop is a function of its own because it runs over all candidates; see `compiled` on reference counts.
    """
    rows, in_substeps = table.rows, NONE
    for j in range(n):
        kind = rows[row.KIND + j]
        if kind == row.NEEDS_SUBSTEPS:
            enter(table, j, in_substeps, c)
            in_substeps += 1
        elif kind == row.RE_ARMS:
            pixels.fields[state.slot(table.pixels[j]) + _REF] = rows[row.BASE + j] + rows[row.A + j]
    return int(in_substeps)


@kernel
def _fold_parasitic(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Move the parasitic leak of candidates that fire or are re-armed into their references; its sum starts at zero."""
    for j in range(n):
        kind = table.rows[row.KIND + j]
        if (kind == row.FIRES) | (kind == row.RE_ARMS):
            table.rows[row.BASE + j] -= table.rows[row.P1 + j]
            pixels.fields[state.slot(table.pixels[j]) + _P] = -table.rows[row.LIT + j] * c.since_epoch_1


@cached_entry
def solve(
    pixels: Pixels, table: Table, n: int, keys: Keys, n_keys: int, c: StepConstants
) -> tuple[Keys, int, int, int]:
    """Find all crossings of the n candidates, and move their references.

    Returns
    -------
    The keys (a longer copy where they were too short), the number of events in them, the number of crossings beyond
    MOST_EVENTS of a pixel, and the number of undersampled pixels.
    """
    _find_starts(pixels, table, n, c)
    if (c.reset.offset != _ZERO) | (c.reset.noise > _ZERO):
        _find_offsets(pixels, table, n, c)
    make_curves(pixels, table, n, c)
    if c.offsets:
        gather_draws(pixels, table, n, c)
        place_levels(table.rows, pixels.tables, state.whole_vectors(n), c)
        keep_clocks(pixels, table, n, c)
    _sort_by_kind(table.rows, state.whole_vectors(n), c)
    if c.parasitic > _ZERO:
        _fold_parasitic(pixels, table, n, c)
    in_substeps = _dispatch(pixels, table, n, c)
    keys, n_keys, lost, undersampled = solve_substeps(
        pixels, table.substep_table, table.draws, in_substeps, keys, n_keys, c
    )
    event = 0
    while n > 0:
        if event == event_time.MOST_EVENTS:
            lost += _pass_over(pixels, table, n, c)
            break
        _cross(table.rows, state.whole_vectors(n))
        if c.offsets:
            take_due(table.rows, state.whole_vectors(n))
        _bisect_unsettled(table, n)
        if max(c.on_delay, c.off_delay) > 0:
            _find_delays(table, n, c)
        if c.offsets:
            draw_next(pixels, table, n, c)
        _follow(table.rows, state.whole_vectors(n), c)
        keys = reserve(keys, n_keys + n)
        n_keys, n = _fire(pixels, table, n, keys, n_keys, c)
        event += 1
    return keys, n_keys, lost, undersampled

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

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import emulator.sensor.pixels.substeps as substep
from emulator.sensor.numerics.compiled import NONE, cached_entry, inlined, kernel, lane, vector_kernel
from emulator.sensor.numerics.elementary import aligned_zeros, decay, exponential, use_widest_vectors
from emulator.sensor.pixels import curve, event_time, state
from emulator.sensor.pixels.crossings import Keys, pack, reserve
from emulator.sensor.pixels.idle import pixel_at
from emulator.sensor.pixels.march import solve_substeps
from emulator.sensor.pixels.passages.rows import Visits, new_visits
from emulator.sensor.pixels.receptor import MOST_BEHIND, response
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, Field, Pixels, StepConstants
from emulator.sensor.pixels.substeps import CAPACITY, SubstepTable, new_substep_table

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P, _, _, _, _, _Y = (int(f) * BLOCK for f in Field)

_U0, _V0, _L0, _G0, _A0, _A1, _S, _, _W0, _P0, _, _, _Y0 = BEFORE_ROWS

BATCH, NOISY_BATCH = BLOCK, 3 * BLOCK
"""Candidates from which on the table is solved, without noise and with it; a block more fits."""

MOST_WAITING = BLOCK
"""Pixels with noise in the table of substeps that wait for those of the next batch, for which there is room."""

# Rows of the table, by their first index in the flat array.
(
    C_U0, C_V0, C_L0, C_A0, C_U1, C_V1, C_L1, C_A1, C_S, C_REF, C_ON, C_OFF, C_LEAK,
    C_W0, C_W1, C_P0, C_P1, C_START, C_BASE, C_A, C_D0, C_D1, C_C1, C_C2, C_C3, C_KIND,
    C_Z, C_MISS, C_NEXT_A, C_NEXT_START, C_NEXT_REF, C_AGAIN, C_LIT,
    C_RESET, C_NEXT_RESET, C_LATE, C_Y0, C_Y1,
) = (k * CAPACITY for k in range(38))  # fmt: skip
C_ROWS = 38
_LAST, _NEXT = (np.int64(n) for n in range(2))

_NOTHING, _RE_ARMS, _FIRES, NEEDS_SUBSTEPS = (np.float32(kind) for kind in range(4))

_NAN = np.float32(np.nan)
_ZERO, _ONE, _TWO, _THREE, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 0.5))
_MISSED = np.float32(1e-3)  # ln units: up to there the second pole's output is that behind a cubic (see `receptor`)
_SHARE = np.float32(0.01)  # of a threshold: what the cubic may miss of the exponential


class Table(NamedTuple):
    """The candidates: float32 rows, their pixels, room to list columns, and tables of substeps and of noise.

    The caller uses one table for all steps: memory of this size costs page faults when it is allocated again.
    """

    rows: _Float32s
    pixels: _Int64s
    listed: _Int64s
    substep_table: SubstepTable
    visits: Visits


def new_table() -> Table:
    """Return an empty table."""
    rows = aligned_zeros(C_ROWS * CAPACITY)
    pixels, listed = np.empty(CAPACITY, np.int64), np.empty(CAPACITY, np.int64)
    return Table(rows, pixels, listed, new_substep_table(), new_visits())


@inlined
def entry_at(row: int, k: np.uint64) -> np.uint64:
    """Return the index of entry k of a row; unsigned, which avoids the test for negative indices."""
    return np.uint64(row) + k


@kernel
def select(
    flagged: _Int64s, s: _Float32s, before: _Float32s, firsts: _Int64s, refractory_until_ns: _Int64s, c: StepConstants
) -> tuple[int, int]:
    """Select the candidates of a block, whose parts begin at `firsts`, that are to be solved, in place.

    Three kinds are left out: smooth ones whose refractory period covers the step, and pixels whose light is unreadable,
    or was at the last step, where the filter starts again. Returns the numbers of selected and unreadable pixels.
    """
    selected = unreadable = NONE
    for place in flagged:
        i = np.uint64(place)
        u1 = s[entry_at(_U, i)]
        v0 = before[entry_at(_V0, i)]
        reference = s[entry_at(_REF, i)]
        if v0 != v0 or u1 != u1:
            s[entry_at(_V, i)] = s[entry_at(_W, i)] = u1
            s[entry_at(_Y, i)] = u1 - u1
        unreadable += u1 != u1
        flagged[selected] = place  # written always, counted where it stays: no branch
        waits = reference != reference and refractory_until_ns[pixel_at(firsts, place)] - c.t0_ns > c.h_ns
        if waits and c.high == _ZERO:  # the quiet pass may not know the output of a high-pass
            d = u1 - before[entry_at(_U0, i)]
            threshold = min(s[entry_at(_ON, i)], s[entry_at(_OFF, i)])
            in_one_piece = not c.large or before[entry_at(_U0, i)] - v0 < MOST_BEHIND
            a0, a1 = before[entry_at(_A0, i)], before[entry_at(_A1, i)]
            if in_one_piece and curve.is_smooth(d, a0, a1, threshold, c.unseen_share):
                continue
        selected += (u1 == u1) & (v0 == v0)
    return selected, unreadable


@kernel
def gather(selected: _Int64s, s: _Float32s, before: _Float32s, firsts: _Int64s, table: Table, n: int) -> None:
    """Add candidates of the block of parts that begin at `firsts` to the table, from column n on.

    This happens while their block is in the first cache. The table then holds all that the solution needs, row after
    row, so that the loops over it become vectors.
    """
    rows = table.rows
    for j in range(selected.size):
        i, k = np.uint64(selected[j]), np.uint64(n + j)
        table.pixels[k] = pixel_at(firsts, selected[j])
        # light, filter, rate and slopes at both ends of the step
        rows[entry_at(C_U0, k)], rows[entry_at(C_U1, k)] = before[entry_at(_U0, i)], s[entry_at(_U, i)]
        rows[entry_at(C_V0, k)], rows[entry_at(C_V1, k)] = before[entry_at(_V0, i)], s[entry_at(_V, i)]
        rows[entry_at(C_L0, k)], rows[entry_at(C_L1, k)] = before[entry_at(_L0, i)], s[entry_at(_L, i)]
        rows[entry_at(C_A0, k)], rows[entry_at(C_A1, k)] = before[entry_at(_A0, i)], before[entry_at(_A1, i)]
        rows[entry_at(C_S, k)] = before[entry_at(_S, i)]
        # the comparator
        rows[entry_at(C_LEAK, k)] = s[entry_at(_LEAK, i)]
        rows[entry_at(C_ON, k)], rows[entry_at(C_OFF, k)] = s[entry_at(_ON, i)], s[entry_at(_OFF, i)]
        rows[entry_at(C_REF, k)] = s[entry_at(_REF, i)]


@kernel
def gather_rare(selected: _Int64s, s: _Float32s, before: _Float32s, n: int, table: Table, c: StepConstants) -> None:
    """Add the state behind a second pole or a high-pass and of parasitic leak; `_complete_parasitic` follows."""
    rows = table.rows
    for j in range(selected.size):
        i, k = np.uint64(selected[j]), np.uint64(n + j)
        if c.second > _ZERO:
            rows[entry_at(C_W0, k)], rows[entry_at(C_W1, k)] = before[entry_at(_W0, i)], s[entry_at(_W, i)]
        if c.parasitic > _ZERO:
            rows[entry_at(C_P0, k)], rows[entry_at(C_P1, k)] = before[entry_at(_P0, i)], s[entry_at(_P, i)]
        if c.high > _ZERO:
            rows[entry_at(C_Y0, k)] = before[entry_at(_Y0, i)]


@kernel
def _complete_parasitic(rows: _Float32s, n: int, c: StepConstants) -> None:
    """Add to each candidate's sums what its light at both ends of the step leaks since the epoch."""
    use_widest_vectors()
    for j in range(n):
        leaks = c.parasitic * rows[C_ON + j]
        since0, since1 = leaks * curve.photocurrent(rows[C_U0 + j]), leaks * curve.photocurrent(rows[C_U1 + j])
        rows[C_P0 + j] += since0 * c.since_epoch_0
        rows[C_P1 + j] += since1 * c.since_epoch_1
        rows[C_LIT + j] = since1


@kernel
def _find_starts(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Write when each candidate is re-armed, as a share of the step; 0 outside a refractory period."""
    for j in range(n):
        reference = table.rows[C_REF + j]
        start = _ZERO
        if reference != reference:
            wait_ns = pixels.refractory_until_ns[table.pixels[j]] - c.t0_ns
            start = np.float32(max(wait_ns, 0) / c.h_ns)
        table.rows[C_START + j] = start


@kernel
def _find_offsets(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Write the offsets of each candidate's reference after its last reset and after its next one; see `state`."""
    rows = table.rows
    for j in range(n):
        pixel, on, off = table.pixels[j], rows[C_ON + j], rows[C_OFF + j]
        rows[C_RESET + j] = state.reset_offset(pixels, pixel, _LAST, on, off, c.reset)
        rows[C_NEXT_RESET + j] = state.reset_offset(pixels, pixel, _NEXT, on, off, c.reset)


@vector_kernel
def _make_curves(table: _Float32s, n: int, c: StepConstants) -> None:
    """Write each candidate's cubic, without leak, and whether the pixel needs substeps instead."""
    use_widest_vectors()
    for j in range(n):
        u0, u1 = table[C_U0 + j], table[C_U1 + j]
        v0, v1 = table[C_V0 + j], table[C_V1 + j]
        a0, a1 = table[C_A0 + j], table[C_A1 + j]
        s = table[C_S + j]
        threshold = min(table[C_ON + j], table[C_OFF + j])
        r0 = c.h * table[C_L0 + j]  # rates of the filter, per step
        r1 = c.h * table[C_L1 + j]
        smooth = curve.is_smooth(u1 - u0, a0, a1, threshold, c.unseen_share)
        # The slopes of the filter's output are its rate times its lag. Where the exponential is rounding noise, the lag
        # without it is more accurate than the difference of two large numbers.
        allowed = _SHARE * threshold
        t = curve.transient(u0 - v0, curve.Course(s, u1 - u0, s * a0 / r0, s * a1 / r1), allowed)
        m0 = r0 * (t.lag0 if t.faint else u0 - v0)
        m1 = r1 * (t.lag1 if t.faint else u1 - v1)
        # A cubic is good where it misses little of the exponential.
        fits = (_ZERO if t.faint else curve.missed_by_cubic(t.b, s)) <= allowed
        table[C_D0 + j] = v0
        table[C_D1 + j] = v1
        table[C_C1 + j] = m0
        table[C_C2 + j] = m1
        table[C_KIND + j] = _NOTHING if smooth & fits else NEEDS_SUBSTEPS


@vector_kernel
def _make_curves_of_receptor(table: _Float32s, n: int, c: StepConstants) -> None:
    """Write the cubics of `_make_curves` for the large-signal law."""
    use_widest_vectors()
    for j in range(n):
        u0, u1 = table[C_U0 + j], table[C_U1 + j]
        v0, v1 = table[C_V0 + j], table[C_V1 + j]
        a0, a1 = table[C_A0 + j], table[C_A1 + j]
        s = table[C_S + j]
        threshold = min(table[C_ON + j], table[C_OFF + j])
        r0 = c.h * table[C_L0 + j]
        r1 = c.h * table[C_L1 + j]
        allowed = _SHARE * threshold if c.second == _ZERO else min(_SHARE * threshold, _MISSED)
        course = curve.Course(s, u1 - u0, s * a0 / r0, s * a1 / r1)
        r = response(curve.Filtered(u0 - v0, u1 - v1, v1 - v0, r0, r1), course, allowed)
        smooth = curve.is_smooth(u1 - u0, a0, a1, threshold, c.unseen_share) & (u0 - v0 < MOST_BEHIND)
        table[C_D0 + j] = v0
        table[C_D1 + j] = v1
        table[C_C1 + j] = r.m0
        table[C_C2 + j] = r.m1
        table[C_KIND + j] = _NOTHING if smooth & (r.missed <= allowed) else NEEDS_SUBSTEPS


@vector_kernel
def _make_curves_of_second_pole(table: _Float32s, n: int, c: StepConstants) -> None:
    """Replace each candidate's cubic by that of the second pole's output: it follows the cubic as the filter light."""
    use_widest_vectors()
    for j in range(n):
        v0, v1 = table[C_V0 + j], table[C_V1 + j]
        w0, w1 = table[C_W0 + j], table[C_W1 + j]
        allowed = _SHARE * min(table[C_ON + j], table[C_OFF + j])
        t = curve.transient(v0 - w0, curve.Course(c.second, v1 - v0, table[C_C1 + j], table[C_C2 + j]), allowed)
        fits = (_ZERO if t.faint else curve.missed_by_cubic(t.b, c.second)) <= allowed
        table[C_D0 + j] = w0
        table[C_D1 + j] = w1
        table[C_C1 + j] = c.second * (t.lag0 if t.faint else v0 - w0)
        table[C_C2 + j] = c.second * (t.lag1 if t.faint else v1 - w1)
        table[C_KIND + j] = table[C_KIND + j] if fits else NEEDS_SUBSTEPS


@vector_kernel
def _make_curves_of_high_pass(table: _Float32s, n: int, c: StepConstants) -> None:
    """Replace each candidate's cubic by that of the high-pass's output; long steps are left to substeps."""
    use_widest_vectors()
    q = decay(c.high)
    for j in range(n):
        w = curve.Course(c.high, table[C_D1 + j] - table[C_D0 + j], table[C_C1 + j], table[C_C2 + j])
        y0 = table[C_Y0 + j]
        y1 = curve.behind_high_pass(q, y0, w)
        table[C_D0 + j] = y0
        table[C_D1 + j] = table[C_Y1 + j] = y1
        table[C_C1 + j] = w.w0 - c.high * y0
        table[C_C2 + j] = w.w1 - c.high * y1
        table[C_KIND + j] = table[C_KIND + j] if c.high <= curve.LARGEST_CHANGE else NEEDS_SUBSTEPS


@vector_kernel
def _add_parasitic(table: _Float32s, n: int, c: StepConstants) -> None:
    """Add the parasitic leak to each candidate's curve."""
    use_widest_vectors()
    for j in range(n):
        leaks = c.h * c.parasitic * table[C_ON + j]
        table[C_D0 + j] += table[C_P0 + j]
        table[C_D1 + j] += table[C_P1 + j]
        table[C_C1 + j] += leaks * exponential(table[C_U0 + j])
        table[C_C2 + j] += leaks * exponential(table[C_U1 + j])


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
            pixels.fields[state.slot(table.pixels[j]) + _Y] = rows[C_Y1 + j]
    if c.parasitic > _ZERO:
        _add_parasitic(rows, state.whole_vectors(n), c)


@vector_kernel
def _sort_by_kind(table: _Float32s, n: int, c: StepConstants) -> None:
    """Finish each candidate's curve, relative to `base` and with leak, and write its kind."""
    use_widest_vectors()
    for j in range(n):
        leak = table[C_LEAK + j]
        on = table[C_ON + j]
        off = table[C_OFF + j]
        start = table[C_START + j]
        reference = table[C_REF + j]
        w0 = table[C_D0 + j]
        # Relative to the reference, or to the start of the step where there is none: small numbers are exact.
        refractory = reference != reference
        base = w0 + leak * c.since_epoch_0 if refractory else reference
        d0 = (w0 - base) + leak * c.since_epoch_0
        d1 = (table[C_D1 + j] - base) + leak * c.since_epoch_1
        # The cubic through both values and slopes. It is monotone if the Bernstein coefficients of its slope, m0, m1
        # and the middle one, have one sign.
        rise = d1 - d0
        m0 = table[C_C1 + j] + c.h * leak
        m1 = table[C_C2 + j] + c.h * leak
        c2 = _THREE * rise - _TWO * m0 - m1
        c3 = m0 + m1 - _TWO * rise
        middle = m0 + c2
        monotone = (min(min(m0, m1), middle) >= _ZERO) | (max(max(m0, m1), middle) <= _ZERO)
        # The pixel compares from `start` on with the level a: then a monotone curve fires if its end does.
        at_start = ((c3 * start + c2) * start + m0) * start + d0
        a = at_start + table[C_RESET + j] if refractory else _ZERO
        inside = (at_start - a < on) & (at_start - a > -off)
        fires = (d1 - a >= on) | (d1 - a <= -off)
        table[C_BASE + j] = base
        table[C_A + j] = a
        table[C_D0 + j] = d0
        table[C_D1 + j] = d1
        table[C_C1 + j] = m0
        table[C_C2 + j] = c2
        table[C_C3 + j] = c3
        idle = _RE_ARMS if refractory else _NOTHING
        kind = _FIRES if fires else idle
        table[C_KIND + j] = kind if monotone & inside & (table[C_KIND + j] != NEEDS_SUBSTEPS) else NEEDS_SUBSTEPS


@lane
def _cubic(rows: _Float32s, j: int) -> event_time.Cubic:
    """Return the curve of candidate j over the step."""
    return event_time.Cubic(rows[C_D0 + j], rows[C_C1 + j], rows[C_C2 + j], rows[C_C3 + j])


@lane
def _bracket(rows: _Float32s, j: int) -> event_time.Bracket:
    """Return the bracket in which the curve of candidate j meets its next level."""
    a = rows[C_A + j]
    rising = rows[C_D1 + j] > a
    level = a + (rows[C_ON + j] if rising else -rows[C_OFF + j])
    return event_time.Bracket(rows[C_START + j], _ONE, level, rising)


@vector_kernel
def _cross(table: _Float32s, n: int) -> None:
    """Find where each candidate's monotone cubic meets its next level, and write z and the last Newton correction."""
    use_widest_vectors()
    for j in range(n):
        g, at = _cubic(table, j), _bracket(table, j)
        at_start = event_time.value(g, at.low)
        guess = at.low + (_ONE - at.low) * (at.level - at_start) / (table[C_D1 + j] - at_start)
        table[C_Z + j], table[C_MISS + j] = event_time.newton(g, at, guess)


@kernel
def _bisect_unsettled(table: Table, n: int) -> None:
    """Bisect the crossings whose Newton iterations have not settled.

    These are listed first: in one loop the compiler would bisect for all candidates and then choose.
    """
    rows, unsettled = table.rows, 0
    for j in range(n):
        table.listed[unsettled] = j
        unsettled += (rows[C_KIND + j] == _FIRES) & (rows[C_MISS + j] > event_time.SETTLED)
    for k in range(unsettled):
        j = table.listed[k]
        rows[C_Z + j] = event_time.bisect(_cubic(rows, j), _bracket(rows, j))


@kernel
def _find_delays(table: Table, n: int, c: StepConstants) -> None:
    """Write the delay of the comparator of each candidate that fires, as a share of the step."""
    rows = table.rows
    for j in range(n):
        if rows[C_KIND + j] == _FIRES:
            z = rows[C_Z + j]
            slope = (_THREE * rows[C_C3 + j] * z + _TWO * rows[C_C2 + j]) * z + rows[C_C1 + j]
            late_s = event_time.delay_s(np.float64(abs(slope) / c.h), rows[C_D1 + j] > rows[C_A + j], c)
            rows[C_LATE + j] = np.float32(late_s / c.h)


@vector_kernel
def _follow(table: _Float32s, n: int, c: StepConstants) -> None:
    """Write for each candidate that fires at z its next reference, when it is re-armed, and whether it fires again."""
    use_widest_vectors()
    for j in range(n):
        a, d1 = table[C_A + j], table[C_D1 + j]
        on, off = table[C_ON + j], table[C_OFF + j]
        re_armed = table[C_Z + j] + (table[C_LATE + j] + c.refractory)
        # Without a refractory period the level that was crossed is the next reference; else the curve at its end is.
        crossed = a + (on if d1 > a else -off)
        at_end = event_time.value(_cubic(table, j), re_armed)
        following = (at_end if c.refractory > _ZERO else crossed) + table[C_NEXT_RESET + j]
        fires = ((d1 - following >= on) | (d1 - following <= -off)) & (re_armed <= _ONE)
        table[C_NEXT_A + j] = following
        table[C_NEXT_START + j] = re_armed
        table[C_NEXT_REF + j] = table[C_BASE + j] + following if re_armed <= _ONE else _NAN
        table[C_AGAIN + j] = _ONE if fires & (table[C_KIND + j] == _FIRES) else _ZERO


@kernel
def _move_column(table: Table, j: int, k: int) -> None:
    """Move the entries for the next crossing from column j to column k."""
    rows = table.rows
    table.pixels[k] = table.pixels[j]
    rows[C_A + k] = rows[C_NEXT_A + j]
    rows[C_START + k] = rows[C_NEXT_START + j]
    rows[C_KIND + k] = _FIRES
    for row in (C_ON, C_OFF, C_BASE, C_D0, C_D1, C_C1, C_C2, C_C3, C_NEXT_RESET):
        rows[row + k] = rows[row + j]


@kernel
def _fire(pixels: Pixels, table: Table, n: int, keys: Keys, n_keys: int, c: StepConstants) -> tuple[int, int]:
    """Write the events of the candidates that fire, and their references; return n_keys and the count of repeats."""
    rows, again = table.rows, NONE
    for j in range(n):
        if rows[C_KIND + j] != _FIRES:
            continue
        # The event: its time in the step is the crossing's, and the delay of the comparator.
        pixel = table.pixels[j]
        dt_ns = min(int(rows[C_Z + j] * c.h_ns), c.h_ns) + int(rows[C_LATE + j] * c.h_ns)
        keys[n_keys] = pack(dt_ns, pixel, rows[C_D1 + j] > rows[C_A + j], c.pixel_bits)
        n_keys += 1
        # The reset. The reference is NaN in the refractory period, if that lasts longer than the step.
        reference = rows[C_NEXT_REF + j]
        pixels.fields[state.slot(pixel) + _REF] = reference
        if reference != reference:
            pixels.refractory_until_ns[pixel] = c.t0_ns + dt_ns + c.refractory_ns
        state.count_reset(pixels, pixel, c.reset.noise)
        if rows[C_AGAIN + j] != _ZERO:
            _move_column(table, j, again)  # to the front: `again` is never behind j
            if c.reset.noise > _ZERO:
                on, off = rows[C_ON + j], rows[C_OFF + j]
                rows[C_NEXT_RESET + again] = state.reset_offset(pixels, pixel, _NEXT, on, off, c.reset)
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
        on, off = rows[C_ON + j], rows[C_OFF + j]
        rising = rows[C_D1 + j] > rows[C_A + j]
        if c.refractory_ns == 0:
            crossings, climbed = event_time.levels_passed(rows[C_A + j], rows[C_D1 + j], on if rising else off)
            pixels.fields[at + _REF] = compared - np.float32(climbed)
            lost += crossings
            continue
        offset = state.reset_offset(pixels, pixel, _LAST, on, off, c.reset)
        threshold = np.float64(on + offset if rising else off - offset)
        passed = event_time.pass_over(_cubic(rows, j), np.float64(rows[C_START + j]), 1.0, threshold, rising, 1.0, c)
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
    to[substep.U + k] = rows[C_U0 + j]
    to[substep.D + k] = rows[C_U1 + j] - rows[C_U0 + j]
    to[substep.A0 + k] = rows[C_A0 + j]
    to[substep.A1 + k] = rows[C_A1 + j]
    # filters and leak
    to[substep.V + k] = rows[C_V0 + j]
    to[substep.W + k] = rows[C_W0 + j] if c.second > _ZERO else rows[C_V0 + j]
    to[substep.Y + k] = rows[C_Y0 + j] if c.high > _ZERO else _ZERO
    to[substep.P + k] = rows[C_P0 + j] if c.parasitic > _ZERO else _ZERO
    to[substep.LEAK + k] = rows[C_LEAK + j]
    # comparator: the reference is NaN in the refractory period, until `re_armed`
    to[substep.BASE + k] = rows[C_REF + j]
    to[substep.RE_ARMED + k] = rows[C_START + j]
    to[substep.ON + k] = rows[C_ON + j]
    to[substep.OFF + k] = rows[C_OFF + j]
    to[substep.RESET + k] = rows[C_RESET + j]


@kernel
def _dispatch(pixels: Pixels, table: Table, n: int, c: StepConstants) -> int:
    """Store the references of re-armed candidates that do not fire; enter and count those that need substeps.

    This loop is a function of its own because it runs over all candidates; see `compiled` on reference counts.
    """
    rows, in_substeps = table.rows, NONE
    for j in range(n):
        kind = rows[C_KIND + j]
        if kind == NEEDS_SUBSTEPS:
            enter(table, j, in_substeps, c)
            in_substeps += 1
        elif kind == _RE_ARMS:
            pixels.fields[state.slot(table.pixels[j]) + _REF] = rows[C_BASE + j] + rows[C_A + j]
    return int(in_substeps)


@kernel
def _fold_parasitic(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Move the parasitic leak of candidates that fire or are re-armed into their references; its sum starts at zero."""
    for j in range(n):
        kind = table.rows[C_KIND + j]
        if (kind == _FIRES) | (kind == _RE_ARMS):
            table.rows[C_BASE + j] -= table.rows[C_P1 + j]
            pixels.fields[state.slot(table.pixels[j]) + _P] = -table.rows[C_LIT + j] * c.since_epoch_1


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
    _sort_by_kind(table.rows, state.whole_vectors(n), c)
    if c.parasitic > _ZERO:
        _fold_parasitic(pixels, table, n, c)
    in_substeps = _dispatch(pixels, table, n, c)
    keys, n_keys, lost, undersampled = solve_substeps(pixels, table.substep_table, in_substeps, keys, n_keys, c)
    event = 0
    while n > 0:
        if event == event_time.MOST_EVENTS:
            lost += _pass_over(pixels, table, n, c)
            break
        _cross(table.rows, state.whole_vectors(n))
        _bisect_unsettled(table, n)
        if max(c.on_delay, c.off_delay) > 0:
            _find_delays(table, n, c)
        _follow(table.rows, state.whole_vectors(n), c)
        keys = reserve(keys, n_keys + n)
        n_keys, n = _fire(pixels, table, n, keys, n_keys, c)
        event += 1
    return keys, n_keys, lost, undersampled

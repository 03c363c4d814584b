"""Stepping of pixels through a step, substep by substep and event by event, for a whole table of pixels at once.

A round takes every column over one substep (`substeps`), and within it from event to event. The comparator's curve g
over a substep is a cubic, whose turning points are known in closed form. Between them it is monotone, so its values at
the ends decide whether a level is met, and no crossing is missed; `event_time` finds where.

Fast because a loop does one thing for all columns: loops over numbers only become vectors; the few columns that bisect,
fire or end go one by one in their own loops. Finished columns are filled from behind: later rounds are short.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import emulator.sensor.pixels.substeps as row
from emulator.sensor.numerics.compiled import NONE, kernel, kernel_that_allocates, lane, vector_kernel
from emulator.sensor.pixels import event_time, state
from emulator.sensor.pixels.candidate_table import Draw, Draws
from emulator.sensor.pixels.crossings import Keys, pack, reserve
from emulator.sensor.pixels.curve import photocurrent
from emulator.sensor.pixels.offsets import Passage, draw_all, enter_reset, is_of_noise, store_reset
from emulator.sensor.pixels.state import BLOCK, Field, Pixels, StepConstants
from emulator.sensor.pixels.substeps import SubstepTable, begin, begin_substep, go_on, store_filters

_Float32s = npt.NDArray[np.float32]

_U, _REF, _P = (int(f) * BLOCK for f in (Field.LOG_LIGHT, Field.REFERENCE, Field.LEAKED))

_NAN = np.float32(np.nan)
_ZERO, _ONE, _TWO, _THREE = (np.float32(x) for x in (0, 1, 2, 3))
_BEHIND = np.float32(2)  # the substep, which ends at 1
_LAST = np.int64(0)


@lane
def _cubic(rows: _Float32s, j: int) -> event_time.Cubic:
    """Return the curve of column j over its substep."""
    return event_time.Cubic(rows[row.D0 + j], rows[row.C1 + j], rows[row.C2 + j], rows[row.C3 + j])


@lane
def _bracket(rows: _Float32s, j: int) -> event_time.Bracket:
    """Return the bracket in which the curve of column j meets its level."""
    to = rows[row.TO + j]
    return event_time.Bracket(rows[row.LOW + j], rows[row.HIGH + j], to, to > rows[row.LEVEL + j])


@vector_kernel
def _find_firing_part(rows: _Float32s, n: int) -> None:
    """Find for each column the next monotone part of its curve on which it fires; read a new level where re-armed."""
    for j in range(n):
        on = rows[row.FIRES_ON + j]
        off = rows[row.FIRES_OFF + j]
        level = rows[row.LEVEL + j]
        x = rows[row.X + j]
        g = _cubic(rows, j)
        # A pixel in its refractory period has no level (NaN). Where that ends in this substep, the level is read there.
        wait = rows[row.RE_ARMED + j] - rows[row.Z + j]
        opens = wait / rows[row.SPAN + j] if wait > _ZERO else _ZERO
        refractory = level != level
        x = max(x, opens) if refractory else x
        armed = x <= _ONE
        level = event_time.value(g, x) + rows[row.RESET + j] if refractory & armed else level
        # The curve is monotone between x, its turns and the end. The pixel fires on the first of these three parts at
        # whose end a threshold is met; at x itself if it is met there already.
        turn = max(rows[row.TURN + j], x)
        turn2 = max(rows[row.TURN2 + j], x)
        g0 = event_time.value(g, x) - level
        g1 = event_time.value(g, turn) - level
        g2 = event_time.value(g, turn2) - level
        g3 = event_time.value(g, _ONE) - level
        at_once = (g0 >= on) | (g0 <= -off)
        by1 = (g1 >= on) | (g1 <= -off)
        by2 = (g2 >= on) | (g2 <= -off)
        by3 = (g3 >= on) | (g3 <= -off)
        end = x if at_once else (turn if by1 else (turn2 if by2 else _ONE))
        change = g0 if at_once else (g1 if by1 else (g2 if by2 else g3))
        rows[row.LEVEL + j] = level
        rows[row.X + j] = x if armed else rows[row.X + j]
        crosses = armed & (at_once | by1 | by2 | by3)
        is_due = armed & (rows[row.DUE + j] - rows[row.Z + j] <= rows[row.SPAN + j])
        rows[row.CROSSES + j] = _ONE if crosses else _ZERO
        rows[row.FIRES + j] = _ONE if crosses | is_due else _ZERO
        rows[row.LOW + j] = x if at_once | by1 else (turn if by2 else turn2)
        rows[row.HIGH + j] = end
        rows[row.TO + j] = level + (on if change > _ZERO else -off)


@vector_kernel
def _cross(rows: _Float32s, n: int) -> None:
    """Find where each column meets its level in its monotone part, and write the last Newton correction."""
    for j in range(n):
        g, at = _cubic(rows, j), _bracket(rows, j)
        at_low, at_high = event_time.value(g, at.low), event_time.value(g, at.high)
        # The secant is a first guess so near that four iterations settle almost all columns.
        secant = at.low + (at.high - at.low) * (at.level - at_low) / (at_high - at_low)
        guess = secant if (secant >= at.low) & (secant <= at.high) else at.high
        rows[row.HIT + j], rows[row.MISS + j] = event_time.newton(g, at, guess)
        rows[row.UP + j] = _ONE if at.rising else _ZERO


@vector_kernel
def _take_due(rows: _Float32s, n: int) -> None:
    """Let each column fire where its clock runs out, if that is before its crossing."""
    for j in range(n):
        due = (rows[row.DUE + j] - rows[row.Z + j]) / rows[row.SPAN + j]
        crossed = rows[row.HIT + j] if rows[row.CROSSES + j] != _ZERO else _BEHIND
        first, at = due <= crossed, max(due, rows[row.X + j])
        rows[row.HIT + j] = at if first else rows[row.HIT + j]
        rows[row.MISS + j] = _ZERO if first else rows[row.MISS + j]
        rows[row.UP + j] = max(rows[row.SIGN + j], _ZERO) if first else rows[row.UP + j]
        rows[row.TO + j] = event_time.value(_cubic(rows, j), at) if first else rows[row.TO + j]


@kernel
def _draw(pixels: Pixels, table: SubstepTable, draws: Draws, n: int, c: StepConstants) -> None:
    """Draw the resets of the columns that fire, in their order."""
    rows, k = table.rows, NONE
    for j in range(n):
        if rows[row.FIRES + j] == _ZERO or rows[row.COUNT + j] >= event_time.MOST_EVENTS:
            continue
        hit, span = rows[row.HIT + j], rows[row.SPAN + j]
        g, armed = _cubic(rows, j), min(hit + c.refractory / span, _ONE)
        speed = ((_THREE * g.c3 * armed + _TWO * g.c2) * armed + g.c1) / (span * c.h)
        rate = c.rate_at_reference * photocurrent(rows[row.U0 + j] + hit * (rows[row.U1 + j] - rows[row.U0 + j]))
        late = _late(rows, j, c)
        reset_ns = c.t0_ns + _event_ns(rows, j, late, c) + c.refractory_ns
        dead_s = (late + c.refractory) * c.h
        moved = event_time.value(g, hit) - rows[row.LEVEL + j]
        rate = min(max(rate, c.rate_min), c.rate_max)
        passage = Passage(moved, rows[row.UP + j] != _ZERO, rate, speed, dead_s, reset_ns)
        enter_reset(draws, k, pixels, table.pixels[j], passage, c)
        k += 1
    draw_all(draws, pixels, k, c)


@kernel
def _bisect_unsettled(table: SubstepTable, n: int) -> None:
    """Bisect the crossings whose Newton iterations have not settled; these are listed first."""
    rows, unsettled = table.rows, 0
    for j in range(n):
        table.unsettled[unsettled] = j
        unsettled += (rows[row.FIRES + j] != _ZERO) & (rows[row.MISS + j] > event_time.SETTLED)
    for k in range(unsettled):
        j = table.unsettled[k]
        rows[row.HIT + j] = event_time.bisect(_cubic(rows, j), _bracket(rows, j))


@kernel
def _pass_over(rows: _Float32s, j: int) -> int:
    """Move the level of a column that fires too often to the last one in its monotone part; return how many it met.

    Where float32 is too coarse for a threshold, the level becomes that of the substep's end.
    """
    level = rows[row.LEVEL + j]
    high = rows[row.HIGH + j]
    to = rows[row.TO + j]
    end = event_time.value(_cubic(rows, j), high)
    threshold = rows[row.ON + j] if to >= level else rows[row.OFF + j]
    passed, beyond = event_time.levels_passed(level, end, threshold)
    last = end - np.float32(beyond)
    rows[row.X + j], rows[row.LEVEL + j] = high, last if abs(end - last) < threshold else end
    if passed == 0 and to != level:
        rows[row.LEVEL + j], passed = to, 1
    elif passed == 0:
        end = event_time.value(_cubic(rows, j), _ONE)
        passed, _ = event_time.levels_passed(level, end, threshold)
        rows[row.X + j], rows[row.LEVEL + j] = _BEHIND, end
    return int(passed)


@kernel
def _pass_over_waiting(pixels: Pixels, table: SubstepTable, j: int, c: StepConstants) -> int:
    """Move a column with a refractory period past all crossings of its monotone part; return how many they are.

    It begins with the present crossing: the reference is read a dead time behind it, with the offset of the last reset.
    """
    rows, pixel = table.rows, table.pixels[j]
    high, span = np.float64(rows[row.HIGH + j]), np.float64(rows[row.SPAN + j])
    rising = rows[row.TO + j] > rows[row.LEVEL + j]
    offset = rows[row.RESET + j]
    threshold = np.float64(rows[row.ON + j] + offset if rising else rows[row.OFF + j] - offset)
    re_armed = rows[row.HIT + j] + (np.float64(_late(rows, j, c)) + c.refractory) / span
    passed = event_time.pass_over(_cubic(rows, j), re_armed, high, threshold, rising, span, c)
    rows[row.X + j] = rows[row.HIGH + j]
    if passed.waiting > 0:
        re_armed = rows[row.Z + j] + (high + passed.waiting) * span
        rows[row.LEVEL + j], rows[row.RE_ARMED + j] = _NAN, np.float32(re_armed)
        pixels.refractory_until_ns[pixel] = c.t0_ns + int(re_armed * c.h_ns)
    else:
        climbed = np.float32(passed.climbed if rising else -passed.climbed)
        rows[row.LEVEL + j] = event_time.value(_cubic(rows, j), rows[row.HIGH + j]) - climbed + offset
    return int(passed.crossings) + 1


@kernel
def _late(rows: _Float32s, j: int, c: StepConstants) -> np.float32:
    """Return the delay of the comparator of a column that fires, as a share of the step."""
    if max(c.on_delay, c.off_delay) <= 0:
        return _ZERO
    g, x = _cubic(rows, j), rows[row.HIT + j]
    slope = ((_THREE * g.c3 * x + _TWO * g.c2) * x + g.c1) / (rows[row.SPAN + j] * c.h)
    return np.float32(event_time.delay_s(np.float64(abs(slope)), rows[row.UP + j] != _ZERO, c) / c.h)


@kernel
def _event_ns(rows: _Float32s, j: int, late: np.float32, c: StepConstants) -> int:
    """Return the time of column j's event in the step: that of its crossing, and the delay of the comparator."""
    z = rows[row.Z + j] + rows[row.HIT + j] * rows[row.SPAN + j]
    return min(int(z * c.h_ns), c.h_ns) + int(late * c.h_ns)


@kernel
def _fire(  # noqa: PLR0913, PLR0917
    pixels: Pixels, table: SubstepTable, draws: Draws, n: int, keys: Keys, n_keys: int, c: StepConstants
) -> tuple[int, int, int]:
    """Write the events of the columns that fire; return the numbers of events in `keys`, written, and lost."""
    rows = table.rows
    fired = lost = resets = NONE
    if c.offsets:
        _draw(pixels, table, draws, n, c)
    for j in range(n):
        if rows[row.FIRES + j] == _ZERO:
            continue
        fired += 1
        if rows[row.COUNT + j] >= event_time.MOST_EVENTS:
            lost += _pass_over(rows, j) if c.refractory_ns == 0 else _pass_over_waiting(pixels, table, j, c)
            continue
        pixel = table.pixels[j]
        level = rows[row.TO + j]
        z = rows[row.Z + j] + rows[row.HIT + j] * rows[row.SPAN + j]
        late = _late(rows, j, c)
        dt_ns = _event_ns(rows, j, late, c)
        number = 2 * pixel + is_of_noise(draws, resets) if c.offsets else pixel
        keys[n_keys] = pack(dt_ns, number, rows[row.UP + j] != _ZERO, c.pixel_bits)
        n_keys += 1
        rows[row.COUNT + j] += _ONE
        # The reset: the crossed level is the new reference, or with a refractory period the level at its end.
        state.count_reset(pixels, pixel, c.reset.noise)
        offset = state.reset_offset(pixels, pixel, _LAST, rows[row.ON + j], rows[row.OFF + j], c.reset)
        rows[row.X + j] = rows[row.HIT + j]
        rows[row.LEVEL + j] = level + offset
        rows[row.RESET + j] = offset
        if c.refractory > _ZERO:
            rows[row.LEVEL + j], rows[row.RE_ARMED + j] = _NAN, z + (late + c.refractory)
            pixels.refractory_until_ns[pixel] = c.t0_ns + dt_ns + c.refractory_ns
        if c.offsets:
            rows[row.FIRES_ON + j] = draws.rows[Draw.ON_LEVEL + resets]
            rows[row.FIRES_OFF + j] = draws.rows[Draw.OFF_LEVEL + resets]
            rows[row.SIGN + j] = draws.rows[Draw.SIGN + resets]
            rows[row.DUE + j] = store_reset(draws, resets, pixels, pixel, c.t0_ns + dt_ns + c.refractory_ns, c)
            resets += 1
    return n_keys, fired, lost


@kernel
def _last_reference(rows: _Float32s, j: int, c: StepConstants) -> np.float32:
    """Return the reference of a column that fired too often: near its comparator, however large its leak has become."""
    on, off = rows[row.ON + j], rows[row.OFF + j]
    change = min(max(event_time.value(_cubic(rows, j), _ONE) - rows[row.LEVEL + j], -off), on)
    compared = rows[(row.Y1 if c.high > _ZERO else row.W1) + j]
    reference: np.float32 = compared + rows[row.LEAK + j] * c.since_epoch_1 - change
    return reference


@kernel
def _store(pixels: Pixels, table: SubstepTable, j: int, c: StepConstants) -> None:
    """Write the state of a column that has reached the end of the step."""
    rows = table.rows
    at = state.slot(table.pixels[j])
    level, leaked = rows[row.LEVEL + j], _ZERO
    store_filters(pixels, table.pixels[j], rows, j, c)
    if c.parasitic > _ZERO:
        # A level other than 0 is that of an event in this step, which the sum of the leak counts from.
        leaked = rows[row.P1 + j]
        leaks = c.parasitic * rows[row.ON + j] * photocurrent(pixels.fields[at + _U])
        pixels.fields[at + _P] = (leaked if level == _ZERO else _ZERO) - leaks * c.since_epoch_1
    if (rows[row.COUNT + j] >= event_time.MOST_EVENTS) & (level == level):
        pixels.fields[at + _REF] = _last_reference(rows, j, c)
        return
    moved = level - leaked if level != _ZERO else _ZERO
    pixels.fields[at + _REF] = rows[row.BASE + j] + moved  # NaN in the refractory period


@kernel
def _end_substep(pixels: Pixels, table: SubstepTable, n: int, c: StepConstants) -> int:
    """Store the columns that have reached the end of the step, compact the others; return how many remain."""
    rows, remaining = table.rows, 0
    for j in range(n):
        if rows[row.Z1 + j] >= _ONE:
            _store(pixels, table, j, c)
            continue
        go_on(table, j, remaining)
        remaining += 1
    return remaining


@kernel_that_allocates
def solve_substeps(  # noqa: PLR0913, PLR0917
    pixels: Pixels, table: SubstepTable, draws: Draws, n: int, keys: Keys, n_keys: int, c: StepConstants
) -> tuple[Keys, int, int, int]:
    """Take the n columns of the table through the step.

    Returns
    -------
    The keys (a longer copy where they were too short), the number of events in them, the number of crossings beyond
    MOST_EVENTS of a pixel, and the number of undersampled pixels.
    """
    begin(table.rows, 0, state.whole_vectors(n), c)
    undersampled = lost = NONE
    for j in range(n):
        undersampled += table.rows[row.UNDERSAMPLED + j] != _ZERO
    while n > 0:
        begin_substep(table.rows, state.whole_vectors(n), c)
        fired = n
        while fired > 0:
            keys = reserve(keys, n_keys + n)
            _find_firing_part(table.rows, state.whole_vectors(n))
            _cross(table.rows, state.whole_vectors(n))
            if c.offsets:
                _take_due(table.rows, state.whole_vectors(n))
            _bisect_unsettled(table, n)
            n_keys, fired, passed = _fire(pixels, table, draws, n, keys, n_keys, c)
            lost += passed
        n = _end_substep(pixels, table, n, c)
    return keys, n_keys, lost, undersampled

"""The pixels that may fire in a step: gathered in a table, solved together, column by column a pixel.

A candidate's filtered value, leak added and the reference subtracted, is a curve in z, the share of the step:

    a cubic through its values and derivatives at both ends of the step (the derivative is rate times what the filter
    lacks). Leaves out part of the exponential of the filter's answer, at most |B| E(S) with
    E = min(S^4 / 384, 0.16 S + 0.2), and is taken where that is less than 1 % of a threshold;
    else the line and exponential itself, the time constant held at its mean over the step.

A candidate whose curve rises or falls all through the step needs only its end values to tell whether it fires. Its
crossing is found by a fixed number of Newton turns, kept in their bracket, for all candidates of the table at once; who
fires again in the same step goes round again. What turns inside the step, and what changes by more than 0.5 in log
light, is solved one by one by `exact`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.compiled import kernel, kernel_that_allocates, vector_kernel
from emulator.sensor.elementary import decay
from emulator.sensor.exact import MOST_EVENTS, Pixel, Real, Step, Trace, solve_exactly
from emulator.sensor.layout import BLOCK, Field, Pixels, StepConstants, slot

__all__ = ["BATCH", "BEFORE_ROWS", "Table", "gather", "new_table", "select", "solve"]

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Keys = npt.NDArray[np.uint64]

_U, _V, _L, _REF, _ON, _OFF, _LEAK = (int(f) * BLOCK for f in Field)

# Rows of a block's scratch: the first three fields as they were before the step, then S, q = 1 - e^-S and 1 - q / S.
BEFORE_ROWS = _U0, _V0, _L0, _S, _Q, _P = tuple(k * BLOCK for k in range(6))

BATCH = BLOCK
"""Candidates from which on the table is solved; a block more fits."""

# Rows of the table; a little longer than a power of two, so that a column's entries do not all fall into the same set
# of the first cache.
_CAPACITY = BATCH + BLOCK + 16
(
    _C_U0, _C_V0, _C_L0, _C_U1, _C_V1, _C_L1, _C_S, _C_REF, _C_ON, _C_OFF, _C_LEAK, _C_START,
    _C_BASE, _C_A, _C_D0, _C_D1, _C_C1, _C_C2, _C_C3, _C_B, _C_KIND, _C_Z, _C_MISS,
    _C_NEXT_A, _C_NEXT_START, _C_NEXT_REF, _C_AGAIN,
) = (k * _CAPACITY for k in range(27))  # fmt: skip
_C_ROWS = 27

_NOTHING, _SEES_AGAIN, _FIRES, _EXACT = (np.float32(kind) for kind in range(4))

_NAN = np.float32(np.nan)
_ZERO, _ONE, _TWO, _THREE, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 0.5))
_LARGEST_CHANGE = np.float32(0.5)
_SHARE = np.float32(0.01)
_FAST = np.float32(100)  # S from which slopes are rounding noise if the exponential is below _FAINT
_FAINT = np.float32(1e-5)
_CUBIC_TURNS = 4
_TURNS = 6
_HALVINGS = 25
_SETTLED = np.float32(3e-5)  # last Newton correction; the error is of the order of its square


class Table(NamedTuple):
    """The candidates: float32 rows, their pixels, columns that need the exact form, room for one pixel's events.

    Kept from step to step by the caller: memory of this size, once freed, costs page faults when taken again.
    """

    rows: _Float32s
    pixels: _Int64s
    odd: _Int64s
    trace: Trace


def new_table() -> Table:
    """Return an empty table."""
    trace = Trace(np.empty(MOST_EVENTS, np.float64), np.empty(MOST_EVENTS, np.uint8))
    rows = np.empty(_C_ROWS * _CAPACITY, np.float32)
    return Table(rows, np.empty(_CAPACITY, np.int64), np.empty(_CAPACITY, np.int64), trace)


@kernel
def _at(row: int, k: np.uint64) -> np.uint64:
    """Return the index of entry k of a row; unsigned, so that no one asks whether it counts from the end."""
    return np.uint64(row) + k


@kernel
def select(
    found: _Int64s, s: _Float32s, before: _Float32s, blind_until_ns: _Int64s, c: StepConstants
) -> tuple[int, int]:
    """Keep of a block's candidates those that can be solved, in place.

    Left out are those that stay blind through the step, pixels whose light is unreadable, and those whose light was so
    at the last step: their filter starts anew. Returns how many are kept and how many have unreadable light.
    """
    kept = unreadable = 0
    for pixel in found:
        i = np.uint64(pixel)
        u1, v0, reference = s[_at(_U, i)], before[_at(_V0, i)], s[_at(_REF, i)]
        if v0 != v0:
            s[_at(_V, i)] = u1
        unreadable += u1 != u1
        wait_ns = blind_until_ns[i] - c.t0_ns if reference != reference else 0
        found[kept] = pixel
        kept += (u1 == u1) & (v0 == v0) & (wait_ns <= c.h_ns)
    return kept, unreadable


@kernel
def gather(kept: _Int64s, s: _Float32s, before: _Float32s, first: int, table: Table, n: int) -> None:
    """Add candidates of the block that begins at pixel `first` to the table, from column n on."""
    rows = table.rows
    for j in range(kept.size):
        i, k = np.uint64(kept[j]), np.uint64(n + j)
        table.pixels[k] = first + kept[j]
        rows[_at(_C_U0, k)], rows[_at(_C_U1, k)] = before[_at(_U0, i)], s[_at(_U, i)]
        rows[_at(_C_V0, k)], rows[_at(_C_V1, k)] = before[_at(_V0, i)], s[_at(_V, i)]
        rows[_at(_C_L0, k)], rows[_at(_C_L1, k)] = before[_at(_L0, i)], s[_at(_L, i)]
        rows[_at(_C_S, k)], rows[_at(_C_LEAK, k)] = before[_at(_S, i)], s[_at(_LEAK, i)]
        rows[_at(_C_REF, k)], rows[_at(_C_ON, k)], rows[_at(_C_OFF, k)] = (
            s[_at(_REF, i)],
            s[_at(_ON, i)],
            s[_at(_OFF, i)],
        )


@kernel
def _find_starts(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Write from when on each candidate sees, as a share of the step."""
    for j in range(n):
        reference = table.rows[_C_REF + j]
        start = _ZERO
        if reference != reference:
            wait_ns = pixels.blind_until_ns[table.pixels[j]] - c.t0_ns
            start = np.float32(max(wait_ns, 0) / c.h_ns)
        table.rows[_C_START + j] = start


@vector_kernel
def _prepare(table: _Float32s, n: int, c: StepConstants) -> None:
    """Give each candidate its curve, its reference a (both relative to `base`) and its kind."""
    for j in range(n):
        u0, v0, u1, v1 = table[_C_U0 + j], table[_C_V0 + j], table[_C_U1 + j], table[_C_V1 + j]
        warped, reference, start = table[_C_S + j], table[_C_REF + j], table[_C_START + j]
        leak, on, off = table[_C_LEAK + j], table[_C_ON + j], table[_C_OFF + j]
        d = u1 - u0
        blind = reference != reference
        base = v0 + leak * c.since_epoch_0 if blind else reference
        d0 = (v0 - base) + leak * c.since_epoch_0
        d1 = (v1 - base) + leak * c.since_epoch_1
        rise = d1 - d0
        b = (v0 - u0) + d / warped
        s2 = warped * warped
        missed = abs(b) * min(s2 * s2 * np.float32(1 / 384), np.float32(0.16) * warped + np.float32(0.2))
        is_cubic = missed <= _SHARE * min(on, off)
        straight = (warped > _FAST) & (abs(b) < _FAINT)
        m0 = c.h * (table[_C_L0 + j] * (u0 - v0) + leak)
        m1 = c.h * (table[_C_L1 + j] * (u1 - v1) + leak)
        b = _ZERO if is_cubic | straight else b
        c1 = rise if straight else (m0 if is_cubic else d + leak * c.h)
        bend = is_cubic & (not straight)
        c2 = _THREE * rise - _TWO * m0 - m1 if bend else _ZERO
        c3 = m0 + m1 - _TWO * rise if bend else _ZERO
        # Slopes that are all of one sign where the curve is monotone; the middle one is for the cubic.
        first, last = c1 - b * warped, c1 + _TWO * c2 + _THREE * c3 - b * warped * (_ONE - decay(warped))
        middle = c1 + c2 if bend else last
        monotone = (min(min(first, last), middle) >= _ZERO) | (max(max(first, last), middle) <= _ZERO)
        at_start = _value(_Shape(d0, c1, c2, c3, b, warped), start)
        a = at_start if blind else _ZERO
        inside = (at_start - a < on) & (at_start - a > -off)
        fires = (d1 - a >= on) | (d1 - a <= -off)
        table[_C_BASE + j], table[_C_A + j] = base, a
        table[_C_D0 + j], table[_C_D1 + j], table[_C_B + j] = d0, d1, b
        table[_C_C1 + j], table[_C_C2 + j], table[_C_C3 + j] = c1, c2, c3
        idle = _SEES_AGAIN if blind else _NOTHING
        kind = _FIRES if fires else idle
        table[_C_KIND + j] = kind if monotone & inside & (straight | (abs(d) <= _LARGEST_CHANGE)) else _EXACT


class _Shape(NamedTuple):
    """A candidate's curve: ((c3 z + c2) z + c1) z + d0 - b (1 - e^(-s z)), with b = 0 or c2 = c3 = 0."""

    d0: Real
    c1: Real
    c2: Real
    c3: Real
    b: Real
    s: Real


@vector_kernel
def _value(f: _Shape, z: Real) -> Real:
    return (((f.c3 * z + f.c2) * z + f.c1) * z + f.d0) - f.b * decay(f.s * z)


@vector_kernel
def _cubic_value(f: _Shape, z: Real) -> Real:
    return ((f.c3 * z + f.c2) * z + f.c1) * z + f.d0


@vector_kernel
def _shape(rows: _Float32s, j: int) -> _Shape:
    c1, c2, c3 = rows[_C_C1 + j], rows[_C_C2 + j], rows[_C_C3 + j]
    return _Shape(rows[_C_D0 + j], c1, c2, c3, rows[_C_B + j], rows[_C_S + j])


@vector_kernel
def _cross_cubics(table: _Float32s, n: int) -> None:
    """Find where each candidate's monotone cubic meets its next level: z and the last Newton correction."""
    for j in range(n):
        f, d1, a, start = _shape(table, j), table[_C_D1 + j], table[_C_A + j], table[_C_START + j]
        sign = _ONE if d1 > a else -_ONE
        level = a + (table[_C_ON + j] if d1 > a else -table[_C_OFF + j])
        at_start = _cubic_value(f, start)
        low, high, step = start, _ONE, _ONE
        z = start + (_ONE - start) * (level - at_start) / (d1 - at_start)
        for _ in range(_CUBIC_TURNS):
            beyond = sign * (_cubic_value(f, z) - level)
            slope = sign * ((_THREE * f.c3 * z + _TWO * f.c2) * z + f.c1)
            low = low if beyond > _ZERO else z
            high = z if beyond > _ZERO else high
            newton = z - beyond / slope
            better = newton if (newton >= low) & (newton <= high) else _HALF * (low + high)
            step = better - z
            z = better
        table[_C_Z + j], table[_C_MISS + j] = z, abs(step)


@vector_kernel
def _cross(table: _Float32s, n: int) -> None:
    """Do as `_cross_cubics` for curves of both kinds.

    An exponential starts from the side from which Newton's steps do not overshoot.
    """
    for j in range(n):
        f, d1, a, start = _shape(table, j), table[_C_D1 + j], table[_C_A + j], table[_C_START + j]
        sign = _ONE if d1 > a else -_ONE
        level = a + (table[_C_ON + j] if d1 > a else -table[_C_OFF + j])
        at_start = _value(f, start)
        low, high, step = start, _ONE, _ONE
        secant = start + (_ONE - start) * (level - at_start) / (d1 - at_start)
        side = _ONE if sign * f.b > _ZERO else start
        z = secant if f.b == _ZERO else side
        for _ in range(_TURNS):
            risen = f.b * decay(f.s * z)
            beyond = sign * (_cubic_value(f, z) - risen - level)
            slope = sign * ((_THREE * f.c3 * z + _TWO * f.c2) * z + f.c1 - f.s * (f.b - risen))
            low = low if beyond > _ZERO else z
            high = z if beyond > _ZERO else high
            newton = z - beyond / slope
            better = newton if (newton >= low) & (newton <= high) else _HALF * (low + high)
            step = better - z
            z = better
        table[_C_Z + j], table[_C_MISS + j] = z, abs(step)


@kernel
def _halve(rows: _Float32s, j: int) -> None:
    """Find the crossing of candidate j by halving."""
    f, a = _shape(rows, j), rows[_C_A + j]
    rising = rows[_C_D1 + j] > a
    level = a + (rows[_C_ON + j] if rising else -rows[_C_OFF + j])
    low, high = rows[_C_START + j], _ONE
    for _ in range(_HALVINGS):
        z = _HALF * (low + high)
        if (_value(f, z) > level) == rising:
            high = z
        else:
            low = z
    rows[_C_Z + j] = high


@kernel
def _mend(table: Table, n: int) -> None:
    """Find by halving the crossings that Newton did not settle on in its fixed number of turns.

    These are listed first: in one loop the compiler would halve for all candidates and then choose.
    """
    unsettled = 0
    for j in range(n):
        table.odd[unsettled] = j
        unsettled += (table.rows[_C_KIND + j] == _FIRES) & (table.rows[_C_MISS + j] > _SETTLED)
    for k in range(unsettled):
        _halve(table.rows, table.odd[k])


@vector_kernel
def _follow(table: _Float32s, n: int, c: StepConstants) -> None:
    """Tell for each candidate that fires at z what comes next: reference, from when, and whether it fires again."""
    for j in range(n):
        a, d1, on, off = table[_C_A + j], table[_C_D1 + j], table[_C_ON + j], table[_C_OFF + j]
        sees_again = table[_C_Z + j] + c.refractory
        level = a + (on if d1 > a else -off)
        there = _value(_shape(table, j), sees_again)
        following = there if c.refractory > _ZERO else level
        fires = ((d1 - following >= on) | (d1 - following <= -off)) & (sees_again <= _ONE)
        table[_C_NEXT_A + j], table[_C_NEXT_START + j] = following, sees_again
        table[_C_NEXT_REF + j] = table[_C_BASE + j] + following if sees_again <= _ONE else _NAN
        table[_C_AGAIN + j] = _ONE if fires & (table[_C_KIND + j] == _FIRES) else _ZERO


@kernel
def _key(dt_ns: int, pixel: int, on: int, c: StepConstants) -> np.uint64:
    """Pack an event so that sorting the numbers sorts by (time, pixel): [dt_ns | pixel | on]."""
    return (np.uint64(dt_ns) << np.uint64(c.pixel_bits + 1)) | (np.uint64(pixel) << np.uint64(1)) | np.uint64(on)


@kernel_that_allocates
def _room(keys: _Keys, needed: int) -> _Keys:
    """Return `keys`, or a longer copy if it holds fewer than `needed`."""
    if needed <= keys.size:
        return keys
    longer = np.empty(max(2 * keys.size, needed), np.uint64)
    longer[: keys.size] = keys
    return longer


@kernel
def _keep(table: Table, j: int, k: int) -> None:
    """Move what a candidate needs for its next crossing from column j to column k."""
    rows = table.rows
    table.pixels[k] = table.pixels[j]
    rows[_C_A + k], rows[_C_START + k], rows[_C_KIND + k] = rows[_C_NEXT_A + j], rows[_C_NEXT_START + j], _FIRES
    for row in (_C_ON, _C_OFF, _C_BASE, _C_D0, _C_D1, _C_C1, _C_C2, _C_C3, _C_B, _C_S):
        rows[row + k] = rows[row + j]


@kernel
def _fire(pixels: Pixels, table: Table, n: int, keys: _Keys, n_keys: int, c: StepConstants) -> tuple[int, int]:
    """Write the events of those that fire, and their new references; return n_keys and how many fire again."""
    rows = table.rows
    again = 0
    for j in range(n):
        if rows[_C_KIND + j] != _FIRES:
            continue
        pixel, reference = table.pixels[j], rows[_C_NEXT_REF + j]
        dt_ns = min(int(rows[_C_Z + j] * c.h_ns), c.h_ns)
        keys[n_keys] = _key(dt_ns, pixel, rows[_C_D1 + j] > rows[_C_A + j], c)
        n_keys += 1
        pixels.fields[slot(pixel) + _REF] = reference
        if reference != reference:
            pixels.blind_until_ns[pixel] = c.t0_ns + dt_ns + c.refractory_ns
        if rows[_C_AGAIN + j] != _ZERO:
            _keep(table, j, again)
            again += 1
    return n_keys, again


@kernel
def _pixel(table: _Float32s, j: int) -> Pixel:
    """Return column j of the table for the exact solver."""
    return Pixel(
        log_light=np.float64(table[_C_U0 + j]),
        filtered=np.float64(table[_C_V0 + j]),
        rate=np.float64(table[_C_L0 + j]),
        log_light_after=np.float64(table[_C_U1 + j]),
        rate_after=np.float64(table[_C_L1 + j]),
        reference=np.float64(table[_C_REF + j]),
        on=np.float64(table[_C_ON + j]),
        off=np.float64(table[_C_OFF + j]),
        leak=np.float64(table[_C_LEAK + j]),
        start=np.float64(table[_C_START + j]),
    )


@kernel
def _step(c: StepConstants) -> Step:
    """Return the step for the exact solver."""
    return Step(
        h=np.float64(c.h),
        since_epoch=np.float64(c.since_epoch_0),
        refractory=np.float64(c.refractory),
        rate_at_reference=np.float64(c.rate_at_reference),
        rate_min=np.float64(c.rate_min),
        rate_max=np.float64(c.rate_max),
    )


@kernel
def _solve_one(pixels: Pixels, table: Table, j: int, keys: _Keys, n_keys: int, c: StepConstants) -> tuple[int, int]:
    """Solve candidate j in its exact form; return the new n_keys and the number of crossings beyond the cap."""
    pixel, trace = table.pixels[j], table.trace
    count, v1, reference, blind_end = solve_exactly(_pixel(table.rows, j), _step(c), trace)
    for k in range(min(count, MOST_EVENTS)):
        keys[n_keys + k] = _key(min(int(trace.z[k] * c.h_ns), c.h_ns), pixel, trace.on[k], c)
    pixels.fields[slot(pixel) + _V], pixels.fields[slot(pixel) + _REF] = v1, reference
    if reference != reference:
        pixels.blind_until_ns[pixel] = c.t0_ns + int(blind_end * c.h_ns)
    return n_keys + min(count, MOST_EVENTS), max(count - MOST_EVENTS, 0)


@kernel
def _sort_out(pixels: Pixels, table: Table, n: int) -> tuple[int, int]:
    """Store the references of those that see again and do not fire, and list those for the exact form.

    Returns how many need the exact form, and how many of those that fire have an exponential.

    A loop of its own, because it is the one over all candidates: see `compiled` on counting references.
    """
    odd = exponentials = 0
    for j in range(n):
        kind = table.rows[_C_KIND + j]
        table.odd[odd] = j
        odd += kind == _EXACT
        exponentials += (kind == _FIRES) & (table.rows[_C_B + j] != _ZERO)
        if kind == _SEES_AGAIN:
            pixels.fields[slot(table.pixels[j]) + _REF] = table.rows[_C_BASE + j] + table.rows[_C_A + j]
    return odd, exponentials


@kernel_that_allocates
def solve(pixels: Pixels, table: Table, n: int, keys: _Keys, n_keys: int, c: StepConstants) -> tuple[_Keys, int, int]:
    """Find all crossings of the n candidates, and move their references.

    Returns
    -------
    keys (replaced by a longer copy if there was no room), the number of events in it, and the number of crossings
    beyond MOST_EVENTS of a pixel.
    """
    _find_starts(pixels, table, n, c)
    _prepare(table.rows, n, c)
    event = lost = 0
    odd, exponentials = _sort_out(pixels, table, n)
    for k in range(odd):
        keys = _room(keys, n_keys + MOST_EVENTS)
        n_keys, more = _solve_one(pixels, table, table.odd[k], keys, n_keys, c)
        lost += more
    while n > 0:
        if exponentials:
            _cross(table.rows, n)
        else:
            _cross_cubics(table.rows, n)
        _mend(table, n)
        _follow(table.rows, n, c)
        keys = _room(keys, n_keys + n)
        counted, n = _fire(pixels, table, n, keys, n_keys, c)
        if event < MOST_EVENTS:
            n_keys = counted
        else:
            lost += counted - n_keys
        event += 1
    return keys, n_keys, lost

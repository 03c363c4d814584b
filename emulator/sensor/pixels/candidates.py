"""The pixels that may fire in a step: gathered in a table, solved together, column by column a pixel.

A candidate's filtered value, leak added and the reference subtracted, is taken as the cubic in time through its values
and derivatives at both ends of the step (both are known: the derivative is rate times what the filter lacks). What that
leaves out of the exponential in the filter's answer is at most |B| E(S), E = min(S^4 / 384, 0.16 S + 0.2); a plain step
where this is less than 1 % of a threshold, and whose cubic rises or falls all through, is solved here: its end values
tell whether it fires, and the crossing is found by a fixed number of Newton turns, kept in their bracket, for all
candidates of the table at once. Who fires again in the same step goes round again. All others walk through the step in
`pieces`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import Real, kernel, kernel_that_allocates, lane, vector_kernel
from emulator.sensor.numerics.elementary import exponential
from emulator.sensor.pixels.interpolation import is_plain
from emulator.sensor.pixels.lowpass import Course, missed_by_cubic, transient
from emulator.sensor.pixels.packed_crossings import MOST_EVENTS, Keys, pack, room_for
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, Field, Pixels, StepConstants, slot, whole_vectors
from emulator.sensor.pixels.substeps import WALK_CAPACITY, Start, Walk, enter, new_walk, walk_through

__all__ = ["BATCH", "Table", "gather", "new_table", "select", "solve"]

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P = (int(f) * BLOCK for f in Field)

_U0, _V0, _L0, _G0, _A0, _A1, _S, _, _W0, _P0, _, _ = BEFORE_ROWS

BATCH = BLOCK
"""Candidates from which on the table is solved; a block more fits."""

# Rows of the table; a little longer than a power of two, so that a column's entries do not all fall into the same set
# of the first cache.
_CAPACITY = WALK_CAPACITY
(
    _C_U0, _C_V0, _C_L0, _C_A0, _C_U1, _C_V1, _C_L1, _C_A1, _C_S, _C_REF, _C_ON, _C_OFF, _C_LEAK,
    _C_W0, _C_W1, _C_P0, _C_P1, _C_START, _C_BASE, _C_A, _C_D0, _C_D1, _C_C1, _C_C2, _C_C3, _C_KIND,
    _C_Z, _C_MISS, _C_NEXT_A, _C_NEXT_START, _C_NEXT_REF, _C_AGAIN,
) = (k * _CAPACITY for k in range(32))  # fmt: skip
_C_ROWS = 32

_NOTHING, _SEES_AGAIN, _FIRES, _ODD = (np.float32(kind) for kind in range(4))

_NAN = np.float32(np.nan)
_ZERO, _ONE, _TWO, _THREE, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 0.5))
_SHARE = np.float32(0.01)  # of a threshold: what the cubic may miss of the exponential
_NEWTON_TURNS = 4
_HALVINGS = 25
_SETTLED = np.float32(3e-5)  # last Newton correction; the error is of the order of its square


class Table(NamedTuple):
    """The candidates: float32 rows, their pixels, columns of which more is wanted, and those that walk.

    Kept from step to step by the caller: memory of this size, once freed, costs page faults when taken again.
    """

    rows: _Float32s
    pixels: _Int64s
    listed: _Int64s
    walk: Walk


def new_table() -> Table:
    """Return an empty table."""
    rows = np.zeros(_C_ROWS * _CAPACITY, np.float32)
    return Table(rows, np.empty(_CAPACITY, np.int64), np.empty(_CAPACITY, np.int64), new_walk())


@kernel
def _at(row: int, k: np.uint64) -> np.uint64:
    """Return the index of entry k of a row; unsigned, so that no one asks whether it counts from the end."""
    return np.uint64(row) + k


@kernel
def select(
    found: _Int64s, s: _Float32s, before: _Float32s, blind_until_ns: _Int64s, c: StepConstants
) -> tuple[int, int]:
    """Keep of a block's candidates those that are to be solved, in place.

    Left out are plain ones that stay blind through the step, pixels whose light is unreadable, and those whose light
    was so at the last step: their filter starts anew. Returns how many are kept and how many have unreadable light.
    """
    kept = unreadable = 0
    for pixel in found:
        i = np.uint64(pixel)
        u1, v0, reference = s[_at(_U, i)], before[_at(_V0, i)], s[_at(_REF, i)]
        if v0 != v0 or u1 != u1:
            s[_at(_V, i)] = s[_at(_W, i)] = u1
        unreadable += u1 != u1
        found[kept] = pixel
        if reference != reference and blind_until_ns[i] - c.t0_ns > c.h_ns:
            unseen = c.trust * min(s[_at(_ON, i)], s[_at(_OFF, i)])
            if is_plain(u1 - before[_at(_U0, i)], before[_at(_A0, i)], before[_at(_A1, i)], unseen):
                continue
        kept += (u1 == u1) & (v0 == v0)
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
        rows[_at(_C_A0, k)], rows[_at(_C_A1, k)] = before[_at(_A0, i)], before[_at(_A1, i)]
        rows[_at(_C_S, k)], rows[_at(_C_LEAK, k)] = before[_at(_S, i)], s[_at(_LEAK, i)]
        rows[_at(_C_ON, k)], rows[_at(_C_OFF, k)] = s[_at(_ON, i)], s[_at(_OFF, i)]
        rows[_at(_C_REF, k)] = s[_at(_REF, i)]


@kernel
def gather_rare(kept: _Int64s, s: _Float32s, before: _Float32s, n: int, table: Table, c: StepConstants) -> None:
    """Add what only sensors with a second pole or parasitic leak have."""
    rows = table.rows
    for j in range(kept.size):
        i, k = np.uint64(kept[j]), np.uint64(n + j)
        if c.second > _ZERO:
            rows[_at(_C_W0, k)], rows[_at(_C_W1, k)] = before[_at(_W0, i)], s[_at(_W, i)]
        if c.parasitic > _ZERO:
            rows[_at(_C_P0, k)], rows[_at(_C_P1, k)] = before[_at(_P0, i)], s[_at(_P, i)]


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
def _draw_curves(table: _Float32s, n: int, c: StepConstants) -> None:
    """Give each candidate its cubic, without leak; the kind is odd where not plain or where that misses too much."""
    for j in range(n):
        u0, v0, u1, v1 = table[_C_U0 + j], table[_C_V0 + j], table[_C_U1 + j], table[_C_V1 + j]
        r0, r1, a0, a1 = c.h * table[_C_L0 + j], c.h * table[_C_L1 + j], table[_C_A0 + j], table[_C_A1 + j]
        s, threshold = table[_C_S + j], min(table[_C_ON + j], table[_C_OFF + j])
        plain = is_plain(u1 - u0, a0, a1, c.trust * threshold)
        t = transient(u0 - v0, Course(s, u1 - u0, s * a0 / r0, s * a1 / r1))
        m0, m1 = r0 * (t.lag0 if t.faint else u0 - v0), r1 * (t.lag1 if t.faint else u1 - v1)
        fits = (_ZERO if t.faint else missed_by_cubic(t.b, s)) <= _SHARE * threshold
        table[_C_D0 + j], table[_C_D1 + j], table[_C_C1 + j], table[_C_C2 + j] = v0, v1, m0, m1
        table[_C_KIND + j] = _NOTHING if plain & fits else _ODD


@vector_kernel
def _draw_behind_second_pole(table: _Float32s, n: int, c: StepConstants) -> None:
    """Do so for what is behind the second pole."""
    for j in range(n):
        v0, v1, w0, w1 = table[_C_V0 + j], table[_C_V1 + j], table[_C_W0 + j], table[_C_W1 + j]
        t = transient(v0 - w0, Course(c.second, v1 - v0, table[_C_C1 + j], table[_C_C2 + j]))
        most = _SHARE * min(table[_C_ON + j], table[_C_OFF + j])
        fits = (_ZERO if t.faint else missed_by_cubic(t.b, c.second)) <= most
        table[_C_D0 + j], table[_C_D1 + j] = w0, w1
        table[_C_C1 + j] = c.second * (t.lag0 if t.faint else v0 - w0)
        table[_C_C2 + j] = c.second * (t.lag1 if t.faint else v1 - w1)
        table[_C_KIND + j] = table[_C_KIND + j] if fits else _ODD


@vector_kernel
def _add_parasitic(table: _Float32s, n: int, c: StepConstants) -> None:
    """Add what light leaks to each candidate's curve."""
    for j in range(n):
        leaks = c.h * c.parasitic * table[_C_ON + j]
        table[_C_D0 + j] += table[_C_P0 + j]
        table[_C_D1 + j] += table[_C_P1 + j]
        table[_C_C1 + j] += leaks * exponential(table[_C_U0 + j])
        table[_C_C2 + j] += leaks * exponential(table[_C_U1 + j])


@vector_kernel
def _sort_by_kind(table: _Float32s, n: int, c: StepConstants) -> None:
    """Add leak to each candidate's curve, put it and the reference a relative to `base`, and tell what happens."""
    for j in range(n):
        leak, on, off, start = table[_C_LEAK + j], table[_C_ON + j], table[_C_OFF + j], table[_C_START + j]
        reference, w0 = table[_C_REF + j], table[_C_D0 + j]
        blind = reference != reference
        base = w0 + leak * c.since_epoch_0 if blind else reference
        d0 = (w0 - base) + leak * c.since_epoch_0
        d1 = (table[_C_D1 + j] - base) + leak * c.since_epoch_1
        rise, m0, m1 = d1 - d0, table[_C_C1 + j] + c.h * leak, table[_C_C2 + j] + c.h * leak
        c2, c3 = _THREE * rise - _TWO * m0 - m1, m0 + m1 - _TWO * rise
        middle = m0 + c2
        monotone = (min(min(m0, m1), middle) >= _ZERO) | (max(max(m0, m1), middle) <= _ZERO)
        at_start = ((c3 * start + c2) * start + m0) * start + d0
        a = at_start if blind else _ZERO
        inside = (at_start - a < on) & (at_start - a > -off)
        fires = (d1 - a >= on) | (d1 - a <= -off)
        table[_C_BASE + j], table[_C_A + j] = base, a
        table[_C_D0 + j], table[_C_D1 + j] = d0, d1
        table[_C_C1 + j], table[_C_C2 + j], table[_C_C3 + j] = m0, c2, c3
        idle = _SEES_AGAIN if blind else _NOTHING
        kind = _FIRES if fires else idle
        table[_C_KIND + j] = kind if monotone & inside & (table[_C_KIND + j] != _ODD) else _ODD


@lane
def _value(rows: _Float32s, j: int, z: Real) -> Real:
    return ((rows[_C_C3 + j] * z + rows[_C_C2 + j]) * z + rows[_C_C1 + j]) * z + rows[_C_D0 + j]


@vector_kernel
def _cross(table: _Float32s, n: int) -> None:
    """Find where each candidate's monotone cubic meets its next level: z and the last Newton correction."""
    for j in range(n):
        d1, a, start = table[_C_D1 + j], table[_C_A + j], table[_C_START + j]
        c1, c2, c3 = table[_C_C1 + j], table[_C_C2 + j], table[_C_C3 + j]
        sign = _ONE if d1 > a else -_ONE
        level = a + (table[_C_ON + j] if d1 > a else -table[_C_OFF + j])
        at_start = _value(table, j, start)
        low, high, step = start, _ONE, _ONE
        z = start + (_ONE - start) * (level - at_start) / (d1 - at_start)
        for _ in range(_NEWTON_TURNS):
            beyond = sign * (_value(table, j, z) - level)
            slope = sign * ((_THREE * c3 * z + _TWO * c2) * z + c1)
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
    a = rows[_C_A + j]
    rising = rows[_C_D1 + j] > a
    level = a + (rows[_C_ON + j] if rising else -rows[_C_OFF + j])
    low, high = rows[_C_START + j], _ONE
    for _ in range(_HALVINGS):
        z = _HALF * (low + high)
        if (_value(rows, j, z) > level) == rising:
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
        table.listed[unsettled] = j
        unsettled += (table.rows[_C_KIND + j] == _FIRES) & (table.rows[_C_MISS + j] > _SETTLED)
    for k in range(unsettled):
        _halve(table.rows, table.listed[k])


@vector_kernel
def _follow(table: _Float32s, n: int, c: StepConstants) -> None:
    """Tell for each candidate that fires at z what comes next: reference, from when, and whether it fires again."""
    for j in range(n):
        a, d1, on, off = table[_C_A + j], table[_C_D1 + j], table[_C_ON + j], table[_C_OFF + j]
        sees_again = table[_C_Z + j] + c.refractory
        level = a + (on if d1 > a else -off)
        there = _value(table, j, sees_again)
        following = there if c.refractory > _ZERO else level
        fires = ((d1 - following >= on) | (d1 - following <= -off)) & (sees_again <= _ONE)
        table[_C_NEXT_A + j], table[_C_NEXT_START + j] = following, sees_again
        table[_C_NEXT_REF + j] = table[_C_BASE + j] + following if sees_again <= _ONE else _NAN
        table[_C_AGAIN + j] = _ONE if fires & (table[_C_KIND + j] == _FIRES) else _ZERO


@kernel
def _keep(table: Table, j: int, k: int) -> None:
    """Move what a candidate needs for its next crossing from column j to column k."""
    rows = table.rows
    table.pixels[k] = table.pixels[j]
    rows[_C_A + k], rows[_C_START + k], rows[_C_KIND + k] = rows[_C_NEXT_A + j], rows[_C_NEXT_START + j], _FIRES
    for row in (_C_ON, _C_OFF, _C_BASE, _C_D0, _C_D1, _C_C1, _C_C2, _C_C3):
        rows[row + k] = rows[row + j]


@kernel
def _fire(pixels: Pixels, table: Table, n: int, keys: Keys, n_keys: int, c: StepConstants) -> tuple[int, int]:
    """Write the events of those that fire, and their new references; return n_keys and how many fire again."""
    rows = table.rows
    again = 0
    for j in range(n):
        if rows[_C_KIND + j] != _FIRES:
            continue
        pixel, reference = table.pixels[j], rows[_C_NEXT_REF + j]
        dt_ns = min(int(rows[_C_Z + j] * c.h_ns), c.h_ns)
        keys[n_keys] = pack(dt_ns, pixel, rows[_C_D1 + j] > rows[_C_A + j], c.pixel_bits)
        n_keys += 1
        pixels.fields[slot(pixel) + _REF] = reference
        if reference != reference:
            pixels.blind_until_ns[pixel] = c.t0_ns + dt_ns + c.refractory_ns
        if rows[_C_AGAIN + j] != _ZERO:
            _keep(table, j, again)
            again += 1
    return n_keys, again


@kernel
def _start(rows: _Float32s, j: int, c: StepConstants) -> Start:
    """Return column j of the table as the start of a walk."""
    return Start(
        u0=rows[_C_U0 + j],
        u1=rows[_C_U1 + j],
        a0=rows[_C_A0 + j],
        a1=rows[_C_A1 + j],
        v=rows[_C_V0 + j],
        w=rows[_C_W0 + j] if c.second > _ZERO else rows[_C_V0 + j],
        leaked=rows[_C_P0 + j] if c.parasitic > _ZERO else _ZERO,
        reference=rows[_C_REF + j],
        sees=rows[_C_START + j],
        on=rows[_C_ON + j],
        off=rows[_C_OFF + j],
        leak=rows[_C_LEAK + j],
    )


@kernel
def _sort_out(pixels: Pixels, table: Table, n: int, c: StepConstants) -> int:
    """Store the references of those that see again and do not fire; let the odd ones walk, return how many.

    A loop of its own, because it is the one over all candidates: see `compiled` on counting references.
    """
    rows, odd = table.rows, 0
    for j in range(n):
        kind = rows[_C_KIND + j]
        if kind == _ODD:
            enter(table.walk, odd, table.pixels[j], _start(rows, j, c))
            odd += 1
        elif kind == _SEES_AGAIN:
            pixels.fields[slot(table.pixels[j]) + _REF] = rows[_C_BASE + j] + rows[_C_A + j]
    return odd


@kernel
def _fold_parasitic(pixels: Pixels, table: Table, n: int) -> None:
    """Move what light has leaked into the references of those that fire or read theirs anew; its sum starts at zero."""
    for j in range(n):
        kind = table.rows[_C_KIND + j]
        if (kind == _FIRES) | (kind == _SEES_AGAIN):
            table.rows[_C_BASE + j] -= table.rows[_C_P1 + j]
            pixels.fields[slot(table.pixels[j]) + _P] = _ZERO


@kernel_that_allocates
def solve(
    pixels: Pixels, table: Table, n: int, keys: Keys, n_keys: int, c: StepConstants
) -> tuple[Keys, int, int, int]:
    """Find all crossings of the n candidates, and move their references.

    Returns
    -------
    keys (replaced by a longer copy if there was no room), the number of events in it, the number of crossings
    beyond MOST_EVENTS of a pixel, and the number of suspect pixels.
    """
    _find_starts(pixels, table, n, c)
    _draw_curves(table.rows, whole_vectors(n), c)
    if c.second > _ZERO:
        _draw_behind_second_pole(table.rows, whole_vectors(n), c)
    if c.parasitic > _ZERO:
        _add_parasitic(table.rows, whole_vectors(n), c)
    _sort_by_kind(table.rows, whole_vectors(n), c)
    if c.parasitic > _ZERO:
        _fold_parasitic(pixels, table, n)
    odd = _sort_out(pixels, table, n, c)
    keys, n_keys, lost, suspects = walk_through(pixels, table.walk, odd, keys, n_keys, c)
    event = 0
    while n > 0:
        _cross(table.rows, whole_vectors(n))
        _mend(table, n)
        _follow(table.rows, whole_vectors(n), c)
        keys = room_for(keys, n_keys + n)
        counted, n = _fire(pixels, table, n, keys, n_keys, c)
        if event < MOST_EVENTS:
            n_keys = counted
        else:
            lost += counted - n_keys
        event += 1
    return keys, n_keys, lost, suspects

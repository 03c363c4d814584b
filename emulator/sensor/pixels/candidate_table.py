"""The table of candidates, one column a pixel, and how the candidates of a block come into it.

A row is named by its first index in the flat array, so `rows[REF + j]` is the reference of candidate j.
"""

from __future__ import annotations

from enum import IntEnum, auto
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import NONE, inlined, kernel
from emulator.sensor.numerics.elementary import aligned_zeros
from emulator.sensor.pixels import curve
from emulator.sensor.pixels.idle import pixel_at
from emulator.sensor.pixels.passages.rows import Visits, new_visits
from emulator.sensor.pixels.receptor import MOST_BEHIND
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, Field, StepConstants
from emulator.sensor.pixels.substeps import CAPACITY, SubstepTable, new_substep_table

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Words = npt.NDArray[np.uint64]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P, _, _, _, _, _Y = (int(f) * BLOCK for f in Field)

_U0, _V0, _L0, _G0, _A0, _A1, _S, _, _W0, _P0, _, _, _Y0 = BEFORE_ROWS

BATCH, NOISY_BATCH = BLOCK, 3 * BLOCK
"""Candidates from which on the table is solved, without noise and with it; a block more fits."""

MOST_WAITING = BLOCK
"""Pixels with noise in the table of substeps that wait for those of the next batch, for which there is room."""

# Rows of the table, by their first index in the flat array.
(
    U0, V0, L0, A0, U1, V1, L1, A1, S, REF, ON, OFF, LEAK,
    W0, W1, P0, P1, START, BASE, A, D0, D1, C1, C2, C3, KIND,
    Z, MISS, NEXT_A, NEXT_START, NEXT_REF, AGAIN, LIT,
    RESET, NEXT_RESET, LATE, Y0, Y1, UP,
    TRUE_ON, TRUE_OFF, N, RMS, ON_LEFT, OFF_LEFT, SINCE, UNIFORM, KEPT, FRESH, KEPT2, FRESH2, OF_NOISE,
    DUE, CLOCK, SIGN, NEXT_ON, NEXT_OFF, NEXT_DUE, NEXT_SIGN,
) = (k * CAPACITY for k in range(59))  # fmt: skip
_ROWS = 59
NOTHING, RE_ARMS, FIRES, NEEDS_SUBSTEPS = (np.float32(kind) for kind in range(4))
"""Kinds of candidates."""

_ZERO = np.float32(0)


class Draw(IntEnum):
    """Rows of the resets that are drawn, by their first index."""

    @staticmethod
    def _generate_next_value_(name: str, start: int, count: int, last_values: list[int]) -> int:
        return count * CAPACITY

    RATE = auto()  # of the receptor's pole, 1/s
    RMS = auto()  # of the noise behind the receptor, ln units
    SPEED = auto()  # of the signal, ln units a second
    MOVED = auto()  # of the signal since the reset before, at the event, ln units
    NOISE = auto()  # at the event, ln units
    UP = auto()  # 1: the event was ON, -1: OFF, 0: there was none
    DEAD = auto()  # dead time behind it, s
    ON = auto()  # thresholds, ln units
    OFF = auto()
    # Random numbers: a normal one, five exponential ones.
    NORMAL = auto()
    ON_LEFT = auto()
    OFF_LEFT = auto()
    ON_CLOCK = auto()
    OFF_CLOCK = auto()
    FRESH = auto()
    # Results.
    N = auto()  # noise at the end of the dead time
    ON_LEVEL = auto()  # ways at SPEED, and at NEAR, ln units
    OFF_LEVEL = auto()
    ON_LIMIT = auto()
    OFF_LIMIT = auto()
    WAIT = auto()  # until the event in still light, s, and rate of such events, 1/s
    HZ = auto()
    NEXT = auto()  # until that of a signal that goes on at SPEED, and its polarity, 1 or -1
    SIGN = auto()


class Draws(NamedTuple):
    """Resets that are drawn together: rows, and the keys of their random numbers."""

    rows: _Float32s
    keys: _Words


def new_draws() -> Draws:
    """Return an empty table."""
    return Draws(aligned_zeros(len(Draw) * CAPACITY), np.zeros(CAPACITY, np.uint64))


class Table(NamedTuple):
    """The candidates: float32 rows, their pixels, room to list columns, and tables of substeps and of noise.

    The caller uses one table for all steps: memory of this size costs page faults when it is allocated again.
    """

    rows: _Float32s
    pixels: _Int64s
    listed: _Int64s
    substep_table: SubstepTable
    visits: Visits
    draws: Draws


def new_table() -> Table:
    """Return an empty table."""
    rows = aligned_zeros(_ROWS * CAPACITY)
    for never in (DUE, NEXT_DUE):  # where no event comes in still light
        rows[never : never + CAPACITY] = 2
    pixels, listed = np.empty(CAPACITY, np.int64), np.empty(CAPACITY, np.int64)
    return Table(rows, pixels, listed, new_substep_table(), new_visits(), new_draws())


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
        rows[entry_at(U0, k)], rows[entry_at(U1, k)] = before[entry_at(_U0, i)], s[entry_at(_U, i)]
        rows[entry_at(V0, k)], rows[entry_at(V1, k)] = before[entry_at(_V0, i)], s[entry_at(_V, i)]
        rows[entry_at(L0, k)], rows[entry_at(L1, k)] = before[entry_at(_L0, i)], s[entry_at(_L, i)]
        rows[entry_at(A0, k)], rows[entry_at(A1, k)] = before[entry_at(_A0, i)], before[entry_at(_A1, i)]
        rows[entry_at(S, k)] = before[entry_at(_S, i)]
        # the comparator
        rows[entry_at(LEAK, k)] = s[entry_at(_LEAK, i)]
        rows[entry_at(ON, k)], rows[entry_at(OFF, k)] = s[entry_at(_ON, i)], s[entry_at(_OFF, i)]
        rows[entry_at(REF, k)] = s[entry_at(_REF, i)]


@kernel
def gather_rare(selected: _Int64s, s: _Float32s, before: _Float32s, n: int, table: Table, c: StepConstants) -> None:
    """Add the state behind a second pole or a high-pass and of parasitic leak; `_complete_parasitic` follows."""
    rows = table.rows
    for j in range(selected.size):
        i, k = np.uint64(selected[j]), np.uint64(n + j)
        if c.second > _ZERO:
            rows[entry_at(W0, k)], rows[entry_at(W1, k)] = before[entry_at(_W0, i)], s[entry_at(_W, i)]
        if c.parasitic > _ZERO:
            rows[entry_at(P0, k)], rows[entry_at(P1, k)] = before[entry_at(_P0, i)], s[entry_at(_P, i)]
        if c.high > _ZERO:
            rows[entry_at(Y0, k)] = before[entry_at(_Y0, i)]

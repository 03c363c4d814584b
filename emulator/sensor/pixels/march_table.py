"""The table of the pixels that need substeps: one column a pixel, one row a quantity.

A row is named by its first index in the flat array, so `rows[march_table.Z + j]` is quantity Z of column j. The first
`STEP_ROWS` rows hold for the whole step and move with a column; the others are rewritten for each substep.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import Real, kernel
from emulator.sensor.numerics.elementary import aligned_zeros
from emulator.sensor.pixels.state import BLOCK

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]

CAPACITY = 2 * BLOCK + 16
"""Columns; a little more than a power of two, so that a column's entries do not all fall into one set of the cache."""

STEP_ROWS = 19
# Light: value at the start, change, both slopes, its form and where that changes, width of a substep. State: filter,
# second pole, parasitic leak. Position z; base and level of the comparator, when it is re-armed; thresholds, leak,
# number of events, offset of the reference after the last reset.
(
    U, D, A0, A1, FORM, KNOT, WIDTH, V, W, P, Z, BASE, LEVEL, RE_ARMED, ON, OFF, LEAK, COUNT, RESET,
) = (k * CAPACITY for k in range(STEP_ROWS))  # fmt: skip
# The curve of a substep g = d0 + c1 x + c2 x^2 + c3 x^3 with x in [0, 1], its turns, its width and end; the position x,
# whether it fires and where, bounds and level of that crossing, the last Newton correction; light at both ends.
(
    D0, C1, C2, C3, TURN, TURN2, SPAN, V1, W1, P1, Z1,
    X, FIRES, HIT, LOW, HIGH, TO, MISS, UNDERSAMPLED, U0, U1, SLOPE0, SLOPE1, D1, M1,
) = (k * CAPACITY for k in range(STEP_ROWS, STEP_ROWS + 25))  # fmt: skip
_ROWS = STEP_ROWS + 25


class SubstepTable(NamedTuple):
    """The table: float32 rows, pixels of the columns, and a list of columns whose root has not settled."""

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
    reference: Real  # NaN: in its refractory period until `re_armed`
    re_armed: Real  # as a share of the step
    on: Real
    off: Real
    leak: Real
    reset: Real  # offset of the reference after the last reset


def new_substep_table() -> SubstepTable:
    """Return an empty table."""
    rows = aligned_zeros(_ROWS * CAPACITY)
    return SubstepTable(rows, np.empty(CAPACITY, np.int64), np.empty(CAPACITY, np.int64))


@kernel
def enter(table: SubstepTable, j: int, pixel: int, p: Start) -> None:
    """Write a pixel into column j."""
    rows = table.rows
    table.pixels[j] = pixel
    rows[U + j], rows[D + j], rows[A0 + j], rows[A1 + j] = p.u0, p.u1 - p.u0, p.a0, p.a1
    rows[V + j], rows[W + j], rows[P + j], rows[RE_ARMED + j] = p.v, p.w, p.leaked, p.re_armed
    rows[BASE + j], rows[ON + j], rows[OFF + j], rows[LEAK + j] = p.reference, p.on, p.off, p.leak
    rows[RESET + j] = p.reset

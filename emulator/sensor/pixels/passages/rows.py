"""Tables of the pixels of a step with noise: one column a pixel, one row a quantity, in one flat array each.

    Visit       all pixels that are solved: state, curve of the piece, noise's parameters, and what becomes of them
    Column      those of them in which an event may come in the piece; `rounds` takes each through its states

A row is named by its first index, so `rows[Visit.C1 + j]` is quantity C1 of pixel j. Times within a piece are in units
of its length, from 0 to 1, and values of the comparator in ln units from that at its start.

States of a column, and the kernel that takes it to the next state:

    BURST    a part of the time shortly after a reset is next      bursts.bound     DONE, PART, SLICE, FIRST, DIRECT
    PART     a part is next in which the noise has settled         settled.part     DONE, PART, BURST, FIRED
    FIRED    the event is in the part that was integrated          settled.locate   PLACED
    FIRST    values at the start of a slice of a burst are missing bursts.slice_    SLICE
    SLICE    a slice of a burst is next                            bursts.slice_    SLICE, PART, BURST, DONE, CUT
    DIRECT   a fast approach in a burst                            bursts.direct    PLACED, SLICE, FIRST
    CUT      the event is in the slice that was integrated         bursts.choose    SEEK, PLACED
    SEEK     it is in a slice of an approach                       bursts.seek      PLACED
    PLACED   time and noise of the event are known                 resets.reset     DONE, PART and those of BURST
    DONE     the end of the piece is reached
"""

from __future__ import annotations

from enum import IntEnum, auto
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.moments import Noise
from emulator.sensor.numerics.columns import put, take
from emulator.sensor.numerics.compiled import Real, inlined, lane
from emulator.sensor.numerics.elementary import aligned_zeros
from emulator.sensor.pixels.substeps import CAPACITY

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Int32s = npt.NDArray[np.int32]
_Words = npt.NDArray[np.uint64]

WIDTH = 16
"""Columns of a vector: kernels run over whole ones."""


class Visit(IntEnum):
    """Rows of the visited pixels, by their first index."""

    @staticmethod
    def _generate_next_value_(name: str, start: int, count: int, last_values: list[int]) -> int:
        return count * CAPACITY

    # The curve, a cubic without its value at the start: c1 x + c2 x^2 + c3 x^3; leaks included.
    C1 = auto()
    C2 = auto()
    C3 = auto()
    BASE = auto()  # value at the start, ln units, and the start since that of the step, s
    BEGIN = auto()
    SPAN = auto()  # length of the piece, s
    RATE0 = auto()  # of the receptor's pole at both ends, 1/s
    RATE1 = auto()
    RMS = auto()  # of the noise behind the receptor, ln units
    ON = auto()  # thresholds, ln units
    OFF = auto()
    LEAK = auto()  # ln units a second
    LIT = auto()  # of it, that by the light
    STILL = auto()  # 1: the light does not change
    FASTEST = auto()  # bound of the value's speed, ln units a second, as the quiet pass has it
    # State.
    REFERENCE = auto()  # from the value at the start; NaN in a dead time
    LEFT = auto()  # what is left of the drawn number
    N = auto()  # value and slope of the noise at the last reset, ln units and a second
    V = auto()
    RESET = auto()  # time of the last reset
    RESTED = auto()  # time since the last visit, before the piece
    SEEN = auto()  # value then, from the reference
    COUNT = auto()  # events in this step
    # Results.
    FLAG = auto()  # above 0: an event may come
    ON_LIMIT = auto()  # the certificate, see `Field`
    OFF_LIMIT = auto()
    SPEED = auto()
    LASTS = auto()  # s from the end of the piece


class Column(IntEnum):
    """Rows of the columns, by their first index, in the order in which states use them: see `GROUPS`."""

    @staticmethod
    def _generate_next_value_(name: str, start: int, count: int, last_values: list[int]) -> int:
        return count * CAPACITY

    STATE = auto()
    C1 = auto()
    C2 = auto()
    C3 = auto()
    TURN = auto()  # times at which the curve turns; 1: it does not
    TURN2 = auto()
    ON = auto()
    OFF = auto()
    # The noise at the start and its change over the piece, see `Noise`; rates in units of the piece.
    SIGMA = auto()
    D_SIGMA = auto()
    RATE = auto()
    D_RATE = auto()
    A1 = auto()
    D_A1 = auto()
    A2 = auto()
    D_A2 = auto()
    Z = auto()
    D_Z = auto()
    APART = auto()
    BURST = auto()  # length of a burst
    DEAD = auto()  # the dead time without the comparator's delay
    SPAN = auto()  # s
    REFERENCE = auto()
    LEFT = auto()
    N = auto()
    V = auto()  # ln units a piece
    RESET = auto()
    POLARITY = auto()  # uniform number that decides the polarity where both thresholds are near
    OFFSET = auto()  # of a reference from the signal, by the circuit of the reset
    AT = auto()  # time up to which the column is solved
    LIMIT = auto()  # end of a shortened part; 2: none
    # Of a burst.
    BURST_END = auto()  # of its present part
    SKIPPED = auto()  # time up to which little can happen; -1: none
    CUT_AT = auto()  # end of a halved slice; 2: none
    HALVINGS = auto()
    BEGINS = auto()  # 1: the slice begins at the reset
    ON_RATE0 = auto()  # at the start of a slice: hazards, distances, speeds
    OFF_RATE0 = auto()
    ON_C0 = auto()
    OFF_C0 = auto()
    ON_NU0 = auto()
    OFF_NU0 = auto()
    SLOPE0 = auto()
    Z0 = auto()
    # Of the part or slice that was integrated.
    END = auto()
    ON_INTEGRAL = auto()
    OFF_INTEGRAL = auto()
    ON_SPEED = auto()
    OFF_SPEED = auto()
    CELL = auto()  # bit 0: ON was a cell, bit 1: OFF was
    # Of the event.
    EVENT = auto()  # its time
    SIGN = auto()  # 1: ON, -1: OFF
    C = auto()
    NU = auto()
    SLOPE = auto()
    DEVIATION = auto()
    PULL = auto()
    MEAN_SLOPE = auto()
    EVENT_Z = auto()
    # Of the slice that an event is in.
    ON_MIDDLE = auto()  # hazards in its middle
    OFF_MIDDLE = auto()
    ON_RATE1 = auto()  # at its end
    OFF_RATE1 = auto()
    TELESCOPED = auto()  # bit 0: ON was integrated over the distance, bit 1: OFF was
    # Random numbers of an event, and what follows from it.
    NORMAL = auto()
    NORMAL2 = auto()
    SHARE = auto()
    DRAWN = auto()
    LATE = auto()  # delay of the comparator
    OF_NOISE = auto()  # 1: the signal has gone less than half of the way


class State(IntEnum):
    """States of a column."""

    DONE = 0
    PART = 1
    FIRED = 2
    SLICE = 3
    BURST = 4
    PLACED = 5
    CUT = 6
    DIRECT = 7
    FIRST = 8
    SEEK = 9


STATES = len(State)
(
    DONE, PART, FIRED, SLICE, BURST, PLACED, CUT, DIRECT, FIRST, SEEK,
) = (np.float32(state) for state in State)  # fmt: skip

GROUPS = tuple(
    (column - Column.STATE) // CAPACITY
    for column in (Column.STATE, Column.BURST_END, Column.END, Column.ON_MIDDLE, Column.NORMAL)
)
"""First rows of groups, and their end: of all states, of bursts, of events, of events in slices."""

IN_PARTS, IN_BURSTS, IN_EVENTS, IN_SLICES = 1, 2, 4, 8
"""Bits of the groups."""


class Columns(NamedTuple):
    """The columns, and what is whole numbers of them."""

    rows: _Float32s
    visits: _Int32s  # place of each among the visited pixels
    streams: _Words  # of random numbers
    keys: _Words  # of those of its event
    resets_ns: _Int64s  # stream times of the last reset
    counts: _Int64s  # columns of each state
    pairs: _Int32s  # places to be exchanged, the groups of rows that they use, and those of one group
    groups: _Int32s
    chosen: _Int32s


class Visits(NamedTuple):
    """The visited pixels, and what is whole numbers of them."""

    rows: _Float32s
    streams: _Words
    resets_ns: _Int64s
    columns: Columns


def new_visits() -> Visits:
    """Return empty tables."""
    words, times = (np.zeros((2, CAPACITY), kind) for kind in (np.uint64, np.int64))
    columns = Columns(
        aligned_zeros(len(Column) * CAPACITY),
        np.zeros(CAPACITY, np.int32),
        words[0],
        np.zeros(CAPACITY, np.uint64),
        times[0],
        np.zeros(STATES, np.int64),
        *np.zeros((3, 2 * CAPACITY), np.int32),
    )
    rows = aligned_zeros(len(Visit) * CAPACITY)
    return Visits(rows, words[1], times[1], columns)


@inlined
def whole_vectors(n: int) -> int:
    """Return n rounded up to whole vectors."""
    return (n + WIDTH - 1) // WIDTH * WIDTH


class Curve(NamedTuple):
    """The curve of a piece, see `Visit`."""

    c1: Real
    c2: Real
    c3: Real


_ONE, _TWO, _THREE, _SIX = (np.float32(x) for x in (1, 2, 3, 6))


@lane
def curve_of(rows: _Float32s, i: int) -> Curve:
    """Return the curve of column i."""
    return Curve(take(rows, Column.C1 + i), take(rows, Column.C2 + i), take(rows, Column.C3 + i))


@lane
def value_at(curve: Curve, x: Real) -> Real:
    """Return a curve's value."""
    return ((curve.c3 * x + curve.c2) * x + curve.c1) * x


@lane
def speed_at(curve: Curve, x: Real) -> Real:
    """Return a curve's slope."""
    return (_THREE * curve.c3 * x + _TWO * curve.c2) * x + curve.c1


@lane
def bend_at(curve: Curve, x: Real) -> Real:
    """Return a curve's second derivative."""
    return _SIX * curve.c3 * x + _TWO * curve.c2


@lane
def noise_at(rows: _Float32s, i: int, x: Real) -> Noise:
    """Return the noise of column i at a time."""
    return Noise(
        take(rows, Column.SIGMA + i) + take(rows, Column.D_SIGMA + i) * x,
        take(rows, Column.RATE + i) + take(rows, Column.D_RATE + i) * x,
        take(rows, Column.Z + i) + take(rows, Column.D_Z + i) * x,
        take(rows, Column.APART + i),
        take(rows, Column.A1 + i) + take(rows, Column.D_A1 + i) * x,
        take(rows, Column.A2 + i) + take(rows, Column.D_A2 + i) * x,
    )


@lane
def chosen(rows: _Float32s, at: int, other: int, of_first: Real) -> Real:
    """Return the value at one of two indices: a weight, 1 or 0, in place of a choice.

    From a choice LLVM makes a load from a chosen address, which does not become a vector.
    """
    return of_first * take(rows, at) + (_ONE - of_first) * take(rows, other)


@lane
def replace(rows: _Float32s, at: int, value: Real, if_: Real) -> None:
    """Store a value where a condition holds, else store the present one again: a branch would not become a vector."""
    put(rows, at, value if if_ else take(rows, at))

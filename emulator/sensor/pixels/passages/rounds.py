"""Columns through a piece: rounds of kernels, each over the columns that are in its state.

A round runs the kernel of one state over the range that holds its columns; columns of other states in that range stay
as they are. States take turns in the order in which a column goes through them, so that most columns are in the same.
Where a small share of a range is useful, its columns are exchanged to the front first.
A column's own arithmetic does not depend on which others are with it, so its events do not.

Fast because 16 columns are in flight at once, and because an exchange moves only the rows that a state uses, row by
row.

Resets. The noise leaves through a threshold with a slope that is drawn (`exit_speed`); value and slope are carried
over the dead time exactly, with two normal numbers. The new reference is signal plus noise at its end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.hazard import ONE_POLE, exit_speed
from emulator.sensor.noise.moments import Start, moments_over
from emulator.sensor.numerics.columns import Packed, put, take
from emulator.sensor.numerics.compiled import NONE, cached_kernel, kernel, vector_kernel
from emulator.sensor.numerics.elementary import decay, natural_log, use_widest_vectors
from emulator.sensor.numerics.keyed import exponential_float, high, mix_word, unit
from emulator.sensor.pixels.crossings import Keys, pack
from emulator.sensor.pixels.event_time import delay_s
from emulator.sensor.pixels.passages import bursts, settled
from emulator.sensor.pixels.passages.rows import (
    BURST,
    DIRECT,
    DONE,
    FIRED,
    FIRST,
    GROUPS,
    IN_BURSTS,
    IN_EVENTS,
    IN_PARTS,
    IN_SLICES,
    PART,
    PLACED,
    SLICE,
    STATES,
    WIDTH,
    Column,
    Columns,
    State,
    Visit,
    Visits,
    chosen,
    curve_of,
    noise_at,
    replace,
    speed_at,
    value_at,
    whole_vectors,
)
from emulator.sensor.pixels.passages.visiting import Constants, fill
from emulator.sensor.pixels.state import StepConstants, reset_offset_at
from emulator.sensor.pixels.substeps import CAPACITY

_Float32s = npt.NDArray[np.float32]
_Int32s = npt.NDArray[np.int32]
_Int64s = npt.NDArray[np.int64]
_Bytes = npt.NDArray[np.uint8]
_Words = npt.NDArray[np.uint64]

MOST_PASSAGES = 1024
"""Most events of a pixel in a step. The rest of its piece is lost in the pixel, and counted at the rate until then."""

_SPARSE_IN = {
    State.PART: 0.2, State.FIRED: 0.2, State.PLACED: 0.2, State.BURST: 0.2, State.DIRECT: 0.4, State.SLICE: 0.5,
    State.CUT: 0.1, State.SEEK: 0.4,
}  # fmt: skip
"""States in the order in which a column goes through them, and the useful share of a range below which its columns are
exchanged to the front: that costs as much as two to ten columns in a kernel; but those in slices stay for several."""

_SPARSE_OF = np.array([_SPARSE_IN.get(state, 0.0) for state in State])
_TURNS = np.array([*_SPARSE_IN, State.PLACED], np.int64)
_TOO_FEW = 0.1
"""Share of the columns below which a state is left for the next one."""

_SPARSE = 0.5
"""The share of those not DONE below which these are."""

_MOST_LOST = 1e9
_ANY = np.float32(-1)  # instead of a state: all that are not DONE
# Purposes of an event's random numbers.
_OF_EVENT, _OF_RESET = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xD6E8FEB86659FD93)
ALL_GROUPS = IN_PARTS | IN_BURSTS | IN_EVENTS | IN_SLICES
# Of resets.
_ZERO, _HALF, _ONE, _TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
_NAN = np.float32(np.nan)
_DEEP = np.float32(-4)  # deviations behind a threshold at which the noise may be any
_STEEPEST = np.float32(1e6)
_LEAST_DEVIATION = np.float32(1e-10)
_S16, _S32, _S40, _MASK, _LAST = (np.uint64(n) for n in (16, 32, 40, 0xFFFFFF, 0xFFFF))
_SECOND = np.uint64(0x9E3779B97F4A7C15)
_UNIT_16, _UNIT_24 = np.float32(2.0**-16), np.float32(2.0**-24)
# cos 2 pi h and sin 2 pi h / h in powers of h^2, fitted to |h| <= 1/2.
_Z = np.linspace(0, 0.25, 2001)
_COSINE, _SINE = (
    np.polynomial.polynomial.polyfit(_Z, values, 6).astype(np.float32)
    for values in (np.cos(2 * np.pi * np.sqrt(_Z)), 2 * np.pi * np.sinc(2 * np.sqrt(_Z)))
)
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = (np.float32(c) for c in _COSINE)
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = (np.float32(c) for c in _SINE)


@kernel
def polarity_of(stream: np.uint64, reset_ns: int) -> float:
    """Return the uniform number that decides the polarity of the event after a reset."""
    share: float = unit(high(mix_word(stream ^ (np.uint64(reset_ns) * _OF_RESET))))
    return share


@kernel
def _groups_of(state: np.float32) -> int:
    """Return the groups of rows that a column in a state uses."""
    if (state == DONE) | (state == PART) | (state == BURST):
        return IN_PARTS
    if (state == SLICE) | (state == FIRST) | (state == DIRECT):
        return IN_PARTS | IN_BURSTS
    return IN_PARTS | IN_EVENTS if (state == FIRED) | (state == PLACED) else ALL_GROUPS


@kernel
def _exchange(rows: _Float32s, pairs: _Int32s, n: int, first_row: int, end_row: int) -> None:
    """Exchange rows of the pairs in the first n places."""
    for row in range(first_row, end_row):  # by rows: neighbours share cache lines
        for i in range(0, n, 2):
            a, b = row * CAPACITY + pairs[i], row * CAPACITY + pairs[i + 1]
            rows[a], rows[b] = rows[b], rows[a]


@kernel
def _bring_to_front(columns: Columns, state: np.float32, n: int) -> None:
    """Exchange the columns of a state, or all that are not DONE, to the front of the first n."""
    rows, pairs = columns.rows, columns.pairs
    front, back = NONE, n - 1
    listed = NONE
    while True:
        while front < back and ((rows[front] != DONE) if state < DONE else (rows[front] == state)):
            front += 1
        while front < back and not ((rows[back] != DONE) if state < DONE else (rows[back] == state)):
            back -= 1
        if front >= back:
            break
        pairs[listed], pairs[listed + 1] = front, back
        columns.groups[listed] = _groups_of(rows[front]) | _groups_of(rows[back])
        listed += 2
        c = columns
        c.visits[front], c.visits[back] = c.visits[back], c.visits[front]
        c.streams[front], c.streams[back] = c.streams[back], c.streams[front]
        c.resets_ns[front], c.resets_ns[back] = c.resets_ns[back], c.resets_ns[front]
        front += 1
        back -= 1
    # Each group in turn: the list keeps the pairs that use it.
    _exchange(rows, pairs, listed, GROUPS[0], GROUPS[1])
    for group in range(1, 4):
        kept = NONE
        for i in range(0, listed, 2):
            if columns.groups[i] & (1 << group):
                columns.chosen[kept], columns.chosen[kept + 1] = pairs[i], pairs[i + 1]
                kept += 2
        _exchange(rows, columns.chosen, kept, GROUPS[group], GROUPS[group + 1])


@vector_kernel
def _count(rows: _Float32s, counts: _Int64s, n: int) -> None:
    """Count the columns of each state among the first n; FIRST with SLICE too, whose kernel is the same."""
    use_widest_vectors()
    for state in range(1, STATES):
        of_state, count = np.float32(state), np.int32(0)
        for i in range(n):
            count += np.int32(take(rows, Column.STATE + i) == of_state)
        counts[state] = count
    counts[State.SLICE] += counts[State.FIRST]


@vector_kernel
def _draw(rows: _Float32s, keys: _Words, n: int) -> None:
    """Draw the numbers of an event of each column by its key: two normal ones, a share, and an exponential one."""
    use_widest_vectors()
    for i in range(n):
        # Box-Muller on 24 bits for the radius and 24 for the angle, in turns from 1/2; the sign of both is random.
        bits = mix_word(keys[i])
        radius = np.sqrt(-_TWO * natural_log((np.float32(bits >> _S40) + _HALF) * _UNIT_24))
        h = np.float32((bits >> _S16) & _MASK) * _UNIT_24 - _HALF
        z = h * h
        cosine = (((((_C6 * z + _C5) * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _C0
        sine = ((((((_S6 * z + _S5) * z + _S4) * z + _S3) * z + _S2) * z + _S1) * z + _S0) * h
        share = (np.float32(bits & _LAST) + _HALF) * _UNIT_16
        put(rows, Column.NORMAL + i, radius * cosine)
        put(rows, Column.NORMAL2 + i, radius * sine)
        put(rows, Column.SHARE + i, share)
        put(rows, Column.DRAWN + i, exponential_float(mix_word(keys[i] + _SECOND) >> _S32))


@vector_kernel
def _leave(rows: _Float32s, tables: Packed, n: int) -> None:
    """Find value and slope of the noise at the event of each column in state PLACED; N and V hold them from then on.

    Whether the event is the noise's is decided too: the signal has gone less than half of the way since the reset.
    """
    use_widest_vectors()
    for i in range(n):
        selected = take(rows, Column.STATE + i) == PLACED
        x, sign = take(rows, Column.EVENT + i), take(rows, Column.SIGN + i)
        c = take(rows, Column.C + i)
        nu, z = take(rows, Column.NU + i), take(rows, Column.EVENT_Z + i)
        curve = curve_of(rows, i)
        w, reference = value_at(curve, x), take(rows, Column.REFERENCE + i)
        threshold = chosen(rows, Column.ON + i, Column.OFF + i, _ONE if sign > _ZERO else _ZERO)
        deviation = noise_at(rows, i, x).sigma * take(rows, Column.DEVIATION + i)
        # The noise is what the signal lacks; of a signal that has jumped beyond the level, any.
        deep = c < _DEEP
        value = reference + sign * threshold - w
        value += sign * deviation * (take(rows, Column.NORMAL2 + i) - c) if deep else _ZERO
        outward = exit_speed(tables, nu, c, take(rows, Column.SHARE + i), z) - nu
        outward = deviation * (outward * take(rows, Column.SLOPE + i) + c * take(rows, Column.PULL + i))
        slope = take(rows, Column.MEAN_SLOPE + i) + (_ZERO if deep else sign * outward)
        gone = sign * (w - (reference - take(rows, Column.N + i)))
        replace(rows, Column.OF_NOISE + i, _ONE if gone < _HALF * threshold else _ZERO, selected)
        replace(rows, Column.N + i, value, selected)
        # One pole's noise has no slope: any signal is slow beside it.
        steep = _STEEPEST * take(rows, Column.SPAN + i)
        replace(rows, Column.V + i, sign * steep if z > ONE_POLE else slope, selected)


@vector_kernel
def _reset(rows: _Float32s, n: int) -> None:
    """Carry each column in state PLACED over its dead time, set its reference, and bound its burst."""
    use_widest_vectors()
    for i in range(n):
        state = take(rows, Column.STATE + i)
        selected, event = state == PLACED, take(rows, Column.EVENT + i)
        dead = take(rows, Column.DEAD + i) + take(rows, Column.LATE + i)
        noise, value = noise_at(rows, i, event), take(rows, Column.N + i)
        slope = take(rows, Column.V + i)
        single, m = noise.z > ONE_POLE, moments_over(dead, noise)
        g1, g2 = take(rows, Column.NORMAL + i), take(rows, Column.NORMAL2 + i)
        product, total = noise.a1 * noise.a2, noise.a1 + noise.a2
        deviation = np.sqrt(max(m.v, _ZERO))
        shared = total * m.p12 * m.b12 / max(deviation, _LEAST_DEVIATION)
        alone = np.sqrt(max(m.w - shared * shared, _ZERO))
        of_one = value * m.e + noise.sigma * np.sqrt(decay(_TWO * noise.rate * dead)) * g1
        n_after = of_one if single else m.p11 * value + m.p12 * slope + noise.sigma * deviation * g1
        v_after = m.p22 * slope - product * m.p12 * value + noise.sigma * noise.rate * (shared * g1 + alone * g2)
        start = Start(n_after, _ZERO if single else v_after)
        armed, offset = event + dead, take(rows, Column.OFFSET + i)
        reference = value_at(curve_of(rows, i), armed) + n_after + offset
        late, number = armed >= _ONE, take(rows, Column.DRAWN + i)
        # The burst that follows.
        b = bursts.bound_of(rows, i, armed, armed, reference, number, start)
        after = bursts.after_bound(b, armed, armed, take(rows, Column.BURST + i))
        put(rows, Column.STATE + i, (DONE if late else after.state) if selected else state)
        replace(rows, Column.AT + i, max(armed, _ONE) if late else after.x, selected)
        replace(rows, Column.RESET + i, armed, selected)
        replace(rows, Column.REFERENCE + i, _NAN if late else reference, selected)
        replace(rows, Column.LEFT + i, number, selected)
        replace(rows, Column.N + i, start.n, selected)
        replace(rows, Column.V + i, start.v, selected)
        replace(rows, Column.LIMIT + i, _TWO, selected)
        bursts.store_bound(rows, i, b, after, selected)


@kernel
def _event_ns(visits: Visits, i: int, c: StepConstants) -> np.int64:
    """Return the time of column i's event in the step, ns; float32 lengths of pieces may add up to more than it."""
    rows, j = visits.columns.rows, visits.columns.visits[i]
    begin_s, span_s = np.float64(visits.rows[Visit.BEGIN + j]), np.float64(rows[Column.SPAN + i])
    return min(np.int64((begin_s + np.float64(rows[Column.EVENT + i]) * span_s) * 1e9), np.int64(c.h_ns))


@kernel
def _delay_s(rows: _Float32s, i: int, c: StepConstants) -> float:
    """Return the comparator's delay of column i's event, by the slope of signal and noise."""
    curve = curve_of(rows, i)
    slope = (rows[Column.V + i] + speed_at(curve, rows[Column.EVENT + i])) / rows[Column.SPAN + i]
    late_s: float = delay_s(np.float64(abs(slope)), rows[Column.SIGN + i] > 0, c)
    return late_s


@kernel
def _offset(rows: _Float32s, i: int, stream: np.uint64, reset_ns: int, c: StepConstants) -> np.float32:
    """Return the offset of column i's reference that is set at a time."""
    on, off = np.float64(rows[Column.ON + i]), np.float64(rows[Column.OFF + i])
    return np.float32(reset_offset_at(stream, reset_ns, on, off, c.reset))


@kernel
def _let_fire(  # noqa: PLR0913, PLR0917
    visits: Visits, tables: Packed, pixels: _Int64s, n: int, keys: Keys, n_keys: int, c: StepConstants
) -> tuple[int, int]:
    """Write the events of the columns in state PLACED, and take these over their dead times.

    Returns the number of events in `keys`, and of those that are lost.
    """
    columns, rows = visits.columns, visits.columns.rows
    listed, placed = visits.columns.pairs, NONE
    lost = NONE
    for i in range(n):
        listed[placed] = i
        placed += rows[Column.STATE + i] == PLACED
    for i in listed[:placed]:
        columns.resets_ns[i] = c.t0_ns + _event_ns(visits, i, c)
        columns.keys[i] = mix_word(columns.streams[i] ^ (np.uint64(columns.resets_ns[i]) * _OF_EVENT))
    _draw(rows, columns.keys, whole_vectors(n))
    _leave(rows, tables, whole_vectors(n))
    for i in listed[:placed]:
        late_s = _delay_s(rows, np.int64(i), c)
        switched_ns = columns.resets_ns[i] + int(late_s * 1e9)
        j, reset_ns = columns.visits[i], switched_ns + c.refractory_ns
        of_noise, on = int(rows[Column.OF_NOISE + i]), rows[Column.SIGN + i] > 0
        keys[n_keys] = pack(switched_ns - c.t0_ns, 2 * pixels[j] + of_noise, on, c.pixel_bits)
        n_keys += 1
        visits.rows[Visit.COUNT + j] += _ONE
        rows[Column.LATE + i] = np.float32(late_s) / rows[Column.SPAN + i]
        rows[Column.OFFSET + i] = _offset(rows, np.int64(i), columns.streams[i], reset_ns, c)
        rows[Column.POLARITY + i] = np.float32(polarity_of(columns.streams[i], reset_ns))
        columns.resets_ns[i] = reset_ns
    _reset(rows, whole_vectors(n))
    for i in listed[:placed]:
        j = columns.visits[i]
        fired = visits.rows[Visit.COUNT + j]
        if fired >= MOST_PASSAGES and rows[Column.STATE + i] != DONE:
            passed_ns = np.float64(columns.resets_ns[i] - c.t0_ns)
            end_ns = np.float64(visits.rows[Visit.BEGIN + j] + rows[Column.SPAN + i]) * 1e9
            lost += 1 + int(min(fired * (end_ns - passed_ns) / max(passed_ns, 1.0), _MOST_LOST))
            rows[Column.STATE + i] = DONE
            rows[Column.REFERENCE + i] = value_at(curve_of(rows, np.int64(i)), _ONE)
    return n_keys, lost


class Progress(NamedTuple):
    """Columns that are not DONE, events in the keys, and lost ones."""

    active: int
    n_keys: int
    lost: int


@cached_kernel
def begin(visits: Visits, n: int, c: StepConstants, constants: Constants) -> int:
    """Set up columns for the flagged of the n visited pixels; return their number."""
    columns, rows = visits.columns, visits.columns.rows
    m = NONE
    for j in range(n):
        columns.visits[m] = j
        m += visits.rows[Visit.FLAG + j] > 0
    for i in range(m):
        j = columns.visits[i]
        columns.streams[i], columns.resets_ns[i] = visits.streams[j], visits.resets_ns[j]
        rows[Column.POLARITY + i] = np.float32(polarity_of(visits.streams[j], visits.resets_ns[j]))
        rows[Column.ON + i], rows[Column.OFF + i] = visits.rows[Visit.ON + j], visits.rows[Visit.OFF + j]
        rows[Column.OFFSET + i] = _offset(rows, i, visits.streams[j], visits.resets_ns[j], c)
    for i in range(m, whole_vectors(m)):
        columns.visits[i] = 0
    fill(rows, visits.rows, columns.visits, whole_vectors(m), constants)
    for i in range(m, whole_vectors(m)):
        rows[Column.STATE + i] = DONE
    return int(m)


@kernel
def _front_of(columns: Columns, best: int, active: int) -> int:
    """Return the length of the range that holds the columns of a state, after an exchange where it is sparse."""
    rows, state = columns.rows, np.float32(best)
    n = active
    sliced = best == State.SLICE
    while rows[n - 1] != state and not (sliced and rows[n - 1] == FIRST):
        n -= 1
    if columns.counts[best] < _SPARSE_OF[best] * n and n > WIDTH and not (sliced and columns.counts[State.FIRST] > 0):
        _bring_to_front(columns, state, n)
        return int(columns.counts[best])
    return n


@cached_kernel
def go_through(  # noqa: PLR0912, PLR0913, PLR0917
    visits: Visits, tables: Packed, pixels: _Int64s, at: Progress, keys: Keys, stop: _Bytes, c: StepConstants
) -> Progress:
    """Take the columns through their pieces, until all are DONE or `keys` have no room for the events of a round."""
    columns, rows = visits.columns, visits.columns.rows
    active, n_keys = at.active, at.n_keys
    lost = at.lost
    counts, turn = columns.counts, NONE
    best = _TURNS[turn]
    while stop[0] == 0 and keys.size - n_keys >= active:
        _count(rows, counts, whole_vectors(active))
        total, likeliest = NONE, NONE
        for state in range(1, STATES):
            total += counts[state] if state != State.FIRST else NONE
            if counts[state] > counts[likeliest]:
                likeliest = state
        for _ in range(STATES):
            if counts[best] >= _TOO_FEW * total:
                break
            turn = turn + 1 if turn + 1 < _TURNS.size else NONE
            best = _TURNS[turn]
        else:
            best = likeliest
        if total == 0:
            return Progress(NONE, n_keys, lost)
        if total < _SPARSE * active and active > WIDTH:
            _bring_to_front(columns, _ANY, active)
            active = total
        n = _front_of(columns, best, active)
        if best == State.PART:
            settled.part(rows, tables, whole_vectors(n))
        elif best == State.FIRED:
            settled.locate(rows, tables, whole_vectors(n))
        elif best == State.SLICE:
            bursts.slice_(rows, tables, whole_vectors(n))
        elif best == State.BURST:
            bursts.bound(rows, whole_vectors(n))
        elif best == State.PLACED:
            n_keys, lost_now = _let_fire(visits, tables, pixels, n, keys, n_keys, c)
            lost += lost_now
        elif best == State.CUT:
            bursts.choose(rows, whole_vectors(n))
        elif best == State.DIRECT:
            bursts.direct(rows, tables, whole_vectors(n))
        else:
            bursts.seek(rows, tables, whole_vectors(n))
    return Progress(active, n_keys, lost)


@kernel
def end(visits: Visits, m: int) -> None:
    """Write the state of the m columns to the visited pixels."""
    columns, rows = visits.columns, visits.columns.rows
    of_visits = visits.rows
    for i in range(m):
        j = columns.visits[i]
        of_visits[Visit.REFERENCE + j] = rows[Column.REFERENCE + i]
        of_visits[Visit.LEFT + j] = rows[Column.LEFT + i]
        of_visits[Visit.N + j] = rows[Column.N + i]
        of_visits[Visit.V + j] = rows[Column.V + i] / rows[Column.SPAN + i]
        of_visits[Visit.RESET + j] = rows[Column.RESET + i]
        visits.resets_ns[j] = columns.resets_ns[i]

"""Candidates of a sensor with noise: their curves in pieces, and what becomes of them behind the last one.

The curves are those without noise: one cubic where the step is smooth (`candidates`), else one a substep (`substeps`).
The pixels visit the tables of `passages` with each piece, and get a new certificate behind the last one.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

import emulator.sensor.pixels.candidate_table as row
import emulator.sensor.pixels.substeps as sub
from emulator.sensor.noise.law import LAST_LOGIT, SHARES, SHARES_A_LOGIT
from emulator.sensor.numerics.columns import Packed, put
from emulator.sensor.numerics.compiled import (
    NONE,
    cached_entry,
    cached_kernel,
    kernel,
    kernel_that_allocates,
    vector_kernel,
)
from emulator.sensor.numerics.elementary import exponential, use_widest_vectors
from emulator.sensor.numerics.keyed import high, mix_word, stream, unit, word
from emulator.sensor.pixels import state
from emulator.sensor.pixels.candidate_table import Table
from emulator.sensor.pixels.candidates import enter, make_curves
from emulator.sensor.pixels.crossings import Keys, reserve
from emulator.sensor.pixels.curve import Swing, fastest, photocurrent
from emulator.sensor.pixels.idle import Idle, hold_back
from emulator.sensor.pixels.passages import rounds
from emulator.sensor.pixels.passages.rows import Visit, Visits, whole_vectors
from emulator.sensor.pixels.passages.visiting import Constants, book_rest, certify, look
from emulator.sensor.pixels.state import BLOCK, MEMORY, Field, Memory, Pixels, StepConstants, noise_stream, slot
from emulator.sensor.pixels.substeps import begin, begin_substep, go_on, store_filters

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Bytes = npt.NDArray[np.uint8]

_U, _V, _L, _REF, _LEAK, _P, _ON_LIMIT, _OFF_LIMIT, _SPEED, _UNTIL = (
    int(f) * BLOCK
    for f in (
        Field.LOG_LIGHT, Field.FILTERED, Field.RATE, Field.REFERENCE, Field.LEAK, Field.LEAKED,
        Field.ON_LIMIT, Field.OFF_LIMIT, Field.SPEED_LIMIT, Field.UNTIL,
    )
)  # fmt: skip
_ROUNDED = np.float32(1e-6)  # share of a number, more than float32 rounds
_LEAST_RMS = np.float32(1e-6)  # ln units: float32 resolves no less in a log light
_STEEPEST, _A_NS = np.float32(1e15), np.float32(1e-9)
_LEAST_REST_S = np.float32(2e-6)  # below it a time since the last visit is rounding
_ZERO, _ONE, _TWO, _THREE, _NAN = (np.float32(x) for x in (0, 1, 2, 3, np.nan))


@vector_kernel
def _make_pieces(rows: _Float32s, n: int) -> None:
    """Turn values and slopes of each candidate's curve into a cubic relative to its start, exact in float32."""
    use_widest_vectors()
    for j in range(n):
        rise = rows[row.D1 + j] - rows[row.D0 + j]
        m0, m1 = rows[row.C1 + j], rows[row.C2 + j]
        rows[row.BASE + j] = rows[row.D0 + j]
        rows[row.C2 + j] = _THREE * rise - _TWO * m0 - m1
        rows[row.C3 + j] = m0 + m1 - _TWO * rise


@vector_kernel
def _visit_whole(visits: _Float32s, rows: _Float32s, n: int, c: StepConstants) -> None:
    """Write curve, light and comparator of each candidate whose step is one piece to the visited pixels."""
    use_widest_vectors()
    for j in range(n):
        still = (rows[row.U0 + j] == rows[row.U1 + j]) & (rows[row.A0 + j] == _ZERO) & (rows[row.A1 + j] == _ZERO)
        u1, v1 = rows[row.U1 + j], rows[row.V1 + j]
        l1 = c.h * rows[row.L1 + j]
        swing = Swing(u1 - rows[row.U0 + j], rows[row.A0 + j], rows[row.A1 + j], abs(u1 - v1))
        swift = max(fastest(swing, l1, l1), abs(v1 - rows[row.V0 + j]))
        put(visits, Visit.FASTEST + j, max(swift, c.second * abs(v1 - rows[row.W1 + j])) / c.h)
        put(visits, Visit.C1 + j, rows[row.C1 + j])
        put(visits, Visit.C2 + j, rows[row.C2 + j])
        put(visits, Visit.C3 + j, rows[row.C3 + j])
        put(visits, Visit.BASE + j, rows[row.BASE + j])
        put(visits, Visit.BEGIN + j, _ZERO)
        put(visits, Visit.SPAN + j, c.h)
        put(visits, Visit.RATE0 + j, rows[row.L0 + j])
        put(visits, Visit.RATE1 + j, rows[row.L1 + j])
        put(visits, Visit.ON + j, rows[row.ON + j])
        put(visits, Visit.OFF + j, rows[row.OFF + j])
        put(visits, Visit.LIT + j, rows[row.LIT + j] if c.parasitic > _ZERO else _ZERO)
        put(visits, Visit.STILL + j, _ONE if still else _ZERO)
        put(visits, Visit.COUNT + j, _ZERO)


@kernel
def _gather(visits: Visits, pixels: Pixels, of: _Int64s, n: int, c: StepConstants) -> None:
    """Write the state of the noise of pixels to the visited ones."""
    rows, memory = visits.rows, pixels.memory
    for j in range(n):
        pixel = of[j]
        at = pixel * MEMORY
        visits.streams[j], visits.resets_ns[j] = noise_stream(pixels, pixel, c), pixels.refractory_until_ns[pixel]
        rows[Visit.N + j], rows[Visit.V + j] = memory[at + Memory.N], memory[at + Memory.V]
        rows[Visit.RMS + j], rows[Visit.LEFT + j] = memory[at + Memory.SCALE], memory[at + Memory.LEFT]
        rows[Visit.RESTED + j], rows[Visit.SEEN + j] = memory[at + Memory.SEEN_S], memory[at + Memory.SEEN]
        rows[Visit.RESET + j] = np.float32(visits.resets_ns[j] - c.t0_ns)


@vector_kernel
def _complete(rows: _Float32s, n: int, rms: np.float32, c: StepConstants) -> None:
    """Turn what was gathered into the units of a piece: times over its length, values from that at its start."""
    use_widest_vectors()
    for j in range(n):
        leak, span = rows[Visit.LEAK + j], rows[Visit.SPAN + j]
        begin = rows[Visit.BEGIN + j]
        base = rows[Visit.BASE + j] + leak * (c.since_epoch_0 + begin)
        rested = c.since_epoch_0 - rows[Visit.RESTED + j]
        per_span = _ONE / span
        # Steeper curves pass all at once.
        rows[Visit.C1 + j] = min(max(rows[Visit.C1 + j] + leak * span, -_STEEPEST), _STEEPEST)
        rows[Visit.C2 + j] = min(max(rows[Visit.C2 + j], -_STEEPEST), _STEEPEST)
        rows[Visit.C3 + j] = min(max(rows[Visit.C3 + j], -_STEEPEST), _STEEPEST)
        rows[Visit.BASE + j] = base
        rows[Visit.REFERENCE + j] -= base
        rows[Visit.RMS + j] = max(rms * rows[Visit.RMS + j], _LEAST_RMS)
        rows[Visit.RESET + j] = (rows[Visit.RESET + j] * _A_NS - begin) * per_span
        rows[Visit.RESTED + j] = rested * per_span if (rested > _LEAST_REST_S) & (begin == _ZERO) else _ZERO


@kernel
def _leave(visits: Visits, j: int, pixels: Pixels, pixel: int) -> None:
    """Write what the events of a visited pixel have changed to its state."""
    rows, memory = visits.rows, pixels.memory
    at = pixel * MEMORY
    memory[at + Memory.LEFT] = rows[Visit.LEFT + j]
    if rows[Visit.FLAG + j] > 0:
        memory[at + Memory.N], memory[at + Memory.V] = rows[Visit.N + j], rows[Visit.V + j]
        pixels.refractory_until_ns[pixel] = visits.resets_ns[j]
        at = slot(pixel) + _REF
        if rows[Visit.COUNT + j] > 0 or pixels.fields[at] != pixels.fields[at]:
            pixels.fields[at] = rows[Visit.BASE + j] + rows[Visit.REFERENCE + j]


@kernel
def _finish(  # noqa: PLR0913, PLR0917
    visits: Visits, j: int, pixels: Pixels, pixel: int, leaked: float, idle: Idle, c: StepConstants
) -> None:
    """Write the certificate of a visited pixel behind its last piece to its state, and when and where it was seen.

    Its parasitic leak since its last event, `leaked`, moves into the reference of a pixel that fired.
    """
    rows, fields = visits.rows, pixels.fields
    memory, at = pixels.memory, slot(pixel)
    rise = rows[Visit.C1 + j] + rows[Visit.C2 + j] + rows[Visit.C3 + j]
    if c.parasitic > _ZERO and rows[Visit.COUNT + j] > 0:
        fields[at + _REF] -= np.float32(leaked)
        fields[at + _P] = np.float32(-np.float64(rows[Visit.LIT + j]) * c.since_epoch_1)
    memory[pixel * MEMORY + Memory.SEEN_S] = c.since_epoch_1
    memory[pixel * MEMORY + Memory.SEEN] = rise - rows[Visit.REFERENCE + j]
    fields[at + _ON_LIMIT], fields[at + _OFF_LIMIT] = rows[Visit.ON_LIMIT + j], rows[Visit.OFF_LIMIT + j]
    until_s = c.since_epoch_1 + rows[Visit.LASTS + j]
    fields[at + _SPEED] = rows[Visit.SPEED + j]
    fields[at + _UNTIL] = until_s - _LEAST_REST_S - _ROUNDED * abs(until_s)  # earlier by more than rounding
    hold_back(pixels, pixel, idle, c)


@kernel
def _look(visits: Visits, tables: Packed, n: int, c: StepConstants, constants: Constants) -> int:
    """Book what the n visited pixels take in their rest and in the piece; return the number of columns set up."""
    rested = _ZERO
    for j in range(n):
        rested = max(rested, visits.rows[Visit.RESTED + j])
    if rested > _ZERO:
        book_rest(visits.rows, tables, whole_vectors(n), constants)
    look(visits.rows, tables, whole_vectors(n), constants)
    return int(rounds.begin(visits, n, c, constants))


@cached_kernel
def _visit_as_whole(
    pixels: Pixels, table: Table, n: int, waiting: int, c: StepConstants, constants: Constants
) -> tuple[int, int]:
    """Let the candidates whose step is one piece visit, and enter the others into the table of substeps.

    Returns the number of columns set up, and of those in the table of substeps, in which `waiting` were before.
    """
    rows, visits = table.rows, table.visits
    in_substeps = waiting
    for j in range(n):
        visits.rows[Visit.LEAK + j], visits.rows[Visit.REFERENCE + j] = rows[row.LEAK + j], rows[row.REF + j]
        rows[row.LEAK + j] = _ZERO  # added by `_complete`
        rows[row.REF + j] = _NAN  # no curve is relative to a reference, which depends on the step
    make_curves(pixels, table, n, c)
    _make_pieces(rows, whole_vectors(n))
    _visit_whole(visits.rows, rows, whole_vectors(n), c)
    _gather(visits, pixels, table.pixels, n, c)
    _complete(visits.rows, whole_vectors(n), np.float32(c.noise_rms), c)
    for j in range(n):
        if rows[row.KIND + j] == row.NEEDS_SUBSTEPS:
            enter(table, j, in_substeps, c)
            in_substeps += 1
            visits.rows[Visit.RESET + j] = _TWO  # takes no part
            visits.rows[Visit.RESTED + j] = _ZERO
    return _look(visits, pixels.tables, n, c, constants), in_substeps


@cached_kernel
def _end_whole(  # noqa: PLR0913, PLR0917
    pixels: Pixels, table: Table, n: int, columns: int, idle: Idle, constants: Constants, c: StepConstants
) -> None:
    """Store the candidates whose step was one piece."""
    rows, visits = table.rows, table.visits
    rounds.end(visits, columns)
    certify(visits.rows, pixels.tables, whole_vectors(n), constants)
    for j in range(n):
        if rows[row.KIND + j] != row.NEEDS_SUBSTEPS:
            _leave(visits, j, pixels, table.pixels[j])
            _finish(visits, j, pixels, table.pixels[j], np.float64(rows[row.P1 + j]), idle, c)


@kernel
def _rate(u: np.float32, c: StepConstants) -> np.float32:
    """Return the rate of the receptor's pole at a log light, 1/s."""
    rate: np.float32 = min(max(c.rate_at_reference * exponential(u), c.rate_min), c.rate_max)
    return rate


@cached_kernel
def _visit_substep(pixels: Pixels, table: Table, n: int, c: StepConstants, constants: Constants) -> int:
    """Let the n pixels of the table of substeps visit with their next substep; return the number of columns set up."""
    visits, of = table.visits, table.substep_table.pixels
    pieces = table.substep_table.rows
    rows, fields = visits.rows, pixels.fields
    begin_substep(pieces, state.whole_vectors(n), c)
    for j in range(n):
        at = slot(of[j])
        rows[Visit.C1 + j], rows[Visit.C2 + j] = pieces[sub.C1 + j], pieces[sub.C2 + j]
        rows[Visit.C3 + j], rows[Visit.BASE + j] = pieces[sub.C3 + j], pieces[sub.BASE + j] + pieces[sub.D0 + j]
        rows[Visit.BEGIN + j] = pieces[sub.Z + j] * c.h
        rows[Visit.SPAN + j] = (pieces[sub.Z1 + j] - pieces[sub.Z + j]) * c.h
        rows[Visit.RATE0 + j], rows[Visit.RATE1 + j] = _rate(pieces[sub.U0 + j], c), _rate(pieces[sub.U1 + j], c)
        rows[Visit.ON + j], rows[Visit.OFF + j] = pieces[sub.ON + j], pieces[sub.OFF + j]
        rows[Visit.LEAK + j], rows[Visit.REFERENCE + j] = fields[at + _LEAK], fields[at + _REF]
        rows[Visit.LIT + j] = c.parasitic * pieces[sub.ON + j] * photocurrent(pieces[sub.U1 + j])
        rows[Visit.STILL + j], rows[Visit.COUNT + j] = _ZERO, pieces[sub.COUNT + j]
        rows[Visit.FASTEST + j] = _ZERO
    _gather(visits, pixels, of, n, c)
    _complete(rows, whole_vectors(n), np.float32(c.noise_rms), c)
    for j in range(n):
        if pieces[sub.COUNT + j] >= rounds.MOST_PASSAGES:
            rows[Visit.RESET + j] = _TWO  # takes no part any more
    columns: int = _look(visits, pixels.tables, n, c, constants)
    return columns


@cached_kernel
def _end_substep(  # noqa: PLR0913, PLR0917
    pixels: Pixels, table: Table, n: int, columns: int, idle: Idle, constants: Constants, c: StepConstants
) -> int:
    """Store the pixels whose step has ended, and compact the others; return how many remain."""
    visits, pieces = table.visits, table.substep_table.rows
    remaining = NONE
    rounds.end(visits, columns)
    certify(visits.rows, pixels.tables, whole_vectors(n), constants)
    for j in range(n):
        pixel = table.substep_table.pixels[j]
        _leave(visits, j, pixels, pixel)
        pieces[sub.COUNT + j] = visits.rows[Visit.COUNT + j]
        if pieces[sub.Z1 + j] < _ONE:
            go_on(table.substep_table, j, remaining)
            remaining += 1
            continue
        store_filters(pixels, pixel, pieces, j, c)
        leaked = 0.0
        if c.parasitic > _ZERO:
            leaked = np.float64(pieces[sub.P1 + j])
            pixels.fields[slot(pixel) + _P] = np.float32(leaked - visits.rows[Visit.LIT + j] * c.since_epoch_1)
        _finish(visits, j, pixels, pixel, leaked, idle, c)
    return int(remaining)


@kernel_that_allocates
def _find_events(  # noqa: PLR0913, PLR0917
    table: Table, pixels: Pixels, of: _Int64s, columns: int, keys: Keys, n_keys: int, stop: _Bytes, c: StepConstants
) -> tuple[Keys, int, int]:
    """Take the columns through their pieces; return the keys, the number of events in them, and of lost ones."""
    at = rounds.Progress(columns, n_keys, NONE)
    while at.active > 0 and stop[0] == 0:
        keys = reserve(keys, at.n_keys + at.active)
        at = rounds.go_through(table.visits, pixels.tables, of, at, keys, stop, c)
    return keys, at.n_keys, at.lost


@cached_entry
def solve_noisy(  # noqa: PLR0913, PLR0917
    pixels: Pixels, table: Table, n: int, waiting: int, may_wait: int, keys: Keys, n_keys: int, idle: Idle,
    stop: _Bytes, c: StepConstants,
) -> tuple[Keys, int, int, int, int]:  # fmt: skip
    """Find all events of the n candidates, and move their references, as `candidates.solve` does without noise.

    It returns soon where `stop` is set. `waiting` pixels are in the table of substeps, of which `may_wait` may stay for
    the next batch, as a substep of few costs nearly as much as that of many; their number is returned last.
    """
    constants = Constants(np.float32(c.noise_pole), np.float32(c.high_rate), np.float32(c.refractory_ns * 1e-9))
    substeps = table.substep_table
    columns, in_substeps = _visit_as_whole(pixels, table, n, waiting, c, constants)
    keys, n_keys, lost = _find_events(table, pixels, table.pixels, columns, keys, n_keys, stop, c)
    _end_whole(pixels, table, n, columns, idle, constants, c)
    begin(substeps.rows, waiting, state.whole_vectors(in_substeps), c)
    undersampled = NONE
    for j in range(waiting, in_substeps):
        undersampled += substeps.rows[sub.UNDERSAMPLED + j] != _ZERO
    while in_substeps > may_wait and stop[0] == 0:
        columns = _visit_substep(pixels, table, in_substeps, c, constants)
        keys, n_keys, lost_now = _find_events(table, pixels, substeps.pixels, columns, keys, n_keys, stop, c)
        lost += lost_now
        in_substeps = _end_substep(pixels, table, in_substeps, columns, idle, constants, c)
    return keys, n_keys, lost, undersampled, in_substeps


@cached_entry
def settle(  # noqa: PLR0913, PLR0917
    first: int, last: int, places: _Float32s, strides: _Int64s, laws: _Float32s, root: np.uint64, pixels: Pixels,
    c: StepConstants,
) -> None:  # fmt: skip
    """Set the references of pixels first to last - 1 to those at the start of a stream, and draw their first numbers.

    `places`, (4, pixels), are those among `laws`, a lattice with `strides`, (nodes, SHARES.size), of quantiles
    (`law.solve_start`), which are interpolated; NaN: one that stays. The step of `c` ends at the start, without motion.
    """
    fields = pixels.fields
    for pixel in range(first, last):
        bits = mix_word(noise_stream(pixels, pixel, c) ^ np.uint64(pixels.refractory_until_ns[pixel]))
        pixels.memory[pixel * MEMORY + Memory.LEFT] = np.float32(-math.log1p(-unit(high(bits))))
        field = slot(pixel)
        if not abs(fields[field + _V]) < np.inf:
            continue
        value = np.float64(fields[field + c.compared]) + np.float64(fields[field + _LEAK]) * c.since_epoch_1
        if places[0, pixel] == places[0, pixel]:
            share = unit(high(word(stream(root, np.int64(pixels.memory[pixel * MEMORY + Memory.NUMBER])), NONE)))
            logit = (math.log(share / (1 - share)) + LAST_LOGIT) * SHARES_A_LOGIT
            k = min(max(int(logit), 0), SHARES.size - 2)
            fraction = min(max((share - SHARES[k]) / (SHARES[k + 1] - SHARES[k]), 0.0), 1.0)
            level = 0.0
            for corner in range(1 << strides.size):
                at, weight = k, 1.0
                for d in range(strides.size):
                    place = int(places[d, pixel])
                    after = corner >> d & 1
                    at += (place + after) * strides[d]
                    weight *= places[d, pixel] - place if after else 1 - (places[d, pixel] - place)
                if weight > 0:
                    level += weight * (laws[at] + (laws[at + 1] - laws[at]) * fraction)
            fields[field + _REF] = np.float32(
                value + level * c.noise_rms * pixels.memory[pixel * MEMORY + Memory.SCALE]
            )
        pixels.memory[pixel * MEMORY + Memory.SEEN_S] = c.since_epoch_1
        pixels.memory[pixel * MEMORY + Memory.SEEN] = np.float32(value) - fields[field + _REF]

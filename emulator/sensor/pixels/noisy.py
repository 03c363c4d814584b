"""Candidates of a sensor with noise: the pieces of their curves, along which `passage` finds their events; its start.

The curves are those without noise: one cubic where the step is smooth (`candidates`), else one a substep (`substeps`).
The junction's leak is left out, and added in float64 by time: still light gives the same values whatever the steps.

Fast because filters are solved for all columns at once, and a pixel's events one by one with its state in registers.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

import emulator.sensor.pixels.candidates as row
import emulator.sensor.pixels.substeps as sub
from emulator.sensor.noise.law import LAST_LOGIT, SHARES, SHARES_A_LOGIT
from emulator.sensor.numerics.compiled import NONE, cached_entry, kernel, vector_kernel
from emulator.sensor.numerics.elementary import exponential, use_widest_vectors
from emulator.sensor.numerics.keyed import high, stream, unit, word
from emulator.sensor.pixels.candidates import Table, enter, make_curves
from emulator.sensor.pixels.crossings import Keys, reserve
from emulator.sensor.pixels.curve import photocurrent
from emulator.sensor.pixels.passage import MOST_PASSAGES, Piece, certify, pass_piece
from emulator.sensor.pixels.state import BLOCK, MEMORY, Field, Pixels, StepConstants, slot, whole_vectors
from emulator.sensor.pixels.substeps import SubstepTable, begin, begin_substep, go_on, store_filters

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]

_U, _V, _L, _, _REF, _ON, _OFF, _LEAK, _, _P, _, _, _, _, _ = (int(f) * BLOCK for f in Field)
_ZERO, _ONE, _TWO, _THREE, _NAN = (np.float32(x) for x in (0, 1, 2, 3, np.nan))


@vector_kernel
def _make_pieces(rows: _Float32s, n: int) -> None:
    """Turn values and slopes of each candidate's curve into a cubic relative to its start, exact in float32."""
    use_widest_vectors()
    for j in range(n):
        rise = rows[row.C_D1 + j] - rows[row.C_D0 + j]
        m0, m1 = rows[row.C_C1 + j], rows[row.C_C2 + j]
        rows[row.C_BASE + j] = rows[row.C_D0 + j]
        rows[row.C_D0 + j] = _ZERO
        rows[row.C_C2 + j] = _THREE * rise - _TWO * m0 - m1
        rows[row.C_C3 + j] = m0 + m1 - _TWO * rise


@kernel
def _finish(pixels: Pixels, pixel: int, piece: Piece, leaked: float, lit: float, fired: int, c: StepConstants) -> None:  # noqa: PLR0913, PLR0917
    """Certify a pixel at the end of its last piece. Its parasitic leak moves into the reference of one that fired.

    `leaked` is that leak since the last time, `lit` what its present light leaks a second.
    """
    at = slot(pixel)
    base = piece.base
    if c.parasitic > _ZERO and fired > 0:
        pixels.fields[at + _REF] -= np.float32(leaked)
        pixels.fields[at + _P] = np.float32(-lit * c.since_epoch_1)
        base -= leaked
    leak = np.float64(pixels.fields[at + _LEAK])
    value = base + piece.d0 + piece.c1 + piece.c2 + piece.c3 + leak * (c.since_s + c.h_ns * 1e-9)
    moving = (piece.c1 + 2 * piece.c2 + 3 * piece.c3) / piece.span_ns * 1e9
    certify(pixels, pixel, value, piece.rate1, moving, c)


@kernel
def _solve_whole(pixels: Pixels, table: Table, j: int, keys: Keys, n_keys: int, c: StepConstants) -> tuple[int, int]:
    """Find the events of a candidate whose curve is one piece; return the number in `keys`, and of those lost."""
    rows, pixel = table.rows, table.pixels[j]
    piece = Piece(
        0.0,
        np.float64(c.h_ns),
        np.float64(rows[row.C_BASE + j]),
        np.float64(rows[row.C_D0 + j]),
        np.float64(rows[row.C_C1 + j]),
        np.float64(rows[row.C_C2 + j]),
        np.float64(rows[row.C_C3 + j]),
        np.float64(rows[row.C_L0 + j]),
        np.float64(rows[row.C_L1 + j]),
    )
    n_keys, fired, lost = pass_piece(pixels, pixel, piece, keys, n_keys, 0, c)
    leaked = np.float64(rows[row.C_P1 + j]) if c.parasitic > _ZERO else 0.0
    lit = np.float64(rows[row.C_LIT + j]) if c.parasitic > _ZERO else 0.0
    _finish(pixels, pixel, piece, leaked, lit, fired, c)
    return n_keys, lost


@kernel
def _rate(u: np.float32, c: StepConstants) -> float:
    """Return the rate of the receptor's pole at a log light, 1/s."""
    return np.float64(min(max(c.rate_at_reference * exponential(u), c.rate_min), c.rate_max))


@kernel
def _piece_of(rows: _Float32s, j: int, c: StepConstants) -> Piece:
    """Return the piece of column j's substep."""
    return Piece(
        np.float64(rows[sub.Z + j]) * c.h_ns,
        (np.float64(rows[sub.Z1 + j]) - np.float64(rows[sub.Z + j])) * c.h_ns,
        np.float64(rows[sub.BASE + j]),
        np.float64(rows[sub.D0 + j]),
        np.float64(rows[sub.C1 + j]),
        np.float64(rows[sub.C2 + j]),
        np.float64(rows[sub.C3 + j]),
        _rate(rows[sub.U0 + j], c),
        _rate(rows[sub.U1 + j], c),
    )


@kernel
def _end_substep(pixels: Pixels, table: SubstepTable, n: int, c: StepConstants) -> int:
    """Store the columns that have reached the end of the step, compact the others; return how many remain."""
    rows, remaining = table.rows, NONE
    for j in range(n):
        if rows[sub.Z1 + j] >= _ONE:
            pixel = table.pixels[j]
            at = slot(pixel)
            store_filters(pixels, pixel, rows, j, c)
            leaked = lit = 0.0
            if c.parasitic > _ZERO:
                leaked = np.float64(rows[sub.P1 + j])
                lit = np.float64(c.parasitic * rows[sub.ON + j] * photocurrent(pixels.fields[at + _U]))
                pixels.fields[at + _P] = np.float32(leaked - lit * c.since_epoch_1)
            _finish(pixels, pixel, _piece_of(rows, j, c), leaked, lit, int(rows[sub.COUNT + j]), c)
            continue
        go_on(table, j, remaining)
        remaining += 1
    return int(remaining)


@cached_entry
def solve_noisy(
    pixels: Pixels, table: Table, n: int, keys: Keys, n_keys: int, c: StepConstants
) -> tuple[Keys, int, int, int]:
    """Find all events of the n candidates, and move their references, as `candidates.solve` does without noise."""
    rows, substeps = table.rows, table.substep_table
    for j in range(n):
        rows[row.C_LEAK + j] = _ZERO
        rows[row.C_REF + j] = _NAN  # no curve is relative to a reference, which depends on the step
    make_curves(pixels, table, n, c)
    _make_pieces(rows, whole_vectors(n))
    lost = undersampled = in_substeps = NONE
    for j in range(n):
        if rows[row.C_KIND + j] == row.NEEDS_SUBSTEPS:
            enter(table, j, in_substeps, c)
            in_substeps += 1
            continue
        keys = reserve(keys, n_keys + MOST_PASSAGES)
        n_keys, lost_now = _solve_whole(pixels, table, j, keys, n_keys, c)
        lost += lost_now
    n = in_substeps
    begin(substeps.rows, whole_vectors(n), c)
    for j in range(n):
        undersampled += substeps.rows[sub.UNDERSAMPLED + j] != _ZERO
    while n > 0:
        begin_substep(substeps.rows, whole_vectors(n), c)
        for j in range(n):
            keys = reserve(keys, n_keys + MOST_PASSAGES)
            fired = int(substeps.rows[sub.COUNT + j])
            piece = _piece_of(substeps.rows, j, c)
            n_keys, fired, lost_now = pass_piece(pixels, substeps.pixels[j], piece, keys, n_keys, fired, c)
            substeps.rows[sub.COUNT + j] = np.float32(fired)
            lost += lost_now
        n = _end_substep(pixels, substeps, n, c)
    return keys, n_keys, lost, undersampled


@cached_entry
def settle(  # noqa: PLR0913, PLR0917
    first: int, last: int, places: _Float32s, strides: _Int64s, laws: _Float32s, root: np.uint64, pixels: Pixels,
    c: StepConstants,
) -> None:  # fmt: skip
    """Set the references of pixels first to last - 1 to those at the start of a stream, and certify the pixels.

    `places`, (4, pixels), are those among `laws`, a lattice with `strides`, (nodes, SHARES.size), of quantiles
    (`law.solve_start`), which are interpolated; NaN: one that stays. The step of `c` ends at the start, without motion.
    """
    fields = pixels.fields
    for pixel in range(first, last):
        field = slot(pixel)
        if not abs(fields[field + _V]) < np.inf:
            continue
        value = np.float64(fields[field + c.compared]) + np.float64(fields[field + _LEAK]) * c.since_epoch_1
        if places[0, pixel] == places[0, pixel]:
            share = unit(high(word(stream(root, np.int64(pixels.memory[pixel * MEMORY + 3])), NONE)))
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
            fields[field + _REF] = np.float32(value + level * c.noise_rms * pixels.memory[pixel * MEMORY + 2])
        rate = np.float64(fields[field + _L])
        certify(pixels, pixel, value, rate, rate - rate, c)  # no literal, which would be a type of its own

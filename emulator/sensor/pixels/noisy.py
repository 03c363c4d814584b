"""Candidates of a sensor with noise: the pieces of their curves, along which `passage` finds their events.

The curves are those without noise: one cubic where the step is smooth (`candidates`), else one a substep (`substeps`).
The junction's leak is left out, and added in float64 by time: still light gives the same values whatever the steps.

A certificate states that no event comes before a time while the value stays between two limits and moves no faster
than a speed: its hazard is below a bound there, and the field has no point below that bound. The quiet pass tests it in
place of the thresholds, so a pixel that noise does not fire costs as little as one without noise. In still light the
next event is known in advance, but behind a high-pass; the certificate holds until then, for still light alone.

Fast because filters are solved for all columns at once, and a pixel's events one by one with its state in registers.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

import emulator.sensor.pixels.candidates as row
import emulator.sensor.pixels.substeps as sub
from emulator.sensor.noise.hazard import FARTHEST, Noise, noise_of
from emulator.sensor.noise.law import LAST_LOGIT, SHARES, SHARES_A_LOGIT
from emulator.sensor.numerics.compiled import NONE, cached_entry, kernel, vector_kernel
from emulator.sensor.numerics.elementary import exponential, use_widest_vectors
from emulator.sensor.numerics.keyed import high, next_point, stream, unit, word
from emulator.sensor.pixels import passage
from emulator.sensor.pixels.candidates import Table, enter, make_curves
from emulator.sensor.pixels.crossings import Keys, reserve
from emulator.sensor.pixels.curve import photocurrent
from emulator.sensor.pixels.state import BLOCK, MEMORY, Field, Pixels, StepConstants, slot, whole_vectors
from emulator.sensor.pixels.substeps import SubstepTable, begin, begin_substep, go_on, store_filters

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Bytes = npt.NDArray[np.uint8]

_U, _V, _L, _, _REF, _ON, _OFF, _LEAK, _, _P, _ON_LIMIT, _OFF_LIMIT, _SPEED, _UNTIL, _ = (int(f) * BLOCK for f in Field)
# Of a certificate.
_CERTIFIED = 1.5  # its bound, over the hazard's
_STEPS_AHEAD = (4.5, 2.5, 1.5)  # in which the signal comes to its limits, the longest first ...
_MOST_AHEAD = 2.0  # ... and points that are expected below the bound then, at most
_LEAST_SETTLED = 0.75  # deviations of a limit, once the noise has forgotten its reset: the bound holds from there on
_REVISITS, _RESTS_HZ = 0.02, 1e-5  # points below the least bound in a step; that bound of a pixel that rests
_SLOW, _FASTER = 0.3, 2.0  # least speed of a certificate, in units of the noise's own; its speed over the present one
_AMPLE, _FARTHEST = FARTHEST + 3, 30.0  # deviations: well beyond FARTHEST; at which the hazard is still a number
_LONGEST_S, _LONGEST_STEPS = 2.0**33 * 1e-9, 256
_ROUNDED = 1e-6  # share of a number, more than float32 rounds
_STILL = 0.05  # deviations that the value of a pixel at rest may move in the longest time
_SLOWEST = 0.1  # 1/s: forgets in more than the longest time
_LATER = 4.0  # over the time in which a pixel leaves its limits at its present speed
_ZERO, _ONE, _TWO, _THREE, _NAN = (np.float32(x) for x in (0, 1, 2, 3, np.nan))


@vector_kernel
def _make_pieces(rows: _Float32s, n: int) -> None:
    """Turn values and slopes of each candidate's curve into a cubic relative to its start, exact in float32."""
    use_widest_vectors()
    for j in range(n):
        rise = rows[row.C_D1 + j] - rows[row.C_D0 + j]
        m0, m1 = rows[row.C_C1 + j], rows[row.C_C2 + j]
        rows[row.C_BASE + j] = rows[row.C_D0 + j]
        rows[row.C_C2 + j] = _THREE * rise - _TWO * m0 - m1
        rows[row.C_C3 + j] = m0 + m1 - _TWO * rise


@kernel
def _loudest(noise: Noise, on: float, off: float, rms: float, rate: float, c: StepConstants) -> Noise:
    """Return the noise that light may bring within limits on and off, ln units from the present value.

    Light that falls to the limit may raise the rms by a share, to no more than behind the receptor. Behind a high-pass,
    light may change by twice as much in one time constant, and the rms rises with it too.
    """
    if noise.a1 == noise.a2 and c.high_rate == 0:
        return noise
    reach = max(off, 0.0) if c.high_rate == 0 else 2 * max(on, off)
    slower = noise.a1 / (noise.a1 + noise.a2) if noise.a1 != noise.a2 else 0.0
    share = 1 + 0.5 * max(slower, c.high_rate / (rate + c.high_rate)) * reach
    return Noise(min(noise.sigma * share, rms), noise.a1, noise.a2, noise.rate, noise.ratio, noise.apart)


@kernel
def _certify_still(  # noqa: PLR0913, PLR0917
    pixels: Pixels, pixel: int, value: float, lit: float, a: passage.State, noise: Noise, c: StepConstants
) -> None:
    """Write the certificate of a pixel in still light, until the first point that may be below its hazard.

    A filter that settles may still move the value by `_STILL` deviations, and the hazard by less than `_CERTIFIED`.
    """
    at, fields = slot(pixel), pixels.fields
    leak, span_ns = np.float64(fields[at + _LEAK]), _LONGEST_S * 1e9
    rate, rms = np.float64(fields[at + _L]), c.noise_rms * np.float64(pixels.memory[pixel * MEMORY + passage.SCALE])
    base = value - leak * (c.since_s + c.h_ns * 1e-9)
    piece = passage.Piece(np.float64(c.h_ns), span_ns, base, lit * _LONGEST_S, 0.0, 0.0, rate, rate)
    curve = passage.Curve(piece, 1 / span_ns, c.t0_ns, c.since_s, leak, rms, c.noise_pole, c.high_rate)
    next_s = passage.find_next(curve, a, _CERTIFIED, pixels.tables) * 1e-9
    offset = value - a.reference
    reach = _TWO * _STILL * noise.sigma + _ROUNDED * abs(offset)
    # A reference that an event of something else moves leaves these limits. The quiet test allows 1.5 times the leak.
    fields[at + _ON_LIMIT] = np.float32(reach + offset + 1.5 * (leak + lit) * next_s)
    fields[at + _OFF_LIMIT] = np.float32(reach - offset)
    fields[at + _SPEED] = np.float32(-_TWO * _STILL * noise.sigma / _LONGEST_S)
    fields[at + _UNTIL] = _until(next_s - c.h_ns * 1e-9, c)


@kernel
def _until(ahead_s: float, c: StepConstants) -> np.float32:
    """Return a time ahead of the step's end in seconds since the epoch, earlier than that by more than rounding."""
    until_s = np.float64(c.since_epoch_1) + ahead_s
    return np.float32(until_s - 1e-6 - _ROUNDED * abs(until_s))


@kernel
def certify(  # noqa: PLR0913, PLR0917
    pixels: Pixels, pixel: int, value: float, rate: float, moving: float, lit: float, still: bool, c: StepConstants
) -> None:
    """Write the certificate of a pixel at the end of the step, in which its light was `still` or not.

    `value` is the noise-free value of its comparator, leak included, `rate` that of its receptor's pole, 1/s;
    `moving` the speed of the value without the junction's leak, a second, `lit` that of parasitic leak alone. In light
    that moves slowly a pixel gets narrow limits for long, so that its block can rest; one that moves, limits that it
    reaches in some steps, where few points are below the bound.
    """
    at, a, fields = slot(pixel), passage.state_of(pixels, pixel, c), pixels.fields
    rms = c.noise_rms * np.float64(pixels.memory[pixel * MEMORY + passage.SCALE])
    fields[at + _UNTIL] = -np.float32(np.inf)
    noise = noise_of(rate, c.noise_pole, rms, c.high_rate)
    if a.reference != a.reference:
        return
    if still and c.high_rate == 0 and abs(moving - lit) * _LONGEST_S <= _STILL * noise.sigma:
        _certify_still(pixels, pixel, value, lit, a, noise, c)
        return
    since_s = (c.h_ns - a.reset) * 1e-9
    on, off = passage.room_of(since_s, value, noise, a)
    nearest = _LEAST_SETTLED if since_s * min(noise.a1, noise.a2) > passage.FORGOTTEN else passage.LEAST_FAR
    noise = _loudest(noise, on, off, rms, rate, c)
    moves = abs(moving) * _LONGEST_S > _STILL * noise.sigma  # parasitic leak alone does not
    unit = noise.sigma * noise.rate
    nu = max(_SLOW, _FASTER * abs(moving) / unit)
    c_on, c_off = min(on / noise.sigma, _FARTHEST), min(off / noise.sigma, _FARTHEST)
    if not (c_on >= nearest and c_off >= nearest):  # or not a number
        return
    # Beyond FARTHEST no passage is likely at any speed: limits there need none.
    least = FARTHEST if c.high_rate == 0 and min(c_on, c_off) > _AMPLE else nearest
    on_hz, off_hz = passage.bound_of(c_on, nu, noise), passage.bound_of(c_off, nu, noise)
    bound_hz = max(_CERTIFIED * (on_hz + off_hz), _REVISITS / c.h if moves else _RESTS_HZ)
    for steps in _STEPS_AHEAD:  # a pixel that moves would leave narrow limits at once
        c_ahead = (c_on if moving > 0 else c_off) - steps * c.h * abs(moving) / noise.sigma
        ahead_hz = passage.bound_of(c_ahead, nu, noise) + (off_hz if moving > 0 else on_hz)
        if c_ahead > nearest and ahead_hz * steps * c.h < _MOST_AHEAD:
            bound_hz = max(bound_hz, ahead_hz)
            break
    # Limits at which a threshold's hazard has come to what the other one, which is farther then, leaves of the bound.
    limit_on = max(math.sqrt(max(c_on * c_on - 2 * math.log((bound_hz - off_hz) / on_hz), 0.0)), least)
    limit_off = max(math.sqrt(max(c_off * c_off - 2 * math.log((bound_hz - on_hz) / off_hz), 0.0)), least)
    if limit_on >= c_on or limit_off >= c_off:
        return
    end_ns = c.t0_ns + c.h_ns
    lasting_s = _LONGEST_S
    if moves:  # no longer than a high-pass remembers, and than the signal stays within the limits
        leaving_s = noise.sigma * (c_on - limit_on if moving > 0 else c_off - limit_off) / abs(moving)
        lasting_s = min(1 / max(c.high_rate, _SLOWEST), _LONGEST_STEPS * c.h, max(_LATER * leaving_s, c.h))
    last_ns = end_ns + int(lasting_s * 1e9)
    until_ns = min(next_point(a.stream, end_ns - 1, last_ns, bound_hz).t_ns, last_ns)
    fields[at + _ON_LIMIT] = np.float32(on + value - a.reference - noise.sigma * limit_on)
    fields[at + _OFF_LIMIT] = np.float32(off - value + a.reference - noise.sigma * limit_off)
    # Slow light could go any way behind a high-pass: there a pixel that rests is certified for still light only.
    fastest = nu * unit if least < FARTHEST else math.inf
    fields[at + _SPEED] = np.float32(fastest if moves or c.high_rate == 0 else 0.0)
    fields[at + _UNTIL] = _until((until_ns - end_ns) * 1e-9, c)


@kernel
def _finish(  # noqa: PLR0913, PLR0917
    pixels: Pixels, pixel: int, piece: passage.Piece, leaked: float, lit: float, still: bool, fired: int,
    c: StepConstants,
) -> None:  # fmt: skip
    """Certify a pixel at the end of its last piece. Its parasitic leak moves into the reference of one that fired.

    `leaked` is that leak since the last time, `lit` what its present light leaks a second.
    """
    at = slot(pixel)
    base = piece.base
    if c.parasitic > _ZERO and fired > 0:
        pixels.fields[at + _REF] -= np.float32(leaked)
        pixels.fields[at + _P] = np.float32(-lit * c.since_epoch_1)
        base -= leaked
    leaked = np.float64(pixels.fields[at + _LEAK]) * (c.since_s + c.h_ns * 1e-9)
    value = base + piece.c1 + piece.c2 + piece.c3 + leaked
    moving = (piece.c1 + 2 * piece.c2 + 3 * piece.c3) / piece.span_ns * 1e9
    certify(pixels, pixel, value, piece.rate1, moving, lit, still, c)


@kernel
def _solve_whole(pixels: Pixels, table: Table, j: int, keys: Keys, n_keys: int, c: StepConstants) -> tuple[int, int]:
    """Find the events of a candidate whose curve is one piece; return the number in `keys`, and of those lost."""
    rows, pixel = table.rows, table.pixels[j]
    piece = passage.Piece(
        0.0,
        np.float64(c.h_ns),
        np.float64(rows[row.C_BASE + j]),
        np.float64(rows[row.C_C1 + j]),
        np.float64(rows[row.C_C2 + j]),
        np.float64(rows[row.C_C3 + j]),
        np.float64(rows[row.C_L0 + j]),
        np.float64(rows[row.C_L1 + j]),
    )
    n_keys, fired, lost = passage.pass_piece(pixels, pixel, piece, keys, n_keys, NONE, c)
    still = rows[row.C_U0 + j] == rows[row.C_U1 + j] and rows[row.C_A0 + j] == rows[row.C_A1 + j] == _ZERO
    leaked, lit = np.float64(rows[row.C_P1 + j]), np.float64(rows[row.C_LIT + j])
    _finish(pixels, pixel, piece, leaked, lit, still, fired, c)
    return n_keys, lost


@kernel
def _rate(u: np.float32, c: StepConstants) -> float:
    """Return the rate of the receptor's pole at a log light, 1/s."""
    return np.float64(min(max(c.rate_at_reference * exponential(u), c.rate_min), c.rate_max))


@kernel
def _piece_of(rows: _Float32s, j: int, c: StepConstants) -> passage.Piece:
    """Return the piece of column j's substep."""
    return passage.Piece(
        np.float64(rows[sub.Z + j]) * c.h_ns,
        (np.float64(rows[sub.Z1 + j]) - np.float64(rows[sub.Z + j])) * c.h_ns,
        np.float64(rows[sub.BASE + j]) + np.float64(rows[sub.D0 + j]),
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
            _finish(pixels, pixel, _piece_of(rows, j, c), leaked, lit, False, int(rows[sub.COUNT + j]), c)
            continue
        go_on(table, j, remaining)
        remaining += 1
    return int(remaining)


@cached_entry
def solve_noisy(  # noqa: PLR0913, PLR0917
    pixels: Pixels, table: Table, n: int, keys: Keys, n_keys: int, stop: _Bytes, c: StepConstants
) -> tuple[Keys, int, int, int]:
    """Find all events of the n candidates, and move their references, as `candidates.solve` does without noise.

    It returns soon where `stop` is set: in a light of a large range a candidate has a thousand events of 30 us.
    """
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
        if stop[0] != 0:
            break
        keys = reserve(keys, n_keys + passage.MOST_PASSAGES)
        n_keys, lost_now = _solve_whole(pixels, table, j, keys, n_keys, c)
        lost += lost_now
    n = in_substeps
    begin(substeps.rows, whole_vectors(n), c)
    for j in range(n):
        undersampled += substeps.rows[sub.UNDERSAMPLED + j] != _ZERO
    while n > 0 and stop[0] == 0:
        begin_substep(substeps.rows, whole_vectors(n), c)
        for j in range(n if stop[0] == 0 else 0):
            keys = reserve(keys, n_keys + passage.MOST_PASSAGES)
            fired = int(substeps.rows[sub.COUNT + j])
            piece = _piece_of(substeps.rows, j, c)
            n_keys, fired, lost_now = passage.pass_piece(pixels, substeps.pixels[j], piece, keys, n_keys, fired, c)
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
        certify(pixels, pixel, value, rate, rate - rate, rate - rate, False, c)  # a literal 0 would be another type

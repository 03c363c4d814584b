"""Noise of grade "offsets" in the table of candidates: what each has drawn, its levels in a step, and its next draws.

A candidate fires where its signal meets a level or its clock runs out, whichever is first (`take_due`). The levels
follow from the speed: the larger of that in the step and the mean one since the reset. Where the signal is behind a
level at the start of a step, as one that slows down may be, the event comes at a random time of the step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import emulator.sensor.pixels.candidate_table as row
from emulator.sensor.noise.hazard import rate_of, slice_of
from emulator.sensor.noise.moments import noise_in
from emulator.sensor.numerics.columns import Packed, put, take
from emulator.sensor.numerics.compiled import NONE, Real, kernel, lane, vector_kernel
from emulator.sensor.numerics.elementary import use_widest_vectors
from emulator.sensor.numerics.keyed import high, low, mix_word, unit, word
from emulator.sensor.pixels import event_time
from emulator.sensor.pixels.candidate_table import Table
from emulator.sensor.pixels.offsets import (
    Draw,
    Passage,
    Way,
    draw_all,
    enter_reset,
    is_of_noise,
    store_reset,
    way_from,
    way_until,
)
from emulator.sensor.pixels.state import BLOCK, MEMORY, Field, Memory, Pixels, StepConstants, noise_stream, slot

_Float32s = npt.NDArray[np.float32]

_UNTIL, _SIGN = int(Field.UNTIL) * BLOCK, int(Field.SPEED_LIMIT) * BLOCK
_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(x) for x in (0, 0.5, 1, 2, 3))
_NEVER, _UNREACHED = np.float32(2), np.float32(1e9)
_LEAST_S, _LEAST_RATE = np.float32(1e-7), np.float32(1e-9)
_NEEDED = np.bool_(True)


@kernel
def gather_draws(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Write what each candidate has drawn at its last reset."""
    rows = table.rows
    for j in range(n):
        pixel = table.pixels[j]
        at, memory = slot(pixel), pixel * MEMORY
        rows[row.N + j] = pixels.memory[memory + Memory.N]
        rows[row.RMS + j] = np.float32(c.noise_rms) * pixels.memory[memory + Memory.SCALE]
        rows[row.ON_LEFT + j] = pixels.memory[memory + Memory.LEFT]
        rows[row.OFF_LEFT + j] = pixels.memory[memory + Memory.OFF_LEFT]
        rows[row.SINCE + j] = np.float32((c.t0_ns + c.h_ns - pixels.refractory_until_ns[pixel]) * 1e-9)
        rows[row.DUE + j] = (pixels.fields[at + _UNTIL] - c.since_epoch_0) / c.h
        rows[row.SIGN + j] = pixels.fields[at + _SIGN]
        bits = word(noise_stream(pixels, pixel, c), c.t0_ns)
        second = mix_word(bits)
        rows[row.UNIFORM + j] = np.float32(unit(low(mix_word(second))))
        rows[row.KEPT + j], rows[row.KEPT2 + j] = np.float32(unit(high(bits))), np.float32(unit(low(bits)))
        rows[row.FRESH + j] = np.float32(-math.log1p(-unit(high(second))))
        rows[row.FRESH2 + j] = np.float32(-math.log1p(-unit(low(second))))


class Clock(NamedTuple):
    """The ways to both thresholds from the last reset, the noise's rate a step, and the signal's way in the step."""

    on: Way
    off: Way
    rate: Real
    begins: Real  # ln units from the reference
    step: Real


class Tick(NamedTuple):
    """The share of the step after which the clock runs out, and the polarity of the event."""

    due: Real
    sign: Real


@lane
def thinned(tables: Packed, clock: Clock, tick: Tick, kept: Real, fresh: Real, armed: Real) -> Tick:
    """Return a tick in the step where it is kept, with the polarity of the place, else the next one."""
    noise, k = clock.on.noise, clock.on.k
    apart = noise.apart
    before_on = rate_of(tables, k, apart, clock.on.c0, _ZERO, _NEEDED)
    before_off = rate_of(tables, k, apart, clock.off.c0, _ZERO, _NEEDED)
    moved = (clock.begins + clock.step * min(max(tick.due, _ZERO), _ONE)) / noise.sigma
    on = min(rate_of(tables, k, apart, clock.on.c0 - moved, _ZERO, _NEEDED), before_on)
    off = min(rate_of(tables, k, apart, clock.off.c0 + moved, _ZERO, _NEEDED), before_off)
    total, place = before_on + before_off, kept * (before_on + before_off)
    is_out = armed & (tick.due <= _ONE) & (place > on + off)
    later = max(tick.due, _ZERO) + fresh / max(clock.rate * total, _LEAST_RATE)
    sign = _ONE if place < on else -_ONE
    return Tick(later if is_out else tick.due, sign if armed & ~is_out & (tick.due <= _ONE) else tick.sign)


@vector_kernel
def place_levels(rows: _Float32s, tables: Packed, n: int, c: StepConstants) -> None:
    """Replace the thresholds of each candidate by the distances from its reference at which it fires in this step."""
    use_widest_vectors()
    pole, high_rate = np.float32(c.noise_pole), np.float32(c.high_rate)
    for j in range(n):
        on, off = take(rows, row.ON + j), take(rows, row.OFF + j)
        after, reference = take(rows, row.N + j), take(rows, row.REF + j)
        leak = take(rows, row.LEAK + j)
        noise = noise_in(
            _HALF * (take(rows, row.L0 + j) + take(rows, row.L1 + j)), pole, take(rows, row.RMS + j), high_rate
        )
        inverse, k = _ONE / noise.sigma, slice_of(noise.z)
        # The signal at both ends of the step, from the reference, which a pixel in its dead time has not.
        v0 = take(rows, row.D0 + j) + leak * c.since_epoch_0 - reference
        v1 = take(rows, row.D1 + j) + leak * c.since_epoch_1 - reference
        armed = reference == reference
        since = take(rows, row.SINCE + j)
        step = (take(rows, row.D1 + j) - take(rows, row.D0 + j)) / c.h + leak
        mean = v1 / max(since, _LEAST_S) if armed else _ZERO
        to_on, to_off = Way(noise, k, (on + after) * inverse), Way(noise, k, (off - after) * inverse)
        on_s, off_s = since * min(_ONE, on / abs(v1)), since * min(_ONE, off / abs(v1))
        from_on = way_from(noise, k, on, after, on_s if armed else c.h)
        from_off = way_from(noise, k, off, -after, off_s if armed else c.h)
        way_on = way_until(tables, from_on, take(rows, row.ON_LEFT + j), max(step, mean))
        way_off = way_until(tables, from_off, take(rows, row.OFF_LEFT + j), max(-step, -mean))
        behind_on, behind_off = armed & (v0 >= way_on), armed & (v0 <= -way_off)
        # The clock has the hazard of where the last reset was. A pixel that has moved away has less: thin events out.
        clock = Clock(to_on, to_off, noise.rate * c.h, v0, v1 - v0)
        ticks = Tick(take(rows, row.DUE + j), take(rows, row.SIGN + j))
        ticks = thinned(tables, clock, ticks, take(rows, row.KEPT + j), take(rows, row.FRESH + j), armed)
        ticks = thinned(tables, clock, ticks, take(rows, row.KEPT2 + j), take(rows, row.FRESH2 + j), armed)
        due = ticks.due
        at_random = take(rows, row.UNIFORM + j)
        sooner = (behind_on | behind_off) & (at_random < due)
        behind_sign = _ONE if behind_on else -_ONE
        put(rows, row.TRUE_ON + j, on)
        put(rows, row.TRUE_OFF + j, off)
        put(rows, row.ON + j, _UNREACHED if behind_on else way_on)
        put(rows, row.OFF + j, _UNREACHED if behind_off else way_off)
        put(rows, row.CLOCK + j, due)
        put(rows, row.DUE + j, at_random if sooner else due)
        put(rows, row.SIGN + j, behind_sign if sooner else ticks.sign)


@kernel
def keep_clocks(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Write the clocks of the candidates, which `place_levels` may have set, to their state."""
    rows = table.rows
    for j in range(n):
        at = slot(table.pixels[j])
        pixels.fields[at + _UNTIL] = np.float32(c.since_s + np.float64(rows[row.CLOCK + j]) * c.h)
        pixels.fields[at + _SIGN] = rows[row.SIGN + j]


@vector_kernel
def take_due(rows: _Float32s, n: int) -> None:
    """Let each candidate fire where its clock runs out, if that is before its crossing."""
    use_widest_vectors()
    for j in range(n):
        rise = rows[row.D1 + j] - rows[row.A + j]
        crosses = (rise >= rows[row.ON + j]) | (rise <= -rows[row.OFF + j])
        due = rows[row.DUE + j]
        first = due <= (rows[row.Z + j] if crosses else _NEVER)
        rows[row.Z + j] = max(due, rows[row.START + j]) if first else rows[row.Z + j]
        rows[row.MISS + j] = _ZERO if first else rows[row.MISS + j]
        rows[row.UP + j] = max(rows[row.SIGN + j], _ZERO) if first else rows[row.UP + j]


@kernel
def draw_next(pixels: Pixels, table: Table, n: int, c: StepConstants) -> None:
    """Draw the resets of the candidates that fire: their next levels and clocks, and the state of their pixels."""
    rows, listed = table.rows, table.listed
    k = NONE
    for j in range(n):
        listed[k] = j
        k += rows[row.KIND + j] == row.FIRES
    for i in range(k):
        j = listed[i]
        z, late = rows[row.Z + j], rows[row.LATE + j]
        dt_ns = min(int(z * c.h_ns), c.h_ns) + int(late * c.h_ns)
        g = event_time.Cubic(rows[row.D0 + j], rows[row.C1 + j], rows[row.C2 + j], rows[row.C3 + j])
        armed = min(z + (late + c.refractory), _ONE)
        speed = ((_THREE * g.c3 * armed + _TWO * g.c2) * armed + g.c1) / c.h
        rate = rows[row.L0 + j] + z * (rows[row.L1 + j] - rows[row.L0 + j])
        moved = event_time.value(g, z) - rows[row.A + j]
        up, dead_s = rows[row.UP + j] > _ZERO, (late + c.refractory) * c.h
        passage = Passage(moved, up, rate, speed, dead_s, c.t0_ns + dt_ns + c.refractory_ns)
        enter_reset(table.draws, i, pixels, table.pixels[j], passage, c)
        rows[row.OF_NOISE + j] = is_of_noise(table.draws, i)
    draw_all(table.draws, pixels, k, c)
    for i in range(k):
        j, results = listed[i], table.draws.rows
        dt_ns = min(int(rows[row.Z + j] * c.h_ns), c.h_ns) + int(rows[row.LATE + j] * c.h_ns)
        rows[row.NEXT_ON + j], rows[row.NEXT_OFF + j] = results[Draw.ON_LEVEL + i], results[Draw.OFF_LEVEL + i]
        rows[row.NEXT_SIGN + j] = results[Draw.SIGN + i]
        reset_ns = c.t0_ns + dt_ns + c.refractory_ns
        rows[row.NEXT_DUE + j] = store_reset(table.draws, i, pixels, table.pixels[j], reset_ns, c)


@kernel
def go_on(rows: _Float32s, j: int, k: int) -> None:
    """Move what candidate j has drawn for its next event to column k."""
    rows[row.ON + k], rows[row.OFF + k] = rows[row.NEXT_ON + j], rows[row.NEXT_OFF + j]
    rows[row.DUE + k], rows[row.SIGN + k] = rows[row.NEXT_DUE + j], rows[row.NEXT_SIGN + j]
    rows[row.L0 + k], rows[row.L1 + k] = rows[row.L0 + j], rows[row.L1 + j]

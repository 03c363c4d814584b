"""Noise of grade "offsets": at each reset a pixel draws how far its signal goes to the next event.

The full law (`passages`) integrates the hazard of each pixel in each step. Here the law of settled noise is solved at
the reset, so that all that follows costs little more than without noise:

    n       noise at the end of the dead time, by its exact transition: the reference lies that much beside the signal,
            so the thresholds lie at on + n and off - n from it, c0 deviations away
    E       an exponential number for each threshold. It is passed where the integral of the hazard along a straight way
            at one speed reaches E, so at the c where K(c) = K(c0) + E nu / (1 + nu): see `hazard`
    clock   an exponential number and the hazard at c0 give the time of an event in still light, for each polarity. A
            pixel that has moved away by then has less hazard, so the event is thinned out (`thinned`). One that
            has come nearer has more, which the ways take: K less the share of the clock

The speed of a way is known when a pixel is a candidate: the larger of that in the step and the mean one since the
reset. Until then its limits, which the quiet test takes for thresholds, are those of a quarter of its speed at the
reset, or of NEAR. Before the end of the step the speed at the reset serves.

Left out are bursts: the noise is taken to have settled at once. Left out is also that a pixel which turns has used up a
part of its number. docs/physics.md states what that costs.

A candidate fires where its signal meets a level or its clock runs out, whichever is first (`take_due`). The levels
follow from the speed: the larger of that in the step and the mean one since the reset. Where the signal is behind a
level at the start of a step, as one that slows down may be, the event comes at a random time of the step.

Fast because draws and ways are vector loops over the columns that fire or may fire.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import emulator.sensor.pixels.candidate_table as row
from emulator.sensor.noise.hazard import (
    FARTHEST,
    ONE_POLE,
    farther,
    integral_beyond,
    pair_factors,
    place_of,
    rate_of,
    rho_of,
    slice_of,
)
from emulator.sensor.noise.moments import Noise, moments_over, noise_in, slower_rate
from emulator.sensor.numerics.columns import Packed, put, take
from emulator.sensor.numerics.compiled import NONE, Real, cached_entry, kernel, lane, vector_kernel
from emulator.sensor.numerics.elementary import decay, natural_log, use_widest_vectors
from emulator.sensor.numerics.keyed import exponential_float, high, low, mix_word, normal_float, unit, word
from emulator.sensor.pixels import event_time
from emulator.sensor.pixels.candidate_table import Draw, Draws, Table
from emulator.sensor.pixels.state import BLOCK, MEMORY, Field, Memory, Pixels, StepConstants, noise_stream, slot

_Float32s = npt.NDArray[np.float32]
_Words = npt.NDArray[np.uint64]

_ON, _OFF, _RATE, _ON_LIMIT, _OFF_LIMIT, _SIGN, _UNTIL = (
    int(f) * BLOCK
    for f in (
        Field.ON, Field.OFF, Field.RATE, Field.ON_LIMIT, Field.OFF_LIMIT, Field.SPEED_LIMIT, Field.UNTIL,
    )
)  # fmt: skip
_REF = int(Field.REFERENCE) * BLOCK

NEAR = np.float32(0.0002)
"""Speed, in units of sigma times the rate of the noise, of the limits that the quiet test takes for thresholds."""

_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(x) for x in (0, 0.5, 1, 2, 3))
_NEVER, _UNREACHED, _LEAST_RATE = (np.float32(x) for x in (2, 1e9, 1e-9))
_NEEDED = np.bool_(True)
_LEAST_C = np.float32(-3.5)  # deviations: an event follows at once
_LEAST_WAY = np.float32(1e-6)  # ln units
_LEAST_S, _LEAST_HZ, _LONGEST_S, _LEAST_INTEGRAL = (np.float32(x) for x in (1e-7, 1e-9, 1e9, 1e-12))
_LEAST_VARIANCE, _LEAST_SPEED = np.float32(1e-3), np.float32(1e-6)
_PUSHED, _SPREAD = np.float32(math.sqrt(math.pi / 2)), np.float32(2 - math.pi / 2)  # of a slope by Rayleigh's law
_OF_RESET, _SECOND, _THIRD = (np.uint64(n) for n in (0xD6E8FEB86659FD93, 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9))
_S32, _LOW = np.uint64(32), np.uint64(0xFFFFFFFF)
_QUARTER = np.float32(0.25)


class Way(NamedTuple):
    """The noise of a way, its slice of the tables, and the distance of the threshold at its start, deviations."""

    noise: Noise
    k: Real
    c0: Real


@lane
def way_from(noise: Noise, k: Real, threshold: Real, after: Real, t_s: Real) -> Way:
    """Return the way to a threshold that is passed about `t_s` after a reset at which the noise was `after` towards it.

    Noise that has not forgotten the reset is less broad, and its mean is still a part of what it was.
    """
    single, m = noise.z > ONE_POLE, moments_over(max(t_s, _LEAST_S), noise)
    kept, variance = (m.e if single else m.p11), max(_ONE - m.e * m.e if single else m.v, _LEAST_VARIANCE)
    settling = Noise(noise.sigma * np.sqrt(variance), noise.rate / variance, noise.z, noise.apart, noise.a1, noise.a2)
    return Way(settling, k, max((threshold + after - kept * after) / settling.sigma, _LEAST_C))


@lane
def _nearest(tables: Packed, to: Way, left: Real, speed: Real) -> Real:
    """Return ln units below those of `way_until` at the same speed or a faster one: without the share of the clock."""
    noise, c0 = to.noise, to.c0
    nu = max(speed / (noise.sigma * noise.rate), NEAR)
    rho = rho_of(nu)
    passed = integral_beyond(tables, to.k, rho, c0 + farther(c0, nu, noise.apart), c0 < FARTHEST)
    c = place_of(tables, to.k, rho, left * rho + passed, _NEEDED)
    return max((c0 - c + farther(c, nu, noise.apart)) * noise.sigma, _LEAST_WAY)


@lane
def way_until(tables: Packed, to: Way, left: Real, speed: Real) -> Real:
    """Return the ln units that a signal goes at a speed until it passes a threshold, if `left` is its drawn number."""
    noise, c0 = to.noise, to.c0
    nu = max(speed / (noise.sigma * noise.rate), NEAR)
    rho = rho_of(nu)
    passed = integral_beyond(tables, to.k, rho, c0 + farther(c0, nu, noise.apart), c0 < FARTHEST)
    still = rate_of(tables, to.k, noise.apart, c0, _ZERO, _NEEDED)
    # The clock takes the hazard at c0 all the way, whose length is not known at first.
    c = place_of(tables, to.k, rho, left * rho + passed, _NEEDED)
    gone = max(c0 - c + farther(c, nu, noise.apart), _ZERO)
    c = place_of(tables, to.k, rho, (left + still * gone / nu) * rho + passed, _NEEDED)
    return max((c0 - c + farther(c, nu, noise.apart)) * noise.sigma, _LEAST_WAY)


@vector_kernel
def _draw_numbers(rows: _Float32s, keys: _Words, n: int) -> None:
    """Draw the random numbers of n resets by their keys, apart from `_draw`, whose gathers 64-bit words would halve."""
    use_widest_vectors()
    for i in range(n):
        bits, second = mix_word(keys[i]), mix_word(keys[i] + _SECOND)
        last = mix_word(keys[i] + _THIRD)
        put(rows, Draw.NORMAL + i, normal_float(bits))
        put(rows, Draw.ON_LEFT + i, exponential_float(second >> _S32))
        put(rows, Draw.OFF_LEFT + i, exponential_float(second & _LOW))
        put(rows, Draw.ON_CLOCK + i, exponential_float(last >> _S32))
        put(rows, Draw.OFF_CLOCK + i, exponential_float(last & _LOW))
        put(rows, Draw.FRESH + i, exponential_float(mix_word(last) >> _S32))


@vector_kernel
def _draw(rows: _Float32s, tables: Packed, n: int, pole: np.float32, high: np.float32) -> None:  # noqa: PLR0915
    """Find the noise after n resets by their random numbers, and what follows from it."""
    use_widest_vectors()
    for i in range(n):
        noise = noise_in(take(rows, Draw.RATE + i), pole, take(rows, Draw.RMS + i), high)
        on, off = take(rows, Draw.ON + i), take(rows, Draw.OFF + i)
        # The noise leaves through the threshold with a slope; over the dead time it forgets both.
        up, dead = take(rows, Draw.UP + i), max(take(rows, Draw.DEAD + i), _LEAST_S)
        single, m = noise.z > ONE_POLE, moments_over(dead, noise)
        kept = m.e if single else m.p11
        pushed = _ZERO if single else _PUSHED * noise.sigma * m.b12
        lost = decay(_TWO * noise.rate * dead) if single else max(m.v + _SPREAD * m.b12 * m.b12, _ZERO)
        before = take(rows, Draw.NOISE + i)
        fresh = kept * before + up * pushed + noise.sigma * np.sqrt(lost) * take(rows, Draw.NORMAL + i)
        after = before if up == _ZERO else fresh
        inverse, k = _ONE / noise.sigma, slice_of(noise.z)
        c_on, c_off = max((on + after) * inverse, _LEAST_C), max((off - after) * inverse, _LEAST_C)
        # The clock, which begins when the noise has decayed from the reference.
        of_on, of_off = pair_factors(tables, c_on, c_off, noise.z, _ONE, _NEEDED)
        on_hz = max(noise.rate * of_on * rate_of(tables, k, noise.apart, c_on, _ZERO, _NEEDED), _LEAST_HZ)
        off_hz = max(noise.rate * of_off * rate_of(tables, k, noise.apart, c_off, _ZERO, _NEEDED), _LEAST_HZ)
        begins = natural_log(_ONE + max(min(c_on, c_off), _ZERO) * abs(after) * inverse) / slower_rate(noise)
        on_number, off_number = take(rows, Draw.ON_CLOCK + i), take(rows, Draw.OFF_CLOCK + i)
        on_wait, off_wait = begins + on_number / on_hz, begins + off_number / off_hz
        put(rows, Draw.WAIT + i, min(min(on_wait, off_wait), _LONGEST_S))
        put(rows, Draw.HZ + i, on_hz + off_hz)
        # In the rest of the step the signal goes on at its speed, away from one of the thresholds.
        speed = take(rows, Draw.SPEED + i)
        nu = max(abs(speed) * inverse / noise.rate, NEAR)
        rising = speed > _ZERO
        c_away = (c_off if rising else c_on) + nu * noise.rate * begins
        beyond = integral_beyond(tables, k, rho_of(nu), c_away + farther(c_away, nu, noise.apart), _NEEDED)
        integral = beyond / rho_of(nu)
        away_hz = max(noise.rate * rate_of(tables, k, noise.apart, c_away, _ZERO, _NEEDED), _LEAST_HZ)
        left = _ONE - (off_number if rising else on_number) / max(integral, _LEAST_INTEGRAL)
        away = begins - integral / away_hz * natural_log(left) if left > _ZERO else _LONGEST_S
        on_wait, off_wait = on_wait if rising else away, away if rising else off_wait
        put(rows, Draw.NEXT + i, min(min(on_wait, off_wait), _LONGEST_S))
        put(rows, Draw.SIGN + i, _ONE if on_wait < off_wait else -_ONE)
        # The ways.
        on_left, off_left = take(rows, Draw.ON_LEFT + i), take(rows, Draw.OFF_LEFT + i)
        to_on = way_from(noise, k, on, after, on / max(abs(speed), _LEAST_SPEED))
        to_off = way_from(noise, k, off, -after, off / max(abs(speed), _LEAST_SPEED))
        put(rows, Draw.N + i, after)
        put(rows, Draw.ON_LEVEL + i, way_until(tables, to_on, on_left, speed))
        put(rows, Draw.OFF_LEVEL + i, way_until(tables, to_off, off_left, -speed))
        put(rows, Draw.ON_LIMIT + i, _nearest(tables, to_on, on_left, _QUARTER * abs(speed)))
        put(rows, Draw.OFF_LIMIT + i, _nearest(tables, to_off, off_left, _QUARTER * abs(speed)))


class Passage(NamedTuple):
    """An event of a pixel, and the end of its dead time."""

    moved: Real  # signal at the event, from the reference, ln units
    up: bool
    rate: Real  # of the receptor, 1/s
    speed: Real  # of the signal at the end, ln units a second
    dead_s: Real
    reset_ns: int  # the end, stream time


@kernel
def enter_reset(draws: Draws, i: int, pixels: Pixels, pixel: int, passage: Passage, c: StepConstants) -> None:
    """Enter the reset behind an event of a pixel in place i of the draws."""
    rows, at = draws.rows, slot(pixel)
    on, off = pixels.fields[at + _ON], pixels.fields[at + _OFF]
    before = pixels.memory[pixel * MEMORY + Memory.N]
    rows[Draw.RATE + i], rows[Draw.SPEED + i] = passage.rate, passage.speed
    rows[Draw.DEAD + i] = passage.dead_s
    rows[Draw.RMS + i] = np.float32(c.noise_rms) * pixels.memory[pixel * MEMORY + Memory.SCALE]
    rows[Draw.ON + i], rows[Draw.OFF + i] = on, off
    rows[Draw.UP + i], rows[Draw.MOVED + i] = (_ONE if passage.up else -_ONE), passage.moved
    # The noise is what the signal lacks.
    rows[Draw.NOISE + i] = before - passage.moved + (on if passage.up else -off)
    draws.keys[i] = mix_word(noise_stream(pixels, pixel, c) ^ (np.uint64(passage.reset_ns) * _OF_RESET))


@kernel
def is_of_noise(draws: Draws, i: int) -> int:
    """Return 1 where the signal had gone less than half of the way to the threshold of the event in place i, else 0."""
    rows = draws.rows
    up = rows[Draw.UP + i] > _ZERO
    threshold = rows[Draw.ON + i] if up else rows[Draw.OFF + i]
    return int(rows[Draw.UP + i] * rows[Draw.MOVED + i] < _HALF * threshold)


@kernel
def draw_all(draws: Draws, pixels: Pixels, n: int, c: StepConstants) -> None:
    """Draw the first n resets."""
    columns = (n + 15) // 16 * 16
    _draw_numbers(draws.rows, draws.keys, columns)
    _draw(draws.rows, pixels.tables, columns, np.float32(c.noise_pole), np.float32(c.high_rate))


@kernel
def store_reset(draws: Draws, i: int, pixels: Pixels, pixel: int, reset_ns: int, c: StepConstants) -> np.float32:
    """Write what was drawn in place i to the state of a pixel; return when its clock runs out, in steps."""
    rows, at = draws.rows, slot(pixel)
    memory = pixel * MEMORY
    pixels.fields[at + _ON_LIMIT], pixels.fields[at + _OFF_LIMIT] = rows[Draw.ON_LIMIT + i], rows[Draw.OFF_LIMIT + i]
    armed_s, wait_s = np.float64(reset_ns - c.t0_ns) * 1e-9, np.float64(rows[Draw.WAIT + i])
    rest_s = np.float64(c.h_ns) * 1e-9 - armed_s
    if wait_s < rest_s:  # the rest of the step goes by `NEXT`
        wait_s = rest_s + np.float64(rows[Draw.FRESH + i] / rows[Draw.HZ + i])
    pixels.fields[at + _UNTIL] = np.float32(c.since_s + armed_s + wait_s)
    pixels.fields[at + _SIGN] = rows[Draw.SIGN + i]
    pixels.memory[memory + Memory.N] = rows[Draw.N + i]
    pixels.memory[memory + Memory.LEFT] = rows[Draw.ON_LEFT + i]
    pixels.memory[memory + Memory.OFF_LEFT] = rows[Draw.OFF_LEFT + i]
    pixels.refractory_until_ns[pixel] = reset_ns
    return np.float32((armed_s + np.float64(rows[Draw.NEXT + i])) / (np.float64(c.h_ns) * 1e-9))


@cached_entry
def draw_anew(first: int, last: int, pixels: Pixels, draws: Draws, c: StepConstants) -> None:
    """Draw ways and clocks of pixels first to last - 1 at the end of a step, for the noise that each has kept."""
    rows, fields = draws.rows, pixels.fields
    now_ns = c.t0_ns + c.h_ns
    n, begin = 0, first
    for pixel in range(first, last):
        enter_reset(draws, n, pixels, pixel, Passage(_ZERO, True, fields[slot(pixel) + _RATE], _ZERO, _ZERO, now_ns), c)
        rows[Draw.UP + n], rows[Draw.NOISE + n] = _ZERO, pixels.memory[pixel * MEMORY + Memory.N]
        n += 1
        if n == BLOCK or pixel == last - 1:
            draw_all(draws, pixels, n, c)
            for i in range(n):
                # A dead time that has begun keeps its end.
                armed_ns = pixels.refractory_until_ns[begin + i]
                in_dead_time = fields[slot(begin + i) + _REF] != fields[slot(begin + i) + _REF]
                store_reset(draws, i, pixels, begin + i, armed_ns if in_dead_time else now_ns, c)
                pixels.refractory_until_ns[begin + i] = armed_ns
            n, begin = 0, pixel + 1


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

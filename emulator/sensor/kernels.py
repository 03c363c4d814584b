"""The pixel step in float32: one quiet pass over every pixel, then work for the few that may fire.

What is solved (photocurrent i relative to the reference light, u = ln i, natural logarithms throughout):

    rate      lambda = 2 pi f(i), f proportional to i within its bounds
    filter    dv/dt = lambda (u - v)
    leak      the reference falls by l each second; instead, the filtered value is raised: g = v + l T, T seconds since
              the epoch, and the stored reference moves at events only
    crossing  ON when g - reference >= threshold_on, OFF when <= -threshold_off

Between two pictures u is a straight line, and the filter runs over S, the integral of lambda dt (trapezium rule with
its end correction), with constant time constant within the step:

    v(s) = u(s) - D/S + B e^-s       D = u1 - u0,  B = v0 - u0 + D/S,  s in [0, S]

The step of a pixel is *quiet* when bounds show that it cannot fire: v stays between v0 and v0 + q (U - v0), with
q = 1 - e^-S and U the highest (lowest) of u. Most pixels are, most of the time, and cost one pass of plain arithmetic.
For those that may fire, and move by one monotone stretch, crossings are solved on the cubic in time through v and its
derivative at both ends, all lanes together; what is left (turns, big changes, slow exponentials) goes to `exact`.

What makes it fast, all measured:

- State is kept in blocks of 512 pixels, field after field within a block (see `Field`), in one flat array. A block fits
  the first cache with its scratch, and all its fields lie at distances known when compiled: LLVM gives up on a loop
  with many separate arrays, because it would have to check each pair for overlap.
- Loops run from 0 over BLOCK, a constant: no test for negative indices, no remainder, and a pixel's arithmetic does not
  depend on where in the picture it lies.
- Three short loops instead of one long: their constants stay in registers. 0.7 ns a pixel instead of 1.1.
- No integer arithmetic in vector loops (numba widens it to 64 bits); logarithm and exponential are polynomials
  (`elementary`), and `compiled` tells which compiler options matter.
- The list of candidates is made without a branch, `found[k] = i; k += flag`, and only where a word of flags has any.
- Candidates are gathered while their block is in the first cache, and solved in batches.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.compiled import kernel, kernel_that_allocates, vector_kernel
from emulator.sensor.elementary import decay, natural_log
from emulator.sensor.exact import MOST_EVENTS, Pixel, Step, Trace, cubic, solve_exactly

__all__ = ["BLOCK", "FIELDS", "Field", "StepConstants", "advance", "unpack"]

BLOCK = 512
"""Pixels of a block."""


class Field(IntEnum):
    """The state of a pixel; state is (blocks, FIELDS, BLOCK) float32, flat."""

    LOG_LIGHT = 0  # u, ln of the photocurrent at the last step's end; NaN after unreadable light
    FILTERED = 1  # v
    RATE = 2  # lambda, rad/s
    REFERENCE = 3  # with leak times the time since the epoch added; NaN while the pixel is blind
    ON = 4  # thresholds, ln units, > 0
    OFF = 5
    LEAK = 6  # ln units a second


FIELDS = len(Field)


class StepConstants(NamedTuple):
    """What is the same for all pixels of a step."""

    dark: np.float32
    rate_at_reference: np.float32  # rad/s
    rate_min: np.float32
    rate_max: np.float32
    h: np.float32  # the step, s
    since_epoch_0: np.float32  # time since the epoch at the step's start and end, s
    since_epoch_1: np.float32
    refractory: np.float32  # as a share of the step
    h_ns: int
    t0_ns: int
    refractory_ns: int
    pixel_bits: int


_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Keys = npt.NDArray[np.uint64]

# Rows of the block's scratch: the step's end values, before they go into the state.
_U1, _V1, _L1, _S, _Q = (k * BLOCK for k in range(5))
_U, _V, _L, _REF, _ON, _OFF, _LEAK = (int(f) * BLOCK for f in Field)

# Rows of the table of candidates.
_CAPACITY = 2 * BLOCK
_BATCH = _CAPACITY - BLOCK
(
    _C_U0, _C_V0, _C_L0, _C_U1, _C_V1, _C_L1, _C_S, _C_REF, _C_ON, _C_OFF, _C_LEAK, _C_START,
    _C_BASE, _C_A, _C_D0, _C_D1, _C_M0, _C_M1, _C_KIND, _C_Z, _C_MISS,
) = (k * _CAPACITY for k in range(21))  # fmt: skip
_C_ROWS = 21

_NOTHING, _FIRES, _EXACT = np.float32(0), np.float32(1), np.float32(2)

_NAN = np.float32(np.nan)
_ZERO, _ONE, _TWO, _THREE, _HALF = (np.float32(x) for x in (0, 1, 2, 3, 0.5))
_TWELFTH = np.float32(1 / 12)
_BRIGHTEST = np.float32(3.4e38)
_LARGEST_CHANGE = np.float32(0.5)  # of u in one piece; beyond, the time constant may not be frozen
_MARGIN = np.float32(5e-6)  # rounding of the quiet test, ln units
_WIDER = np.float32(1.02)  # covers the error of S
_SHARE = np.float32(0.01)  # of a threshold: what the cubic may miss of the exponential
_FAST = np.float32(100)  # S from which end slopes are rounding noise if the exponential is below _FAINT
_FAINT = np.float32(1e-5)
_SETTLED = np.float32(3e-5)  # last Newton correction; the error is of the order of its square


@vector_kernel
def _take_light(light: _Float32s, end: _Float32s, c: StepConstants) -> None:
    """Write a block's log light (NaN where the light is not finite) and rate at the end of the step."""
    for i in range(BLOCK):
        e = light[i]
        current = (e if e > _ZERO else _ZERO) + c.dark
        end[_U1 + i] = natural_log(current) if abs(e) <= _BRIGHTEST else _NAN
        end[_L1 + i] = min(max(c.rate_at_reference * current, c.rate_min), c.rate_max)


@vector_kernel
def _warp(s: _Float32s, end: _Float32s, c: StepConstants) -> None:
    """Write a block's S and 1 - e^-S."""
    for i in range(BLOCK):
        l0, l1 = s[_L + i], end[_L1 + i]
        slope0 = l0 if (l0 > c.rate_min) & (l0 < c.rate_max) else _ZERO
        slope1 = l1 if (l1 > c.rate_min) & (l1 < c.rate_max) else _ZERO
        correction = (end[_U1 + i] - s[_U + i]) * (slope0 - slope1) * _TWELFTH
        warped = c.h * max(_HALF * (l0 + l1) + correction, min(l0, l1))
        end[_S + i] = warped
        end[_Q + i] = decay(warped)


@vector_kernel
def _filter_and_test(s: _Float32s, end: _Float32s, loud: npt.NDArray[np.uint8], c: StepConstants) -> None:
    """Write a block's filtered values at the end of the step, and 1 into `loud` where the pixel may fire, else 0.

    Whatever is NaN makes the pixel loud: blind ones, whose reference is NaN, and those with unreadable light.
    """
    for i in range(BLOCK):
        u0, v0, u1, q, leak = s[_U + i], s[_V + i], end[_U1 + i], end[_Q + i], s[_LEAK + i]
        d = u1 - u0
        v1 = v0 + (q * (u0 - v0) + d * (_ONE - q / end[_S + i]))
        end[_V1 + i] = v1 if v1 == v1 else u1
        reach = min(_WIDER * q, _ONE)
        above = v0 - s[_REF + i]
        high = above + (reach * max(max(u0, u1) - v0, _ZERO) + leak * c.since_epoch_1)
        low = above + (reach * min(min(u0, u1) - v0, _ZERO) + leak * c.since_epoch_0)
        quiet = (high < s[_ON + i] - _MARGIN) & (low > _MARGIN - s[_OFF + i]) & (abs(d) <= _LARGEST_CHANGE)
        loud[i] = 0 if quiet else 1


@kernel
def _store(s: _Float32s, end: _Float32s) -> None:
    """Make the end of the step the state: log light, filtered value and rate, the first three fields of both."""
    for i in range(3 * BLOCK):
        s[i] = end[i]


@kernel
def _list(loud: npt.NDArray[np.uint8], eights: npt.NDArray[np.uint64], found: _Int64s) -> int:
    """Write the indices of a block's loud pixels into `found`; return how many. `eights` is `loud`, eight at a time."""
    k = 0
    for word in range(BLOCK // 8):
        if eights[word] != 0:
            for i in range(8 * word, 8 * word + 8):
                found[k] = i
                k += loud[i]
    return k


@kernel
def _gather(
    s: _Float32s, end: _Float32s, found: _Int64s, first: int, blind_until: _Int64s, table: _Float32s, pixels: _Int64s,
    n: int, c: StepConstants,
) -> tuple[int, int]:  # fmt: skip
    """Add a block's candidates to the table of `n`; return its new length and the number with unreadable light.

    Left out: pixels whose light is unreadable or was at the last step, and those that stay blind all through the step.
    """
    unreadable = 0
    for i in found:
        u1, v0, reference = end[_U1 + i], s[_V + i], s[_REF + i]
        unreadable += u1 != u1
        start = _ZERO
        if reference != reference:
            wait_ns = blind_until[first + i] - c.t0_ns
            if wait_ns > c.h_ns:
                continue
            start = np.float32(max(wait_ns, 0) / c.h_ns)
        if (u1 != u1) | (v0 != v0):
            continue
        pixels[n] = first + i
        table[_C_U0 + n], table[_C_V0 + n], table[_C_L0 + n] = s[_U + i], v0, s[_L + i]
        table[_C_U1 + n], table[_C_V1 + n], table[_C_L1 + n] = u1, end[_V1 + i], end[_L1 + i]
        table[_C_S + n], table[_C_REF + n], table[_C_START + n] = end[_S + i], reference, start
        table[_C_ON + n], table[_C_OFF + n], table[_C_LEAK + n] = s[_ON + i], s[_OFF + i], s[_LEAK + i]
        n += 1
    return n, unreadable


@vector_kernel
def _prepare(table: _Float32s, n: int, c: StepConstants) -> None:
    """Give each candidate its cubic (values d, slopes m per step, relative to `base`), start, reference a and kind."""
    for j in range(n):
        u0, v0, u1, v1 = table[_C_U0 + j], table[_C_V0 + j], table[_C_U1 + j], table[_C_V1 + j]
        warped, reference, start = table[_C_S + j], table[_C_REF + j], table[_C_START + j]
        leak, on, off = table[_C_LEAK + j], table[_C_ON + j], table[_C_OFF + j]
        d = u1 - u0
        blind = reference != reference
        base = v0 + leak * c.since_epoch_0 if blind else reference
        d0 = (v0 - base) + leak * c.since_epoch_0
        d1 = (v1 - base) + leak * c.since_epoch_1
        exponential = abs((v0 - u0) + d / warped)
        straight = (warped > _FAST) & (exponential < _FAINT)
        m0 = d1 - d0 if straight else c.h * (table[_C_L0 + j] * (u0 - v0) + leak)
        m1 = d1 - d0 if straight else c.h * (table[_C_L1 + j] * (u1 - v1) + leak)
        s2 = warped * warped
        missed = exponential * min(s2 * s2 * np.float32(1 / 384), np.float32(0.16) * warped + np.float32(0.2))
        middle = _THREE * (d1 - d0) - m0 - m1
        monotone = (min(min(m0, m1), middle) >= _ZERO) | (max(max(m0, m1), middle) <= _ZERO)
        at_start = cubic(d0, d1, m0, m1, start)
        a = at_start if blind else _ZERO
        cheap = straight | (monotone & (missed <= _SHARE * min(on, off)) & (abs(d) <= _LARGEST_CHANGE))
        inside = (at_start - a < on) & (at_start - a > -off)
        fires = (d1 - a >= on) | (d1 - a <= -off)
        table[_C_BASE + j], table[_C_A + j] = base, a
        table[_C_D0 + j], table[_C_D1 + j], table[_C_M0 + j], table[_C_M1 + j] = d0, d1, m0, m1
        kind = _FIRES if fires else _NOTHING
        table[_C_KIND + j] = kind if cheap & inside else _EXACT


@vector_kernel
def _solve(table: _Float32s, n: int) -> None:
    """Find where each candidate's monotone cubic meets its next level: z and the last Newton correction."""
    for j in range(n):
        d0, d1, m0, m1 = table[_C_D0 + j], table[_C_D1 + j], table[_C_M0 + j], table[_C_M1 + j]
        a, start = table[_C_A + j], table[_C_START + j]
        rising = d1 > a
        level = a + (table[_C_ON + j] if rising else -table[_C_OFF + j])
        sign = _ONE if rising else -_ONE
        c2 = _THREE * (d1 - d0) - _TWO * m0 - m1
        c3 = m0 + m1 - _TWO * (d1 - d0)
        at_start = ((c3 * start + c2) * start + m0) * start + d0
        low, high = start, _ONE
        z = start + (_ONE - start) * (level - at_start) / (d1 - at_start)
        step = _ONE
        for _ in range(4):
            f = sign * ((((c3 * z + c2) * z + m0) * z + d0) - level)
            slope = sign * ((_THREE * c3 * z + _TWO * c2) * z + m0)
            low = low if f > _ZERO else z
            high = z if f > _ZERO else high
            newton = z - f / slope
            better = newton if (newton >= low) & (newton <= high) else _HALF * (low + high)
            step = better - z
            z = better
        table[_C_Z + j] = z
        table[_C_MISS + j] = abs(step)


@kernel
def _bisect(table: _Float32s, j: int) -> np.float32:
    """Find a crossing that Newton did not settle on in its fixed number of turns, by halving."""
    a = table[_C_A + j]
    rising = table[_C_D1 + j] > a
    level = a + (table[_C_ON + j] if rising else -table[_C_OFF + j])
    low, high = table[_C_START + j], _ONE
    for _ in range(25):
        z = _HALF * (low + high)
        f = cubic(table[_C_D0 + j], table[_C_D1 + j], table[_C_M0 + j], table[_C_M1 + j], z) - level
        if (f > _ZERO) == rising:
            high = z
        else:
            low = z
    return high


@kernel
def _key(z: float, pixel: int, on: int, c: StepConstants) -> np.uint64:
    """Pack an event so that sorting the numbers sorts by (time, pixel): [dt_ns | pixel | on]."""
    dt_ns = np.uint64(min(int(z * c.h_ns), c.h_ns))
    return (dt_ns << np.uint64(c.pixel_bits + 1)) | (np.uint64(pixel) << np.uint64(1)) | np.uint64(on)


@kernel_that_allocates
def _room(keys: _Keys, needed: int) -> _Keys:
    """Return `keys`, or a longer copy if it holds fewer than `needed`."""
    if needed <= keys.size:
        return keys
    longer = np.empty(max(2 * keys.size, needed), np.uint64)
    longer[: keys.size] = keys
    return longer


@kernel
def _settle(
    state: _Float32s, blind_until: _Int64s, table: _Float32s, pixels: _Int64s, j: int, z: float, c: StepConstants
) -> bool:  # fmt: skip
    """Let the candidate j fire at z: move its reference or make it blind. Tell whether it fires again in this step."""
    a, d1, on, off = table[_C_A + j], table[_C_D1 + j], table[_C_ON + j], table[_C_OFF + j]
    pixel = pixels[j]
    slot = (pixel // BLOCK) * (FIELDS * BLOCK) + _REF + pixel % BLOCK
    start = np.float32(z)
    if c.refractory_ns == 0:
        a = a + on if d1 > a else a - off
    else:
        start += c.refractory
        if start > _ONE:
            state[slot] = _NAN
            blind_until[pixel] = c.t0_ns + min(int(z * c.h_ns), c.h_ns) + c.refractory_ns
            return False
        a = cubic(table[_C_D0 + j], d1, table[_C_M0 + j], table[_C_M1 + j], start)
    table[_C_A + j], table[_C_START + j] = a, start
    state[slot] = table[_C_BASE + j] + a
    return bool((d1 - a >= on) | (d1 - a <= -off))


@kernel
def _keep(table: _Float32s, pixels: _Int64s, j: int, k: int) -> None:
    """Move what a candidate needs for its next crossing from column j to column k."""
    pixels[k] = pixels[j]
    for row in (_C_ON, _C_OFF, _C_START, _C_BASE, _C_A, _C_D0, _C_D1, _C_M0, _C_M1):
        table[row + k] = table[row + j]


@kernel
def _pixel(table: _Float32s, j: int) -> Pixel:
    """Return column j of the table for the exact solver."""
    return Pixel(
        log_light=np.float64(table[_C_U0 + j]),
        filtered=np.float64(table[_C_V0 + j]),
        rate=np.float64(table[_C_L0 + j]),
        log_light_after=np.float64(table[_C_U1 + j]),
        rate_after=np.float64(table[_C_L1 + j]),
        reference=np.float64(table[_C_REF + j]),
        on=np.float64(table[_C_ON + j]),
        off=np.float64(table[_C_OFF + j]),
        leak=np.float64(table[_C_LEAK + j]),
        start=np.float64(table[_C_START + j]),
    )


@kernel
def _step(c: StepConstants) -> Step:
    """Return the step for the exact solver."""
    return Step(
        h=np.float64(c.h),
        since_epoch=np.float64(c.since_epoch_0),
        refractory=np.float64(c.refractory),
        rate_at_reference=np.float64(c.rate_at_reference),
        rate_min=np.float64(c.rate_min),
        rate_max=np.float64(c.rate_max),
    )


@kernel_that_allocates
def _exact_ones(
    state: _Float32s, blind_until: _Int64s, table: _Float32s, pixels: _Int64s, n: int, keys: _Keys, n_keys: int,
    c: StepConstants, trace: Trace,
) -> tuple[_Keys, int, int, int]:  # fmt: skip
    """Solve what needs the exact form and leave in the table what fires on its cubic.

    Returns keys, their number, the number of crossings beyond the cap and the new length of the table.
    """
    kept = lost = 0
    step = _step(c)
    for j in range(n):
        kind = table[_C_KIND + j]
        if kind == _FIRES:
            _keep(table, pixels, j, kept)
            kept += 1
            continue
        pixel = pixels[j]
        slot = (pixel // BLOCK) * (FIELDS * BLOCK) + pixel % BLOCK
        if kind == _NOTHING:
            state[slot + _REF] = table[_C_BASE + j] + table[_C_A + j]
            continue
        keys = _room(keys, n_keys + MOST_EVENTS)
        count, v1, reference, blind_end = solve_exactly(_pixel(table, j), step, trace)
        for k in range(min(count, MOST_EVENTS)):
            keys[n_keys] = _key(trace.z[k], pixel, trace.on[k], c)
            n_keys += 1
        lost += max(count - MOST_EVENTS, 0)
        state[slot + _V], state[slot + _REF] = v1, reference
        if reference != reference:
            blind_until[pixel] = c.t0_ns + np.int64(blind_end * c.h_ns)
    return keys, n_keys, lost, kept


@kernel_that_allocates
def _batch(
    state: _Float32s, blind_until: _Int64s, table: _Float32s, pixels: _Int64s, n: int, keys: _Keys, n_keys: int,
    c: StepConstants, trace: Trace,
) -> tuple[_Keys, int, int]:  # fmt: skip
    """Solve all crossings of the n candidates of the table; return keys, their number and those beyond the cap."""
    _prepare(table, n, c)
    keys, n_keys, lost, n = _exact_ones(state, blind_until, table, pixels, n, keys, n_keys, c, trace)
    event = 0
    while n > 0:
        _solve(table, n)
        keys = _room(keys, n_keys + n)
        emitted = event < MOST_EVENTS
        kept = 0
        for j in range(n):
            z = table[_C_Z + j] if table[_C_MISS + j] <= _SETTLED else _bisect(table, j)
            if emitted:
                keys[n_keys] = _key(z, pixels[j], table[_C_D1 + j] > table[_C_A + j], c)
                n_keys += 1
            else:
                lost += 1
            if _settle(state, blind_until, table, pixels, j, z, c):
                _keep(table, pixels, j, kept)
                kept += 1
        n = kept
        event += 1
    return keys, n_keys, lost


@kernel_that_allocates
def advance(
    light: _Float32s, state: _Float32s, blind_until: _Int64s, keys: _Keys, c: StepConstants
) -> tuple[_Keys, int, int, int]:
    """Move all pixels over one step.

    Parameters
    ----------
    light : (pixels,) float32, the picture at the end of the step.
    state : (blocks * FIELDS * BLOCK,) float32, changed in place.
    blind_until : (blocks * BLOCK,) int64 ns, meaningful where the reference is NaN; changed in place.
    keys : (any,) uint64, room for the events; replaced by a longer one if it does not do.
    c : the step.

    Returns
    -------
    keys, number of events in it (packed as in `unpack`, unsorted), crossings beyond MOST_EVENTS of a pixel,
    pixels whose light was not finite.
    """
    end, padded = np.empty(5 * BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    loud, found = np.empty(BLOCK, np.uint8), np.empty(BLOCK + 1, np.int64)
    eights = loud.view(np.uint64)
    table, pixels = np.empty(_C_ROWS * _CAPACITY, np.float32), np.empty(_CAPACITY, np.int64)
    trace = Trace(np.empty(MOST_EVENTS, np.float64), np.empty(MOST_EVENTS, np.uint8))
    n = n_keys = lost = unreadable = 0
    for first in range(0, light.size, BLOCK):
        s = state[first * FIELDS : (first + BLOCK) * FIELDS]
        here = light[first : first + BLOCK]
        if here.size < BLOCK:
            padded[: here.size] = here
            here = padded
        _take_light(here, end, c)
        _warp(s, end, c)
        _filter_and_test(s, end, loud, c)
        n_found = _list(loud, eights, found)
        n, bad = _gather(s, end, found[:n_found], first, blind_until, table, pixels, n, c)
        unreadable += bad
        _store(s, end)
        if n > _BATCH:
            keys, n_keys, more = _batch(state, blind_until, table, pixels, n, keys, n_keys, c, trace)
            lost += more
            n = 0
    keys, n_keys, more = _batch(state, blind_until, table, pixels, n, keys, n_keys, c, trace)
    return keys, n_keys, lost + more, unreadable


@kernel
def unpack(
    keys: _Keys, t0_ns: int, pixel_bits: int, t_ns: _Int64s, pixel: npt.NDArray[np.uint32], on: npt.NDArray[np.bool_]
) -> None:
    """Split sorted keys [dt_ns | pixel | on] into arrays of one field each, all of the same length."""
    mask = np.uint64((1 << pixel_bits) - 1)
    for k in range(keys.size):
        key = keys[k]
        t_ns[k] = t0_ns + np.int64(key >> np.uint64(pixel_bits + 1))
        pixel[k] = np.uint32((key >> np.uint64(1)) & mask)
        on[k] = (key & np.uint64(1)) != 0

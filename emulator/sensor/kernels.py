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
- Candidates are gathered while their block is in the first cache, and solved in batches (`candidates`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.candidates import BATCH, BEFORE_ROWS, Table, gather, select, solve
from emulator.sensor.compiled import SOURCES, entry, kernel, vector_kernel
from emulator.sensor.elementary import decay, lowest_bit, natural_log
from emulator.sensor.layout import BLOCK, FIELDS, Field, Pixels, StepConstants

__all__ = ["advance", "unpack"]

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Keys = npt.NDArray[np.uint64]

_U, _V, _L, _REF, _ON, _OFF, _LEAK = (int(f) * BLOCK for f in Field)
_U0, _V0, _L0, _S, _Q, _P = BEFORE_ROWS

_COLLECT = np.uint64(0x0102040810204080)
_NAN = np.float32(np.nan)
_ZERO, _ONE, _HALF = (np.float32(x) for x in (0, 1, 0.5))
_TWELFTH = np.float32(1 / 12)
_BRIGHTEST = np.finfo(np.float32).max
_LARGEST_CHANGE = np.float32(0.5)  # of u in one piece; beyond, the time constant may not be frozen
_MARGIN = np.float32(5e-6)  # rounding of the quiet test, ln units
_WIDER = np.float32(1.08)  # covers the error of S for the largest change, bounds of the rate included


@vector_kernel
def _take_light(light: _Float32s, s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Put a block's new log light (NaN where the light is not finite) and rate into the state, the old ones aside."""
    for i in range(BLOCK):
        e = light[i]
        current = (e if e > _ZERO else _ZERO) + c.dark
        before[_U0 + i], before[_L0 + i] = s[_U + i], s[_L + i]
        s[_U + i] = natural_log(current) if abs(e) <= _BRIGHTEST else _NAN
        s[_L + i] = min(max(c.rate_at_reference * current, c.rate_min), c.rate_max)


@vector_kernel
def _warp(s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Write a block's S, q = 1 - e^-S, and 1 - q / S.

    S is the trapezium with its end correction for a rate that is exponential in time. Where the rate meets a bound
    inside the step it is off by up to 7 %.
    """
    for i in range(BLOCK):
        l0, l1 = before[_L0 + i], s[_L + i]
        correction = (s[_U + i] - before[_U0 + i]) * (l0 - l1) * _TWELFTH
        warped = c.h * max(_HALF * (l0 + l1) + correction, min(l0, l1))
        q = decay(warped)
        before[_S + i], before[_Q + i], before[_P + i] = warped, q, _ONE - q / warped


@vector_kernel
def _filter_and_test(s: _Float32s, before: _Float32s, loud: npt.NDArray[np.uint8], c: StepConstants) -> None:
    """Put a block's new filtered values into the state, and 1 into `loud` where the pixel may fire, else 0.

    Whatever is NaN makes the pixel loud: blind ones, whose reference is NaN, and those with unreadable light.
    """
    for i in range(BLOCK):
        u0, u1, v0, q, leak = before[_U0 + i], s[_U + i], s[_V + i], before[_Q + i], s[_LEAK + i]
        d, behind = u1 - u0, u0 - v0
        before[_V0 + i] = v0
        s[_V + i] = v0 + (q * behind + d * before[_P + i])
        reach = min(_WIDER * q, _ONE)
        above = v0 - s[_REF + i]
        high = above + (reach * max(behind + max(d, _ZERO), _ZERO) + leak * c.since_epoch_1)
        low = above + (reach * min(behind + min(d, _ZERO), _ZERO) + leak * c.since_epoch_0)
        quiet = (high < s[_ON + i] - _MARGIN) & (low > _MARGIN - s[_OFF + i]) & (abs(d) <= _LARGEST_CHANGE)
        loud[i] = 0 if quiet else 1


@kernel
def _list(eights: npt.NDArray[np.uint64], found: _Int64s) -> int:
    """Write the indices of a block's loud pixels into `found`; return how many. `eights` is `loud`, eight at a time."""
    k = 0
    for word in range(BLOCK // 64):
        bits = np.uint64(0)
        for eight in range(8):  # each byte is 0 or 1; the product collects them in the top byte
            bits |= ((eights[8 * word + eight] * _COLLECT) >> np.uint64(56)) << np.uint64(8 * eight)
        while bits != 0:
            found[k] = 64 * word + np.int64(lowest_bit(bits))
            k += 1
            bits &= bits - np.uint64(1)
    return k


@entry
def advance(
    light: _Float32s, pixels: Pixels, table: Table, keys: _Keys, c: StepConstants, sources: int = SOURCES
) -> tuple[_Keys, int, int, int]:
    """Move all pixels over one step.

    Parameters
    ----------
    light : (pixels,) float32, the picture at the end of the step.
    pixels : the state, changed in place.
    table : room for the candidates.
    keys : (any,) uint64, room for the events; replaced by a longer one if it does not do.
    c : the step.
    sources : left out; see `compiled`.

    Returns
    -------
    keys, number of events in it (packed as in `unpack`, unsorted), crossings beyond MOST_EVENTS of a pixel,
    pixels whose light was not finite.
    """
    before, padded = np.empty(len(BEFORE_ROWS) * BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    loud, found = np.empty(BLOCK, np.uint8), np.empty(BLOCK, np.int64)
    eights = loud.view(np.uint64)
    n = n_keys = lost = unreadable = 0
    for first in range(0, light.size, BLOCK):
        s = pixels.fields[first * FIELDS : (first + BLOCK) * FIELDS]
        here = light[first : first + BLOCK]
        if here.size < BLOCK:
            padded[: here.size] = here
            here = padded
        _take_light(here, s, before, c)
        _warp(s, before, c)
        _filter_and_test(s, before, loud, c)
        n_found = _list(eights, found)
        if n_found == 0:
            continue
        kept, bad = select(found[:n_found], s, before, pixels.blind_until_ns[first : first + BLOCK], c)
        gather(found[:kept], s, before, first, table, n)
        n += kept
        unreadable += bad
        if n > BATCH:
            keys, n_keys, more = solve(pixels, table, n, keys, n_keys, c)
            lost += more
            n = 0
    keys, n_keys, more = solve(pixels, table, n, keys, n_keys, c)
    return keys, n_keys, lost + more, unreadable


@entry
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

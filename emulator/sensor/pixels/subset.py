"""Compact copies of pixels for a step: of the undersampled pixels, and of active parts of blocks.

`refinement` advances a copy of the undersampled pixels, at their state before the step, over parts of the step with the
kernels that move the whole array, and writes the result back (gather and scatter).

A pack holds active parts of several blocks, moved together as one block. Where few parts of a block are active, as
where a star passes, only these are copied to one scratch block (gather), moved by the kernels that move a whole one,
and copied back (scatter). Of a sky of stars at 1280x720, 1.3 % of the pixels change in a step, which lie in 53 % of the
blocks and in 10 % of the parts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import cached_entry, inlined, kernel, vector_kernel
from emulator.sensor.pixels.curve import completed, is_undersampled
from emulator.sensor.pixels.idle import NO_PART, Idle, Touched, may_rest, part_at, part_is_same, part_is_touched
from emulator.sensor.pixels.state import (
    BEFORE_ROWS,
    BLOCK,
    FIELDS,
    PART,
    PARTS,
    Field,
    Keys,
    Pixels,
    StepConstants,
    slot,
)

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Frame = tuple[_Float32s, _Float32s]

MOST_PACKED = PARTS // 2
"""Active parts of a block up to which it is packed; with more it is moved in place, which saves the copies."""

_MOVED = tuple(int(f) * BLOCK for f in (Field.LOG_LIGHT, Field.FILTERED, Field.RATE, Field.SLOPE, Field.SECOND))
_LEAKED = int(Field.LEAKED) * BLOCK
_ZERO = np.float32(0)


@kernel
def pixel_at(firsts: _Int64s, i: int) -> int:
    """Return the pixel at place i of a block or pack, `firsts` being the first pixels of its parts."""
    pixel: int = firsts[np.uint64(i) // np.uint64(PART)] + i % PART
    return pixel


@kernel
def list_all(first: int, firsts: _Int64s) -> int:
    """List the parts of the block that begins at pixel `first`; return their number."""
    for j in range(PARTS):
        firsts[j] = first + j * PART
    return PARTS


@kernel
def list_active(frame: _Frame, first: int, idle: Idle, touched: Touched, firsts: _Int64s, c: StepConstants) -> int:
    """List the parts of the block that begins at pixel `first` that cannot be skipped; return their number."""
    if idle.until_ns[first // BLOCK] == NO_PART:
        return int(list_all(first, firsts))
    n = 0
    for j in range(PARTS):
        part = first + j * PART
        rests = may_rest(idle, part_at(idle, part), c)
        if rests and (not part_is_touched(part, touched) or part_is_same(frame, idle, part, c)):
            continue
        firsts[n] = part
        n += 1
    return n


@kernel
def _copy_values(values: _Float32s, first: int, out: _Float32s) -> None:
    """Copy a part's values of a frame, with zeros beyond its end."""
    there = min(PART, max(values.size - first, 0))
    for i in range(there):
        out[i] = values[first + i]
    for i in range(there, PART):
        out[i] = _ZERO


@vector_kernel
def _copy(source: _Float32s, target: _Float32s) -> None:
    for i in range(PART):
        target[i] = source[i]


@kernel
def gather_parts(
    frame: _Frame, fields: _Float32s, firsts: _Int64s, pack: tuple[_Float32s, _Frame], chord: bool
) -> None:
    """Copy the state of parts to the front of a scratch block, and their light and rate; without rate if `chord`."""
    s, (light, rate) = pack
    for j in range(firsts.size):
        here, at = j * PART, slot(firsts[j])
        _copy_values(frame[0], firsts[j], light[here : here + PART])
        if not chord:
            _copy_values(frame[1], firsts[j], rate[here : here + PART])
        for row in range(FIELDS):
            begin, to = at + row * BLOCK, here + row * BLOCK
            _copy(fields[begin : begin + PART], s[to : to + PART])


@kernel
def scatter_parts(s: _Float32s, fields: _Float32s, firsts: _Int64s, parasitic: bool) -> None:
    """Copy the state that a step may have changed from a scratch block back to its parts."""
    for j in range(firsts.size):
        here, at = j * PART, slot(firsts[j])
        for row in _MOVED:
            _copy(s[here + row : here + row + PART], fields[at + row : at + row + PART])
        if parasitic:
            _copy(s[here + _LEAKED : here + _LEAKED + PART], fields[at + _LEAKED : at + _LEAKED + PART])


_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P = (int(f) * BLOCK for f in Field)
_U0, _V0, _L0, _G0, _A0, _A1, _, _, _W0, _P0, _, _ = BEFORE_ROWS


class Subset(NamedTuple):
    """States of some pixels of an array, laid out as `Pixels.fields`, and the numbers of these pixels."""

    fields: _Float32s
    pixels: _Int64s


def new_subset(blocks: int) -> Subset:
    """Return a subset with room for `blocks` blocks; the system provides its memory where it is written."""
    return Subset(np.zeros(blocks * FIELDS * BLOCK, np.float32), np.zeros(blocks * BLOCK, np.int64))


@inlined
def _at(row: int, k: np.uint64) -> np.uint64:
    return np.uint64(row) + k


@kernel
def gather_undersampled(
    found: _Int64s, s: _Float32s, before: _Float32s, subset: Subset, at: tuple[_Int64s, int], c: StepConstants
) -> tuple[int, int]:
    """Move the undersampled pixels of a block's candidates to the subset.

    Parameters
    ----------
    found : (n,) int64
        Indices of the candidates in the block; those that remain move to the front.
    at : tuple
        First pixels of the block's parts, and the number of pixels in the subset.

    Returns
    -------
    The number of candidates that remain, and of pixels in the subset. Pixels with unreadable light always remain.
    """
    firsts, n = at
    remaining = 0
    for pixel in found:
        i = np.uint64(pixel)
        found[remaining] = pixel
        u0, v0 = before[_at(_U0, i)], before[_at(_V0, i)]
        d, unseen = s[_at(_U, i)] - u0, c.unseen_share * min(s[_at(_ON, i)], s[_at(_OFF, i)])
        a0, a1 = completed(d, before[_at(_A0, i)], before[_at(_A1, i)])
        if not (is_undersampled(d, a0, a1, unseen) & (v0 == v0)):
            remaining += 1
            continue
        subset.pixels[n] = pixel_at(firsts, pixel)
        to = slot(n)
        n += 1
        subset.fields[to + _U], subset.fields[to + _V] = u0, v0
        subset.fields[to + _L], subset.fields[to + _G] = before[_at(_L0, i)], before[_at(_G0, i)]
        for row in (_REF, _ON, _OFF, _LEAK):
            subset.fields[to + row] = s[_at(row, i)]
        subset.fields[to + _W] = before[_at(_W0, i)] if c.second > _ZERO else s[_at(_W, i)]
        subset.fields[to + _P] = before[_at(_P0, i)] if c.parasitic > _ZERO else s[_at(_P, i)]
    return remaining, n


@cached_entry
def scatter(here: Pixels, above: Pixels, listed: _Int64s) -> None:
    """Write the state of the subset `here`, at the end of the step, back to its pixels of `above`.

    The light of these pixels is up to date there.
    """
    for k in range(listed.size):
        at, to = slot(k), slot(listed[k])
        for row in (_V, _REF, _W, _P):
            above.fields[to + row] = here.fields[at + row]
        above.refractory_until_ns[listed[k]] = here.refractory_until_ns[k]
    places, of = here.refractory_until_ns.size // 2, above.refractory_until_ns.size // 2
    if here.refractory_until_ns.size > here.fields.size // FIELDS:
        for k in range(listed.size):
            above.refractory_until_ns[of + listed[k]] = here.refractory_until_ns[places + k]


@cached_entry
def renumbered(keys: Keys, origin: _Int64s, later_ns: int, pixel_bits: int) -> Keys:
    """Return packed events with the pixel numbers `origin`, and times counted from `later_ns` earlier."""
    out, one, shift = np.empty(keys.size, np.uint64), np.uint64(1), np.uint64(pixel_bits + 1)
    mask = np.uint64((1 << pixel_bits) - 1)
    for k in range(keys.size):
        pixel, dt = np.uint64(origin[(keys[k] >> one) & mask]), (keys[k] >> shift) + np.uint64(later_ns)
        out[k] = (dt << shift) | (pixel << one) | (keys[k] & one)
    return out

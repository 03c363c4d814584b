"""Compact copy of the undersampled pixels, at their state before the step.

`refinement` advances this copy over parts of the step with the kernels that move the whole array, and writes the result
back (gather and scatter).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.numerics.compiled import inlined, kernel
from emulator.sensor.pixels.interpolation import completed, is_undersampled
from emulator.sensor.pixels.packed_crossings import Keys
from emulator.sensor.pixels.packs import pixel_at
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, FIELDS, Field, Pixels, StepConstants, slot

__all__ = ["Subset", "gather_undersampled", "new_subset", "renumbered", "scatter"]

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P = (int(f) * BLOCK for f in Field)
_U0, _V0, _L0, _G0, _A0, _A1, _, _, _W0, _P0, _, _ = BEFORE_ROWS
_ZERO = np.float32(0)


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


@cached_entry
def renumbered(keys: Keys, origin: _Int64s, later_ns: int, pixel_bits: int) -> Keys:
    """Return packed events with the pixel numbers `origin`, and times counted from `later_ns` earlier."""
    out, one, shift = np.empty(keys.size, np.uint64), np.uint64(1), np.uint64(pixel_bits + 1)
    mask = np.uint64((1 << pixel_bits) - 1)
    for k in range(keys.size):
        pixel, dt = np.uint64(origin[(keys[k] >> one) & mask]), (keys[k] >> shift) + np.uint64(later_ns)
        out[k] = (dt << shift) | (pixel << one) | (keys[k] & one)
    return out

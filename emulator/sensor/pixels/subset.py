"""Pixels that are set aside: as they were at the start of a step, packed as an array of pixels of their own.

What is suspect in a step and can be had in halves is not solved with the others. Its state is copied here and moved
over the halves by the same kernels that move the whole array (see `halving`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.cached import kept_entry
from emulator.sensor.numerics.compiled import kernel
from emulator.sensor.pixels.interpolation import completed, is_suspect
from emulator.sensor.pixels.packed_crossings import Keys
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, FIELDS, Field, Pixels, StepConstants, slot

__all__ = ["Aside", "new_aside", "placed", "put_back", "set_aside"]

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P = (int(f) * BLOCK for f in Field)
_U0, _V0, _L0, _G0, _A0, _A1, _, _, _W0, _P0, _, _ = BEFORE_ROWS
_ZERO = np.float32(0)


class Aside(NamedTuple):
    """Room for the pixels of `blocks` blocks: their states, laid out as `Pixels.fields`, and who they are."""

    fields: _Float32s
    pixels: _Int64s


def new_aside(blocks: int) -> Aside:
    """Return an empty one. Memory that is never written to is never taken."""
    return Aside(np.zeros(blocks * FIELDS * BLOCK, np.float32), np.zeros(blocks * BLOCK, np.int64))


@kernel
def _at(row: int, k: np.uint64) -> np.uint64:
    return np.uint64(row) + k


@kernel
def set_aside(
    found: _Int64s, s: _Float32s, before: _Float32s, aside: Aside, at: tuple[int, int], c: StepConstants
) -> tuple[int, int]:
    """Take the suspects from a block's candidates.

    Parameters
    ----------
    found : indices of the candidates in the block; those that are left move to the front.
    at : the block's first pixel, and how many are set aside already.

    Returns
    -------
    How many are left, and how many are set aside now. Pixels whose light is not readable are never taken.
    """
    first, n = at
    left = 0
    for pixel in found:
        i = np.uint64(pixel)
        found[left] = pixel
        u0, v0 = before[_at(_U0, i)], before[_at(_V0, i)]
        d, unseen = s[_at(_U, i)] - u0, c.trust * min(s[_at(_ON, i)], s[_at(_OFF, i)])
        a0, a1 = completed(d, before[_at(_A0, i)], before[_at(_A1, i)])
        if not (is_suspect(d, a0, a1, unseen) & (v0 == v0)):
            left += 1
            continue
        aside.pixels[n] = first + pixel
        to = slot(n)
        n += 1
        aside.fields[to + _U], aside.fields[to + _V] = u0, v0
        aside.fields[to + _L], aside.fields[to + _G] = before[_at(_L0, i)], before[_at(_G0, i)]
        for row in (_REF, _ON, _OFF, _LEAK):
            aside.fields[to + row] = s[_at(row, i)]
        aside.fields[to + _W] = before[_at(_W0, i)] if c.second > _ZERO else s[_at(_W, i)]
        aside.fields[to + _P] = before[_at(_P0, i)] if c.parasitic > _ZERO else s[_at(_P, i)]
    return left, n


@kept_entry
def put_back(here: Pixels, above: Pixels, listed: _Int64s) -> None:
    """Put the state of `here`, come to the step's end, back to the pixels of `above` it was taken from.

    Their light is up to date there.
    """
    for k in range(listed.size):
        at, to = slot(k), slot(listed[k])
        for row in (_V, _REF, _W, _P):
            above.fields[to + row] = here.fields[at + row]
        above.blind_until_ns[listed[k]] = here.blind_until_ns[k]


@kept_entry
def placed(keys: Keys, origin: _Int64s, later_ns: int, pixel_bits: int) -> Keys:
    """Return packed events with their pixels named as by `origin`, and counted from `later_ns` earlier."""
    out, one, shift = np.empty(keys.size, np.uint64), np.uint64(1), np.uint64(pixel_bits + 1)
    mask = np.uint64((1 << pixel_bits) - 1)
    for k in range(keys.size):
        pixel, dt = np.uint64(origin[(keys[k] >> one) & mask]), (keys[k] >> shift) + np.uint64(later_ns)
        out[k] = (dt << shift) | (pixel << one) | (keys[k] & one)
    return out

"""Threshold crossings: lists made from packed keys, concatenated, or merged by time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import cached_entry
from emulator.sensor.pixels.step import unpack

_Arrays = tuple[npt.NDArray[np.int64], npt.NDArray[np.uint32], npt.NDArray[np.bool_]]


@dataclass(frozen=True, slots=True)
class Crossings:
    """Threshold crossings of one step, sorted by (time, pixel); views, valid until the next step or reset.

    Attributes
    ----------
    t_ns : (n,) int64
        Stream time.
    pixel : (n,) uint32
        row * width + column.
    on : (n,) bool
        True where the light increased.
    lost_in_pixel : int
        Crossings of this step that are not listed, because their pixel had more than 64.
    """

    t_ns: npt.NDArray[np.int64]
    pixel: npt.NDArray[np.uint32]
    on: npt.NDArray[np.bool_]
    lost_in_pixel: int = 0

    def __len__(self) -> int:
        return self.t_ns.size


NO_CROSSINGS = Crossings(np.empty(0, np.int64), np.empty(0, np.uint32), np.empty(0, np.bool_))
"""The crossings of a step in which no pixel fires."""


def unpacked(keys: npt.NDArray[np.uint64], t0_ns: int, pixel_bits: int) -> Crossings:
    """Sort `keys`, (n,) uint64 packed as [time since t0 | pixel | on], in place, and return them as crossings."""
    if not keys.size:
        return NO_CROSSINGS
    keys.sort()
    arrays = np.empty(keys.size, np.int64), np.empty(keys.size, np.uint32), np.empty(keys.size, np.bool_)
    unpack(keys, t0_ns, pixel_bits, arrays)
    return Crossings(*arrays)


def joined(parts: Sequence[Crossings]) -> Crossings:
    """Return one list of several that follow each other in time."""
    parts = [part for part in parts if len(part) or part.lost_in_pixel] or [NO_CROSSINGS]
    if len(parts) == 1:
        return parts[0]
    t_ns, pixel, on = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "pixel", "on"))
    return Crossings(t_ns, pixel, on, sum(part.lost_in_pixel for part in parts))


@cached_entry
def _merge(a: _Arrays, b: _Arrays, out: _Arrays) -> None:
    i = j = 0
    n_a, n_b = a[0].size, b[0].size
    for k in range(n_a + n_b):
        first = j == n_b or (i < n_a and (a[0][i] < b[0][j] or (a[0][i] == b[0][j] and a[1][i] <= b[1][j])))
        if first:
            out[0][k], out[1][k], out[2][k] = a[0][i], a[1][i], a[2][i]
            i += 1
        else:
            out[0][k], out[1][k], out[2][k] = b[0][j], b[1][j], b[2][j]
            j += 1


def merged(a: Crossings, b: Crossings) -> Crossings:
    """Return both lists as one, sorted by (time, pixel); of equals, those of `a` come first."""
    if not len(b) and not b.lost_in_pixel:
        return a
    if not len(a) and not a.lost_in_pixel:
        return b
    n = len(a) + len(b)
    out = np.empty(n, np.int64), np.empty(n, np.uint32), np.empty(n, np.bool_)
    _merge((a.t_ns, a.pixel, a.on), (b.t_ns, b.pixel, b.on), out)
    return Crossings(*out, a.lost_in_pixel + b.lost_in_pixel)

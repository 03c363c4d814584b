"""Threshold crossings: packed for sorting, unpacked to lists, concatenated, or merged by time.

A step's crossings are packed in 64 bits each, in the order of time and pixel: fast, as numpy sorts these with vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import cached_entry, kernel, kernel_that_allocates

Keys = npt.NDArray[np.uint64]
"""Packed events."""

Fields = tuple[npt.NDArray[np.int64], npt.NDArray[np.uint32], npt.NDArray[np.bool_]]
"""Times, ns, pixels and polarities of events."""


@kernel
def pack(dt_ns: int, pixel: int, on: int, pixel_bits: int) -> np.uint64:
    """Pack an event so that sorting the numbers sorts by (time, pixel): [dt_ns | pixel | on]."""
    return (np.uint64(dt_ns) << np.uint64(pixel_bits + 1)) | (np.uint64(pixel) << np.uint64(1)) | np.uint64(on)


@kernel_that_allocates
def reserve(keys: Keys, needed: int) -> Keys:
    """Return `keys`, or a longer copy if it holds fewer than `needed`."""
    if needed <= keys.size:
        return keys
    longer = np.empty(max(2 * keys.size, needed), np.uint64)
    for k in range(keys.size):  # a slice would take seconds to compile
        longer[k] = keys[k]
    return longer


@cached_entry
def unpack(keys: Keys, t0_ns: int, pixel_bits: int, out: Fields) -> None:
    """Split sorted keys [dt_ns | pixel | on] into arrays of one field each, at least as long."""
    for k in range(keys.size):
        key = keys[k]
        out[0][k] = t0_ns + np.int64(key >> np.uint64(pixel_bits + 1))
        out[1][k] = np.uint32((key >> np.uint64(1)) & np.uint64((1 << pixel_bits) - 1))
        out[2][k] = (key & np.uint64(1)) != 0


@dataclass(slots=True)
class EventBuffers:
    """Packed events, and times, pixels and polarities of unpacked ones."""

    keys: Keys = field(default_factory=lambda: np.empty(4096, np.uint64))
    t_ns: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    pixel: npt.NDArray[np.uint32] = field(default_factory=lambda: np.empty(0, np.uint32))
    on: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))

    def add(self, keys: Keys, t0_ns: int, pixel_bits: int, n: int) -> int:
        """Add a sorted list, packed with times from `t0_ns`, to the first n events; return the new number."""
        self._reserve(n + keys.size)
        unpack(keys, t0_ns, pixel_bits, (self.t_ns[n:], self.pixel[n:], self.on[n:]))
        return n + keys.size

    def _reserve(self, n: int) -> None:
        """Provide space for n events; the present ones stay."""
        if n > self.t_ns.size:
            added = max(n, 2 * self.t_ns.size) - self.t_ns.size
            self.t_ns = np.concatenate([self.t_ns, np.empty(added, np.int64)])
            self.pixel = np.concatenate([self.pixel, np.empty(added, np.uint32)])
            self.on = np.concatenate([self.on, np.empty(added, np.bool_)])


@dataclass(frozen=True, slots=True)
class Crossings:
    """Threshold crossings of one step, sorted by (time, pixel); views, valid until the next step or reset.

    Attributes
    ----------
    t_ns : stream time, (n,) int64.
    pixel : row * width + column, (n,) uint32.
    on : true where the light increased, (n,) bool.
    lost_in_pixel : crossings of this step that are not listed, because their pixel had more than 64.
    """

    t_ns: npt.NDArray[np.int64]
    pixel: npt.NDArray[np.uint32]
    on: npt.NDArray[np.bool_]
    lost_in_pixel: int = 0

    def __len__(self) -> int:
        return self.t_ns.size


NO_CROSSINGS = Crossings(np.empty(0, np.int64), np.empty(0, np.uint32), np.empty(0, np.bool_))
"""The crossings of a step in which no pixel fires."""


def unpacked(keys: Keys, t0_ns: int, pixel_bits: int) -> Crossings:
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
def _merge(a: Fields, b: Fields, out: Fields) -> None:
    i = j = 0
    n_a, n_b = a[0].size, b[0].size
    for k in range(n_a + n_b):
        takes_a = j == n_b or (i < n_a and (a[0][i] < b[0][j] or (a[0][i] == b[0][j] and a[1][i] <= b[1][j])))
        source, place = (a, i) if takes_a else (b, j)
        out[0][k] = source[0][place]
        out[1][k] = source[1][place]
        out[2][k] = source[2][place]
        i += takes_a
        j += not takes_a


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

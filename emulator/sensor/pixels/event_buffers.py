"""Buffers of a step's events, which grow on demand and are used again."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.sensor.pixels.step import unpack, unpack_both

__all__ = ["EventBuffers"]


@dataclass(slots=True)
class EventBuffers:
    """Packed events, and times, pixels and polarities of unpacked ones."""

    keys: npt.NDArray[np.uint64] = field(default_factory=lambda: np.empty(4096, np.uint64))
    t_ns: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    pixel: npt.NDArray[np.uint32] = field(default_factory=lambda: np.empty(0, np.uint32))
    on: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))

    def add(self, lists: list[npt.NDArray[np.uint64]], packed: tuple[int, int], n: int) -> int:
        """Add the events of one or two sorted lists to the first n, and return the new number.

        `packed`: the time from which they count, ns, and the bits of a pixel's number.
        """
        found = sum(keys.size for keys in lists)
        if not found:
            return n
        self._reserve(n + found)
        out = self.t_ns[n:], self.pixel[n:], self.on[n:]
        if len(lists) == 1:
            unpack(lists[0], *packed, out)
        else:
            unpack_both((lists[0], lists[1]), *packed, out)
        return n + found

    def _reserve(self, n: int) -> None:
        """Provide space for n events; the present ones stay."""
        if n > self.t_ns.size:
            more = max(n, 2 * self.t_ns.size) - self.t_ns.size
            self.t_ns = np.concatenate([self.t_ns, np.empty(more, np.int64)])
            self.pixel = np.concatenate([self.pixel, np.empty(more, np.uint32)])
            self.on = np.concatenate([self.on, np.empty(more, np.bool_)])

"""Random events of their own, as those of particles: drawn by slots of stream time, given out step by step.

What is drawn for a slot of 1024 us depends on the slot and the seed alone. An event may lie later than its slot (the
second of a pair, the OFF event after a particle), so all that is known is kept until a step reaches it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import kernel, kernel_that_allocates
from emulator.sensor.pixels.array import Crossings
from emulator.sensor.pixels.merging import NO_CROSSINGS, joined, merged, unpacked

__all__ = ["LONGEST_NS", "SLOT_NS", "Ahead", "SlottedEvents", "Window", "give_out", "new_ahead", "roomy"]

SLOT_NS = 1_024_000
"""Events are drawn in slots of this length."""

LONGEST_NS = 1 << 33
"""Events of so long a stretch are sorted together: times and pixels must share 64 bits."""


class Ahead(NamedTuple):
    """Events that are known and have not been given out: times, and pixel << 1 | on; room for more behind."""

    t_ns: npt.NDArray[np.int64]
    key: npt.NDArray[np.uint64]


class Window(NamedTuple):
    """The first slot to draw, the times between which events are wanted, and the bits of a pixel's number."""

    slot: int
    t0_ns: int
    t1_ns: int
    pixel_bits: int


def new_ahead() -> Ahead:
    """Return an empty one."""
    return Ahead(np.empty(256, np.int64), np.empty(256, np.uint64))


@kernel_that_allocates
def roomy(ahead: Ahead, n: int, more: int) -> Ahead:
    """Return `ahead` with room for `more` behind its first n events."""
    if n + more <= ahead.t_ns.size:
        return ahead
    t_ns, key = np.empty(2 * (n + more), np.int64), np.empty(2 * (n + more), np.uint64)
    t_ns[:n], key[:n] = ahead.t_ns[:n], ahead.key[:n]
    return Ahead(t_ns, key)


@kernel
def give_out(window: Window, ahead: Ahead, n: int, keys: npt.NDArray[np.uint64]) -> tuple[int, int]:
    """Pack the events of the window into `keys`, (n + 1,), and move up those after it; return the numbers of each."""
    shift = np.uint64(window.pixel_bits + 1)
    found = kept = 0
    for k in range(n):
        t_ns, key = ahead.t_ns[k], ahead.key[k]
        ahead.t_ns[kept], ahead.key[kept] = t_ns, key
        kept += t_ns >= window.t1_ns
        keys[found] = np.uint64(t_ns - window.t0_ns) << shift | key
        found += (t_ns < window.t1_ns) & (t_ns >= window.t0_ns)
    return found, kept


class SlottedEvents(ABC):
    """A source of events; `pixels` is the array's number of pixels."""

    def __init__(self, pixels: int) -> None:
        self._pixel_bits = max(1, (pixels - 1).bit_length())
        self.reset(0)

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`; what began before is left out."""
        self._ahead, self._known = new_ahead(), 0
        self._slot, self._t_ns = t_ns // SLOT_NS, t_ns

    def add_to(self, crossings: Crossings, light: npt.NDArray[np.float32], t_ns: int) -> Crossings:
        """Return a step's `crossings` with the events up to, and without, `t_ns` among them."""
        return merged(crossings, self.step(light, t_ns))

    def step(self, light: npt.NDArray[np.float32], t_ns: int) -> Crossings:
        """Return the events from the last time up to, and without, `t_ns`, under `light`, (pixels,) float32."""
        parts = []
        while self._t_ns < t_ns:
            parts.append(self._piece(light, min(t_ns, self._t_ns + LONGEST_NS)))
        return joined(parts) if parts else NO_CROSSINGS

    def _piece(self, light: npt.NDArray[np.float32], t_ns: int) -> Crossings:
        window = Window(self._slot, self._t_ns, t_ns, self._pixel_bits)
        ahead, self._known, keys = self._advance(window, light, self._ahead, self._known)
        self._ahead, self._slot, self._t_ns = Ahead(*ahead), -(-t_ns // SLOT_NS), t_ns
        return unpacked(keys, window.t0_ns, self._pixel_bits)

    @abstractmethod
    def _advance(
        self, window: Window, light: npt.NDArray[np.float32], ahead: Ahead, known: int
    ) -> tuple[Ahead, int, npt.NDArray[np.uint64]]:
        """Draw the slots that begin before the window's end; return what lies ahead, and what `give_out` packed."""

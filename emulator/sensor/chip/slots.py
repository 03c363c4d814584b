"""Random events that are drawn by slots of stream time and released step by step, such as those of particles.

The draws of a slot of 1024 us depend on the slot and the seed alone. An event may lie after its slot (the second of a
pair, the OFF event after a particle), so drawn events stay pending until a step reaches them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import kernel, kernel_that_allocates
from emulator.sensor.pixels.array import Crossings
from emulator.sensor.pixels.merging import NO_CROSSINGS, joined, merged, unpacked

__all__ = ["LONGEST_NS", "SLOT_NS", "Pending", "SlottedEvents", "Window", "new_pending", "release", "reserve"]

SLOT_NS = 1_024_000
"""Length of a slot, in which events are drawn."""

LONGEST_NS = 1 << 33
"""Longest interval whose events are sorted together: time and pixel share 64 bits."""


class Pending(NamedTuple):
    """Events that are drawn and not yet released: times, and pixel << 1 | on; with free space behind them."""

    t_ns: npt.NDArray[np.int64]
    key: npt.NDArray[np.uint64]


class Window(NamedTuple):
    """The first slot to draw, the start and end of the wanted interval, and the bits of a pixel's number."""

    slot: int
    t0_ns: int
    t1_ns: int
    pixel_bits: int


def new_pending() -> Pending:
    """Return an empty list of pending events."""
    return Pending(np.empty(256, np.int64), np.empty(256, np.uint64))


@kernel_that_allocates
def reserve(pending: Pending, n: int, more: int) -> Pending:
    """Return `pending`, a longer copy where there is no space for `more` behind its first n events."""
    if n + more <= pending.t_ns.size:
        return pending
    t_ns, key = np.empty(2 * (n + more), np.int64), np.empty(2 * (n + more), np.uint64)
    t_ns[:n], key[:n] = pending.t_ns[:n], pending.key[:n]
    return Pending(t_ns, key)


@kernel
def release(window: Window, pending: Pending, n: int, keys: npt.NDArray[np.uint64]) -> tuple[int, int]:
    """Pack the events of the window into `keys`, (n + 1,), and compact those after it; return both numbers."""
    shift = np.uint64(window.pixel_bits + 1)
    found = remaining = 0
    for k in range(n):
        t_ns, key = pending.t_ns[k], pending.key[k]
        pending.t_ns[remaining], pending.key[remaining] = t_ns, key
        remaining += t_ns >= window.t1_ns
        keys[found] = np.uint64(t_ns - window.t0_ns) << shift | key
        found += (t_ns < window.t1_ns) & (t_ns >= window.t0_ns)
    return found, remaining


class SlottedEvents(ABC):
    """A source of random events for an array of `pixels` pixels."""

    def __init__(self, pixels: int) -> None:
        self._pixel_bits = max(1, (pixels - 1).bit_length())
        self.reset(0)

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`; events that began before are left out."""
        self._pending, self._known = new_pending(), 0
        self._slot, self._t_ns = t_ns // SLOT_NS, t_ns

    def add_to(self, crossings: Crossings, light: npt.NDArray[np.float32], t_ns: int) -> Crossings:
        """Return a step's `crossings` with the events up to, and without, `t_ns` among them."""
        return merged(crossings, self.step(light, t_ns))

    def step(self, light: npt.NDArray[np.float32], t_ns: int) -> Crossings:
        """Return the events from the last time up to, and without, `t_ns`, under `light`, (pixels,) float32."""
        parts = []
        while self._t_ns < t_ns:
            parts.append(self._events_until(light, min(t_ns, self._t_ns + LONGEST_NS)))
        return joined(parts) if parts else NO_CROSSINGS

    def _events_until(self, light: npt.NDArray[np.float32], t_ns: int) -> Crossings:
        window = Window(self._slot, self._t_ns, t_ns, self._pixel_bits)
        pending, self._known, keys = self._advance(window, light, self._pending, self._known)
        self._pending, self._slot, self._t_ns = Pending(*pending), -(-t_ns // SLOT_NS), t_ns
        return unpacked(keys, window.t0_ns, self._pixel_bits)

    @abstractmethod
    def _advance(
        self, window: Window, light: npt.NDArray[np.float32], pending: Pending, known: int
    ) -> tuple[Pending, int, npt.NDArray[np.uint64]]:
        """Draw the slots that begin before the window's end; return the pending and the packed events."""

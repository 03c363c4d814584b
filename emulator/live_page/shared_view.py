"""What the session shows the page's process, in shared memory: events, the light, and whether anybody looks.

While nobody looks the session does nothing for the page but read one number a step. Events that find no room are not
shown; the run's own events go other ways.
"""

from __future__ import annotations

import multiprocessing
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.live_page.drawing import reduction
from firmware_protocol.events import Events
from transports.link.ring import EventRing

__all__ = ["SharedView"]

_VIEWERS, _COMMANDS, _CELLS = range(3)
_RING_EVENTS = 1 << 19
_LIGHT_PERIOD_US = 40_000  # of stream time; the page shows 25 pictures a second


class SharedView:
    """Shared memory for a sensor of `size`, (width, height); pass it to a process started by the spawn method."""

    def __init__(self, size: tuple[int, int]) -> None:
        context = multiprocessing.get_context("spawn")
        self._size, self._ring = size, EventRing(_RING_EVENTS)
        self._by = reduction(size)
        shape = tuple(-(-side // self._by) for side in reversed(size))
        self._memory = context.RawArray("f", shape[0] * shape[1]), context.RawArray("q", _CELLS), shape
        self._light_us = 0
        self._map()

    def _map(self) -> None:
        light, cells, shape = self._memory
        self.light: npt.NDArray[np.float32] = np.frombuffer(light, np.float32).reshape(shape)
        self._cells = np.frombuffer(cells, np.int64)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("light", "_cells")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._map()

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor, pixels."""
        return self._size

    @property
    def viewers(self) -> int:
        """How many look; the page's process writes it."""
        return int(self._cells[_VIEWERS])

    @viewers.setter
    def viewers(self, count: int) -> None:
        self._cells[_VIEWERS] = count

    @property
    def commands(self) -> int:
        """Commands sent so far; the page's process writes it, so that the session need not ask the pipe each step."""
        return int(self._cells[_COMMANDS])

    @commands.setter
    def commands(self, count: int) -> None:
        self._cells[_COMMANDS] = count

    def show(self, events: Events, light: npt.NDArray[np.float32], now_us: int) -> None:
        """Show the events of a step, up to `now_us`, and the light at its end."""
        if not self._cells[_VIEWERS]:
            return
        self._ring.push(events)
        self._ring.publish(now_us)
        if not 0 <= now_us - self._light_us < _LIGHT_PERIOD_US:
            self._light_us = now_us
            self.light[:] = light[:: self._by, :: self._by]

    def take(self) -> tuple[Events, int]:
        """Return the events shown since the last call, and the time up to which; for the page's process."""
        now_us = self._ring.now_us
        return self._ring.take(1 << 62), now_us

"""A piece of flight software: it reads a camera's telemetry and requests a smaller window at high rates.

It takes a serial port, any object with `read`, `write` and `in_waiting`, and does not depend on the emulator. It
decodes with the receiver of evstim; a C program uses firmware_protocol/c instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from evstim import SerialReceiver
from firmware_protocol.packets.telecommands import SetRegion

WINDOW_US = 100_000


class Port(Protocol):
    """The part of a serial port that is used."""

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read."""

    def read(self, size: int = 1) -> bytes:
        """Return at most `size` bytes."""

    def write(self, data: bytes) -> object:
        """Send bytes."""


class RateGuard:
    """Keeps the camera's event rate below a limit.

    Parameters
    ----------
    port : the camera's line.
    limit : most events in 100 ms.
    small : x, y, width and height of the window that is requested when there are more.

    Attributes
    ----------
    events : received so far.
    reduced : True when the smaller window was requested.
    """

    def __init__(self, port: Port, limit: int, small: tuple[int, int, int, int] = (109, 66, 128, 128)) -> None:
        self.events = 0
        self.reduced = False
        self._port = port
        self._limit = limit
        self._small = small
        self._receiver = SerialReceiver("ccsds-cobs")
        self._window = -1
        self._count = 0

    @property
    def faults(self) -> int:
        """Damaged frames, gaps and broken blocks."""
        return self._receiver.faults

    def poll(self) -> None:
        """Read the received bytes and act on them; to be called in a loop."""
        self._receiver.push(self._port.read(max(1, self._port.in_waiting)))
        events = self._receiver.take_events()
        self.events += len(events)
        for window, count in zip(*np.unique(events["t"] // WINDOW_US, return_counts=True), strict=True):
            self._add(int(window), int(count))

    def run(self, goes_on: Callable[[], bool]) -> None:
        """Poll as long as `goes_on` returns True."""
        while goes_on():
            self.poll()

    def _add(self, window: int, count: int) -> None:
        self._count = self._count + count if window == self._window else count
        self._window = window
        if self._count > self._limit and not self.reduced:
            self.reduced = True
            self._port.write(self._receiver.wrap(SetRegion(*self._small)))

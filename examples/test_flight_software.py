"""A test of flight software against an emulated camera: `pytest test_flight_software.py`.

The code under test watches the event rate and requests a shorter exposure to light (here: a flag) when it is too high.
Two kinds of input reach it: events of a whole camera, read by the loopback host as a driver reads them, and a scene of
our own, made of frames.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import evstim


class RateMonitor:
    """The code under test: raises `alarm` when more than `limit` events come in one window of 10 ms."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.alarm = False
        self._window = -1
        self._count = 0

    def take(self, events: npt.NDArray[np.void]) -> None:
        """Take the next events, sorted by time."""
        for window, count in zip(*np.unique(events["t"] // 10_000, return_counts=True), strict=True):
            self._count = int(count) if window != self._window else self._count + int(count)
            self._window = int(window)
            self.alarm |= self._count > self.limit


def test_a_scene_that_moves_slowly_raises_no_alarm() -> None:
    """The camera of the rig 'loopback' sends 1.5 million events a second, 15 000 in 10 ms."""
    monitor = RateMonitor(limit=40_000)
    with evstim.run("loopback", seconds=0.1, pace="free", seed=1) as run:
        for events in run:
            monitor.take(events)
    assert run.result.good, "every event has arrived at the host inside the link"
    assert run.result.ledger.read_out > 10_000
    assert not monitor.alarm


def test_a_flash_raises_the_alarm() -> None:
    """The thruster fires: everything becomes eight times brighter within a millisecond."""
    still, flash = np.full((260, 346), 0.1), np.full((260, 346), 0.8)
    events = evstim.events_from_frames([still, still, flash, flash], t_us=[0, 20_000, 21_000, 40_000], seed=1)
    monitor = RateMonitor(limit=40_000)
    monitor.take(events)
    assert monitor.alarm

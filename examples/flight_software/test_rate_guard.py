"""Tests of the rate guard: on a serial port in memory, on a running camera, and on one whose line is damaged."""

from __future__ import annotations

import time

import numpy as np
import pytest
import serial
from rate_guard import RateGuard

import evstim
from evstim.testing.fakes import FakeSerialPort
from evstim.testing.running_rig import RunningRig


def events(count: int, gap_us: int) -> np.ndarray:
    """Return `count` events at the left edge of the picture."""
    made = np.zeros(count, evstim.EVENT)
    made["t"] = np.arange(count) * gap_us
    made["y"] = np.arange(count) % 260
    return made


def test_a_quiet_camera_is_left_alone() -> None:
    """One event a millisecond is 100 in a window."""
    with FakeSerialPort() as port:
        guard = RateGuard(port, limit=200)
        port.show(events(1000, gap_us=1000))
        guard.poll()
    assert guard.events == 1000
    assert not guard.reduced


def test_a_busy_camera_is_commanded_to_send_less() -> None:
    """The instrument obeys: events outside the window do not come any more."""
    with FakeSerialPort() as port:
        guard = RateGuard(port, limit=200)
        port.show(events(1000, gap_us=100))
        guard.poll()
        assert guard.reduced
        port.show(events(2000, gap_us=100)[1000:])
        assert port.instrument.counters.not_selected == 1000


@pytest.mark.rig("serial-demo", seed=7)
def test_with_a_camera_on_a_real_port(evstim_rig: RunningRig) -> None:
    """The rig sends some 10 000 events in 100 ms; the guard allows 1 000 and gets the window."""
    with serial.Serial(evstim_rig.address, timeout=0.05) as port:
        guard = RateGuard(port, limit=1000)
        end_s = time.monotonic() + 30
        guard.run(lambda: not guard.reduced and time.monotonic() < end_s)
    assert guard.reduced
    assert guard.faults == 0


@pytest.mark.rig("serial-demo", seed=7)
def test_bit_flips_are_noticed(evstim_rig: RunningRig) -> None:
    """Three bits of ten thousand are wrong for a while: frames are lost, and the guard counts them."""
    with serial.Serial(evstim_rig.address, timeout=0.05) as port:
        guard = RateGuard(port, limit=10**9)
        end_s = time.monotonic() + 30
        guard.run(lambda: not guard.events and time.monotonic() < end_s)
        evstim_rig.inject("bit_flips", rate=3e-4, for_s=1.0)
        guard.run(lambda: not guard.faults and time.monotonic() < end_s)
    assert guard.faults > 0

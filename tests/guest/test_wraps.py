"""Unmodified drivers read on across the wraps of the camera's time, which comes a thousand times faster than real time.

The words carry 15 bits of the time, and libcaer's events 31: a camera gets past 2^31 us after 35.8 minutes. A day, with
40 such crossings for each driver:

    EVSTIM_WRAP_HOURS=24 python -m pytest tests/guest/test_wraps.py
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.streaming import Streaming
from tests.hostile.looped import Follower, Looped
from tests.hostile.usbip_soak import free_run
from transports.recording.record import load_record

HOURS = float(os.environ.get("EVSTIM_WRAP_HOURS", "0.61"))
GAP_US = 20_000
PACKET_MS = 60_000
READY_MS = 1000  # neuromorphic_drivers must have started all its transfers; a guest on a busy machine is slow
TIMEOUT_S = 300.0 + 120.0 * HOURS

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(TIMEOUT_S + 300),
]


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_every_time_is_exact_across_the_wraps(guest: Guest, driver: Driver, driver_pythons: dict[str, Path]) -> None:
    looped = Looped(1_000_000, GAP_US)
    count = round(HOURS * 3.6e9) // GAP_US
    with free_run(looped, READY_MS, record=True) as run, Attachment(guest, run.port):
        options = ("--packet-ms", str(PACKET_MS))
        seen = Streaming(guest, driver, driver_pythons[driver.name], count, *options, timeout_s=TIMEOUT_S).wait()
        summary = run.stop()
        delivered, resets = load_record(run.record)
    assert len(seen.events) >= count, seen.about
    first_us, last_us = (int(seen.events["t"][k]) for k in (0, -1))
    assert last_us - first_us > 1 << 31
    delivered = delivered[resets[-1] :]
    assert_same(seen.events, delivered, offset_us=first_us - int(delivered["t"][0]) if driver.adds_host_time else 0)
    Follower(looped).take(seen.events)
    assert summary["balanced"], summary

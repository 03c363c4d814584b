"""Unmodified drivers read on across the wraps of the camera's time, which comes a thousand times faster than real time.

The words carry 15 bits of the time, and libcaer's events 31: a camera gets past 2^31 us after 35.8 minutes. A day, with
40 such crossings for each driver:

    EVSTIM_WRAP_HOURS=24 python -m pytest tests/guest/test_wraps.py
"""

import os
from contextlib import suppress

import pytest

from tests.guest.all_streams import place_of
from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming
from tests.guest.turns import Turns, selected
from tests.hostile.looped import Follower, Looped

HOURS = float(os.environ.get("EVSTIM_WRAP_HOURS", "0.61"))
GAP_US = 20_000
COUNT = round(HOURS * 3.6e9) // GAP_US
MOST_DISCARDED = COUNT // 5
MOST_KEPT = 16  # between discarded ones; 1 and 2 were seen
PACKET_MS = 60_000
TIMEOUT_S = 300.0 + 120.0 * HOURS

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(3 * (TIMEOUT_S + 300)),  # the first test waits for all drivers
]


RIG = """
title = "a loop of recorded events as fast as its reader takes them"
[scene]
kind = "recording"
path = "looped.npz"
[camera]
start_delay_ms = 3000.0   # a driver must have started all its transfers; a guest on a busy machine is slow
[run]
pace = "free"
step_us = 1000000
[[links]]
kind = "usbip"
port = {port}
"""


class LongRun(RunningRig):
    """A run whose time passes a thousand times faster than real time."""

    limit_s = 3.2e7


@pytest.fixture(scope="module")
def looped():
    return Looped(1_000_000, GAP_US)


@pytest.fixture(scope="module")
def turns(request, guest, driver_pythons, looped, tmp_path_factory):
    folder = tmp_path_factory.mktemp("wraps")
    looped.save(folder / "looped.npz")
    rig = LongRun(folder, text=RIG)

    def read(driver):
        options = ("--packet-ms", str(PACKET_MS))
        with Attachment(guest, rig.port):
            python = driver_pythons[driver.name]
            return Streaming(guest, driver, python, COUNT, *options, timeout_s=TIMEOUT_S).wait()

    return Turns(rig, selected(request, "driver"), read)


def begun(driver, seen, delivered):
    """Return the events that a driver saw from its start on, and the index of the first one in `delivered`.

    iniVation's libraries discard what arrives within some 0.1 s of their start, and in this run that is minutes. A few
    events between discarded ones they keep, the last of these with the row of a discarded one.
    """
    if not driver.adds_host_time or (seen["x"][:100] == delivered["x"][:100]).all():
        return seen, 0
    for kept in range(1, MOST_KEPT + 1):
        with suppress(AssertionError):
            return seen[kept:], place_of(seen[kept:], delivered)
    raise AssertionError(f"nothing that was delivered begins as what was seen: {seen[: MOST_KEPT + 5].tolist()}")


@pytest.mark.long
@pytest.mark.sampled
@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_every_time_is_exact_across_the_wraps(turns, looped, driver):
    seen, delivered = turns.result(driver), turns.delivered(driver).events
    assert len(seen.events) >= COUNT, seen.about
    first_us, last_us = (int(seen.events["t"][k]) for k in (0, -1))
    assert last_us - first_us > 1 << 31
    events, place = begun(driver, seen.events, delivered)
    assert place < MOST_DISCARDED
    offset_us = int(events["t"][0]) - int(delivered["t"][place]) if driver.adds_host_time else 0
    assert_same(events, delivered[place:], offset_us=offset_us)
    Follower(looped).take(events)

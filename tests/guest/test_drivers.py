"""Three unmodified drivers on a real Linux kernel open the camera that is not there and see every event."""

import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import read, read_until_pulled
from tests.guest.turns import long_but, parts_of

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200)]

EVENTS = 1_000_000
FEWER_EVENTS = 100_000
SERIAL = "00000346"


def assert_sees(driver, seen, delivered):
    """Assert every t, x, y and polarity, from the first event delivered since device time was zero."""
    offset_us = int(seen["t"][0]) - int(delivered["t"][0]) if driver.adds_host_time else 0
    assert_same(seen, delivered, offset_us=offset_us)


@pytest.mark.shows("davis346", "{driver.name}", "opens", "events", "unplugged", "plugged again")
@pytest.mark.parametrize("driver", long_but(DRIVERS[:1], DRIVERS), ids=lambda driver: driver.name)
def test_every_event_is_seen_until_the_camera_is_unplugged_and_when_it_is_plugged_again(
    guest, driver, driver_pythons, tmp_path
):
    python = driver_pythons[driver.name]
    with RunningRig(tmp_path) as rig:
        cut, _ = read_until_pulled(Attachment(guest, rig.port), guest, driver, python, EVENTS)
        with Attachment(guest, rig.port):
            again = read(guest, driver, python, FEWER_EVENTS)
    assert any(SERIAL in found for found in cut.about["discovered"])
    for view, part in zip((cut, again), parts_of([cut, again], rig.delivered.turns), strict=True):
        assert_sees(driver, view.events, part.events)


@pytest.mark.long
def test_drivers_take_turns_at_high_speed_on_a_turned_chip(guest, driver_pythons, tmp_path):
    seen = []
    with RunningRig(tmp_path, speed="high", layout="turned") as rig:
        for driver in DRIVERS:
            with Attachment(guest, rig.port) as camera:
                assert camera.device["speed"] == "480"
                seen.append(read(guest, driver, driver_pythons[driver.name], FEWER_EVENTS))
    parts = parts_of(seen, rig.delivered.turns)
    for driver, view, part in zip(DRIVERS, seen, parts, strict=True):
        assert view.about["running"]
        assert_sees(driver, view.events, part.events)

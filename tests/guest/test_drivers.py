"""Three unmodified drivers on a real Linux kernel open the camera that is not there and see every event."""

from __future__ import annotations

from pathlib import Path

import pytest

from firmware_protocol.events import Events
from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import Delivered, RunningRig
from tests.guest.streaming import Streaming

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(240), pytest.mark.xdist_group("guest")]

EVENTS = 1_000_000
SERIAL = "00000346"
LONGER_THAN_THE_CABLE = 1 << 40


@pytest.fixture(params=DRIVERS, ids=lambda driver: driver.name)
def driver(request: pytest.FixtureRequest) -> Driver:
    chosen: Driver = request.param
    return chosen


def assert_sees_what_was_delivered(driver: Driver, seen: Events, delivered: Delivered) -> None:
    """Assert every t, x, y and polarity, from the very event on which the driver must start."""
    if driver.resets_time:
        expected = delivered.events[delivered.resets[-1] :]
        offset_us = int(seen["t"][0]) - int(expected["t"][0])
    else:
        expected, offset_us = delivered.events, 0
    assert_same(seen, expected, offset_us=offset_us)


def test_every_event_delivered_is_seen(guest: Guest, driver: Driver, driver_python: Path, tmp_path: Path) -> None:
    with RunningRig(tmp_path) as rig, Attachment(guest, rig.port):
        seen = Streaming(guest, driver, driver_python, EVENTS).wait()
    assert any(SERIAL in found for found in seen.about["discovered"])
    assert seen.about["running"]
    assert len(seen.events) >= EVENTS
    assert_sees_what_was_delivered(driver, seen.events, rig.delivered)
    assert rig.summary["balanced"], rig.summary


def test_an_unplugged_camera_is_noticed(guest: Guest, driver: Driver, driver_python: Path, tmp_path: Path) -> None:
    with RunningRig(tmp_path) as rig, Attachment(guest, rig.port):
        streaming = Streaming(guest, driver, driver_python, LONGER_THAN_THE_CABLE)
        streaming.wait_until_started()
        rig.stop()
        seen = streaming.wait()
    assert seen.about["running"] is False
    assert len(seen.events) > 0
    assert_sees_what_was_delivered(driver, seen.events, rig.delivered)
    assert rig.summary["balanced"], rig.summary

"""Three unmodified drivers on a real Linux kernel open the camera that is not there and see every event."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same, load_seen
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(240), pytest.mark.xdist_group("guest")]

EVENTS = 1_000_000
STREAM_TIMEOUT_S = 60
SERIAL = "00000346"


def client_command(guest: Guest, driver: Driver, python: Path, count: int = EVENTS) -> list[str]:
    limits = ["--count", str(count), "--timeout", str(STREAM_TIMEOUT_S)]
    return [str(python), str(driver.program), *limits, "--output", guest.path_in_guest(f"{driver.name}.npz")]


def last_json(stdout: str) -> dict[str, Any]:
    seen: dict[str, Any] = json.loads(stdout.splitlines()[-1])
    return seen


@pytest.fixture(params=DRIVERS, ids=lambda driver: driver.name)
def driver(request: pytest.FixtureRequest) -> Driver:
    chosen: Driver = request.param
    return chosen


def test_every_event_delivered_is_seen(guest: Guest, driver: Driver, driver_python: Path, tmp_path: Path) -> None:
    with RunningRig(tmp_path) as rig, Attachment(guest, rig.port):
        said = guest.check(client_command(guest, driver, driver_python), timeout_s=STREAM_TIMEOUT_S + 60)
    about = last_json(said)
    seen = load_seen(guest.results / f"{driver.name}.npz")
    delivered = rig.delivered

    assert any(SERIAL in found for found in about["discovered"])
    assert about["running"]
    assert about["events"] == len(seen) >= EVENTS
    # The drivers of iniVation reset the camera's time at the end of open, throw away what came before, and add the
    # host's time to every event; neuromorphic_drivers does none of this.
    resets_time = driver.name != "nd"
    assert len(delivered.resets) == (2 if resets_time else 1)
    expected = delivered.events[delivered.resets[-1] :]
    offset_us = int(seen["t"][0] - expected["t"][0]) if resets_time else 0
    assert_same(seen, expected, offset_us=offset_us)
    assert rig.summary["balanced"]

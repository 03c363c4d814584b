"""Three unmodified drivers see what happens on the camera's external input, at its times, among the events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_protocol.edges import EdgeKind
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200), pytest.mark.xdist_group("guest")]

EVENTS = 500_000
TRIGGER = """
[camera.clock]
drift_ppm = 50

[trigger]
period_ms = 10.0
kind = "pulse"
pulse_us = 300
latency_us = 37
jitter_us = 5
"""


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_every_edge_delivered_is_seen_at_its_time(
    guest: Guest, driver: Driver, driver_pythons: dict[str, Path], tmp_path: Path
) -> None:
    with RunningRig(tmp_path, more=TRIGGER) as rig, Attachment(guest, rig.port):
        seen = Streaming(guest, driver, driver_pythons[driver.name], EVENTS, "--triggers").wait()
    delivered = rig.delivered
    edges = delivered.edges[delivered.edge_resets[-1] :]
    first = delivered.events[delivered.resets[-1]]["t"]
    offset_us = int(seen.events["t"][0]) - int(first) if driver.adds_host_time else 0
    count = len(seen.triggers)
    assert count > 50
    assert (seen.triggers["t"] - np.uint64(offset_us)).tolist() == edges["t"][:count].tolist()
    assert seen.triggers["kind"].tolist() == edges["kind"][:count].tolist()
    assert set(seen.triggers["kind"].tolist()) == set(EdgeKind)
    assert rig.summary["balanced"], rig.summary
    assert rig.summary["links"]["usbip"]["edges"]["balanced"], rig.summary

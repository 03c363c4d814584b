"""Three unmodified drivers take samples of the inertial unit among events: every value, at its time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200), pytest.mark.xdist_group("guest")]

EVENTS = 300_000
UNIT = "\n[camera.imu]\ngyroscope_bias_deg_s = [30.0, -20.0, 0.5]\n"
COLUMNS = [f"accelerometer_{a}" for a in "xyz"] + ["temperature"] + [f"gyroscope_{a}" for a in "xyz"]


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_every_sample_delivered_is_seen_as_it_was_measured(
    guest: Guest, driver: Driver, driver_pythons: dict[str, Path], tmp_path: Path
) -> None:
    with RunningRig(tmp_path, more=UNIT) as rig, Attachment(guest, rig.port):
        seen = Streaming(guest, driver, driver_pythons[driver.name], EVENTS, "--imu").wait()
    delivered = rig.delivered
    events, imu = delivered.events[delivered.resets[-1] :], delivered.imu[delivered.imu_resets[-1] :]
    offset_us = int(seen.events["t"][0]) - int(events["t"][0]) if driver.adds_host_time else 0
    assert_same(seen.events, events, offset_us=offset_us)
    count = len(seen.imu_t)
    assert count > 100
    first = int(np.searchsorted(imu["t"], seen.imu_t[0] - offset_us))
    told = imu[first : first + count]
    assert (seen.imu_t - offset_us).tolist() == told["t"].astype(np.int64).tolist()
    values = np.column_stack([told[name] for name in COLUMNS]).astype(np.float64)
    np.testing.assert_allclose(seen.imu, values, rtol=4e-7, atol=1e-9)  # a few roundings of float32
    assert abs(values[:, 1].mean() + 1) < 0.2  # at rest on the bench, y down, it is held up with 1 g
    assert rig.summary["balanced"], rig.summary

"""Three unmodified drivers take all that a DAVIS346 has to tell at once: events, frames, inertial samples and triggers.

Each driver reads one layout of the chip; both are read. Every event, pixel, sample and edge, at its time; and the
AEDAT4 file that dv-processing's own writer makes of them is as that of a real camera. Ten million
events of each driver, with what comes beside them in half a minute:

    EVSTIM_GUEST_EVENTS=10000000 python -m pytest tests/guest/test_streams.py
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.guest.all_streams import ASKED, FREE, STREAMS, assert_same_frames, assert_same_streams
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming
from tests.guest.written_file import assert_same_file

# By default half a second of device time: a dozen frames, 50 pulses, 500 samples.
EVENTS = int(os.environ.get("EVSTIM_GUEST_EVENTS", "150000"))
TIMEOUT_S = 240.0 + EVENTS / 5000

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(TIMEOUT_S + 960),
]
# libcaer asks for this interval; dv-processing 2 for none: 20 ms of exposure and two reads of 260 lines of 35.25 us
FRAME_US = {"dv1": 40_000, "dv2": 20_000 + round(2 * 260 * 35.25)}
LAYOUTS = {"dv2": "upright", "dv1": "turned", "nd": "upright"}


@pytest.mark.shows("davis346", "{driver.name}", "opens", "events", "frames", "imu", "triggers")
@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_every_stream_is_seen_as_it_was_delivered(
    guest: Guest, driver: Driver, driver_pythons: dict[str, Path], tmp_path: Path
) -> None:
    asked = (*ASKED, "--aedat4", guest.path_in_guest("written.aedat4")) if driver.adds_host_time else ASKED
    # neuromorphic_drivers did not open beside a run at free pace: its requests timed out.
    more = STREAMS + (FREE if driver.adds_host_time else "")
    with RunningRig(tmp_path, layout=LAYOUTS[driver.name], more=more) as rig, Attachment(guest, rig.port):
        seen = Streaming(guest, driver, driver_pythons[driver.name], EVENTS, *asked, timeout_s=TIMEOUT_S).wait()
    assert len(seen.events) >= EVENTS
    delivered = rig.delivered
    offset_us = assert_same_streams(driver, seen, delivered)
    assert_same_frames(driver, seen, delivered, offset_us)
    if driver.adds_host_time:
        assert_same_file(guest.results / "written.aedat4", seen, FRAME_US[driver.name])
    assert rig.summary["balanced"], rig.summary
    assert rig.summary["links"]["usbip"]["edges"]["balanced"], rig.summary

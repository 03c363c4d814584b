"""Three unmodified drivers take all that a DAVIS346 has to tell at once: events, frames, inertial samples and triggers.

Those of iniVation read a DAVIS240C too. Each driver reads one layout of a DAVIS346's chip; both are read. Every event,
pixel, sample and edge, at its time. Ten million events of each driver, with what comes beside them in half a minute:

    EVSTIM_GUEST_EVENTS=10000000 python -m pytest tests/guest/test_streams.py
"""

import os
import time

import pytest

from tests.guest.all_streams import ASKED, FREE, STREAMS, STREAMS_240C, assert_same_frames, assert_same_streams
from tests.guest.attachment import DAVIS_FX2, DAVIS_FX3, Attachment
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import CHECKERBOARD, CHECKERBOARD_240C, RunningRig
from tests.guest.streaming import read

# By default half a second of device time: a dozen frames, 50 pulses, 500 samples.
EVENTS = int(os.environ.get("EVSTIM_GUEST_EVENTS", "150000"))
TIMEOUT_S = 240.0 + EVENTS / 5000

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(TIMEOUT_S + 960)]
LAYOUTS = {"dv2": "upright", "dv1": "turned", "nd": "upright"}
MODELS = {"davis346": (CHECKERBOARD, STREAMS, DAVIS_FX3), "davis240c": (CHECKERBOARD_240C, STREAMS_240C, DAVIS_FX2)}
CASES = [pytest.param("davis346", driver, id=driver.name) for driver in DRIVERS] + [
    pytest.param("davis240c", driver, id=f"davis240c-{driver.name}") for driver in DRIVERS if driver.adds_host_time
]


@pytest.mark.sampled
@pytest.mark.shows("{model}", "{driver.name}", "opens", "events", "frames", "imu", "triggers")
@pytest.mark.parametrize(("model", "driver"), CASES)
def test_every_stream_is_seen_as_it_was_delivered(guest, model, driver, driver_pythons, tmp_path, record_property):
    text, streams, usb_id = MODELS[model]
    layout = LAYOUTS[driver.name] if model == "davis346" else "upright"
    # neuromorphic_drivers did not open beside a run at free pace: its requests timed out.
    more = streams + (FREE if driver.adds_host_time else "")
    with RunningRig(tmp_path, layout=layout, more=more, text=text) as rig, Attachment(guest, rig.port, model=usb_id):
        started_s = time.monotonic()
        seen = read(guest, driver, driver_pythons[driver.name], EVENTS, *ASKED, timeout_s=TIMEOUT_S)
        record_property("seconds", round(time.monotonic() - started_s))
    record_property("amount", f"{len(seen.events)} events, with frames, samples and edges")
    delivered = rig.delivered
    offset_us = assert_same_streams(driver, seen, delivered)
    assert_same_frames(driver, seen, delivered, offset_us)
    assert rig.summary["links"]["usbip"]["edges"]["balanced"], rig.summary

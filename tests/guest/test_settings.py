"""Three unmodified drivers change every setting that they have while all streams run, and the streams go on.

What the changes do to the streams is tested elsewhere; here none of them may fail or put a warning into a driver's log,
and when all is set back, everything is exact again.
"""

import re
from dataclasses import replace

import pytest

from tests.guest.all_streams import ASKED, FREE, STREAMS, assert_same_frames, assert_same_streams
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import CHECKERBOARD, RunningRig
from tests.guest.streaming import read
from tests.guest.turns import long_but

TIMEOUT_S = 300.0  # on a busy machine; some 20 s on one that is not
FILTERING = CHECKERBOARD.replace("[camera]\n", "[camera]\nactivity_filter = true\n")
EVENTS = 100_000  # of the settled part: a third of a second of device time
ABOVE_INFO = re.compile(r"\b(WARNING|WARN|ERROR|CRITICAL|ALERT|EMERGENCY)\b")

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(TIMEOUT_S + 900)]


@pytest.mark.long
@pytest.mark.shows("davis346", "{driver.name}", "settings")
@pytest.mark.parametrize("driver", long_but(DRIVERS[-1:], DRIVERS), ids=lambda driver: driver.name)
def test_every_setting_is_changed_while_all_streams_run(guest, driver, driver_pythons, tmp_path):
    client = replace(driver, name=f"settings_{driver.name}")
    more = STREAMS + (FREE if driver.adds_host_time else "")
    with RunningRig(tmp_path, more=more, text=FILTERING) as rig, Attachment(guest, rig.port):
        seen = read(guest, client, driver_pythons[driver.name], EVENTS, *ASKED, timeout_s=TIMEOUT_S)
    assert {change["name"]: change["error"] for change in seen.about["changes"] if change["error"]} == {}
    assert seen.about["untried"] == []
    assert [line for line in seen.said.splitlines() if ABOVE_INFO.search(line)] == []
    offset_us = assert_same_streams(driver, seen, rig.delivered, whole=False)
    assert_same_frames(driver, seen, rig.delivered, offset_us)
    assert rig.summary["links"]["usbip"]["dropped_in_device"]["dropped_background"] > 0

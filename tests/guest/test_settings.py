"""Three unmodified drivers change every setting that they have while all streams run, and the streams go on.

What the changes do to the streams is tested elsewhere; here none of them may fail or put a warning into a driver's log,
and when all is set back, everything is exact again.

dv-processing 1.7.9 only when asked for:

    EVSTIM_EVERY_SETTING=1 python -m pytest tests/guest/test_settings.py
"""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from tests.guest.all_streams import ASKED, FREE, STREAMS, assert_same_frames, assert_same_streams
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import CHECKERBOARD, RunningRig
from tests.guest.streaming import Streaming

TIMEOUT_S = 300.0  # on a busy machine; some 20 s on one that is not
FILTERING = CHECKERBOARD.replace("[camera]\n", "[camera]\nactivity_filter = true\n")
EVENTS = 100_000  # of the settled part: a third of a second of device time
ABOVE_INFO = re.compile(r"\b(WARNING|WARN|ERROR|CRITICAL|ALERT|EMERGENCY)\b")

# dv-processing 1.7.9 has passed alone and after the others, and hung in one of six runs: why is not known yet.
CHANGING = [driver for driver in DRIVERS if driver.name != "dv1" or os.environ.get("EVSTIM_EVERY_SETTING")]

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(TIMEOUT_S + 900),
]


@pytest.mark.parametrize("driver", CHANGING, ids=lambda driver: driver.name)
def test_every_setting_is_changed_while_all_streams_run(
    guest: Guest, driver: Driver, driver_pythons: dict[str, Path], tmp_path: Path
) -> None:
    client = replace(driver, name=f"settings_{driver.name}")
    more = STREAMS + (FREE if driver.adds_host_time else "")
    with RunningRig(tmp_path, more=more, text=FILTERING) as rig, Attachment(guest, rig.port):
        seen = Streaming(guest, client, driver_pythons[driver.name], EVENTS, *ASKED, timeout_s=TIMEOUT_S).wait()
    failed = {change["name"]: change["error"] for change in seen.about["changes"] if change["error"]}
    assert failed == {}
    assert seen.about["untried"] == []
    assert [line for line in seen.said.splitlines() if ABOVE_INFO.search(line)] == []
    assert len(seen.events) >= EVENTS
    offset_us = assert_same_streams(driver, seen, rig.delivered, whole=False)
    assert_same_frames(driver, seen, rig.delivered, offset_us)
    assert rig.summary["balanced"], rig.summary
    assert rig.summary["links"]["usbip"]["dropped_in_device"]["dropped_background"] > 0

"""Unmodified drivers open a Gen 3.1 that is not there, on an EVK3 or in a SilkyEvCam, and see every event.

Short by default; at length:

    EVSTIM_GEN31_EVENTS=5e6 EVSTIM_OPENEB_CLIENT=BUILD/client python -m pytest tests/guest/test_gen31.py
"""

import os

import numpy as np
import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import ND_VGA
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import read, read_until_pulled
from tests.guest.test_evk4 import GAP_US, looped, needs_openeb, read_by_openeb, rig_of

EVENTS = round(float(os.environ.get("EVSTIM_GEN31_EVENTS", "3e4")))
TIMEOUT_S = 240.0 + 8.0 * EVENTS * GAP_US * 1e-6
OPENEB_EVENTS = max(EVENTS, 1_000_000)  # its decoder is seconds behind the camera when it changes the window
VGA = (640, 480)
SILKY = ("31f7", "0002")
WINDOW = (100, 499, 60, 359)  # as openeb/client.cpp has it

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(2 * TIMEOUT_S + 1200)]


@pytest.mark.shows("evk3_vga", "openeb", "opens", "events", "triggers", "settings")
@needs_openeb
def test_openeb_sees_every_event_of_its_window(guest, tmp_path, record_property):
    looped(tmp_path, VGA)
    rig = RunningRig(tmp_path, text=rig_of("evk3_vga"))
    about, seen = read_by_openeb(guest, rig, "evk3-vga.bin", OPENEB_EVENTS, "EVT3", timeout_s=TIMEOUT_S)
    assert (about["sensor"], about["word_bytes"], about["file"]) == ("Gen3.1", 2, (VGA, "evt3"))
    assert about["bias_diff_on"] == 397  # mV: the least that OpenEB's table has for the code of 25 mV more
    assert about["changed"] is True
    assert (about["celsius"], abs(about["lux"] - 100) <= 1) == (20, True)  # the driver cuts fractions off
    record_property("amount", f"{len(seen)} events")
    record_property("seconds", about["seconds"])
    assert (seen["x"].min(), seen["x"].max(), seen["y"].min(), seen["y"].max()) == WINDOW
    narrow = np.flatnonzero(np.diff(np.flatnonzero(seen["x"] >= 300)) > 100)
    assert len(narrow) == 1  # the window was narrow once, while many events came: none was in its right half


@pytest.mark.shows("silkyevcam_vga", "nd", "opens", "events", "settings", "unplugged", "plugged again")
def test_a_driver_sees_every_event(guest, driver_pythons, tmp_path, record_property):
    """The cable is pulled while the driver streams; then it opens the camera again, and changes its biases."""
    looped(tmp_path, VGA)
    more = (guest, ND_VGA, driver_pythons["nd"], EVENTS)
    with RunningRig(tmp_path, text=rig_of("silkyevcam_vga")) as rig:
        _, device = read_until_pulled(Attachment(guest, rig.port, model=SILKY), *more, timeout_s=TIMEOUT_S)
        with Attachment(guest, rig.port, model=SILKY):
            seen = read(*more, "--settings", timeout_s=TIMEOUT_S)
    assert (device["manufacturer"], device["product"]) == ("CenturyArks", "SilkyEvCam Gen3.1 v03.09.00C")
    assert (seen.about["serial"], seen.about["discovered"]) == ("0BADCAFE", ["0BADCAFE"])
    assert seen.about["changes"] == 8  # seven biases, and back
    record_property("amount", f"{len(seen.events)} events")
    record_property("seconds", round(seen.about["streamed_s"]))
    assert_same(seen.events, rig.delivered.last, offset_us=0)

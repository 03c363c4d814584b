"""Unmodified drivers open a Gen 3.1 that is not there, on an EVK3 or in a SilkyEvCam, and see every event.

Short by default; at length:

    EVSTIM_GEN31_EVENTS=5e6 EVSTIM_OPENEB_CLIENT=BUILD/client python -m pytest tests/guest/test_gen31.py
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from firmware_protocol.events import EDGE, EVENT, EdgeKind
from tests.guest.attachment import EVK4, Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import ND_VGA
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming
from tests.guest.test_evk4 import RIG, assert_same_triggers
from tests.hostile.looped import Looped
from transports.recording.word_files import EvtReader

EVENTS = round(float(os.environ.get("EVSTIM_GEN31_EVENTS", "3e4")))
GAP_US = 4
TIMEOUT_S = 240.0 + 8.0 * EVENTS * GAP_US * 1e-6
OPENEB = os.environ.get("EVSTIM_OPENEB_CLIENT", "")
OPENEB_EVENTS = max(EVENTS, 1_000_000)  # its decoder is seconds behind the camera when it changes the window
SILKY = ("31f7", "0002")
WINDOW = (100, 499, 60, 359)  # as openeb/client.cpp has it

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(2 * TIMEOUT_S + 1200)]


def looped(folder: Path, count: int = 1_000_000) -> None:
    """Save the recording that the rig plays in a loop."""
    looped, draw = Looped(count, 1), np.random.default_rng(2)
    looped.events["x"], looped.events["y"] = draw.integers(0, 640, count), draw.integers(0, 480, count)
    looped.events["t"] *= GAP_US
    looped.save(folder / "looped.npz")


@pytest.mark.shows("evk3_vga", "openeb", "opens", "events", "triggers", "settings")
@pytest.mark.skipif(not OPENEB, reason="EVSTIM_OPENEB_CLIENT names no program; tests/guest/openeb/Makefile builds it")
def test_openeb_sees_every_event_of_its_window(
    guest: Guest, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """Its own discovery, device, noise filter, biases, window, monitoring, stream and decoder."""
    looped(tmp_path)
    out = "evk3-vga.bin"
    text = RIG.replace('"evk4"', '"evk3_vga"')
    with RunningRig(tmp_path, text=text) as rig, Attachment(guest, rig.port, model=EVK4):
        command = [OPENEB, str(OPENEB_EVENTS), str(TIMEOUT_S), guest.path_in_guest(out), "EVT3"]
        begun_s = time.monotonic()
        about = json.loads(guest.check(command, 2 * TIMEOUT_S).splitlines()[-1])
        seconds = time.monotonic() - begun_s
    assert (about["serial"], about["sensor"], about["word_bytes"]) == ("0badcafe", "Gen3.1", 2)
    assert about["bias_diff_on"] == 397  # mV: the least that OpenEB's table has for the code of 25 mV more
    assert about["changed"] is True
    assert (about["celsius"], abs(about["lux"] - 100) <= 1) == (20, True)  # the driver cuts fractions off
    seen = np.fromfile(guest.results / out, EVENT)
    assert len(seen) >= OPENEB_EVENTS
    record_property("amount", f"{len(seen)} events")
    record_property("seconds", round(seconds))
    sent = rig.delivered.events[rig.delivered.resets[-1] :]
    assert_same(seen, sent, offset_us=0)
    assert (seen["x"].min(), seen["x"].max(), seen["y"].min(), seen["y"].max()) == WINDOW
    narrow = np.flatnonzero(np.diff(np.flatnonzero(seen["x"] >= 300)) > 100)
    assert len(narrow) == 1  # the window was narrow once, while many events came: none was in its right half
    triggers = np.array([(t, EdgeKind.RISING if on else EdgeKind.FALLING, 0, 0) for t, on in about["triggers"]], EDGE)
    assert_same_triggers(triggers, rig.delivered)
    recorded = EvtReader(guest.results / f"{out}.raw", None)
    assert (recorded.facts.size, recorded.facts.camera) == ((640, 480), "evt3")
    assert_same(np.concatenate([part.events for part in recorded.parts()]), sent, offset_us=0)
    assert rig.summary["balanced"], rig.summary


@pytest.mark.shows("silkyevcam_vga", "nd", "opens", "events", "settings", "unplugged", "plugged again")
def test_a_driver_sees_every_event(
    guest: Guest, driver_pythons: dict[str, Path], tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """The cable is pulled while the driver streams; then it opens the camera again, and changes its biases."""
    looped(tmp_path)
    more = (guest, ND_VGA, driver_pythons["nd"], EVENTS)
    with RunningRig(tmp_path, text=RIG.replace('"evk4"', '"silkyevcam_vga"')) as rig:
        with Attachment(guest, rig.port, model=SILKY) as camera:
            product = "SilkyEvCam Gen3.1 v03.09.00C"
            assert [camera.device["manufacturer"], camera.device["product"]] == ["CenturyArks", product]
            streaming = Streaming(*more, "--on", timeout_s=TIMEOUT_S)
            streaming.wait_until_started()
        cut = streaming.wait()
        with Attachment(guest, rig.port, model=SILKY):
            seen = Streaming(*more, "--settings", timeout_s=TIMEOUT_S).wait()
    assert cut.about["running"] is False
    assert len(cut.events) >= EVENTS
    assert (seen.about["serial"], seen.about["discovered"]) == ("0BADCAFE", ["0BADCAFE"])
    assert seen.about["changes"] == 8  # seven biases, and back
    assert len(seen.events) >= EVENTS
    record_property("amount", f"{len(seen.events)} events")
    record_property("seconds", round(seen.about["streamed_s"]))
    delivered = rig.delivered
    assert_same(seen.events, delivered.events[delivered.resets[-1] :], offset_us=0)
    assert rig.summary["balanced"], rig.summary

"""Unmodified drivers open an EVK4 that is not there, or a sibling, on a real Linux kernel's USB, and see every event.

Short by default; at length:

    EVSTIM_EVK4_EVENTS=5e6 python -m pytest tests/guest/test_evk4.py
"""

from __future__ import annotations

import json
import math
import os
import time
from dataclasses import dataclass

import numpy as np
import pytest

from emulator.sensor.presets import PRESETS
from firmware_protocol.events import EDGE, EVENT, EdgeKind
from tests.guest.attachment import EVK4, Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import EVENTCV, ND_EVK3, ND_EVK4
from tests.guest.gige_run import HD
from tests.guest.known_ramp import apart_us, expected_us, save_frames
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming, read, read_until_pulled
from tests.guest.turns import Turns, long_but, selected
from tests.hostile.looped import Looped
from transports.recording.word_files import EvtReader

EVENTS = round(float(os.environ.get("EVSTIM_EVK4_EVENTS", "1e5")))
GAP_US = 4  # 0.25 million events a second, which a processor that QEMU translates can take
TIMEOUT_S = 240.0 + 3.0 * EVENTS * GAP_US * 1e-6
FEWER_EVENTS = 100_000
OPENEB = os.environ.get("EVSTIM_OPENEB_CLIENT", "")
LIMIT = 40  # events in 200 us, of 50 on average
MASKED_COLUMNS, MASKED_ROWS, MASKED_PIXEL = (100, 200), (40, 60), (640, 300)  # as clients/nd_evk4.py has them

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(2 * TIMEOUT_S + 1200)]

RIG = """
title = "recorded events at their own pace, for a driver of the EVK4"
[scene]
kind = "recording"
path = "looped.npz"
[camera]
model = "evk4"
serial = "0badcafe"
speed = "{speed}"
start_delay_ms = 3000.0   # neuromorphic_drivers must have started all its transfers; a guest on a busy machine is slow
[camera.sensor.temperature]
celsius = 20.0
[trigger]
period_ms = 10.0
kind = "pulse"
pulse_us = 300
[run]
step_us = 1000
max_late_ms = 0
[[links]]
kind = "usbip"
port = {port}
"""
RAMP = """
title = "light whose logarithm goes up and down on straight lines"
[scene]
kind = "video"
path = "ramp.npy"
frames_per_s = 2.0
floor = 1e-6
[camera]
model = "evk4"
serial = "0badcafe"
speed = "{speed}"
start_delay_ms = 3000.0
[camera.sensor]
threshold_on = 0.2
threshold_off = 0.2
refractory_us = 2000.0
mismatch = 0.0
corner_hz_at_reference = inf
corner_max_hz = inf
dark_current_relative = 1e-6
[camera.sensor.noise]
rms = 0.0
[camera.sensor.background]
hz = 0.0
hot_share = 0.0
[run]
step_us = 20000
lead_us = 20000
max_late_ms = 0
[[links]]
kind = "usbip"
port = {port}
"""


def looped(folder, size=HD):
    """Save the recording that the rig plays in a loop."""
    Looped(1_000_000, GAP_US, size).save(folder / "looped.npz")


def rig_of(model):
    return RIG.replace('model = "evk4"', f'model = "{model}"')


def streamed(guest, python, rig, count, *options):
    with Attachment(guest, rig.port, model=EVK4) as camera:
        assert camera.device["manufacturer"] == "Prophesee"
        return read(guest, ND_EVK4, python, count, *options, timeout_s=TIMEOUT_S)


@pytest.fixture(scope="module")
def turns(request, guest, tmp_path_factory):
    """What each program that reads the camera as it is saw."""
    folder = tmp_path_factory.mktemp("evk4")
    looped(folder)
    rig = RunningRig(folder, text=RIG)
    programs = {
        "nd": lambda: streamed(guest, request.getfixturevalue("driver_pythons")["nd"], rig, EVENTS, "--settings"),
        "eventcv": lambda: read_region(guest, request.getfixturevalue("eventcv_python"), rig),
    }
    return Turns(rig, selected(request, "program"), lambda program: programs[program]())


def read_region(guest, python, rig):
    with Attachment(guest, rig.port, model=EVK4):
        return Streaming(guest, EVENTCV, python, FEWER_EVENTS, "--roi", timeout_s=TIMEOUT_S).wait()


@pytest.mark.shows("evk4", "{program}", "opens", "events", "triggers", "settings")
@pytest.mark.parametrize("program", ["nd"])
def test_every_event_delivered_is_seen(turns, program):
    seen = turns.result(program)
    assert seen.about["serial"] == "0BADCAFE"
    assert seen.about["discovered"] == ["0BADCAFE"]
    assert seen.about["overflows"] == 0
    assert abs(seen.about["celsius"] - 20.0) < 0.19
    assert seen.about["changes"] == 17  # 13 biases, 3 masks, and back
    delivered = turns.delivered(program)
    assert_same(seen.events, delivered.events, offset_us=0)
    assert_same_triggers(seen.triggers, delivered)


def assert_same_triggers(triggers, delivered):
    """Assert that the edges of at least ten pulses were seen at their times; the last may still be on their way."""
    edges = delivered.edges[delivered.edge_resets[-1] :][: len(triggers)]
    assert len(edges) >= 20
    assert triggers["t"].tolist() == edges["t"].tolist()
    assert triggers["kind"].tolist() == edges["kind"].tolist()


@pytest.mark.long
def test_masks_and_the_rate_control_hide_what_the_driver_names_at_high_speed(guest, driver_pythons, tmp_path):
    """The driver counts the rows of its masks from the bottom, and those of its events from the top."""
    looped(tmp_path)
    with RunningRig(tmp_path, speed="high", text=RIG) as rig:
        seen = streamed(guest, driver_pythons["nd"], rig, FEWER_EVENTS, "--masks", "--limit", str(LIMIT))
    delivered = rig.delivered
    assert_same(seen.events, delivered.last, offset_us=0)
    columns, rows = (np.bincount(seen.events[axis], minlength=size) for axis, size in (("x", 1280), ("y", 720)))
    assert np.flatnonzero(columns == 0).tolist() == list(range(*MASKED_COLUMNS))
    assert np.flatnonzero(rows == 0).tolist() == [719 - row for row in reversed(range(*MASKED_ROWS))]
    x, row = MASKED_PIXEL
    assert not np.any((seen.events["x"] == x) & (seen.events["y"] == 719 - row))
    assert np.bincount(seen.events["t"].astype(np.int64) // 200).max() == LIMIT


@pytest.mark.long
def test_biases_that_the_driver_writes_move_thresholds_and_refractory_period(guest, driver_pythons, tmp_path):
    """The client opens with diff_on 20 and refr -10 steps from the factory's values."""
    save_frames(tmp_path / "ramp.npy", 1280, 720, (40, 30))
    with RunningRig(tmp_path, text=RAMP) as rig:
        seen = streamed(guest, driver_pythons["nd"], rig, FEWER_EVENTS // 2)
    measured = [apart_us(seen.events, on=on) for on in (True, False)]
    expected = [expected_us(0.2 * math.exp(20 * 0.0143), 4000.0), expected_us(0.2, 4000.0)]
    assert np.allclose(measured, expected, rtol=0.01), (measured, expected)
    assert "biases make threshold_on 0.2662" in rig.said
    assert "no effect" not in rig.said  # what it writes when it opens are the factory's values


@pytest.mark.long
@pytest.mark.shows("evk4", "{program}", "opens", "events")
@pytest.mark.parametrize("program", ["eventcv"])
def test_a_library_with_an_older_driver_inside_sees_every_event_of_its_region(turns, program):
    seen = turns.result(program)
    assert seen.about["discovered"] == [["prophesee_evk4", "0BADCAFE"]]
    assert_same(seen.events, turns.delivered(program).events, offset_us=0)
    x, y = seen.events["x"], seen.events["y"]
    assert (x.min(), x.max(), y.min(), y.max()) == (200, 999, 100, 599)


@dataclass(frozen=True)
class Opened:
    """A board in OpenEB: its name in the rig, the format that it is set to, and what the client prints of it."""

    model: str = "evk4"
    form: str = "EVT3"
    usb_id: tuple[str, str] = EVK4
    bias_diff_on: int = 25  # steps above the factory's; a Gen4.1's are currents
    has_thermometer: bool = True

    def __str__(self):
        return f"{self.model}-{self.form}"


OPENED = [
    Opened(),
    Opened(form="EVT21"),
    Opened("silkyevcam_hd", "EVT21", ("31f7", "0003")),
    Opened("silkyevcam_hd_lite", usb_id=("31f7", "0004")),
    Opened("ueye_xcp_e", "EVT21", ("1409", "8e00")),
    Opened("ueye_xls_e", usb_id=("1409", "8e00")),
    Opened("evk3_hd", "EVT21", bias_diff_on=0x73 + 25, has_thermometer=False),
]


needs_openeb = pytest.mark.skipif(
    not OPENEB, reason="EVSTIM_OPENEB_CLIENT names no program; tests/guest/openeb/Makefile builds it"
)


def read_by_openeb(guest, rig, out, count, *options, usb_id=EVK4, **limits):
    """Return what OpenEB's client told of a camera, and the events that it saw.

    Its own discovery, device, biases, window, filters, monitoring, stream and decoder, as its Prophesee plugin has
    them. All events, triggers and the file that OpenEB recorded must be as delivered.
    """
    timeout_s = limits.get("timeout_s", TIMEOUT_S)
    with rig, Attachment(guest, rig.port, model=usb_id):
        command = [OPENEB, str(count), str(timeout_s), guest.path_in_guest(out), *options]
        began_s = time.monotonic()
        about = json.loads(guest.check(command, 2 * timeout_s).splitlines()[-1])
        about["seconds"] = round(time.monotonic() - began_s)
    seen = np.fromfile(guest.results / out, EVENT)
    assert len(seen) >= count
    assert_same(seen, rig.delivered.last, offset_us=0)
    kinds = EdgeKind.FALLING, EdgeKind.RISING
    assert_same_triggers(np.array([(t, kinds[on], 0, 0) for t, on in about["triggers"]], EDGE), rig.delivered)
    recorded = EvtReader(guest.results / f"{out}.raw", None)
    about["file"] = recorded.facts.size, recorded.facts.camera
    assert_same(np.concatenate([part.events for part in recorded.parts()]), rig.delivered.last, offset_us=0)
    assert about["serial"] == "0badcafe"
    return about, seen


@pytest.mark.shows("{one.model}", "openeb", "opens", "events", "triggers", "settings")
@needs_openeb
@pytest.mark.parametrize("one", OPENED, ids=str)
def test_openeb_sees_every_event_of_its_window(guest, tmp_path, one):
    """The ids of other makers, which their own plugins list, are given to it."""
    looped(tmp_path)
    rig = RunningRig(tmp_path, text=rig_of(one.model))
    about, seen = read_by_openeb(guest, rig, f"openeb-{one}.bin", EVENTS, one.form, *one.usb_id, usb_id=one.usb_id)
    assert about["word_bytes"] == {"EVT3": 2, "EVT21": 8}[one.form]
    assert about["bias_diff_on"] == one.bias_diff_on
    assert about["anti_flicker"] is True
    assert abs(about["lux"] - 100) <= 1  # the driver cuts fractions off
    if one.has_thermometer:
        assert abs(about["celsius"] - 20) <= 1
        assert about["dead_time_us"] == PRESETS["imx636"].refractory_us
    assert (seen["x"].min(), seen["x"].max(), seen["y"].min(), seen["y"].max()) == (200, 999, 100, 599)
    assert about["changed"] is True
    assert about["file"] == ((1280, 720), {"EVT3": "evt3", "EVT21": "evt21-legacy"}[one.form])


LISTED = {
    "evk4": (ND_EVK4, EVK4, "Prophesee", "EVK4"),
    "silkyevcam_hd": (ND_EVK4, ("31f7", "0003"), "CenturyArks", "SilkyEvCam HD v03.09.00C"),
    "silkyevcam_hd_lite": (ND_EVK4, ("31f7", "0004"), "CenturyArks", "SilkyEvCam HD Lite v03.09.01C"),
    "ueye_xcp_e": (ND_EVK4, ("1409", "8e00"), "IDS Imaging Development Systems GmbH", "UE-39B0XCP"),
    "ueye_xls_e": (ND_EVK4, ("1409", "8e00"), "IDS Imaging Development Systems GmbH", "UE-39B2XLS"),
    "evk3_hd": (ND_EVK3, EVK4, "Prophesee", "EVK3"),
}
SIBLINGS_EVENTS = round(float(os.environ.get("EVSTIM_SIBLINGS_EVENTS", "2e4")))


@pytest.mark.long
@pytest.mark.shows("{model}", "nd", "opens", "events", "unplugged", "plugged again")
@pytest.mark.parametrize("model", long_but(["evk4"], LISTED))
def test_a_driver_sees_every_event_of_a_sibling(guest, driver_pythons, tmp_path, model):
    """The cable is pulled while the driver streams; then it opens the camera again."""
    driver, usb_id, *strings = LISTED[model]
    looped(tmp_path)
    more = (guest, driver, driver_pythons["nd"], SIBLINGS_EVENTS)
    with RunningRig(tmp_path, text=rig_of(model)) as rig:
        _, device = read_until_pulled(Attachment(guest, rig.port, model=usb_id), *more, timeout_s=TIMEOUT_S)
        with Attachment(guest, rig.port, model=usb_id):
            seen = read(*more, timeout_s=TIMEOUT_S)
    assert [device["manufacturer"], device["product"]] == strings
    assert seen.about["serial"] == "0BADCAFE"
    assert seen.about["discovered"] == ["0BADCAFE"]
    assert_same(seen.events, rig.delivered.last, offset_us=0)


@pytest.mark.long
@pytest.mark.shows("{model}", "nd", "triggers", "settings")
@pytest.mark.parametrize("model", [model for model, listed in LISTED.items() if listed[0] is ND_EVK4][1:])
def test_triggers_and_settings_of_a_sibling(guest, driver_pythons, tmp_path, model):
    looped(tmp_path)
    count = max(SIBLINGS_EVENTS, FEWER_EVENTS)
    with RunningRig(tmp_path, text=rig_of(model)) as rig, Attachment(guest, rig.port, model=LISTED[model][1]):
        seen = read(guest, ND_EVK4, driver_pythons["nd"], count, "--settings", timeout_s=TIMEOUT_S)
    assert seen.about["changes"] == 17  # 13 biases, 3 masks, and back
    delivered = rig.delivered
    assert_same(seen.events, delivered.last, offset_us=0)
    assert_same_triggers(seen.triggers, delivered)

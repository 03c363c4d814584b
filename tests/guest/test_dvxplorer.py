"""Three unmodified drivers open a DVXplorer that is not there, on a real Linux kernel's USB, and see all its streams.

Every event, trigger and inertial sample, at its time, also while settings change and after the cable was pulled. By
default a second of device time; at length:

    EVSTIM_DVXPLORER_EVENTS=1e6 python -m pytest tests/guest/test_dvxplorer.py
"""

import dataclasses
import os

import numpy as np
import pytest

from tests.guest.all_streams import COLUMNS, assert_same_streams
from tests.guest.attachment import DVXPLORER, Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import read, read_until_pulled
from tests.guest.turns import long_but

EVENTS = round(float(os.environ.get("EVSTIM_DVXPLORER_EVENTS", "3e5")))
FEWER_EVENTS = 20_000
LEAST_CHANGES = 9  # of a driver, those that set a value back included
TIMEOUT_S = 240.0 + EVENTS / 5000

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(TIMEOUT_S + 960)]

RIG = """
title = "A moving checkerboard, seen by a DVXplorer at rest on the bench"
[scene]
kind = "checkerboard"
speed_px_s = 3.0         # some 0.3 million events a second, which a processor that QEMU translates can take
[camera]
model = "dvxplorer"
serial = "DVX00042"
speed = "{speed}"
start_delay_ms = 3000.0  # neuromorphic_drivers must have started all its transfers; a guest on a busy machine is slow
[camera.imu]
unit = "bmi160"
gyroscope_bias_deg_s = [30.0, -20.0, 0.5]
[trigger]
period_ms = 10.0
kind = "pulse"
pulse_us = 300
[run]
max_late_ms = 0
[[links]]
kind = "usbip"
port = {port}
"""
SWAPPED = [0, 1, 2, 3, 5, 4, 6]


def as_others(driver, seen):
    """Return what a driver saw; neuromorphic_drivers 0.18 has the first two axes of the gyroscope exchanged."""
    return dataclasses.replace(seen, imu=seen.imu[:, SWAPPED]) if driver.name == "nd" else seen


def mirrored_back(seen, delivered):
    """Return events with x and y as the camera sent them, where dv-processing 2 mirrored a run of them.

    Its `setFlipHorizontal` and `setFlipVertical` mirror events in the library, those that are in its queue later: in a
    short run none. The client sets each once, and back.
    """
    seen = seen.copy()
    for name, last in (("x", 639), ("y", 479)):
        differ = np.flatnonzero(seen[name] != delivered[name][: len(seen)])
        if len(differ):
            run = slice(differ[0], differ[-1] + 1)
            seen[name][run] = last - seen[name][run]
    return seen


@pytest.mark.long
@pytest.mark.shows("dvxplorer", "{driver.name}", "opens", "events", "imu", "triggers", "settings")
@pytest.mark.shows("dvxplorer", "{driver.name}", "unplugged", "plugged again")
@pytest.mark.parametrize("driver", long_but(DRIVERS[-1:], DRIVERS), ids=lambda driver: driver.name)
def test_every_stream_is_seen_as_it_was_delivered(guest, driver, driver_pythons, tmp_path):
    """The cable is pulled while the driver streams; then it opens the camera again, and changes settings."""
    options = ("--imu", "--triggers", *(("--device", "inivation_dvxplorer") if driver.name == "nd" else ()))
    python = driver_pythons[driver.name]
    client = dataclasses.replace(driver, name=f"dvxplorer_{driver.name}")
    with RunningRig(tmp_path, text=RIG) as rig:
        camera = Attachment(guest, rig.port, model=DVXPLORER)
        _, device = read_until_pulled(camera, guest, driver, python, FEWER_EVENTS, *options, timeout_s=TIMEOUT_S)
        with Attachment(guest, rig.port, model=DVXPLORER):
            seen = as_others(driver, read(guest, client, python, EVENTS, *options, timeout_s=TIMEOUT_S))
    assert device["bcdDevice"] == "0309"
    assert any("DVX00042" in found for found in seen.about["discovered"])
    assert {change["name"]: change["error"] for change in seen.about["changes"] if change["error"]} == {}
    assert len(seen.about["changes"]) >= LEAST_CHANGES
    delivered = rig.delivered
    if driver.name == "dv2":
        back = mirrored_back(seen.events, delivered.last)
        seen = dataclasses.replace(seen, events=back)
    assert_same_streams(driver, seen, delivered)
    assert rig.summary["links"]["usbip"]["edges"]["balanced"], rig.summary


MICRO = RIG.replace('"dvxplorer"', '"dvxplorer_micro"').replace(RIG[RIG.index("[trigger]") : RIG.index("[run]")], "")


def by_column(events):
    """Return events in the order in which dv-processing hands over those of one column: all OFF events come first."""
    return events[np.lexsort((events["y"], events["on"], events["x"], events["t"]))]


@pytest.mark.shows("dvxplorer_micro", "dv2", "opens", "events", "imu", "unplugged", "plugged again")
def test_a_micro_is_seen_as_it_was_delivered(guest, driver_pythons, tmp_path):
    """Its library stamps an inertial sample when it arrives, so only the values are compared.

    The cable is pulled while the driver streams; then it opens the camera again.
    """
    driver, python = DRIVERS[0], driver_pythons["dv2"]
    with RunningRig(tmp_path, text=MICRO) as rig:
        camera = Attachment(guest, rig.port, model=DVXPLORER)
        _, device = read_until_pulled(camera, guest, driver, python, FEWER_EVENTS, timeout_s=TIMEOUT_S)
        with Attachment(guest, rig.port, model=DVXPLORER):
            seen = read(guest, driver, python, EVENTS, "--imu", timeout_s=TIMEOUT_S)
    assert device["bcdDevice"] == "040a"
    delivered = rig.delivered
    assert any("DVX00042" in found for found in seen.about["discovered"])
    events = delivered.last
    assert_same(seen.events, by_column(events), offset_us=int(seen.events["t"][0]) - int(events["t"][0]))
    samples = delivered.imu[delivered.imu_resets[-1] :]
    values = np.column_stack([samples[name] for name in COLUMNS]).astype(np.float64)
    assert len(seen.imu) >= 100
    np.testing.assert_allclose(seen.imu, values[: len(seen.imu)], rtol=4e-7, atol=1e-9)


@pytest.mark.long
@pytest.mark.shows("dvxplorer_micro", "dv2", "settings")
def test_settings_of_a_micro_are_changed_while_it_streams(guest, driver_pythons, tmp_path):
    client = dataclasses.replace(DRIVERS[0], name="dvxplorer_dv2")
    with RunningRig(tmp_path, text=MICRO) as rig, Attachment(guest, rig.port, model=DVXPLORER):
        seen = read(guest, client, driver_pythons["dv2"], EVENTS, timeout_s=TIMEOUT_S)
    assert {change["name"]: change["error"] for change in seen.about["changes"] if change["error"]} == {}
    assert len(seen.about["changes"]) >= LEAST_CHANGES
    events = by_column(rig.delivered.last)
    back = by_column(mirrored_back(seen.events, events))  # mirrored rows come in the opposite order
    assert_same(back, events, offset_us=int(back["t"][0]) - int(events["t"][0]))

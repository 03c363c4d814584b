"""Unmodified drivers read a camera on FunctionFS: a gadget of the guest's kernel on the guest's own USB bus.

Every driver takes all streams and opens the camera twice; what is the same for all of them, such as a host that never
reads, is tried with one: with neuromorphic_drivers where what the camera had left over would show, for the others
throw away all before their timestamp reset.

Short by default; at length:

    EVSTIM_GADGET_EVENTS=1e6 python -m pytest tests/guest/test_gadget.py
"""

import os
import sys
from pathlib import Path

import pytest

from tests.guest.all_streams import ASKED, assert_same_frames, assert_same_streams
from tests.guest.attachment import EVK4
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS, ND_EVK4
from tests.guest.gadget_rig import SLOWEST_LOOP_S, GadgetCamera, GadgetRig, load_port, loop_s
from tests.guest.gige_run import HD
from tests.guest.streaming import Streaming, read
from tests.hostile.looped import Looped

EVENTS = round(float(os.environ.get("EVSTIM_GADGET_EVENTS", "1e5")))
FEWER_EVENTS = 20_000
STREAMS_GAP_US = 32  # 100 000 events in 3.2 s, with at least three frames; a round is a whole number of frames
LONGER_THAN_THE_CABLE = 1 << 40
TIMEOUT_S = 300.0 + EVENTS * 1e-4
NEVER_READS = str(Path(__file__).parent / "clients" / "never_reads.py")
DV2, DV1, ND = DRIVERS

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(10 * TIMEOUT_S)]


@pytest.fixture(scope="module")
def port(guest):
    """The guest with a SuperSpeed port; skips where QEMU is too slow for it."""
    if (needed_s := loop_s(guest)) > SLOWEST_LOOP_S:
        pytest.skip(
            f"QEMU is too slow here for dummy_hcd's timer: a loop took {needed_s:.2f} s, not {SLOWEST_LOOP_S} s"
        )
    load_port(guest, "super")
    yield guest
    guest.run(["rmmod", "dummy_hcd"])


def streamed(guest, driver, pythons, count=EVENTS, *asked):
    return read(guest, driver, pythons[driver.name], count, *asked, timeout_s=TIMEOUT_S)


def assert_turns(camera, turns):
    """Assert that each driver saw every event delivered since its start, at its time; and the streams it asked for."""
    parts = camera.delivered.turns
    assert len(parts) == len(turns)
    for (driver, seen), part in zip(turns, parts, strict=True):
        offset_us = int(seen.events["t"][0]) - int(part.events["t"][0]) if driver.adds_host_time else 0
        assert_same(seen.events, part.events, offset_us=offset_us)
        if len(seen.imu_t):
            assert assert_same_streams(driver, seen, part) == offset_us
            assert_same_frames(driver, seen, part, offset_us)
    assert camera.told["balanced"], camera.told
    assert camera.told.get("error") is None


@pytest.mark.long
@pytest.mark.shows("davis346", "dv2", "opens", "events", "frames", "imu", "triggers")
@pytest.mark.shows("davis346", "dv1", "opens", "events", "frames", "imu", "triggers")
@pytest.mark.shows("davis346", "nd", "opens", "events", "frames", "imu", "triggers")
def test_each_driver_sees_all_streams_and_opens_the_camera_again(port, driver_pythons):
    turns = []
    with GadgetCamera(port, "--streams", looped=Looped(300_000, STREAMS_GAP_US)) as camera:
        for driver in DRIVERS:
            turns.append((driver, streamed(port, driver, driver_pythons, FEWER_EVENTS)))
            turns.append((driver, streamed(port, driver, driver_pythons, EVENTS, *ASKED)))
    assert port.run(["test", "-e", "/sys/kernel/config/usb_gadget/evstim"]).code == 1
    assert (camera.device["bcdDevice"], camera.device["serial"], camera.device["speed"]) == ("0206", "00000346", "5000")
    assert (camera.device["manufacturer"], camera.device["product"]) == ("iniVation", "DAViS FX3")
    assert any("plugged in" in state for state in camera.told["states"])
    assert_turns(camera, turns)
    assert all(len(seen.imu_t) for _, seen in turns[1::2])


@pytest.mark.long
@pytest.mark.shows("davis346", "dv2", "unplugged", "plugged again")
def test_a_camera_whose_controller_is_taken_away_is_gone_and_comes_again(port, driver_pythons):
    with GadgetCamera(port) as camera:
        streaming = Streaming(port, DV2, driver_pythons[DV2.name], LONGER_THAN_THE_CABLE, timeout_s=TIMEOUT_S)
        streaming.wait_until_started()
        camera.plug(connected=False)
        cut = streaming.wait()
        camera.plug(connected=True)
        again = streamed(port, DV2, driver_pythons, FEWER_EVENTS)
    first, second = (turn.events for turn in camera.delivered.turns)
    assert cut.about["running"] is False
    # What was on its way counts as lost, though the host may have read a part of it.
    assert len(cut.events) <= len(first) + camera.told["dropped"]
    known = cut.events[: len(first)]
    assert_same(known, first, offset_us=int(known["t"][0]) - int(first["t"][0]))
    assert_same(again.events, second, offset_us=int(again.events["t"][0]) - int(second["t"][0]))
    assert camera.told["balanced"], camera.told


@pytest.mark.long
def test_a_host_that_never_reads_does_not_stall_the_camera(port, driver_pythons):
    with GadgetCamera(port) as camera:
        port.check(["env", f"PYTHONPATH={':'.join(sys.path)}", sys.executable, NEVER_READS], TIMEOUT_S)
        turns = [(ND, streamed(port, ND, driver_pythons, FEWER_EVENTS))]
    assert "dropped_fifo=0" not in camera.told["camera"]
    assert camera.told["dropped"] > 0
    assert_turns(camera, turns)


@pytest.mark.long
def test_drivers_take_turns_at_high_speed(port, driver_pythons):
    # By transfers of 8 KiB and of 128 KiB.
    load_port(port, "high")
    try:
        with GadgetCamera(port, "--speed", "high") as camera:
            turns = [(driver, streamed(port, driver, driver_pythons, FEWER_EVENTS)) for driver in (DV2, ND)]
    finally:
        load_port(port, "super")
    assert camera.device["speed"] == "480"
    assert_turns(camera, turns)


@pytest.mark.shows("evk4", "nd", "opens", "events")
def test_an_evk4_is_read_event_by_event(port, driver_pythons):
    options = ("--model", "evk4", "--serial", "0badcafe")
    with GadgetCamera(port, *options, looped=Looped(300_000, 10, HD), model=EVK4) as camera:
        seen = streamed(port, ND_EVK4, {"nd_evk4": driver_pythons["nd"]})
    assert seen.about["serial"] == "0BADCAFE"
    assert_turns(camera, [(ND_EVK4, seen)])


def test_a_rig_runs_on_the_cable_whatever_a_killed_camera_left(port, driver_pythons):
    with GadgetCamera(port) as killed:
        killed.kill()
        killed.on_the_bus(0)
    with GadgetRig(port) as rig:
        turns = [(DV2, streamed(port, DV2, driver_pythons, FEWER_EVENTS))]
    assert_turns(rig, turns)

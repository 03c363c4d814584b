"""Hosts that do what they should not: two drivers at once, and a machine that stands still while it streams."""

import pytest

from emulator.run.control import send_request, sockets
from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200)]

DV2, _, ND = DRIVERS
EVENTS = 900_000
SUSPENDED_S = 12.0  # of stream time: the events of that are more than the FIFO and all buffers of both machines hold


def assert_all_seen(seen, rig):
    delivered = rig.delivered
    events = delivered.last
    assert_same(seen.events, events, offset_us=int(seen.events["t"][0]) - int(events["t"][0]))


def stream_time_s():
    return float(send_request(sockets()[0], {"request": "faults"})["t_s"])


@pytest.mark.long
def test_two_drivers_at_once_do_no_harm_to_the_next(guest, driver_pythons, tmp_path):
    # neuromorphic_drivers takes the camera from a driver that streams, and starts its clock anew: that is the host's
    # affair, and both see a part of the events.
    over = guest.results / "second-driver-is-done"
    over.unlink(missing_ok=True)
    with RunningRig(tmp_path) as rig, Attachment(guest, rig.port):
        first = Streaming(guest, DV2, driver_pythons["dv2"], EVENTS, "--until", guest.path_in_guest(over.name))
        first.wait_until_started()
        # Its requests time out while the camera's run is behind and catches up; by then the first may have ended.
        second = Streaming(guest, ND, driver_pythons["nd"], 1, "--attempts", "30", timeout_s=40).wait()
        over.touch()
        first.wait()
        next_one = Streaming(guest, DV2, driver_pythons["dv2"], EVENTS).wait()
    assert len(second.events) > 0
    assert len(next_one.events) >= EVENTS
    assert_all_seen(next_one, rig)


@pytest.mark.long
def test_a_host_that_stood_still_goes_on_with_all_that_was_delivered(guest, driver_pythons, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with RunningRig(tmp_path) as rig, Attachment(guest, rig.port):
        # After it has stood still, a machine of QEMU lets a sleeping client wait for seconds while its USB goes on:
        # dv-processing's queue of packets of 10 ms overflows then, and with it goes what the camera did deliver.
        streaming = Streaming(guest, DV2, driver_pythons["dv2"], EVENTS, "--packet-ms", "200")
        streaming.wait_until_started()
        with guest.suspended():
            until_s = stream_time_s() + SUSPENDED_S
            while stream_time_s() < until_s:
                pass
        seen = streaming.wait()
    assert len(seen.events) >= EVENTS
    assert seen.about["running"]
    assert_all_seen(seen, rig)
    assert rig.summary["links"]["usbip"]["dropped_in_device"]["dropped_fifo"] > 0, rig.summary

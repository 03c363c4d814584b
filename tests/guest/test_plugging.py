"""The guest's kernel and Debian's own `usbip` see a DAVIS346, plug it in and out, and find it again."""

import pytest

from tests.guest.attachment import Attachment, remote_cameras, usb_bus
from tests.guest.running_rig import RunningRig

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200)]

CYCLES = 5


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    with RunningRig(tmp_path_factory.mktemp("rig")) as running:
        yield running


def test_usbip_lists_the_camera(guest, rig):
    listing = remote_cameras(guest, rig.port)
    assert "1-1:" in listing
    assert "(152a:841a)" in listing


@pytest.mark.shows("davis346", "linux", "opens")
def test_the_kernel_reads_its_descriptors(guest, rig):
    with Attachment(guest, rig.port) as camera:
        device = camera.device
    assert (device["idVendor"], device["idProduct"]) == ("152a", "841a")
    assert device["bcdDevice"].endswith("06")  # the firmware version that all drivers accept
    assert device["serial"] == "00000346"
    assert device["speed"] == "5000"
    assert device["version"] == "3.00"


def test_a_camera_taken_is_refused_to_a_second_host(guest, rig):
    with Attachment(guest, rig.port):
        with pytest.raises(RuntimeError, match=r"(?i)in use|busy|unavailable"), Attachment(guest, rig.port):
            pass
        assert len(usb_bus(guest, cameras=1)["devices"]) == 1


@pytest.mark.shows("davis346", "linux", "unplugged", "plugged again")
def test_it_can_be_plugged_in_again_and_again(guest, rig):
    serials = []
    for _ in range(CYCLES):
        with Attachment(guest, rig.port) as camera:
            serials.append(camera.device["serial"])
    assert serials == ["00000346"] * CYCLES

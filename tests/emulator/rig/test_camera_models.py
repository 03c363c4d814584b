"""What a rig says of its camera reaches the device that drivers see."""

import pytest

from emulator.rig.kinds import CAMERA_MODELS, UsbSettings
from emulator.rig.tables import Camera
from transports.usb.davis_host import DavisHost
from transports.usb.loopback import DirectHost


@pytest.mark.parametrize("has", [False, True])
def test_a_davis346_has_its_activity_filter_if_the_rig_says_so(has):
    device = CAMERA_MODELS["davis346"].usb.device(Camera(activity_filter=has), UsbSettings(0.0))()
    assert DavisHost(DirectHost(device)).read_register(1, 30) == has
    assert not Camera().activity_filter

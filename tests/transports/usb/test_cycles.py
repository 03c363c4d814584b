"""Every camera on USB is opened, read and closed a hundred times over USB/IP; each time it sends its events."""

import numpy as np
import pytest

from emulator.rig.kinds import CAMERA_MODELS, UsbSettings
from emulator.rig.tables import Camera
from firmware_protocol.events import EVENT
from transports.usb.cameras import driver_of
from transports.usb.host import DeviceBusy, StreamSettings
from transports.usb.usbip.client import UsbipHost

CYCLES = 100
ATTEMPTS = 1000  # the server may still be at the end of the last connection
EVENTS = 50
MODELS = [name for name, one in CAMERA_MODELS.items() if one.usb is not None and name != "ideal"]
FIELDS = ["t", "x", "y", "on"]


def attached(port):
    for _ in range(ATTEMPTS - 1):
        try:
            return UsbipHost.attach(port=port, timeout_s=120)
        except DeviceBusy:
            continue
    return UsbipHost.attach(port=port, timeout_s=120)


def events_from(t_us, seed):
    rng = np.random.default_rng(seed)
    events = np.zeros(EVENTS, EVENT)
    events["t"] = t_us + 100 + 1000 * np.arange(EVENTS)
    events["x"], events["y"], events["on"] = (rng.integers(0, most, EVENTS) for most in (240, 180, 2))
    return events


def one_cycle(bench, camera, seed):
    """Attach, open, read `EVENTS` events and close; return what was sent and what was seen."""
    driver = driver_of(attached(bench.server.port))
    driver.start(StreamSettings(transfers=4))
    sent = bench.call(lambda: events_from(camera.now_us, seed))
    bench.call(lambda: (camera.offer(sent), camera.advance(int(sent["t"][-1]) + 100_000), bench.server.pump()))
    seen = np.zeros(0, EVENT)
    while len(seen) < EVENTS:
        part = driver.read(120)
        assert part is not None
        seen = np.concatenate([seen, part])
    driver.close()
    return sent, seen


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.socket
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "model", [name for name, one in CAMERA_MODELS.items() if one.usb is not None and name != "ideal"]
)
def test_a_camera_is_opened_and_closed_a_hundred_times(bench, model):
    settings = Camera(model=model, serial="00c0ffee", sensor=CAMERA_MODELS[model].sensor)
    camera = CAMERA_MODELS[model].usb.device(settings, UsbSettings(start_delay_ms=0))()
    bench.start({"1-1": camera})
    for cycle in range(CYCLES):
        sent, seen = one_cycle(bench, camera, cycle)
        sent["t"] -= sent["t"][0] - seen["t"][0]
        assert seen[FIELDS].tolist() == sent[FIELDS].tolist(), cycle
    fates = camera.counters
    assert (fates.delivered, fates.accounted) == (CYCLES * EVENTS, fates.offered + fates.added)

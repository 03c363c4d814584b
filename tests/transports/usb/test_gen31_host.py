"""The driver of Prophesee's boards reads a Gen 3.1: by function calls, over USB/IP, and through faults and pyusb."""

import numpy as np
import pytest

from evstim.testing.link_contract import event_stream
from firmware_protocol.events import EDGE, EVENT, EdgeKind
from firmware_protocol.gen31.device import BOARDS, Gen31, Gen31Settings
from transports.faults.faulty_device import FaultyDevice
from transports.faults.script import FaultPlan
from transports.faults.usb import ShortTransfers, UsbSilence
from transports.usb.cameras import driver_of
from transports.usb.host import StreamSettings
from transports.usb.loopback import DirectHost
from transports.usb.pyusb_host import PyusbHost
from transports.usb.usbip.client import UsbipHost


def camera_of(name="silkyevcam_vga"):
    return Gen31(Gen31Settings(serial="c0ffee", start_delay_us=0, board=BOARDS[name]))


def received(host, count):
    parts = [np.zeros(0, EVENT)]
    while sum(map(len, parts)) < count:
        parts.append(host.read(120))
        assert parts[-1] is not None
    return np.concatenate(parts)


@pytest.mark.parametrize(("name", "title"), [("silkyevcam_vga", "SilkyEvCam VGA"), ("evk3_vga", "EVK3 VGA")])
def test_it_reports_the_identity(name, title):
    host = driver_of(DirectHost(camera_of(name)))
    assert (host.model, host.info.serial, host.info.release) == (title, "00C0FFEE", 0x030900)
    assert (host.info.name, host.info.size) == ("CCam5 FPGA Event-Based Camera", (640, 480))


def test_events_and_edges_arrive_and_edges_only_where_they_are_wanted():
    edges = np.zeros(1, EDGE)
    edges["t"], edges["kind"] = 700, EdgeKind.RISING
    camera = camera_of()
    host = driver_of(DirectHost(camera))
    camera.advance(500)
    for wanted, ignored in ((True, 0), (False, 1)):
        host.start(StreamSettings(edges=wanted))
        sent = event_stream(2000, camera.now_us, (640, 480))
        camera.offer_edges(edges)
        camera.offer(sent)
        seen = received(host, len(sent))
        seen["t"] += np.uint64(camera.epoch_us)
        assert np.array_equal(seen, sent)
        assert len(host.take_edges()) == wanted
        assert camera.counters.edges.ignored == ignored
        assert len(host.stop()) == 0
    host.close()
    assert not camera.streaming


@pytest.mark.socket
def test_every_event_arrives_over_usbip(bench):
    camera = camera_of()
    bench.start({"1-1": camera})
    host = driver_of(UsbipHost.attach(port=bench.server.port, timeout_s=120))
    host.start(StreamSettings(transfers=4))
    events = event_stream(20_000, 0, (640, 480))
    bench.call(lambda: (camera.offer(events), bench.server.pump()))
    assert np.array_equal(received(host, len(events)), events)
    host.close()
    assert camera.counters.delivered == len(events)


def test_every_event_arrives_through_faults_and_pyusb(usb_bus):
    camera = camera_of()
    device = FaultyDevice(camera, FaultPlan("usb"))
    bus = usb_bus(device, camera.settings.descriptors())
    host = driver_of(PyusbHost.find(0x31F7, 0x0002, backend=bus))
    device.inject(UsbSilence(for_s=0.5, endpoint=1))
    device.inject(ShortTransfers(for_s=10.0, most_bytes=20))
    host.start()
    events = event_stream(500, 0, (640, 480))
    bus.call(camera.offer, events)
    assert host.read(0.0) is None
    bus.call(device.advance, 500_000)
    assert np.array_equal(received(host, len(events)), events)
    host.close()
    assert camera.counters.delivered == len(events)

"""The driver of Prophesee's boards: by function calls, over USB/IP, and through faults and pyusb, with each sensor."""

import dataclasses
import struct
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from evstim.testing.link_contract import event_stream
from firmware_protocol.events import EVENT, EdgeKind, make_edges
from firmware_protocol.gen31.device import BOARDS, Gen31, Gen31Settings
from firmware_protocol.genx320.device import Genx320, Genx320Settings
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.prophesee.treuzell import Frame, Property
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity
from transports.faults.faulty_device import FaultyDevice
from transports.faults.script import FaultPlan
from transports.faults.usb import ShortTransfers, UsbSilence
from transports.usb.cameras import driver_of, first_on_the_bus
from transports.usb.host import DeviceAbsent, PeerBroken, StallError, StreamSettings, TransferTimeout, UnsuitableDevice
from transports.usb.loopback import DirectHost
from transports.usb.pyusb_host import PyusbHost
from transports.usb.treuzell_host import TreuzellHost
from transports.usb.usbip.client import UsbipHost

USUAL = {"serial": "c0ffee", "start_delay_us": 0}
SETTINGS = Evk4Settings(**USUAL)
CAMERAS = {
    "EVK4": lambda: Evk4(SETTINGS),
    "EVK3 GenX320": lambda: Genx320(Genx320Settings(**USUAL)),
    "SilkyEvCam VGA": lambda: Gen31(Gen31Settings(**USUAL, board=BOARDS["silkyevcam_vga"])),
    "EVK3 VGA": lambda: Gen31(Gen31Settings(**USUAL, board=BOARDS["evk3_vga"])),
}
NAMES = {"EVK4": ("CCam5 Imx636 Event-Based Camera", "psee,ccam5_imx636"), "EVK3 GenX320": (None, "psee,cx3_genx320")}
FPGA = "CCam5 FPGA Event-Based Camera", "psee,ccam5_fpga"


@pytest.fixture
def camera():
    return Evk4(SETTINGS)


@pytest.fixture(params=CAMERAS)
def each(request):
    return CAMERAS[request.param]()


def events_of(camera, count, start_us=0):
    return event_stream(count, start_us, camera.settings.size)


def received(host, count):
    parts = [np.zeros(0, EVENT)]
    while sum(map(len, parts)) < count:
        parts.append(host.read(120))
        assert parts[-1] is not None
    return np.concatenate(parts)


@pytest.mark.parametrize("model", CAMERAS)
def test_it_reports_the_identity(model):
    camera = CAMERAS[model]()
    host = driver_of(DirectHost(camera))
    info, (name, compatible) = host.info, NAMES.get(model, FPGA)
    assert model in host.model.split(" or ")
    assert (info.serial, info.release, info.size) == ("00C0FFEE", 0x030900, camera.settings.size)
    assert (name in (None, info.name), info.compatible[0]) == (True, compatible)


def test_events_and_edges_arrive_and_edges_only_where_they_are_wanted(each):
    edges = make_edges(700, EdgeKind.RISING)
    host = driver_of(DirectHost(each))
    each.advance(500)
    for wanted, ignored in ((True, 0), (False, 1)):
        host.start(StreamSettings(edges=wanted))
        sent = events_of(each, 2000, each.now_us)
        each.offer_edges(edges)
        each.offer(sent)
        seen = received(host, len(sent))
        seen["t"] += np.uint64(each.epoch_us)
        assert np.array_equal(seen, sent)
        assert len(host.take_edges()) == wanted
        assert each.counters.edges.ignored == ignored
        assert len(host.stop()) == 0
    host.close()
    assert not each.streaming


@pytest.mark.socket
def test_every_event_arrives_over_usbip(each, bench):
    bench.start({"1-1": each})
    host = driver_of(UsbipHost.attach(port=bench.server.port, timeout_s=120))
    host.start(StreamSettings(transfers=4))
    events = events_of(each, 20_000)
    bench.call(lambda: (each.offer(events), bench.server.pump()))
    assert np.array_equal(received(host, len(events)), events)
    host.close()
    assert each.counters.delivered == len(events)


def test_every_event_arrives_through_faults_and_pyusb(each, usb_bus):
    device = FaultyDevice(each, FaultPlan("usb"))
    bus = usb_bus(device, each.settings.descriptors())
    host = driver_of(PyusbHost.find(each.identity.vendor_id, each.identity.product_id, backend=bus))
    device.inject(UsbSilence(for_s=0.5, endpoint=1))
    device.inject(ShortTransfers(for_s=10.0, most_bytes=20))
    host.start()
    events = events_of(each, 500)
    bus.call(each.offer, events)
    assert host.read(0.0) is None
    bus.call(device.advance, 500_000)
    assert np.array_equal(received(host, len(events)), events)
    host.close()
    assert each.counters.delivered == len(events)


def test_an_endpoint_that_is_none_stalls_on_the_bus(camera, usb_bus):
    host = PyusbHost.find(0x04B4, 0x00F5, backend=usb_bus(camera, SETTINGS.descriptors()))
    host.configure()
    for _ in range(64):
        host.bulk_out(2, bytes(8))
    with pytest.raises(StallError):
        host.bulk_out(2, bytes(8))
    host.close()


@pytest.mark.parametrize("there", [(0x04B4, 0x00F5), (0x152A, 0x8419), (0x1209, 0xA001)])
def test_the_bus_is_searched_for_each_camera_and_for_those_with_an_installed_driver(monkeypatch, there):
    def find(vendor, product):
        if (vendor, product) != there:
            raise DeviceAbsent("none here")
        return vendor, product

    points = [EntryPoint(name, "mine:Host", "evstim.usb_drivers") for name in ("no numbers", "1209:a001")]
    monkeypatch.setattr("transports.usb.cameras.entry_points", lambda group: points)
    monkeypatch.setattr(PyusbHost, "find", find)
    assert first_on_the_bus() == there


@pytest.mark.socket
def test_an_endpoint_that_is_none_stalls_over_usbip(camera, bench):
    bench.start({"1-1": camera})
    host = UsbipHost.attach(port=bench.server.port, timeout_s=120)
    host.configure()
    with pytest.raises(StallError):
        host.bulk_out(5, bytes(8))
    host.bulk_out(2, struct.pack("<II", 0x72, 0))
    assert len(host.bulk_in(2, 1024)) == 16
    host.close()


def test_a_request_that_fails_is_told(camera):
    host = TreuzellHost(DirectHost(camera))
    with pytest.raises(PeerBroken, match="READ_REGISTERS failed"):
        host.read_register(0x10_0000)
    assert host.request(Property.DEVICES) == struct.pack("<I", 1)


def test_a_camera_that_knows_no_property_is_told():
    class Ignorant(Evk4):
        def write(self, endpoint, data):
            super().write(endpoint, bytes(Frame(0x99)))

    with pytest.raises(PeerBroken, match="RELEASE is not known"):
        TreuzellHost(DirectHost(Ignorant(SETTINGS)))


def test_a_camera_that_says_nothing_times_out(camera):
    host = DirectHost(camera)
    host.configure()
    with pytest.raises(TransferTimeout):
        host.bulk_in(2, 1024)


def test_the_driver_of_another_package_is_an_entry_point(monkeypatch):
    class Other(Evk4):
        identity = Identity(0x1234, 0x5678, 0, Speed.SUPER)

    def installed(group, name):
        return [EntryPoint(name, "transports.usb.davis_host:DavisHost", group)] if name == "1234:5678" else []

    monkeypatch.setattr("transports.usb.cameras.entry_points", installed)
    with pytest.raises(UnsuitableDevice, match="1234:5678 is not a DAVIS"):
        driver_of(DirectHost(Other(SETTINGS)))


def test_old_firmware_and_other_devices_are_refused():
    with pytest.raises(UnsuitableDevice, match="030701"):
        TreuzellHost(DirectHost(Evk4(dataclasses.replace(SETTINGS, release=0x030701))))

    class Other(Evk4):
        identity = Identity(0x1234, 0x5678, 0, Speed.SUPER)

    with pytest.raises(UnsuitableDevice, match="1234:5678"):
        driver_of(DirectHost(Other(SETTINGS)))
    with pytest.raises(UnsuitableDevice, match="not an EVK4"):
        TreuzellHost(DirectHost(Other(SETTINGS)))

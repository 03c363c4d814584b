"""The driver of the EVK4 on a cable that is a function call, and over USB/IP: every event comes as it was sent."""

import dataclasses
import struct
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from firmware_protocol.events import EVENT
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.prophesee.treuzell import Frame, Property
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity
from transports.faults.faulty_device import FaultyDevice
from transports.faults.script import FaultPlan
from transports.faults.usb import UsbSilence
from transports.usb.cameras import driver_of, first_on_the_bus
from transports.usb.host import DeviceAbsent, PeerBroken, StallError, StreamSettings, TransferTimeout, UnsuitableDevice
from transports.usb.loopback import DirectHost
from transports.usb.pyusb_host import PyusbHost
from transports.usb.treuzell_host import TreuzellHost
from transports.usb.usbip.client import UsbipHost

SETTINGS = Evk4Settings(serial="c0ffee", start_delay_us=0)


def random_events(count, seed=1):
    rng = np.random.default_rng(seed)
    events = np.zeros(count, EVENT)
    events["t"] = np.sort(rng.integers(0, 20_000_000, count))
    events["x"], events["y"] = rng.integers(0, 1280, count), rng.integers(0, 720, count)
    events["on"] = rng.integers(0, 2, count)
    return events


def all_of(host):
    parts = [np.zeros(0, EVENT)]
    while (events := host.read(0.2)) is not None:
        parts.append(events)
    return np.concatenate(parts)


@pytest.fixture
def camera():
    return Evk4(SETTINGS)


@pytest.fixture
def served_camera(bench, camera):
    """A USB/IP server with the camera at 1-1."""
    bench.start({"1-1": camera})
    return bench


def test_it_tells_who_the_camera_is(camera):
    info = driver_of(DirectHost(camera)).info
    assert (info.serial, info.release, info.size) == ("00C0FFEE", 0x030900, (1280, 720))
    assert (info.name, info.compatible[0]) == ("CCam5 Imx636 Event-Based Camera", "psee,ccam5_imx636")


def test_every_event_arrives(camera):
    host = TreuzellHost(DirectHost(camera))
    camera.advance(500)
    host.start()
    events = random_events(20_000)
    events["t"] += np.uint64(500)
    camera.offer(events)
    seen = all_of(host)
    seen["t"] += np.uint64(500)
    assert np.array_equal(seen, events)
    assert len(host.stop()) == 0
    host.close()
    assert not camera.streaming


@pytest.mark.socket
def test_every_event_arrives_over_usbip(camera, served_camera):
    host = TreuzellHost(UsbipHost.attach(port=served_camera.server.port, timeout_s=120))
    host.start(StreamSettings(transfers=4))
    events = random_events(20_000)
    served_camera.call(lambda: (camera.offer(events), served_camera.server.pump()))
    parts, count = [], 0
    while count < len(events):
        part = host.read(120)
        assert part is not None
        parts.append(part)
        count += len(part)
    host.close()
    assert np.array_equal(np.concatenate(parts), events)
    assert camera.counters.delivered == len(events)


@pytest.mark.socket
def test_every_event_arrives_through_faults_and_pyusb(camera, usb_bus):
    device = FaultyDevice(camera, FaultPlan("usb"))
    bus = usb_bus(device, SETTINGS.descriptors())
    host = driver_of(PyusbHost.find(0x04B4, 0x00F5, backend=bus))
    device.inject(UsbSilence(for_s=0.5, endpoint=1))
    host.start()
    events = random_events(5000)
    bus.call(camera.offer, events)
    assert host.read(0.0) is None
    bus.call(device.advance, 500_000)
    parts, count = [], 0
    while count < len(events):
        parts.append(host.read(120))
        count += len(parts[-1])
    host.close()
    assert np.array_equal(np.concatenate(parts), events)


def test_an_endpoint_that_is_none_stalls_on_the_bus(camera, usb_bus):
    host = PyusbHost.find(0x04B4, 0x00F5, backend=usb_bus(camera, SETTINGS.descriptors()))
    host.configure()
    for _ in range(64):
        host.bulk_out(2, bytes(8))
    with pytest.raises(StallError):
        host.bulk_out(2, bytes(8))
    host.close()


def test_the_bus_is_searched_for_each_camera(monkeypatch):
    def find(vendor, product):
        if vendor == 0x152A:
            raise DeviceAbsent("none here")
        return vendor, product

    monkeypatch.setattr(PyusbHost, "find", find)
    assert first_on_the_bus() == (0x04B4, 0x00F5)


def test_the_bus_is_searched_for_cameras_with_an_installed_driver(monkeypatch):
    def find(vendor, product):
        if (vendor, product) != (0x1209, 0xA001):
            raise DeviceAbsent("none here")
        return vendor, product

    points = [EntryPoint(name, "mine:Host", "evstim.usb_drivers") for name in ("no numbers", "1209:a001")]
    monkeypatch.setattr("transports.usb.cameras.entry_points", lambda group: points)
    monkeypatch.setattr(PyusbHost, "find", find)
    assert first_on_the_bus() == (0x1209, 0xA001)


@pytest.mark.socket
def test_an_endpoint_that_is_none_stalls_over_usbip(served_camera):
    host = UsbipHost.attach(port=served_camera.server.port, timeout_s=120)
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

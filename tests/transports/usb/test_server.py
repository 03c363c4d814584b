"""The server as a well-behaved host sees it: our own host in user space, and one written by others."""

from __future__ import annotations

import pytest
import usbip as other

from firmware_protocol.usb.device import SetupPacket
from tests.transports.usb.raw_host import list_devices
from transports.usb.host import DeviceBusy
from transports.usb.usbip.client import UsbipHost

pytestmark = pytest.mark.socket

GET_DEVICE = SetupPacket(0x80, 0x06, 0x0100, 0, 18)
GET_REGISTER = SetupPacket(0xC0, 0xBF, 6, 0, 4)
SET_REGISTER = SetupPacket(0x40, 0xBF, 6, 0, 4)


@pytest.fixture(params=["tcp", "socketpair"])
def host(request, served):
    sock = served.connect() if request.param == "tcp" else served.pair()
    with UsbipHost(sock, "1-1", timeout_s=120) as host:
        yield host


def test_lists_every_device(bench, new_device):
    bench.start({"1-1": new_device(), "2-3": new_device()})
    records = list_devices(bench.server.port)
    assert [(r.busid, r.busnum, r.devnum) for r in records] == [("1-1", 1, 2), ("2-3", 2, 4)]
    assert records[0].identity == new_device().identity


def test_attach_powers_the_device_and_detach_tells_it(served, device):
    for cycle in range(1, 4):
        host = UsbipHost.attach(port=served.server.port, timeout_s=120)
        device.wait_for("attached", cycle)
        assert list(served.server.attached) == ["1-1"]
        host.close()
        device.wait_for("detached", cycle)
    assert device.log == ["attached", "detached"] * 3


def test_control_out_reaches_the_device_whole_or_short(host, device):
    assert host.control_out(SET_REGISTER, b"\1\2\3\4") == 4
    assert host.control_in(GET_REGISTER) == b"\1\2\3\4"
    assert host.control_out(SET_REGISTER, b"\1\2") == 2
    assert device.register == b"\1\2"


def test_urbs_are_answered_in_order_one_read_each(host, served, device):
    stream = host.stream(2, 4, 3)
    served.feed(device, b"1", b"22", b"333", b"4444+", b"6")
    assert [stream.read(120) for _ in range(6)] == [b"1", b"22", b"333", b"4444", b"+", b"6"]
    assert stream.read(0) is None


def test_close_takes_back_what_is_pending_and_loses_no_data(served, device):
    with UsbipHost(served.connect(), "1-1", timeout_s=120) as host:
        stream = host.stream(2, 8192, 32)
        stream.close()
        served.feed(device, b"later")
        assert host.control_in(GET_DEVICE)
        assert device.given == []
        assert host.stream(2, 8192, 32).read(120) == b"later"


def test_second_import_is_refused_as_busy_until_the_first_host_leaves(served, device):
    first = UsbipHost(served.connect(), "1-1", timeout_s=120)
    with pytest.raises(DeviceBusy):
        UsbipHost(served.connect(), "1-1", timeout_s=120)
    assert first.control_in(GET_DEVICE)
    first.close()
    device.wait_for("detached")
    with UsbipHost(served.connect(), "1-1", timeout_s=120) as second:
        assert second.control_in(GET_DEVICE)


def test_an_independent_host_lists_imports_and_reads(served, device):
    wire = other.transport.USBIP("127.0.0.1", served.server.port)
    (listed,) = other.host.list_devices(wire)
    assert (listed["busid"], listed["idVendor"], listed["speed"]) == ("1-1", 0x152A, 5)
    assert listed["interfaces"] == [(0xFF, 0, 0)]
    served.feed(device, b"from the camera")
    with other.open(0x152A, 0x841A, transport=wire) as handle:
        assert handle.device_descriptor.idProduct == 0x841A
        assert handle.control(0x40, 0xBF, 6, 0, b"\0\0\0\x12") == 4
        assert handle.control(0xC0, 0xBF, 6, 0, 4) == b"\0\0\0\x12"
        assert handle.bulk_in(0x82, 512) == b"from the camera"
        with pytest.raises(other.Stall):
            handle.control(0xC0, 0x77, 0, 0, 4)
    device.wait_for("detached")

"""Chapter 9 requests against a device at each speed."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.davis346.device import Davis346Settings
from firmware_protocol.usb.control import StandardControl
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import SetupPacket, Stall


class Device:
    """Speaks to a StandardControl with the fields of a setup packet."""

    def __init__(self, speed=Speed.SUPER, configured=True):
        self.control = StandardControl(Davis346Settings(speed=speed).descriptors())
        if configured:
            self(0x00, 9, 1)

    def __call__(self, kind, request, value=0, index=0, length=0, data=b""):
        return self.control.control(SetupPacket(kind, request, value, index, length), data)

    def stalls(self, *args, **kwargs):
        with pytest.raises(Stall):
            self(*args, **kwargs)


@pytest.mark.parametrize("speed", [Speed.SUPER, Speed.HIGH])
def test_what_the_kernel_and_libusb_ask_for_at_enumeration(speed):
    device = Device(speed, configured=False)
    assert len(device(0x80, 6, 0x0100, 0, 8)) == 8
    assert len(device(0x80, 6, 0x0100, 0, 18)) == 18
    assert device(0x80, 6, 0x0F00, 0, 5)[2:4] == b"\x16\0"
    assert len(device(0x80, 6, 0x0F00, 0, 22)) == 22
    head = device(0x80, 6, 0x0200, 0, 9)
    assert len(device(0x80, 6, 0x0200, 0, int.from_bytes(head[2:4], "little"))) == head[2] == (44 if speed == 5 else 32)
    assert device(0x80, 6, 0x0300, 0, 255) == b"\x04\x03\x09\x04"
    assert [device(0x80, 6, 0x0300 | k, 0x0409, 255)[1] for k in (1, 2, 3)] == [3, 3, 3]
    if speed is Speed.SUPER:
        assert device(0x00, 0x31, 40) == b""
        assert device(0x00, 0x30, 0, 0, 6, bytes(6)) == b""
    assert device(0x00, 9, 1) == b""
    device.stalls(0x80, 6, 0x0A00, 0, 4)
    assert device(0x80, 0, 0, 0, 2) == b"\0\0"


def test_configuration():
    device = Device(configured=False)
    assert device(0x80, 8, 0, 0, 1) == b"\0"
    assert not device.control.configured
    device.stalls(0x00, 9, 2)
    device(0x00, 9, 1)
    assert device(0x80, 8, 0, 0, 1) == b"\1"
    device(0x00, 9, 0)
    assert not device.control.configured


def test_interface_has_one_setting():
    device = Device()
    assert device(0x01, 11, 0, 0) == b""
    assert device(0x81, 10, 0, 0, 1) == b"\0"
    device.stalls(0x01, 11, 1, 0)
    device.stalls(0x01, 11, 0, 1)
    device.stalls(0x81, 10, 0, 1, 1)
    Device(configured=False).stalls(0x81, 10, 0, 0, 1)


def test_halt_is_set_seen_and_cleared():
    device = Device()
    device.control.require(0x82)
    device(0x02, 3, 0, 0x82)
    assert device(0x82, 0, 0, 0x82, 2) == b"\1\0"
    assert device(0x82, 0, 0, 0x81, 2) == b"\0\0"
    with pytest.raises(Stall):
        device.control.require(0x82)
    device(0x02, 1, 0, 0x82)
    device.control.require(0x82)
    assert device(0x82, 0, 0, 0x82, 2) == b"\0\0"


@pytest.mark.parametrize("clears", [(0x00, 9, 1, 0), (0x01, 11, 0, 0)])
def test_configuring_clears_halts(clears):
    device = Device()
    device(0x02, 3, 0, 0x82)
    device(*clears)
    device.control.require(0x82)


def test_endpoints_that_do_not_exist():
    device = Device()
    for index in (0x02, 0x83, 0x0182):
        device.stalls(0x02, 1, 0, index)
        device.stalls(0x82, 0, 0, index, 2)
        with pytest.raises(Stall):
            device.control.require(index)
    assert device(0x82, 0, 0, 0, 2) == b"\0\0"


def test_link_features_exist_at_super_speed_only():
    device = Device()
    device(0x00, 3, 48)
    device(0x00, 3, 49)
    assert device(0x80, 0, 0, 0, 2) == b"\x0c\0"
    device(0x00, 1, 48)
    assert device(0x80, 0, 0, 0, 2) == b"\x08\0"
    assert device(0x01, 3, 0, 0) == b""
    slow = Device(Speed.HIGH)
    for request in ((0x00, 3, 48), (0x01, 3, 0, 0), (0x00, 0x31, 40), (0x00, 0x30, 0, 0, 6, bytes(6))):
        slow.stalls(*request)


@pytest.mark.parametrize(
    "request_fields",
    [
        (0x00, 3, 1),
        (0x00, 3, 2),
        (0x00, 7, 0x0100, 0, 18, bytes(18)),
        (0x82, 12, 0, 0x82, 2),
        (0x00, 0x30, 0, 0, 6, bytes(5)),
        (0x01, 0x30, 0, 0, 6, bytes(6)),
        (0x00, 9, 1, 0, 1, b"\0"),
        (0x01, 9, 1),
        (0x81, 6, 0x0100, 0, 18),
        (0x81, 8, 0, 0, 1),
        (0x83, 0, 0, 0, 2),
        (0x80, 200, 0, 0, 2),
        (0x00, 200),
        (0x40, 9, 1),
        (0xA0, 6, 0x0100, 0, 18),
    ],
)
def test_unknown_and_malformed_requests_stall(request_fields):
    Device().stalls(*request_fields)


def test_an_address_is_acknowledged():
    assert Device()(0x00, 5, 17) == b""


def test_power_on_forgets_everything():
    device = Device()
    device(0x02, 3, 0, 0x82)
    device(0x00, 3, 48)
    device.control.power_on()
    assert not device.control.configured
    assert device(0x80, 0, 0, 0, 2) == b"\0\0"


@given(st.binary(min_size=8, max_size=8), st.binary(max_size=16))
def test_any_setup_packet_gets_a_reply_or_a_stall(raw, data):
    setup = SetupPacket.parse(raw)
    device = Device()
    try:
        reply = device.control.control(setup, data)
    except Stall:
        return
    assert len(reply) <= setup.length
    assert setup.is_in or reply == b""

"""What can go wrong on a real USB bus, and what the user is told."""

from __future__ import annotations

import errno

import pytest
import usb.core

from firmware_protocol.davis346.device import Davis346
from transports.usb.host import (
    AccessDenied,
    DeviceAbsent,
    DeviceBusy,
    LibraryMissing,
    PeerGone,
    TransferTimeout,
    UsbHostError,
)
from transports.usb.pyusb_host import PyusbHost


@pytest.fixture
def bus(usb_bus):
    camera = Davis346()
    return usb_bus(camera, camera.settings.descriptors())


@pytest.mark.parametrize(
    ("number", "error", "says"),
    [
        (errno.EACCES, AccessDenied, "udev"),
        (errno.EBUSY, DeviceBusy, "another program"),
        (errno.ENODEV, PeerGone, "went away"),
        (errno.ETIMEDOUT, TransferTimeout, "in time"),
        (errno.ENOMEM, UsbHostError, "fault"),
    ],
)
def test_faults_say_whose_they_are(bus, number, error, says):
    bus.break_with(number)
    with pytest.raises(error, match=says):
        PyusbHost.find(0x152A, 0x841A, bus).configure()


def test_absent_device(bus):
    with pytest.raises(DeviceAbsent, match="04b4:00f3"):
        PyusbHost.find(0x04B4, 0x00F3, bus)


def test_missing_libusb_names_the_package(monkeypatch):
    def find(**_):
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", find)
    with pytest.raises(LibraryMissing, match=r"apt-get install libusb-1\.0-0"):
        PyusbHost.find(0x152A, 0x841A)


def test_identity_comes_from_the_descriptor(bus):
    identity = PyusbHost.find(0x152A, 0x841A, bus).identity
    assert (identity.vendor_id, identity.product_id, identity.bcd_device) == (0x152A, 0x841A, 0x0206)


def test_device_that_goes_away_ends_the_stream(bus):
    host = PyusbHost.find(0x152A, 0x841A, bus)
    host.configure()
    reader = host.stream(2, 512, 4)
    bus.break_with(errno.ENODEV)
    with pytest.raises(PeerGone):
        reader.read(120)
    bus.break_with(None)
    host.close()


def test_a_slow_caller_holds_the_device_back_and_loses_nothing(usb_bus, device):
    bus = usb_bus(device, Davis346().settings.descriptors())
    device.chunks.extend(bytes([n]) for n in range(100))
    host = PyusbHost.find(0x152A, 0x841A, bus)
    host.configure()
    reader = host.stream(2, 512, 4)
    first = [reader.read(120) for _ in range(10)]
    rest = reader.close()
    assert first + rest == device.given
    assert len(rest) <= 6
    host.close()

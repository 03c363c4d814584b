"""Descriptor bytes against the layouts of chapter 9, read by a walker written for the test."""

import pytest

from firmware_protocol.davis346.device import Davis346Settings
from firmware_protocol.usb.descriptors import (
    BOS,
    Configuration,
    DescriptorSet,
    DescriptorType,
    DeviceDescriptor,
    Endpoint,
    Interface,
    Speed,
    TransferType,
    string_descriptor,
)


def davis(speed):
    return Davis346Settings(speed=speed).descriptors()


def test_device_descriptor_of_a_davis346_at_super_speed():
    expected = bytes.fromhex("12 01 0003 00 00 00 09 2a15 1a84 0602 01 02 03 01")
    assert davis(Speed.SUPER).find(DescriptorType.DEVICE, 0) == expected


@pytest.mark.parametrize("speed", [Speed.HIGH, Speed.FULL])
def test_device_descriptor_below_super_speed(speed):
    expected = bytes.fromhex("12 01 1002 00 00 00 40 2a15 1a84 0602 01 02 03 01")
    assert davis(speed).find(DescriptorType.DEVICE, 0) == expected


def test_configuration_at_super_speed():
    expected = bytes.fromhex(
        "09 02 2c00 01 01 00 80 32"
        "09 04 00 00 02 ff 00 00 00"
        "07 05 81 03 4000 04  06 30 00 00 4000"
        "07 05 82 02 0004 00  06 30 07 00 0000"
    )
    assert len(expected) == 44
    assert davis(Speed.SUPER).find(DescriptorType.CONFIGURATION, 0) == expected


@pytest.mark.parametrize(("speed", "bulk", "interval"), [(Speed.HIGH, "0002", "04"), (Speed.FULL, "4000", "01")])
def test_configuration_below_super_speed(speed, bulk, interval):
    expected = bytes.fromhex(
        f"09 02 2000 01 01 00 80 c8  09 04 00 00 02 ff 00 00 00  07 05 81 03 4000 {interval}  07 05 82 02 {bulk} 00"
    )
    assert davis(speed).find(DescriptorType.CONFIGURATION, 0) == expected


def test_bos_is_22_bytes():
    expected = bytes.fromhex("05 0f 1600 02  07 10 02 02000000  0a 10 03 00 0e00 03 00 0000")
    assert expected == BOS
    assert len(expected) == 22


def test_strings():
    found = davis(Speed.SUPER)
    assert found.find(DescriptorType.STRING, 0) == b"\x04\x03\x09\x04"
    assert found.find(DescriptorType.STRING, 3) == b"\x12\x03" + "00000346".encode("utf-16-le")
    assert found.find(DescriptorType.STRING, 4) is None


def test_qualifier_and_other_speed_exist_only_in_usb_2():
    for kind in (DescriptorType.DEVICE_QUALIFIER, DescriptorType.OTHER_SPEED_CONFIGURATION):
        assert davis(Speed.SUPER).find(kind, 0) is None
    found = davis(Speed.HIGH)
    assert found.find(DescriptorType.DEVICE_QUALIFIER, 0) == bytes.fromhex("0a 06 1002 00 00 00 40 01 00")
    other = found.find(DescriptorType.OTHER_SPEED_CONFIGURATION, 0)
    at_full_speed = davis(Speed.FULL).find(DescriptorType.CONFIGURATION, 0)
    assert other == at_full_speed[:1] + b"\x07" + at_full_speed[2:]


@pytest.mark.parametrize("kind", [0, DescriptorType.INTERFACE, DescriptorType.ENDPOINT, 0x0A, 0x29, 0xFF])
def test_what_cannot_be_asked_for_alone_is_not_found(kind):
    assert davis(Speed.HIGH).find(kind, 0) is None


def test_a_device_without_strings_or_bos():
    bare = DescriptorSet(
        DeviceDescriptor(Speed.HIGH, 1, 2, 3, strings=(0, 0, 0)), Configuration(Speed.HIGH, (Interface(()),)), bos=None
    )
    assert bare.find(DescriptorType.STRING, 0) is None
    assert bare.find(DescriptorType.BOS, 0) is None
    assert bare.find(DescriptorType.CONFIGURATION, 1) is None


def test_impossible_descriptors_are_refused():
    with pytest.raises(ValueError, match="max_packet 2048"):
        Endpoint(0x81, TransferType.BULK, 2048)
    with pytest.raises(ValueError, match="burst 16"):
        Endpoint(0x81, TransferType.BULK, 1024, burst=16)
    with pytest.raises(ValueError, match="LOW"):
        DeviceDescriptor(Speed.LOW, 1, 2, 3)
    with pytest.raises(ValueError, match="same speed"):
        DescriptorSet(DeviceDescriptor(Speed.HIGH, 1, 2, 3), Configuration(Speed.SUPER, ()))
    with pytest.raises(ValueError, match="126"):
        string_descriptor("x" * 127)
    assert len(string_descriptor("x" * 126)) == 254

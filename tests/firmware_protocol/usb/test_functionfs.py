"""The blocks of FunctionFS, byte for byte, against linux/usb/functionfs.h read by hand."""

import struct

import hypothesis
import pytest
from hypothesis import strategies as st

from firmware_protocol.davis346.device import Davis346Settings
from firmware_protocol.usb.descriptors import Endpoint, Interface, Speed, TransferType
from firmware_protocol.usb.device import SetupPacket
from firmware_protocol.usb.functionfs import NO_STRINGS, Event, EventKind, descriptor_block

SPEEDS = (Speed.FULL, Speed.HIGH, Speed.SUPER)


def interfaces(*endpoints):
    return dict.fromkeys(SPEEDS, Interface(endpoints))


def test_descriptors_of_one_bulk_endpoint():
    interface = bytes.fromhex("09 04 00 00 01 ff 00 00 00")
    bulk, companion = bytes.fromhex("07 05 81 02 40 00 00"), bytes.fromhex("06 30 07 00 00 00")
    body = 2 * (interface + bulk) + interface + bulk + companion
    head = struct.pack("<6I", 3, 24 + len(body), 1 | 2 | 4 | 64 | 128, 2, 2, 3)
    assert descriptor_block(interfaces(Endpoint(0x81, TransferType.BULK, 64, burst=7))) == head + body


def test_descriptors_of_a_davis346_have_the_length_that_they_tell():
    own = {speed: Davis346Settings(speed=speed).descriptors().configuration.interfaces[0] for speed in SPEEDS}
    block = descriptor_block(own)
    magic, length, _, *counts = struct.unpack_from("<6I", block)
    assert (magic, length, counts) == (3, len(block), [3, 3, 5])


def test_endpoints_must_be_the_same_at_all_speeds():
    own = interfaces(Endpoint(0x81, TransferType.BULK, 64)) | {Speed.FULL: Interface(())}
    with pytest.raises(ValueError, match="the same endpoints"):
        descriptor_block(own)


def test_strings():
    assert struct.pack("<4I", 2, 16, 0, 0) == NO_STRINGS


def test_an_event_of_the_kernel():
    setup = Event.parse(bytes.fromhex("c0 bf 0600 0100 0400 04 000000"))
    assert setup == Event(EventKind.SETUP, SetupPacket(0xC0, 0xBF, 6, 1, 4))
    assert Event.parse(bytes.fromhex("ffffffffffffffff 02 000000")) == Event(EventKind.ENABLE)


@pytest.mark.parametrize("data", [b"", bytes(11), bytes(13), bytes(8) + b"\7\0\0\0"])
def test_what_is_no_event_is_refused(data):
    with pytest.raises(ValueError, match=r"12 bytes|EventKind"):
        Event.parse(data)


@hypothesis.given(st.sampled_from(EventKind), st.binary(min_size=8, max_size=8))
def test_events_survive_their_bytes(kind, setup):
    event = Event(kind, SetupPacket.parse(setup) if kind is EventKind.SETUP else None)
    assert Event.parse(bytes(event)) == event

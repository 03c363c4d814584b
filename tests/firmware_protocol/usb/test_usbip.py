"""USB/IP messages: golden bytes, an independent implementation, any cut of the stream, and broken bytes."""

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from usbip import protocol as other

from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity
from firmware_protocol.usb.usbip import (
    DeviceListReply,
    DeviceListRequest,
    DeviceRecord,
    HostParser,
    ImportReply,
    ImportRequest,
    Limits,
    ServerParser,
    Submit,
    Submitted,
    Unlink,
    Unlinked,
    UsbipError,
)

DAVIS = Identity(0x152A, 0x841A, 0x0206, Speed.SUPER)
RECORD = DeviceRecord("1-1", 1, 2, DAVIS, "/sys/devices/evstim/usb1/1-1")

u8, u16, u32 = st.integers(0, 0xFF), st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF)
classes = st.tuples(u8, u8, u8)
identities = st.builds(Identity, u16, u16, u16, st.sampled_from(Speed), classes,
                       st.lists(classes, max_size=4).map(tuple), u8, u8)  # fmt: skip
names = st.text(st.characters(min_codepoint=0x21, max_codepoint=0x7E), min_size=1, max_size=31)
records = st.builds(DeviceRecord, names, u32, u32, identities, names)
in_urbs = st.builds(Submit, u32, u32, st.just(True), st.integers(0, 15), st.integers(0, 1 << 20),
                    st.binary(min_size=8, max_size=8), st.just(b""), u32, st.integers(0, 1 << 20))  # fmt: skip
out_urbs = st.builds(
    lambda urb, data: urb._replace(is_in=False, data=data, length=len(data)), in_urbs, st.binary(max_size=200)
)
unlinks = st.builds(Unlink, u32, u32, u32)


def parse(parser, data, cuts=()):
    """Feed data in pieces; gives all messages."""
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    messages = []
    for start, stop in itertools.pairwise(edges):
        parser.receive(data[start:stop])
        while (message := parser.next_message()) is not None:
            messages.append(message)
    return messages


def urb_parser(limits=None):
    parser = ServerParser(limits or Limits())
    parser.begin_urbs()
    return parser


def host_parser(*urbs):
    parser = HostParser()
    parser.begin_urbs()
    for urb in urbs:
        parser.expect(urb)
    return parser


def assert_parsed_or_refused(parser, data):
    """No other exception, and no more messages than the bytes can hold."""
    try:
        messages = parse(parser, data)
    except UsbipError:
        return
    assert sum(map(len, map(bytes, messages))) <= max(len(data), 48 * len(messages))


def test_golden_submit():
    setup = bytes.fromhex("8006000100001200")
    golden = bytes.fromhex(
        "00000001 00000d05 0001000f 00000001 00000000"  # command, seqnum, devid, direction, endpoint
        "00000200 00000012 00000000 00000000 00000000"  # flags, length, start frame, packets, interval
        "8006000100001200"
    )
    urb = Submit(0xD05, 0x1000F, True, 0, 18, setup, flags=0x200)
    assert bytes(urb) == golden
    assert parse(urb_parser(), golden) == [urb]


def test_golden_replies():
    submitted = bytes.fromhex("00000003 00000d06") + bytes(12) + struct.pack(">iiiii", 0, 4, 0, 0, 0) + bytes(8)
    assert bytes(Submitted(0xD06, 0, 4, b"\1\2\3\4")) == submitted + b"\1\2\3\4"
    unlinked = bytes.fromhex("00000004 00000d08") + bytes(12) + struct.pack(">i", -104) + bytes(24)
    assert bytes(Unlinked(0xD08, -104)) == unlinked


def test_golden_record_offsets():
    data = bytes(RECORD)
    assert len(data) == 312
    assert data[256:260] == b"1-1\0"
    assert struct.unpack_from(">IIIHHHBBBBBB", data, 288) == (1, 2, 5, 0x152A, 0x841A, 0x0206, 0, 0, 0, 1, 1, 1)
    assert RECORD.devid == 0x10002


@given(records)
def test_record_reads_the_same_in_an_independent_implementation(record):
    theirs = other.parse_usb_device(bytes(record))
    it = record.identity
    assert (theirs["busid"], theirs["busnum"], theirs["devnum"]) == (record.busid, record.busnum, record.devnum)
    assert (theirs["idVendor"], theirs["idProduct"]) == (it.vendor_id, it.product_id)


@given(st.lists(st.one_of(in_urbs, out_urbs, unlinks), max_size=6), st.lists(st.integers(0, 1000), max_size=6))
def test_requests_survive_any_cut(messages, cuts):
    assert parse(urb_parser(), b"".join(map(bytes, messages)), cuts) == messages


@given(st.one_of(st.just(DeviceListRequest()), st.builds(ImportRequest, names)), st.lists(st.integers(0, 50)))
def test_operations_survive_any_cut(request, cuts):
    assert parse(ServerParser(), bytes(request), cuts) == [request]


@given(st.lists(records, max_size=4).map(tuple), st.lists(st.integers(0, 1500), max_size=6))
def test_device_list_survives_any_cut(devices, cuts):
    reply = DeviceListReply(devices)
    assert parse(HostParser(), bytes(reply), cuts) == [reply]


def test_import_replies():
    (reply,) = parse(HostParser(), bytes(ImportReply(0, RECORD)), [7, 9, 300])
    assert reply.device.busid == "1-1"
    assert reply.device.identity.product_id == 0x841A
    assert parse(HostParser(), bytes(ImportReply(2))) == [ImportReply(2)]


@given(st.lists(st.binary(max_size=100), max_size=5), st.lists(st.integers(0, 800), max_size=6))
def test_urb_replies_survive_any_cut(chunks, cuts):
    replies = [Submitted(n, 0, len(chunk), chunk) for n, chunk in enumerate(chunks)] + [Unlinked(99, -104)]
    parser = host_parser(*(Submit(n, 0, True, 2, 100) for n in range(len(chunks))))
    assert parse(parser, b"".join(map(bytes, replies)), cuts) == replies


def test_reply_to_an_out_urb_carries_no_data():
    parser = host_parser(Submit(1, 0, False, 0, 4, data=b"1234"))
    assert parse(parser, Submitted(1, 0, 4).header + bytes(Unlinked(2, 0))) == [Submitted(1, 0, 4), Unlinked(2, 0)]


def test_messages_behind_an_import_wait_for_the_urb_phase():
    parser = ServerParser()
    parser.receive(bytes(ImportRequest("1-1")) + bytes(Unlink(2, 0, 1)))
    assert parser.next_message() == ImportRequest("1-1")
    parser.begin_urbs()
    assert parser.next_message() == Unlink(2, 0, 1)


@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_give_messages_or_a_usbip_error(data, urbs):
    for parser in (ServerParser(), HostParser()):
        if urbs:
            parser.begin_urbs()
        assert_parsed_or_refused(parser, data)


@given(st.one_of(in_urbs, out_urbs), st.integers(0, 47), u8)
def test_one_wrong_byte_gives_messages_or_a_usbip_error(urb, at, value):
    data = bytearray(bytes(urb))
    data[at] = value
    assert_parsed_or_refused(urb_parser(), bytes(data))


def broken_submit(offset, value):
    data = bytearray(bytes(Submit(1, 0, True, 2, 100)))
    data[offset : offset + 4] = struct.pack(">i", value)
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (broken_submit(0, 5), "unknown URB command 0x00000005"),
        (broken_submit(12, 2), "direction"),
        (broken_submit(16, 16), "endpoint numbers go from 0 to 15, got 16"),
        (broken_submit(24, -1), "cannot have -1 bytes"),
        (broken_submit(24, 1001), "1001 bytes is longer than the limit of 1000"),
        (broken_submit(32, 8), "isochronous"),
        (bytes(Submit(1, 0, False, 2, 101)), "101 bytes is longer than the limit of 100"),
    ],
)
def test_broken_urbs_say_what_is_wrong(data, says):
    with pytest.raises(UsbipError, match=says):
        parse(urb_parser(Limits(in_bytes=1000, out_bytes=100)), data)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (bytes.fromhex("0106 8005 00000000"), "version 0x0106"),
        (bytes.fromhex("0111 8007 00000000"), "unknown operation 0x8007"),
    ],
)
def test_broken_operations_say_what_is_wrong(data, says):
    with pytest.raises(UsbipError, match=says):
        parse(ServerParser(), data)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (bytes(Submitted(2, 0, 4, b"1234")), "URB 2, which is not pending"),
        (Submitted(1, 0, 101).header, "longer than the limit of 100"),
        (Submitted(1, 0, -5).header, "cannot have -5 bytes"),
        (struct.pack(">II", 7, 1) + bytes(40), "unknown URB answer 0x00000007"),
    ],
)
def test_broken_urb_replies_say_what_is_wrong(data, says):
    with pytest.raises(UsbipError, match=says):
        parse(host_parser(Submit(1, 0, True, 2, 100)), data)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (bytes.fromhex("0111 0005 00000000 00ffffff"), "longer than the limit"),
        (bytes.fromhex("0111 0005 00000001"), "refused"),
        (bytes.fromhex("0111 0009 00000000"), "unknown answer 0x0009"),
        (bytes.fromhex("0111 0003 00000000") + bytes(312), "makes no sense"),
    ],
)
def test_broken_operation_replies_say_what_is_wrong(data, says):
    with pytest.raises(UsbipError, match=says):
        parse(HostParser(), data)


@pytest.mark.parametrize("busid", ["", "x" * 32, "1-µ"])
def test_bus_ids_must_fit_their_field(busid):
    with pytest.raises(ValueError, match="31 ASCII"):
        DeviceRecord(busid, 1, 2, DAVIS)

"""The control protocol: golden requests and answers, and whatever else a host may send."""

import struct

import pytest
from evk4_requests import ANSWERS, REQUESTS, Host
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.prophesee.treuzell import Frame
from firmware_protocol.usb.device import SetupPacket, Stall


@pytest.fixture
def host():
    return Host(Evk4(Evk4Settings(serial="0badcafe")))


# Requests are those of neuromorphic_drivers 0.18.2 at its opening; answers as OpenEB 5.1.1 checks them.
@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("72000000 00000000", "72000000 08000000 fecaad0b 00000000"),
        ("79000000 00000000", "79000000 04000000 00090300"),
        ("7a000000 00000000", "7a000000 08000000 00f15365 00000000"),
        ("00000100 00000000", "00000100 04000000 01000000"),
        ("01000100 04000000 00000000", "01000100 24000000 00000000" + b"CCam5 Imx636 Event-Based Camera\0".hex()),
        ("03000100 04000000 00000000", "03000100 27000000 00000000" + b"psee,ccam5_imx636\0psee,ccam5_gen42\0".hex()),
        ("02010100 0c000000 00000000 10100000 01000000", "02010100 0c000000 00000000 10100000 6600a111"),
        ("02010140 0c000000 00000000 04000000 425400f0", "02010140 08000000 00000000 04000000"),
        ("02010100 0c000000 00000000 14000000 01000000", "02010100 0c000000 00000000 14000000 061840a0"),
    ],
    ids=["serial", "release", "build", "devices", "name", "compatible", "bias", "write", "chip"],
)
def test_golden_requests(host, request_, answer):
    assert host.ask(request_).replace(" ", "") == answer.replace(" ", "")


def test_several_registers_are_written_and_read_at_once(host):
    host.ask("02010140 14000000 00000000 00200000 01000000 02000000 03000000")
    assert host.ask("02010100 0c000000 00000000 00200000 03000000") == (
        "02010100 14000000 00000000 00200000 01000000 02000000 03000000"
    )


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("", "00000080 00000000"),
        ("72", "00000080 00000000"),
        ("72000000 04000000", "00000080 00000000"),  # tells of more than it has
        ("99000000 00000000", "00000080 00000000"),
        ("10000140 08000000 00000000 01000000", "00000080 00000000"),
        ("72000000 04000000 00000000", "72000080 00000000"),
        ("01000100 04000000 01000000", "01000180 04000000 01000000"),
        ("02010100 04000000 00000000", "02010180 0c000000 00000000 00000000 16000000"),
        ("02010100 0c000000 01000000 14000000 01000000", "02010180 0c000000 01000000 14000000 13000000"),
        ("02010100 0c000000 00000000 02000000 01000000", "02010180 0c000000 00000000 02000000 16000000"),
        ("02010100 0c000000 00000000 00000000 fd000000", "02010180 0c000000 00000000 00000000 16000000"),
        ("02010100 0c000000 00000000 00000000 00000000", "02010180 0c000000 00000000 00000000 16000000"),
        ("02010140 0c000000 00000000 00004100 01000000", "020101c0 0c000000 00000000 00004100 16000000"),
        ("02010140 0d000000 00000000 00200000 01000000 01", "020101c0 0c000000 00000000 00200000 16000000"),
    ],
)
def test_what_cannot_be_done_is_refused(host, request_, answer):
    assert host.ask(request_) == answer


def test_the_longest_answer_has_1024_bytes(host):
    assert len(bytes.fromhex(host.ask("02010100 0c000000 00000000 00000000 fc000000"))) == 1024


def test_an_answer_that_is_read_in_pieces_comes_whole(host):
    host.camera.write(REQUESTS, bytes.fromhex("72000000 00000000"))
    pieces = [host.camera.read(ANSWERS, 5).data for _ in range(4)]
    assert [len(piece) for piece in pieces] == [5, 5, 5, 1]
    assert host.camera.read(ANSWERS, 5) is None


def test_a_host_that_does_not_read_is_stalled(host):
    for _ in range(64):
        host.camera.write(REQUESTS, b"\x72" + bytes(7))
    with pytest.raises(Stall):
        host.camera.write(REQUESTS, b"\x72" + bytes(7))
    assert host.camera.read(ANSWERS, 1024) is not None
    host.camera.write(REQUESTS, b"\x72" + bytes(7))


def test_the_kind_of_board_is_told_on_endpoint_0(host):
    assert host.camera.control(SetupPacket(0xC0, 0x72, 0, 0, 2), b"") == b"\x31\x00"
    assert host.camera.control(SetupPacket(0xC0, 0x72, 0, 0, 1), b"") == b"\x31"
    for refused in (
        SetupPacket(0xC0, 0x73, 0, 0, 2),
        SetupPacket(0x40, 0x72, 0, 0, 0),
        SetupPacket(0xC1, 0x72, 0, 0, 2),
    ):
        with pytest.raises(Stall):
            host.camera.control(refused, b"")


def test_the_descriptors_are_those_that_openeb_checks(host):
    configuration = host.camera.control(SetupPacket(0x80, 6, 0x0200, 0, 255), b"")
    interface, endpoints = configuration[9:18], configuration[18:]
    assert interface[4:8] == bytes((3, 0xFF, 0x19, 0))
    assert [endpoints[k + 2] for k in (0, 13, 26)] == [0x82, 0x02, 0x81]
    assert [endpoints[k + 3] & 3 for k in (0, 13, 26)] == [2, 2, 2]
    device = host.camera.control(SetupPacket(0x80, 6, 0x0100, 0, 18), b"")
    assert device[8:18].hex(" ") == "b4 04 f5 00 09 03 01 02 00 01"
    strings = [host.camera.control(SetupPacket(0x80, 6, 0x0300 + k, 0x409, 74), b"") for k in (1, 2)]
    assert [text[2:].decode("utf-16-le") for text in strings] == ["Prophesee", "EVK4"]


@given(name=st.integers(0, 2**32 - 1), payload=st.binary(max_size=64))
def test_frames_come_back_as_they_went(name, payload):
    assert Frame.parse(bytes(Frame(name, payload))) == Frame(name, payload)


_NAMES = st.sampled_from([0x72, 0x79, 0x1_0000, 0x1_0001, 0x1_0003, 0x1_0102, 0x4001_0102, 0x4001_0010, 0xFFFF_FFFF])
_WORDS = st.one_of(
    st.sampled_from([0, 1, 4, 0x20, 0x34, 0x4C, 0x9008, 0x9028, 0x40_0004, 0xF000_5442, 0x645]),
    st.integers(0, 2**32 - 1),
)
_FRAMES = st.builds(
    lambda name, words, tail, lie: (
        struct.pack("<II", name, 4 * len(words) + len(tail) + lie) + struct.pack(f"<{len(words)}I", *words) + tail
    ),
    _NAMES,
    st.lists(_WORDS, max_size=8),
    st.binary(max_size=3),
    st.sampled_from([0, 0, 0, 1]),
)


@given(st.lists(st.one_of(_FRAMES, st.binary(max_size=40)), max_size=20))
def test_any_request_brings_one_answer_that_a_host_can_read(requests):
    camera = Evk4()
    host = Host(camera)
    for data in requests:
        answer = Frame.parse(bytes.fromhex(host.ask(data.hex())))
        asked = int.from_bytes(data[:4], "little")
        assert answer.property in (asked, asked | 0x8000_0000, 0x8000_0000)
        assert len(answer.payload) <= 1016
    assert camera.read(ANSWERS, 1024) is None
    assert camera.counters.offered == 0

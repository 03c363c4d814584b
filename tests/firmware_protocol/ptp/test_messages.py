"""Messages of the Precision Time Protocol: octets that ptp4l sent, and octets that nobody should send."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.ptp.messages import (
    Announce,
    DelayResponse,
    Flag,
    FollowUp,
    Header,
    MessageType,
    PortIdentity,
    Sync,
    clock_identity,
    delay_request,
    parse,
)
from tests.firmware_protocol.ptp_network import announce, delay_response, follow_up, sync

# Captured from ptp4l 3.1.1 (`ptp4l -4 -S`), the master of a veth pair.
SYNC = bytes.fromhex("0002002c00000200000000000000000000000000368699fffe3b5fd10001000100fd00000000000000000000")
FOLLOW_UP = bytes.fromhex("0802002c00000000000000000000000000000000368699fffe3b5fd10001000302fd00006b04772316b3949f")
ANNOUNCE = bytes.fromhex(
    "0b02004000000000000000000000000000000000368699fffe3b5fd10001000205fe"
    "0000000000000000000000250080f8feffff80368699fffe3b5fd10000a0"
)
MASTER = PortIdentity(0x368699FFFE3B5FD1, 1)


def test_octets_of_ptp4l():
    assert parse(SYNC) == Sync(Header(MessageType.SYNC, 0, MASTER, 1, Flag.TWO_STEP, 0, -3), 0)
    header = Header(MessageType.FOLLOW_UP, 0, MASTER, 3, 0, 0, -3)
    assert parse(FOLLOW_UP) == FollowUp(header, 1_795_454_755_380_867_743)
    quality = (128, 0xF8, 0xFE, 0xFFFF, 128)
    header = Header(MessageType.ANNOUNCE, 0, MASTER, 2, 0, 0, -2)
    assert parse(ANNOUNCE) == Announce(header, quality, MASTER.clock, 0, 37, 0xA0)


@pytest.mark.parametrize("octets", [SYNC, FOLLOW_UP, ANNOUNCE])
def test_packing_gives_the_octets_of_ptp4l(octets):
    message = parse(octets)
    assert {Sync: sync, FollowUp: follow_up, Announce: announce}[type(message)](message) == octets


def test_a_delay_request():
    data = delay_request(PortIdentity(0x1C0FAFFFFE123456, 1), 0x0102, 7)
    assert data.hex() == "0102002c0700" + "00" * 14 + "1c0faffffe123456" + "0001" + "0102" + "017f" + "00" * 10
    assert parse(data) is None  # no slave reads one


def test_the_identity_of_a_clock_is_its_mac_with_fffe_between():
    assert clock_identity(0x1C0FAF123456) == 0x1C0FAFFFFE123456


def test_a_correction_is_in_parts_of_a_nanosecond():
    header = Header(MessageType.SYNC, 0, MASTER, 1, 0, -5, 0)
    data = bytearray(sync(Sync(header, 12)))
    assert parse(bytes(data)).header.correction_ns == -5
    data[8:16] = (3 << 16 | 0x8000).to_bytes(8, "big")  # 3.5 ns
    assert parse(bytes(data)).header.correction_ns == 3


identities = st.builds(PortIdentity, st.integers(0, (1 << 64) - 1), st.integers(0, 0xFFFF))
times = st.integers(0, (1 << 33) * 10**9 - 1)


def _headers(kind):
    return st.builds(
        Header, st.just(kind), st.integers(0, 255), identities, st.integers(0, 0xFFFF), st.integers(0, 0xFFFF),
        st.integers(-(1 << 47), (1 << 47) - 1), st.integers(-128, 127),
    )  # fmt: skip


@given(st.builds(DelayResponse, _headers(MessageType.DELAY_RESP), times, identities))
def test_a_response_survives_packing(message):
    assert parse(delay_response(message)) == message


@given(st.builds(FollowUp, _headers(MessageType.FOLLOW_UP), times), st.binary(max_size=40))
def test_octets_after_a_message_are_ignored(message, more):
    assert parse(follow_up(message) + more) == message


@given(st.binary(max_size=80))
def test_any_octets_are_a_message_or_none(data):
    assert parse(data) is None or len(data) >= 44


@given(st.sampled_from([SYNC, FOLLOW_UP, ANNOUNCE]), st.integers(0, 63))
def test_a_message_cut_short_is_none(octets, length):
    assert parse(octets[: min(length, len(octets) - 1)]) is None


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (0, 0x10), (0, 0x18), (0, 0x02), (0, 0x0C), (0, 0x0D), (1, 1), (1, 3), (3, 0), (3, 255), (5, 1),
        (34, 1), (35, 2), (40, 0x3C),
    ],
)  # fmt: skip
def test_what_no_slave_reads(place, value):
    """Another standard, type, version or length; a time beyond the year 2242, or with over 10^9 ns."""
    data = bytearray(FOLLOW_UP)
    data[place] = value
    assert parse(bytes(data)) is None

"""Telecommands and what is answered: golden octets, round trips, refusals, spacepackets as the oracle of service 1."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from packet_strategies import TELECOMMANDS, VERIFICATIONS
from spacepackets.ecss.fields import PacketFieldEnum
from spacepackets.ecss.pus_1_verification import FailureNotice, MessageSubtype, VerificationParams
from spacepackets.ecss.pus_1_verification import RequestId as OracleRequest
from spacepackets.ecss.tc import PusTc

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.ccsds import TcPacket
from firmware_protocol.packets.telecommands import TELECOMMANDS as KINDS
from firmware_protocol.packets.telecommands import (
    CommandRefused,
    Failure,
    FailureCode,
    Ping,
    RequestHousekeeping,
    RequestId,
    SetBias,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Stage,
    Start,
    Stop,
    Verification,
    parse_telecommand,
)


@pytest.mark.parametrize(
    ("command", "type_", "data"),
    [
        (Ping(), (17, 1), ""),
        (RequestHousekeeping(), (3, 27), "01 01"),
        (SetTime(1_500_000), (9, 128), "00 00 00 01 80 00 00"),
        (Start(), (128, 1), ""),
        (Stop(), (128, 2), ""),
        (SetTick(1000), (128, 3), "03 e8"),
        (SetRegion(1, 2, 300, 200), (128, 4), "00 01 00 02 01 2c 00 c8"),
        (SetRateLimit(250_000), (128, 5), "00 03 d0 90"),
        (SetBias(12, 0x5B4F), (128, 6), "0c 5b 4f"),
    ],
)
def test_golden_octets(command, type_, data):
    assert type_ == command.TYPE
    assert command.encode() == bytes.fromhex(data)
    assert parse_telecommand(*type_, bytes.fromhex(data)) == command


@given(TELECOMMANDS)
def test_telecommands_round_trip(command):
    assert parse_telecommand(*command.TYPE, command.encode()) == command


@pytest.mark.parametrize(
    ("service", "subtype", "data", "code", "text"),
    [
        (5, 1, "", FailureCode.ILLEGAL_SERVICE, "no service 5"),
        (17, 2, "", FailureCode.ILLEGAL_SUBTYPE, "service 17 has no subtype 2"),
        (17, 1, "00", FailureCode.LENGTH, "Ping: 1 octets"),
        (128, 4, "00 00", FailureCode.LENGTH, "SetRegion: 2 octets"),
        (128, 3, "00 05", FailureCode.ILLEGAL_DATA, "tick 5 us"),
        (128, 4, "00 00 00 00 00 00 00 01", FailureCode.ILLEGAL_DATA, "width 0"),
        (3, 27, "01 02", FailureCode.ILLEGAL_DATA, "structure"),
        (3, 27, "02 01", FailureCode.ILLEGAL_DATA, "structure"),
        (9, 128, "00", FailureCode.LENGTH, "SetTime: 1 octets"),
    ],
)
def test_unknown_and_malformed_telecommands_are_refused_with_a_reason(service, subtype, data, code, text):
    with pytest.raises(CommandRefused, match=text) as refused:
        parse_telecommand(service, subtype, bytes.fromhex(data))
    assert refused.value.failure.code is code
    assert text in refused.value.failure.text


@given(st.sampled_from([*KINDS, (1, 1), (128, 99)]), st.binary(max_size=12))
@example((9, 128), bytes.fromhex("00 00 00 00 00 00 01"))
@example((9, 128), b"\xff" * 7)
def test_hostile_data_is_refused_or_means_something(type_, data):
    try:
        command = parse_telecommand(*type_, data)
    except CommandRefused:
        return
    # A time between two microseconds goes to the nearer one; all else is written back as it came.
    assert parse_telecommand(*type_, command.encode()) == command
    assert type_ == SetTime.TYPE or command.encode() == data


@pytest.mark.parametrize(
    "make",
    [
        lambda: SetTick(2),
        lambda: SetRegion(0, 0, 0, 1),
        lambda: SetRegion(-1, 0, 1, 1),
        lambda: SetRateLimit(2**32),
        lambda: SetBias(256, 0),
        lambda: SetTime(-1),
    ],
)
def test_values_out_of_range_are_refused_where_they_are_made(make):
    with pytest.raises(ValueError, match=r"is not in|is none of|does not fit"):
        make()


@given(VERIFICATIONS)
def test_verifications_round_trip(verification):
    assert Verification.parse(verification.encode()) == verification


@pytest.mark.parametrize("stage", Stage)
@pytest.mark.parametrize("failed", [False, True])
def test_verifications_are_what_spacepackets_writes(stage, failed):
    packet = bytes(TcPacket(0x2A0, 77, 128, 1, b""))
    failure = Failure(FailureCode.NOT_NOW, "stopped") if failed else None
    verification = Verification(stage, RequestId.parse(packet[:4]), failure)
    notice = FailureNotice(PacketFieldEnum.with_byte_size(2, FailureCode.NOT_NOW), b"stopped") if failed else None
    oracle = VerificationParams(OracleRequest.from_pus_tc(PusTc.unpack(packet)), failure_notice=notice)
    subtype = MessageSubtype(verification.subtype)
    oracle.verify_against_message_subtype(subtype)
    assert verification.encode() == bytes([subtype]) + bytes(oracle.pack())
    assert subtype.name == f"TM_{stage.name}_{'FAILURE' if failed else 'SUCCESS'}"


@pytest.mark.parametrize(
    "octets", ["", "05 1a a0 c0 00", "01 1a a0 c0", "01 1a a0 c0 00 00", "02 1a a0 c0 00 00", "02 1a a0 c0 00 00 63"]
)
def test_malformed_verifications_are_refused(octets):
    with pytest.raises(PacketError):
        Verification.parse(bytes.fromhex(octets))


def test_long_reasons_are_cut_and_strange_letters_replaced():
    failure = Failure(FailureCode.ILLEGAL_DATA, "µ" + "x" * 100)
    assert Verification(Stage.ACCEPTANCE, RequestId(0, 0), failure).encode()[7:] == b"?" + b"x" * 79
